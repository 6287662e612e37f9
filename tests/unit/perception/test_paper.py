"""The paper's estimators, against frames and figures worked out by hand."""

import math

import numpy as np
import pytest

from perception.model.bearing import bearing_body
from perception.model.flare import PixelBox
from perception.paper import (
    bearing_body_paper,
    detect_paper,
    grey_levels_paper,
    range_paper_m,
    regress_paper_range_constant,
)
from perception.types import RawFrame
from tests.unit.perception.simulation import calibration, expected_e, expose, random

SMALL = calibration(width_px=200, height_px=160, cx_px=99.5, cy_px=79.5)
FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def test_paper_equation_1() -> None:
    camera = calibration(range_constant_paper_dn_m2_per_s=2.0e6)
    assert range_paper_m(564.0, 64.0, 1e-3, camera) == pytest.approx(2.0, rel=1e-12)
    assert math.isnan(range_paper_m(64.0, 64.0, 1e-3, camera))
    assert math.isnan(range_paper_m(564.0, math.nan, 1e-3, camera))


def test_paper_grey_levels() -> None:
    """A blob of 2 × 2, a neighbour in the ring that must not count, and clipped pixels that do."""
    data = np.full((30, 30), 70, dtype=np.uint16)
    data[10:12, 10:12] = [[4095, 1000], [1000, 905]]
    data[10, 15] = 4000  # in the ring, but lit itself
    data[12, 12] = 500  # within the gap
    data[9:13, 6] = 90  # in the ring: 4 of its pixels
    lit = data > 600
    levels = grey_levels_paper(data, np.ones((2, 2), dtype=bool), lit, PixelBox(10, 10, 2, 2))
    assert levels.mean_dn == 1750.0
    ring = 12 * 12 - 6 * 6 - 1
    assert levels.background_dn == pytest.approx(70.0 + 4 * 20.0 / ring, rel=1e-12)


def test_paper_background_of_a_blob_that_fills_the_frame() -> None:
    data = np.full((2, 2), 70, dtype=np.uint16)
    levels = grey_levels_paper(data, np.ones((2, 2), bool), np.ones((2, 2), bool), PixelBox(0, 0, 2, 2))
    assert math.isnan(levels.background_dn)


def test_paper_to_the_letter_on_a_drawn_frame() -> None:
    """Background 100 DN: the mean is a little above, the threshold twice that, black level included."""
    camera = calibration(
        width_px=100, height_px=80, range_constant_paper_dn_m2_per_s=4e6, position_body_m=np.zeros(3)
    )
    data = np.full((80, 100), 100, dtype=np.uint16)
    data[10:15, 20:24] = 900  # 4 × 5: aspect 0.8 just passes
    data[10:12, 40:43] = 900  # 3 × 2: aspect 1.5
    data[30:32, 40:42] = 900  # area 4
    data[50:53, 60:63] = 900
    data[51, 61] = 4095  # clipped, and averaged all the same
    data[70, 70:90] = 190  # below twice the mean
    frame = RawFrame("r1.front", 5, 1.5, 2e-3, data, 64.0)
    assert 104.0 < data.mean() < 105.0
    first, second = detect_paper(frame, camera)
    assert (first.u_px, first.v_px, first.area_px) == (21.5, 12.0, 20)
    assert (first.mean_dn, first.background_dn, first.flux_dn) == (900.0, 100.0, 16000.0)
    assert first.range_m == pytest.approx(math.sqrt(4e6 * 2e-3 / 800.0), rel=1e-12)
    assert (second.u_px, second.v_px, second.area_px, second.saturated) == (61.0, 51.0, 9, True)
    assert second.mean_dn == pytest.approx((8 * 900 + 4095) / 9)
    assert math.isnan(first.range_sigma_m)
    assert not first.saturated


def test_paper_bearing_has_the_papers_bias() -> None:
    found = detect_paper(
        expose(expected_e(SMALL, [(99.5, 79.5, 2.0)], 2.4e-4, 2.0), SMALL, random(41), 2.4e-4), SMALL
    )
    (hit,) = found
    tilt = math.atan2(hit.bearing_body[2], hit.bearing_body[0])
    assert tilt == pytest.approx(math.atan(0.12 / 1.08), abs=2e-3)


def test_paper_cannot_fire_above_half_scale() -> None:
    bright = expected_e(SMALL, [(99.5, 79.5, 2.0)], 2.4e-4, 2900.0)
    assert detect_paper(expose(bright, SMALL, random(42), 2.4e-4), SMALL) == []


def test_paper_adds_the_cameras_offset_to_a_unit_vector() -> None:
    """A source straight ahead of a camera 8 cm to the left: the paper's bearing leans by atan(0.08)."""
    camera = calibration(rotation_body_camera=FORWARD, position_body_m=np.array([0.0, 0.08, 0.0]))
    ahead = [[639.5, 479.5]]
    np.testing.assert_allclose(bearing_body(ahead, camera)[0], [1.0, 0.0, 0.0], atol=1e-15)
    x, y, _ = bearing_body_paper(ahead, camera)[0]
    assert np.arctan2(y, x) == pytest.approx(np.arctan(0.08), rel=1e-12)
    assert np.linalg.norm(bearing_body_paper(ahead, camera)) == pytest.approx(1.0, rel=1e-14)


def test_exact_line() -> None:
    range_m = np.array([0.5, 1.0, 2.0, 4.0])
    line = regress_paper_range_constant(64 + 1e-3 * (3e5 / range_m**2 + 700.0), 64.0, 1e-3, range_m)
    assert line.slope_dn_m2_per_s == pytest.approx(3e5, rel=1e-12)
    assert line.intercept_dn_per_s == pytest.approx(700.0, rel=1e-9)


def test_standard_errors_are_those_of_repetition() -> None:
    rng = random(5)
    range_m = np.linspace(1.0, 5.0, 12)
    lines = [
        regress_paper_range_constant(
            64.0 + 1e-3 * 3e5 / range_m**2 + rng.normal(0.0, 2.0, 12), np.full(12, 64.0), 1e-3, range_m
        )
        for _ in range(400)
    ]
    for value, sigma in (
        ("slope_dn_m2_per_s", "slope_sigma_dn_m2_per_s"),
        ("intercept_dn_per_s", "intercept_sigma_dn_per_s"),
    ):
        scatter = np.std([getattr(line, value) for line in lines], ddof=1)
        claim = np.sqrt(np.mean([getattr(line, sigma) ** 2 for line in lines]))
        assert scatter == pytest.approx(claim, rel=4 / math.sqrt(800))


def test_paper_bad_input() -> None:
    with pytest.raises(ValueError, match="two different ranges"):
        regress_paper_range_constant([1.0, 2.0], 0.0, 1e-3, [2.0, 2.0])
    with pytest.raises(ValueError, match="finite"):
        regress_paper_range_constant([1.0, math.nan], 0.0, 1e-3, [1.0, 2.0])
    with pytest.raises(ValueError, match="positive"):
        regress_paper_range_constant([1.0, 2.0], 0.0, 1e-3, [0.0, 2.0])
    assert math.isnan(regress_paper_range_constant([3.0, 2.0], 0.0, 1e-3, [1.0, 2.0]).slope_sigma_dn_m2_per_s)
