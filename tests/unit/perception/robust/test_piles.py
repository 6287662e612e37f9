"""Several near sources that hide parts of each other: what is seen is the union of their discs."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from perception import Detection, detect
from perception.model.window import Camera
from perception.robust import explain
from perception.robust.clusters import Cluster
from perception.robust.hiding.outlines import _cones, discs_by_outline
from tests.unit.perception.robust.test_eclipse import (
    BACKGROUND_E,
    CAMERA,
    RADIUS_M,
    Place,
    _pulls,
    oval_e_per_s,
    union_e_per_s,
)
from tests.unit.perception.simulation import expose, random

Array = NDArray[np.float64]

THREE: list[Place] = [(22.3, 30.2, 0.95), (36.1, 24.6, 1.4), (29.7, 44.9, 1.8)]
FOUR: list[Place] = [(18.2, 19.6, 1.2), (30.4, 26.1, 1.9), (36.8, 34.5, 1.1), (45.3, 45.9, 2.6)]
"""Each overlaps the next: seen are 100, 77 and 64 % of the three, 100, 73, 100 and 68 % of the four."""


def _told(places: list[Place], times: float, key: int) -> list[Detection]:
    """Return what is told of a frame whose discs are so many times as bright as full scale, nearest first."""
    mean_e_per_s = union_e_per_s(places)
    exposure_s = times * 4000.0 / 0.74 / float(mean_e_per_s.max())
    frame = expose(mean_e_per_s * exposure_s + BACKGROUND_E, CAMERA, random(91, key), exposure_s)
    return sorted(detect(frame, CAMERA), key=lambda one: one.range_m)


@pytest.mark.parametrize("times", [0.02, 0.6, 6.0])
@pytest.mark.parametrize("places", [THREE, FOUR])
def test_each_is_ranged(places: list[Place], times: float) -> None:
    """Dim, bright, and clipped: as discs that shine through each other nothing explained any, and all were lost."""
    found = _told(places, times, 0)
    assert len(found) == len(places)
    for place, told in zip(sorted(places, key=lambda place: place[2]), found, strict=True):
        assert np.abs(_pulls(place, told)).max() < 4.5
        assert told.range_sigma_m < 0.02 * told.range_m


@pytest.mark.parametrize("times", [0.6, 6.0, 18.0])
@pytest.mark.parametrize(
    ("places", "ways_px"),
    [
        (THREE[:2], [(0.8, 0.6), (0.8, 0.6)]),
        (THREE[:2], [(2.4, -1.8), (2.4, -1.8)]),
        (THREE[:2], [(1.0, 0.0), (0.0, -1.5)]),
        (THREE, [(1.0, 0.5), (-0.7, 0.7), (0.0, 0.0)]),
        ([(27.3, 30.2, 1.5), (34.1, 33.6, 1.65)], [(0.0, 0.0), (2.3, -1.2)]),
    ],
    ids=["1 px", "3 px", "each its own", "three", "the farther one looks larger"],
)
def test_each_is_ranged_while_they_move(
    places: list[Place], ways_px: list[tuple[float, float]], times: float
) -> None:
    """Clipped none was found, and of others ranges were up to .8 % off, by 11 σ."""
    found = _told_while_moving(places, ways_px, times, round(times))
    assert len(found) == len(places)
    for place, told in zip(sorted(places, key=lambda place: place[2]), found, strict=True):
        assert np.abs(_pulls(place, told)).max() < 4.5
        assert told.range_sigma_m < 0.005 * told.range_m


@pytest.mark.parametrize(
    ("places", "ways_px"),
    [
        ([(31.3, 31.6, 2.1), (27.05, 32.33, 2.82)], [(0.18, 1.87), (1.46, -0.62)]),
        ([(31.3, 31.6, 1.4), (27.85, 38.61, 1.95)], [(1.77, 0.64), (-0.28, -0.5)]),
        ([(31.3, 31.6, 2.03), (38.23, 26.69, 3.35), (27.5, 34.83, 3.46)], [(2.74, 2.98)] * 3),
    ],
)
def test_those_are_told_whose_residual_hardly_asks_for_their_motions(
    places: list[Place], ways_px: list[tuple[float, float]]
) -> None:
    """Motions explain a third to a half of what those at rest leave; where one is missing they do, too."""
    found = _told_while_moving(places, ways_px, 0.6, 60)
    assert len(found) == len(places)
    for place, told in zip(places, found, strict=True):
        assert np.abs(_pulls(place, told)).max() < 4.5


@pytest.mark.parametrize(
    ("places", "way_px"),
    [([(31.83, 31.14, 19.6), (31.38, 28.26, 24.0)], (-0.33, 4.62)), ([(31.9, 32.0, 27.7), (29.0, 32.2, 34.6)], (-2.1, 2.8))],
)  # fmt: skip
def test_two_small_ones_that_move_far_are_two(places: list[Place], way_px: tuple[float, float]) -> None:
    """Of 0.3 to 0.6 px: four to six at rest explain what they add up to, too."""
    found = _told_while_moving(places, [way_px, way_px], 0.6, 40)
    assert len(found) == 2
    for place, told in zip(places, found, strict=True):
        assert np.abs(_pulls(place, told)).max() < 4.5


@cache
def _moved_e_per_s(moving: tuple[tuple[Place, tuple[float, float]], ...]) -> Array:
    """Return the mean frame of places, each of which moves evenly by so much."""
    mean = np.mean(
        [
            union_e_per_s([(u + at * du, v + at * dv, range_m) for (u, v, range_m), (du, dv) in moving])
            for at in (np.arange(9) + 0.5) / 9.0 - 0.5
        ],
        axis=0,
    )
    return np.asarray(mean)


def _told_while_moving(
    places: list[Place], ways_px: list[tuple[float, float]], times: float, key: int
) -> list[Detection]:
    """Return what is told of a frame in which each moves so far, nearest first."""
    mean_e_per_s = _moved_e_per_s(tuple(zip(places, ways_px, strict=True)))
    exposure_s = times * 4000.0 / 0.74 / float(mean_e_per_s.max())
    # As bright as that in an exposure in which robots move so far.
    constant = CAMERA.range_constant_dn_m2_per_s * exposure_s / 5e-3
    camera = replace(CAMERA, range_constant_dn_m2_per_s=constant)
    frame = expose(mean_e_per_s * exposure_s + BACKGROUND_E, camera, random(93, key), 5e-3)
    return sorted(detect(frame, camera), key=lambda one: one.range_m)


def test_sigmas_are_true() -> None:
    """Of three, ten frames: mean squares of 90 pulls."""
    pulls = []
    for key in range(10):
        found = _told(THREE, 0.3, 1 + key)
        assert len(found) == 3
        pulls += [_pulls(place, told) for place, told in zip(THREE, found, strict=True)]
    squares = np.mean(np.square(pulls))
    assert abs(squares - 1.0) < 4.0 * math.sqrt(2.0 / np.size(pulls))


def test_a_small_one_behind_is_told_too() -> None:
    """Beside three one of 2 px, which shows too little of a limb for its outline to tell it."""
    places = [*THREE, (49.0, 25.2, 6.0)]
    found = _told(places, 0.6, 20)
    assert len(found) == 4
    assert np.abs(_pulls(places[3], found[3])).max() < 4.5


def _cluster(mean_e: Array, exposure_s: float, key: int) -> tuple[Cluster, Camera]:
    """Return the window of a frame's only cluster."""
    seen: list[tuple[Cluster, Camera]] = []

    def look(cluster: Cluster, camera: Camera, *_: object) -> None:
        seen.append((cluster, camera))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(explain, "pile_of", look)
        detect(expose(mean_e, CAMERA, random(92, key), exposure_s), CAMERA)
    return seen[0]


def test_an_outline_shows_its_discs() -> None:
    """Within a third of a pixel, and their ranges to 4 %."""
    mean_e_per_s = union_e_per_s(FOUR)
    exposure_s = 0.6 * 4000.0 / 0.74 / float(mean_e_per_s.max())
    discs = discs_by_outline(*_cluster(mean_e_per_s * exposure_s + BACKGROUND_E, exposure_s, 1))
    assert len(discs) == 4
    for u, v, range_m in FOUR:
        at = min(discs, key=lambda disc: math.hypot(disc[0] - u, disc[1] - v))
        assert math.hypot(at[0] - u, at[1] - v) < 0.35
        assert math.exp(at[2]) == pytest.approx(range_m, rel=0.04)


def test_an_outline_that_is_none_of_discs_shows_none() -> None:
    """A square of a source's brightness, 24 px wide."""
    exposure_s = 1e-4
    of_source_e = exposure_s * 1.4e9 / (math.pi * (CAMERA.fx_px * RADIUS_M) ** 2)
    mean_e = np.full((CAMERA.height_px, CAMERA.width_px), BACKGROUND_E)
    mean_e[20:44, 20:44] += of_source_e
    cluster, camera = _cluster(mean_e, exposure_s, 2)
    assert len(discs_by_outline(cluster, camera)) < 2


@pytest.mark.parametrize("axes", [1.05, 1.1, 1.2])
def test_an_oval_lamp_is_no_pile(axes: float) -> None:
    """Of a source's brightness and 20 px wide: one that is not quite round, or nothing."""
    mean_e_per_s = oval_e_per_s(31.4, 31.7, 1.2, axes, 0.7)
    exposure_s = 0.6 * 4000.0 / 0.74 / float(mean_e_per_s.max())
    frame = expose(mean_e_per_s * exposure_s + BACKGROUND_E, CAMERA, random(93), exposure_s)
    assert len(detect(frame, replace(CAMERA, sigma={}))) <= 1


@pytest.mark.parametrize("places", [5, 6])
def test_of_a_short_outline_there_are_cones_or_none(places: int) -> None:
    """Of five places, as few as are looked at, no arc is long enough: a frame with such an outline was an error."""
    turn = np.arange(places) * 0.3
    limb = np.column_stack([0.02 * np.cos(turn), 0.02 * np.sin(turn), np.ones(places)])
    limb /= np.linalg.norm(limb, axis=1, keepdims=True)
    cones = _cones(limb)
    assert (len(cones) > 0) == (places > 5)
    if len(cones):
        np.testing.assert_allclose(limb @ cones.T, 1.0, atol=1e-9)
