"""Point spread and glare against what frames were rendered with, and the bounds put together by hand."""

from dataclasses import replace

import numpy as np
import pytest

from perception import RawFrame, RecordingError, calibrate_point_spread
from perception.calibration.point_spread import PointSpreadShape, glare_image
from perception.model.flare import PixelBox
from tests.unit.perception.simulation import calibration, expected_e, random

CAMERA = calibration(width_px=200, height_px=200, cx_px=99.5, cy_px=99.5, dsnu_e=0.0)
EXPOSURE_S = 5e-4
PLACES_M = (2.2, 3.0, 4.0, 5.5)


def _frame(index: int, range_m: float, glare_share: float, seed: int, place: tuple[float, float]) -> RawFrame:
    """A source under the Gaussian of 0.7 px, and glare of 8 px and exponent 2 made by summing over all pixels."""
    core_e = expected_e(CAMERA, [(*place, range_m)], EXPOSURE_S * (range_m / 5.5) ** 2)
    lit = np.argwhere(core_e > 1e-6 * core_e.max())
    v, u = np.mgrid[0:200, 0:200]
    veil_e = np.zeros_like(core_e)
    if glare_share > 0.0:
        for row, column in lit:
            away = ((v - row) ** 2 + (u - column) ** 2) / 64.0
            veil_e += core_e[row, column] * (1.0 + away) ** -2.0 / (np.pi * 64.0)
    mean_e = (1.0 - glare_share) * core_e + glare_share * veil_e + 5.0
    draw = random(seed, index)
    noisy_e = draw.poisson(mean_e) + draw.normal(0.0, CAMERA.read_noise_e, mean_e.shape)
    counts = np.clip(np.rint(64.0 + CAMERA.system_gain_dn_per_e * noisy_e), 0, 4095).astype(np.uint16)
    return RawFrame("r1.front", index, 0.1 * index, EXPOSURE_S * (range_m / 5.5) ** 2, counts, 64.0)


def _rail(glare_share: float, seed: int = 1, repeats: int = 3) -> tuple[dict[int, float], list[RawFrame]]:
    ranges_m: dict[int, float] = {}
    frames: list[RawFrame] = []
    for number, range_m in enumerate(PLACES_M):
        for _ in range(repeats):
            ranges_m[len(frames)] = range_m
            place = (98.3 + 0.37 * number, 101.2 - 0.21 * number)
            frames.append(_frame(len(frames), range_m, glare_share, seed, place))
    return ranges_m, frames


def test_width_and_glare_are_those_of_the_frames() -> None:
    """From a first guess a fifth too wide; 4 % of glare shows, and its shape comes out within its σ."""
    ranges_m, frames = _rail(0.04)
    found = calibrate_point_spread(ranges_m, lambda index: frames[index], replace(CAMERA, psf_sigma_px=0.85))
    assert found.has_glare
    assert found.sigma_px == pytest.approx(0.7, abs=3.5 * found.sigma_sigma_px)
    assert found.sigma_sigma_px < 0.004
    assert found.glare_share == pytest.approx(0.04, abs=3.5 * found.glare_share_sigma)
    assert found.glare_share_sigma < 0.3 * 0.04
    assert found.glare_radius_px == pytest.approx(8.0, abs=3.5 * found.glare_radius_sigma_px)
    assert found.glare_exponent == pytest.approx(2.0, abs=3.5 * found.glare_exponent_sigma)
    assert found.reduced_chi2 == pytest.approx(1.0, abs=0.03)
    assert (found.places, found.frames) == (4, 12)
    assert found.calibration.glare_share == found.glare_share
    assert found.calibration.sigma["psf_sigma_px"] == found.sigma_sigma_px


def test_where_there_is_no_glare_none_is_told() -> None:
    ranges_m, frames = _rail(0.0)
    found = calibrate_point_spread(ranges_m, lambda index: frames[index], CAMERA)
    assert (found.has_glare, found.glare_share) == (False, 0.0)
    assert 0.0 < found.glare_share_sigma < 0.01
    assert found.sigma_px == pytest.approx(0.7, abs=3.5 * found.sigma_sigma_px)


def test_a_radius_that_is_not_known_widens_the_sigma() -> None:
    ranges_m, frames = _rail(0.0)
    exact, unsure = (
        calibrate_point_spread(ranges_m, lambda index: frames[index], replace(CAMERA, sigma=sigma))
        for sigma in ({}, {"source_radius_m": 0.005})
    )
    assert unsure.sigma_sigma_px > 1.05 * exact.sigma_sigma_px


def test_glare_of_a_disc_is_that_of_its_parts() -> None:
    """Summed over a disc of 5 px by hand, out to 50 px: within 2 % of its own, and derivatives by differences."""
    shape, box, spread_px = PointSpreadShape(0.7, 0.02, 6.0, 2.2), PixelBox(0, 0, 101, 101), 2.5
    angle = 2.0 * np.pi * np.arange(400) / 400
    radius = 5.0 * np.sqrt((np.arange(60) + 0.5) / 60)
    du, dv = (np.outer(radius, turn(angle)).ravel() for turn in (np.cos, np.sin))
    found = glare_image(50.3, 49.6, spread_px, shape, box)
    for row, column in ((50, 50), (50, 56), (40, 61), (80, 20)):
        away = ((column - 50.3 - du) ** 2 + (row - 49.6 - dv) ** 2) / 36.0
        by_hand = float(np.mean(1.2 / (np.pi * 36.0) * (1.0 + away) ** -2.2))
        assert found[0, row, column] == pytest.approx(by_hand, rel=0.02)
    step = 1e-4
    for number, (place, changed) in enumerate(
        [
            ((50.3 + step, 49.6), shape),
            ((50.3, 49.6 + step), shape),
            ((50.3, 49.6), replace(shape, glare_radius_px=6.0 * np.exp(step))),
            ((50.3, 49.6), replace(shape, glare_exponent=1.0 + 1.2 * np.exp(step))),
        ],
        start=1,
    ):
        change = (glare_image(*place, spread_px, changed, box)[0] - found[0]) / step
        assert np.allclose(change, found[number], rtol=0.01, atol=1e-4 * np.abs(found[number]).max())


def test_frames_that_clip_are_left_out_and_said() -> None:
    ranges_m, frames = _rail(0.0, repeats=1)
    clipped = replace(CAMERA, saturation_dn=300)
    with pytest.raises(
        RecordingError, match=r"shows unclipped at 0 places of the rail, wanted 2 or more: shorten"
    ):
        calibrate_point_spread(ranges_m, lambda index: frames[index], clipped)
