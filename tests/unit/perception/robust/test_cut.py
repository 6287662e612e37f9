"""A sphere partly behind a straight edge: frames of what is seen of it, by brute force, and what is told of them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from perception import Detection, detect
from perception.model.window import Camera
from perception.robust.clusters import Cluster
from perception.robust.hiding import cut
from perception.robust.solve import Solution
from tests.unit.perception.robust.test_eclipse import (
    BACKGROUND_E,
    CAMERA,
    FINE,
    Place,
    _plane,
    _pulls,
    _seen_e_per_s,
    _told_of,
)
from tests.unit.perception.simulation import expose, random

Array = NDArray[np.float64]

RADIUS_M = CAMERA.source_radius_m


def cut_e_per_s(
    place: Place, shown: float, turn_rad: float, away_px: tuple[float, float] = (0.0, 0.0)
) -> Array:
    """Return what is seen of a sphere near the axis, so much of its diameter left by an edge at a right angle.

    Were it at its place: so far away the edge is where it was.
    """
    u_px, v_px, range_m = place
    x, y, _ = _plane(CAMERA)
    out_u, out_v = x * CAMERA.fx_px + CAMERA.cx_px - u_px, y * CAMERA.fx_px + CAMERA.cy_px - v_px
    radius_px = CAMERA.fx_px * math.tan(math.asin(RADIUS_M / range_m))
    edge_px = radius_px * (1.0 - 2.0 * shown) - (out_u * math.cos(turn_rad) + out_v * math.sin(turn_rad))
    lit = np.clip(0.5 + (radius_px - np.hypot(out_u - away_px[0], out_v - away_px[1])) * FINE, 0.0, 1.0)
    return _seen_e_per_s(lit * np.clip(0.5 - edge_px * FINE, 0.0, 1.0))


def _told(place: Place, shown: float, turn_rad: float, key: int) -> list[Detection]:
    return _told_of(cut_e_per_s(place, shown, turn_rad), key)[0]


@pytest.mark.parametrize(("range_m", "shown"), [(1.25, 0.4), (2.0, 0.6), (3.75, 0.75), (2.0, 0.9)])
def test_a_part_tells_the_range_of_the_whole(range_m: float, shown: float) -> None:
    """Nothing was found of most, and of others a whole one 3 % too far by 20 σ, or three 2.3 × as far."""
    place = (31.3, 31.6, range_m)
    (told,) = _told(place, shown, 4.0 * shown, round(10.0 * range_m))
    assert told.merged
    assert np.abs(_pulls(place, told)).max() < 4.5
    assert told.range_sigma_m < 0.01 * range_m


@pytest.mark.parametrize("times", [0.6, 6.0])
@pytest.mark.parametrize(
    ("range_m", "way_px"), [(1.835, (0.36, 0.59)), (1.6, (-0.62, 0.49)), (2.95, (0.73, -0.82))]
)
def test_a_part_of_one_that_moves_does_too(range_m: float, way_px: tuple[float, float], times: float) -> None:
    """By 5 to 20 σ it was told too near."""
    place = (31.3, 31.6, range_m)
    parts = (np.arange(5) + 0.5) / 5.0 - 0.5
    mean_e_per_s = np.mean(
        [cut_e_per_s(place, 0.7, 0.7, (at * way_px[0], at * way_px[1])) for at in parts], axis=0
    )
    exposure_s = times * 4000.0 / 0.74 / float(mean_e_per_s.max())
    # As bright as that in an exposure in which robots move so far.
    constant = CAMERA.range_constant_dn_m2_per_s * exposure_s / 5e-3
    camera = replace(CAMERA, range_constant_dn_m2_per_s=constant)
    (told,) = detect(
        expose(mean_e_per_s * exposure_s + BACKGROUND_E, camera, random(94, round(times)), 5e-3), camera
    )
    assert told.range_m == pytest.approx(range_m, abs=4.5 * told.range_sigma_m)
    assert told.range_sigma_m < 0.02 * range_m


@pytest.mark.parametrize(
    ("shown", "turn_rad", "key"), [(0.6, 0.0, 0), (0.6, 0.0, 1), (0.6, 1.1, 2), (0.7, 2.3, 0), (0.7, 2.3, 2)]
)
def test_a_part_is_no_pile_of_spheres(shown: float, turn_rad: float, key: int) -> None:
    """Of 3 px: two discs of its outline and one of what these leave explain it, too; at 5.6 to 8.8 m, by 40 σ."""
    place = (31.3, 31.8, 4.0)
    (told,) = _told(place, shown, turn_rad, key)
    assert told.range_m == pytest.approx(4.0, abs=5.0 * told.range_sigma_m)
    assert told.range_sigma_m < 0.05 * told.range_m


def test_slopes_are_those_of_what_is_expected() -> None:
    """By differences, of each unknown, the line's too: to .3 %."""
    place, seen = (31.3, 31.6, 1.5), list[Cluster]()

    def look(found: list[Cluster], *_: object) -> dict[int, Solution]:
        seen.extend(found)
        return {}

    mean_e_per_s = cut_e_per_s(place, 0.6, 0.7)
    exposure_s = 0.6 * 4000.0 / 0.74 / float(mean_e_per_s.max())
    frame = expose(mean_e_per_s * exposure_s + BACKGROUND_E, CAMERA, random(77, 5), exposure_s)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("perception.robust.explain.cut_discs", look)
        detect(frame, CAMERA)
    known = replace(CAMERA, sigma={"range_constant_dn_m2_per_s": 0.1 * CAMERA.range_constant_dn_m2_per_s})
    radius_px = CAMERA.fx_px * RADIUS_M / 1.5
    guess = (31.3, 31.6, math.log(1.5), 0.7 + math.pi, 0.2 * radius_px)
    fit = cut._Cut(seen[0].window, seen[0].background_e, guess, Camera(known, exposure_s, 1.0))
    values = fit._values.copy()
    _, jacobian = fit._expectation(values)
    steps = dict(enumerate((0.0005, 0.0005, 0.0001, 0.001))) | {
        len(values) - 2: 1e-4,
        len(values) - 1: 0.0005,
    }
    for unknown, size in steps.items():
        step = np.zeros(len(values))
        step[unknown] = size
        above, below = fit._expectation(values + step)[0], fit._expectation(values - step)[0]
        slope = (above - below) / (2.0 * size)
        assert np.linalg.norm(slope - jacobian[unknown]) < 0.003 * np.linalg.norm(slope)


@pytest.mark.verify
def test_of_sixty_parts_sigmas_are_true() -> None:
    """At 1.25 to 5 m, .35 to .95 of the diameter seen, edges of all directions."""
    pulls, lost = [], 0
    for key in range(60):
        number = random(79, key)
        place = (
            31.5 + number.uniform(-0.5, 0.5),
            31.5 + number.uniform(-0.5, 0.5),
            1.25 * 4.0 ** number.random(),
        )
        told = _told(place, number.uniform(0.35, 0.95), number.uniform(0.0, 2.0 * math.pi), 100 + key)
        if len(told) != 1:
            lost += 1
            continue
        pulls.append(_pulls(place, told[0]))
    assert lost == 0
    assert np.abs(pulls).max() < 4.5
    assert np.abs(np.mean(np.square(pulls), axis=0) - 1.0).max() < 4.0 * math.sqrt(2.0 / 60.0)
