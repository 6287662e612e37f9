"""The limits that a source's errors are held against."""

import dataclasses
import math

import pytest

from nir_render.evaluate.metrics import evaluate, source_limits
from perception.model.fisher import flare_limit, flare_limits
from tests.unit.report.cases import calibration, truth

CAMERA = calibration()


def test_on_the_axis_a_pixel_is_one_focal_length_th_of_a_radian_in_both_directions() -> None:
    """480 px focal length: the two equal pixel errors make √2 σ / 480 rad."""
    row = truth(u_px=159.5, v_px=119.5)
    limit = flare_limit(CAMERA, 159.5, 119.5, 2.0, 1e4, 0.0)
    range_m, bearing_deg = source_limits(row, CAMERA)
    assert range_m == limit.range_sigma_m
    # Images are spread exactly along u, by rows across v: to some 1e-6.
    assert limit.u_sigma_px == pytest.approx(limit.v_sigma_px, rel=1e-5)
    assert bearing_deg == pytest.approx(math.degrees(math.sqrt(2.0) * limit.u_sigma_px / 480.0), rel=1e-5)


def test_off_the_axis_pixels_cover_smaller_angles() -> None:
    """At tan θ = 0.3 along u a pixel is cos² θ / f in the field's direction, cos θ / f across it."""
    u_px = 159.5 + 0.3 * 480.0
    limit = flare_limit(CAMERA, u_px, 119.5, 2.0, 1e4, 0.0)
    _, bearing_deg = source_limits(truth(u_px=u_px, v_px=119.5), CAMERA)
    cos = 1.0 / math.hypot(1.0, 0.3)
    along_rad, across_rad = cos**2 * limit.u_sigma_px / 480.0, cos * limit.v_sigma_px / 480.0
    assert bearing_deg == pytest.approx(math.degrees(math.hypot(along_rad, across_rad)), rel=1e-5)


def test_light_from_elsewhere_costs_accuracy() -> None:
    dark, bright = (source_limits(truth(background_e=e), CAMERA) for e in (0.0, 400.0))
    assert bright[0] > 1.3 * dark[0]
    assert bright[1] > 1.3 * dark[1]


def test_a_frame_at_another_gain_has_the_limit_of_a_camera_that_has_it_for_good() -> None:
    """A flare of 10 000 e, a fifth of it in its brightest pixel: at 16 DN/e pixels clip at 4031/16 = 252 e.

    At the calibrated 1 DN/e, where none clips, its limit is lower; the rim of a clipped disc still tells its size.
    """
    for_good = dataclasses.replace(CAMERA, system_gain_dn_per_e=16.0)  # it clips at the ADC's full scale
    row = truth(gain=16.0, background_e=30.0)
    assert source_limits(row, CAMERA) == source_limits(truth(background_e=30.0), for_good)
    assert source_limits(row, CAMERA)[0] > 1.3 * source_limits(truth(background_e=30.0), CAMERA)[0]


def test_dark_current_is_background_that_clips_and_makes_noise() -> None:
    """It is as good as light from elsewhere; a faint flare's limit rises with the noise of a dark pixel."""
    assert source_limits(truth(background_e=70.0, dark_e=50.0), CAMERA) == source_limits(
        truth(background_e=120.0), CAMERA
    )
    cold, hot = (source_limits(truth(direct_e=1.0, dark_e=e), CAMERA)[0] for e in (0.0, 45.7))
    assert hot / cold == pytest.approx(math.sqrt(145.783 / 100.083), rel=2e-3)
    assert source_limits(truth(dark_e=6000.0), CAMERA)[0] == math.inf


def test_two_on_one_bearing_have_to_be_told_apart() -> None:
    """Two points 1.5 px apart: each limit is far above that of one in the other's light; 40 px apart they are alone."""
    alone = truth(background_e=20.0)
    beside, far = (truth(u_px=alone.u_px + apart, background_e=20.0) for apart in (1.5, 40.0))
    single_m, single_deg = source_limits(alone, CAMERA)
    paired_m, paired_deg = source_limits(alone, CAMERA, [alone, beside])
    assert paired_m > 1.5 * single_m
    assert paired_deg > 1.3 * single_deg
    assert source_limits(alone, CAMERA, [alone, far]) == (single_m, single_deg)
    hidden = truth(u_px=alone.u_px + 1.5, direct_e=0.0)
    assert source_limits(alone, CAMERA, [alone, hidden]) == (single_m, single_deg)


def test_light_that_glare_takes_tells_nothing() -> None:
    """Of 10 000 e half are in the flare: its limits are those of 5 000 e, √2 times as large by shot noise alone."""
    row = truth(direct_e=1e4, flare_share=0.5, background_e=20.0)
    assert source_limits(row, CAMERA) == source_limits(truth(direct_e=5e3, background_e=20.0), CAMERA)
    assert source_limits(row, CAMERA)[0] > 1.4 * source_limits(truth(background_e=20.0), CAMERA)[0]


def test_without_light_there_is_no_limit_and_the_summary_leaves_it_out() -> None:
    assert all(math.isnan(limit) for limit in source_limits(truth(direct_e=0.0), CAMERA))
    lit, unlit = truth(), truth(u_px=200.0, direct_e=0.0)
    summary = evaluate([("r1.front", 0)], [lit, unlit], {"r1.front": CAMERA}, {}).summary
    assert summary["bearing_limit_rms_deg"] == pytest.approx(source_limits(lit, CAMERA)[1])


def test_a_flare_that_moves_while_it_is_exposed_has_the_limit_of_one_drawn_out() -> None:
    """By 2.5 px, which is not known: its light lies on more pixels, and its motion is one more unknown."""
    row = truth(background_e=30.0, moved_u_px=2.0, moved_v_px=-1.5)
    at_rest = source_limits(truth(background_e=30.0), CAMERA)
    flare = (row.u_px, row.v_px, row.range_m, row.direct_e)
    (limit,) = flare_limits(CAMERA, [flare], 30.0, motions_px=[(2.0, -1.5)])
    found = source_limits(row, CAMERA)
    assert found[0] == limit.range_sigma_m > 1.05 * at_rest[0]
    assert found[1] > 1.05 * at_rest[1]


def test_motion_that_is_too_little_to_tell_costs_nothing() -> None:
    """The image answers to the square of it: 0.02 px that are not known are as good as none."""
    slow = source_limits(truth(background_e=30.0, moved_u_px=0.02), CAMERA)
    assert slow == pytest.approx(source_limits(truth(background_e=30.0), CAMERA), rel=2e-3)
