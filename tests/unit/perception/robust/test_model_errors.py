"""Near sources that are not quite what the calibration says."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from perception import detect
from perception.robust.overlap.free_fits import chance_of_least
from tests.unit.perception.simulation import calibration, expected_e, expose, random

CAMERA = calibration(sigma={})
EXPOSURE_S, BACKGROUND_E = 1e-4, 7.0
PLACES = [(920.3, 119.3, 0.4168), (1122.8, 120.2, 0.4406), (319.0, 517.3, 0.5939)]


def test_a_lens_that_is_one_per_cent_off_loses_no_near_source() -> None:
    """At 45° from the axis. Told are discs that seem to move by 2 px of 50, on ground that seems uneven: no robot is so
    quick, so two of three were left out as long clutter."""
    off = calibration(sigma={}, lens_model="brown_conrady", distortion=(-0.01, 0.0, 0.0, 0.0))
    mean_e = expected_e(CAMERA, PLACES, EXPOSURE_S, BACKGROUND_E)
    told = detect(expose(mean_e, CAMERA, random(91, 4), EXPOSURE_S), off)
    assert len(told) == len(PLACES)
    for u, v, range_m in PLACES:
        (near,) = (one for one in told if math.hypot(one.u_px - u, one.v_px - v) < 2.0)
        assert near.range_m == pytest.approx(range_m, rel=0.02)


@pytest.mark.parametrize("size", [0.95, 1.05])
def test_what_a_wrong_size_leaves_over_widens_the_sigma_of_a_range(size: float) -> None:
    """By 5 %: ranges are off by 4 %, up to 130 times what σ said."""
    off = replace(CAMERA, source_radius_m=size * CAMERA.source_radius_m)
    mean_e = expected_e(CAMERA, PLACES, EXPOSURE_S, BACKGROUND_E)
    told = detect(expose(mean_e, CAMERA, random(93), EXPOSURE_S), off)
    assert len(told) == len(PLACES)
    for u, v, range_m in PLACES:
        (near,) = (one for one in told if math.hypot(one.u_px - u, one.v_px - v) < 2.0)
        assert abs(near.range_m - range_m) > 0.02 * range_m
        assert abs(near.range_m - range_m) < 1.5 * near.range_sigma_m < 0.1 * range_m
        assert abs(near.u_px - u) < 4.5 * near.u_sigma_px
        assert abs(near.v_px - v) < 4.5 * near.v_sigma_px


def test_what_is_as_it_should_be_is_known_as_well_as_light_allows() -> None:
    """No σ is wider for noise: to 3 % the same in four frames."""
    mean_e = expected_e(CAMERA, PLACES, EXPOSURE_S, BACKGROUND_E)
    sigmas = [
        [one.range_sigma_m for one in detect(expose(mean_e, CAMERA, random(94, key), EXPOSURE_S), CAMERA)]
        for key in range(4)
    ]
    assert np.ptp(np.log(sigmas), axis=0).max() < 0.03


DISCS = [
    (150.3, 120.6, 0.9), (420.2, 150.1, 0.6), (700.8, 300.4, 1.2), (1000.5, 200.9, 0.7),
    (1150.1, 700.3, 1.0), (300.7, 600.2, 0.5), (640.4, 820.8, 0.8), (900.9, 560.5, 1.5), (520.6, 420.7, 6.0),
]  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "least", "most"),
    [
        ({"fx_px": 1.02 * CAMERA.fx_px, "fy_px": 1.02 * CAMERA.fy_px}, 0.001, 0.015),
        ({"source_radius_m": 1.03 * CAMERA.source_radius_m}, 0.01, 0.03),
        ({"range_constant_dn_m2_per_s": 1.08 * CAMERA.range_constant_dn_m2_per_s}, 0.01, 0.04),
    ],
)
def test_discs_tell_together_that_a_calibration_is_off(
    changes: dict[str, Any], least: float, most: float
) -> None:
    """One that claims no σ. Flux and size tell 2 % of focal length, 3 % of radius, 4 % of range by flux apart.

    The last of the sources is a point: it says nothing, and is off with the others. Without them pulls are up
    to 30 σ.
    """
    mean_e = expected_e(CAMERA, DISCS, EXPOSURE_S, BACKGROUND_E)
    told = detect(expose(mean_e, CAMERA, random(95), EXPOSURE_S), replace(CAMERA, **changes))
    assert len(told) == len(DISCS)
    assert least < told.range_doubt < most
    for u, v, range_m in DISCS:
        (near,) = (one for one in told if math.hypot(one.u_px - u, one.v_px - v) < 2.0)
        assert abs(near.range_m - range_m) < 5.0 * near.range_sigma_m
        assert near.range_sigma_m >= near.range_sigma_common_m > 0.99 * told.range_doubt * near.range_m


def test_nothing_is_said_against_a_calibration_that_is_right() -> None:
    """Nor where half of the discs are mirror images in a pane that sends back four fifths of the light."""
    mean_e = expected_e(CAMERA, DISCS, EXPOSURE_S, BACKGROUND_E)
    dimmed = expected_e(CAMERA, DISCS[:4], EXPOSURE_S) - 0.2 * expected_e(CAMERA, DISCS[:4], EXPOSURE_S)
    mirrored_e = dimmed + expected_e(CAMERA, DISCS[4:], EXPOSURE_S, BACKGROUND_E)
    for image_e in (mean_e, mirrored_e):
        told = detect(expose(image_e, CAMERA, random(96), EXPOSURE_S), CAMERA)
        assert len(told) == len(DISCS)
        assert told.range_doubt == 0.0
        for u, v, range_m in DISCS[4:]:
            (near,) = (one for one in told if math.hypot(one.u_px - u, one.v_px - v) < 2.0)
            assert abs(near.range_m - range_m) < 4.5 * near.range_sigma_m < 0.1 * range_m


@pytest.mark.parametrize(("least", "count"), [(1, 1), (1, 2), (4, 8), (3, 5)])
def test_the_least_of_several_gains_are_as_likely_as_drawn_ones(least: int, count: int) -> None:
    gains = np.sort(random(97, count).exponential(2.0, (200_000, count)), axis=1)[:, :least].sum(axis=1)
    for total in (1.0, 4.0, 8.0):
        chance = chance_of_least(total, least, count)
        assert np.mean(gains > total) == pytest.approx(chance, abs=4.5 * math.sqrt(chance / len(gains)))
