"""Near sources anywhere in the frame, clipped up to fifty times: none is lost, and their sigmas hold."""

import math
from dataclasses import replace

import numpy as np
import pytest

import perception
from nir_render.camera.sensor.well import bloom_into
from tests.unit.perception.simulation import calibration, expected_e, expose, random


@pytest.mark.parametrize("frames", [4, pytest.param(60, marks=pytest.mark.verify)])
def test_balls_are_found_and_ranged_however_clipped(frames: int) -> None:
    """24 balls of 1.2 to 25 px a frame, at 0.45 to 4 m, up to 50° off the axis, of 5 % to fifty times full scale.

    Expected: all are told, none is that is not there, no σ is missing, and pulls of place and range have a root
    mean square of 1 (within 3 of its own σ) and none exceeds 5. Off the axis a disc is an oval whose shape goes
    by its place and size: where it was laid out for the first guess of them, pulls of range reached 17, and
    one in twelve of those clipped and larger than 12 px was lost, with only its flux as a first guess of its size.
    """
    camera, pulls = calibration(), []
    for frame in range(frames):
        generator = random(77, frame)
        exposure_s = float(10.0 ** generator.uniform(-4.3, -1.3))
        drawn = []
        for k in range(24):
            u = 100.0 + 200.0 * (k % 6) + generator.uniform(-25.0, 25.0)
            v = 110.0 + 240.0 * (k // 6) + generator.uniform(-25.0, 25.0)
            drawn.append((u, v, float(np.exp(generator.uniform(math.log(0.45), math.log(4.0))))))
        image_e = expected_e(camera, drawn, exposure_s) + 20.0
        found = perception.detect(expose(image_e, camera, random(78, frame), exposure_s), camera)
        assert len(found) == len(drawn)
        for u, v, range_m in drawn:
            told = min(found, key=lambda one: math.hypot(one.u_px - u, one.v_px - v))
            off = told.u_px - u, told.v_px - v, told.range_m - range_m
            pulls.append(np.divide(off, (told.u_sigma_px, told.v_sigma_px, told.range_sigma_m)))
    assert np.max(np.abs(pulls)) < 5.0
    within = 3.0 / math.sqrt(2 * len(pulls))
    assert np.sqrt(np.mean(np.square(pulls), axis=0)) == pytest.approx([1.0] * 3, abs=within + 0.03)


@pytest.mark.parametrize(
    "place", [(679.2, 342.3, 1.37), (917.2, 342.3, 0.89), (600.5, 400.5, 0.7), (600.5, 400.5, 2.0)]
)
@pytest.mark.parametrize("spilled", [0.3, 1.0])
def test_balls_whose_charge_spills_are_ranged_by_their_flanks(
    place: tuple[float, float, float], spilled: float
) -> None:
    """One and a half to 2.6 times full scale, the charge beyond it spilled along columns: all but one were lost."""
    camera, exposure_s = calibration(), 8e-4
    generator, full_e = random(79, 1), camera.saturation_dn / camera.system_gain_dn_per_e
    charge_e = generator.poisson(expected_e(camera, [place], exposure_s) + 20.0).astype(np.float32)
    bloom_into(charge_e, full_e, spilled)
    charge_e += generator.normal(0.0, camera.read_noise_e, charge_e.shape).astype(np.float32)
    frame = expose(np.zeros(charge_e.shape), camera, generator, exposure_s)
    counts_dn = np.clip(np.rint(camera.system_gain_dn_per_e * charge_e + camera.black_level_dn), 0, 4095)
    (told,) = perception.detect(replace(frame, data_dn=counts_dn.astype(np.uint16)), camera)
    u, v, range_m = place
    off = told.u_px - u, told.v_px - v, told.range_m - range_m
    assert np.abs(np.divide(off, (told.u_sigma_px, told.v_sigma_px, told.range_sigma_m))).max() < 4.5
    assert told.range_sigma_m < 0.003 * range_m
