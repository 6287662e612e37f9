"""What is seen of discs behind others, or behind an edge, in rows: against sums over fine samples of the image."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from perception.model.bearing import direction_camera
from perception.model.discs.visible import NO_EDGE, seen_of_discs
from perception.model.layout import Known, View
from perception.robust.hiding.seen_light import add_seen
from perception.types import Calibration
from tests.unit.perception.simulation import calibration, random

Array = NDArray[np.float64]

SIDE, FINE = 56, 16
FALLING: Array = np.linspace(0.0, 1.2, 13)
LENSES: dict[str, dict[str, Any]] = {
    "rectilinear": {},
    "aside": {"cx_px": 27.5 - 400.0, "cy_px": 27.5 - 250.0},
    "sharp": {"psf_sigma_px": 0.4},
    "fisheye": {"lens_model": "fisheye", "distortion": (-0.02, 0.003, 0.0, 0.0), "cx_px": 27.5 - 300.0},
    "vignetted": {"response_angle_rad": FALLING, "response_relative": np.cos(FALLING) ** 2, "cx_px": 27.5 - 300.0},
}  # fmt: skip


def _camera(**other: Any) -> Calibration:
    return replace(calibration(width_px=SIDE, height_px=SIDE, cx_px=27.5, cy_px=27.5, sigma={}), **other)


def _light(camera: Calibration) -> tuple[Array, Array]:
    """Return the directions of fine samples, shape (rows, columns, 3), and the light that falls on each.

    The solid angle of a sample is that of the two triangles between its corners.
    """
    grid = (np.arange(SIDE * FINE) + 0.5) / FINE - 0.5
    corners = (np.arange(SIDE * FINE + 1)) / FINE - 0.5
    u, v = np.meshgrid(grid, grid)
    at = direction_camera(np.column_stack([u.ravel(), v.ravel()]), camera).reshape(*u.shape, 3)
    u, v = np.meshgrid(corners, corners)
    corner = direction_camera(np.column_stack([u.ravel(), v.ravel()]), camera).reshape(*u.shape, 3)
    down, across = corner[1:, :-1] - corner[:-1, :-1], corner[:-1, 1:] - corner[:-1, :-1]
    sterad = np.linalg.norm(np.cross(across, down), axis=2)
    angle = np.arctan2(np.hypot(at[..., 0], at[..., 1]), at[..., 2])
    response = np.interp(angle, camera.response_angle_rad, camera.response_relative)
    return np.asarray(at), np.asarray(sterad * at[..., 2] * response)


def _inside(at: Array, axis: Array, radius_rad: float) -> Array:
    """Return how much of each sample lies within a cap, the edge soft over a sample."""
    depth = radius_rad - 2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(at - axis, axis=2), 1.0))
    down, across = np.gradient(depth)
    return np.asarray(np.clip(0.5 + depth / np.hypot(down, across).clip(1e-300), 0.0, 1.0))


def _expected(
    camera: Calibration,
    places: Array,
    axis: Array,
    radius_rad: Array,
    hides: list[tuple[int, int]],
    edge: Array,
) -> Array:
    seen = seen_of_discs(
        places, axis, radius_rad, np.array(hides, dtype=np.int64).reshape(-1, 2), camera, edge
    )
    assert seen is not None
    none = np.zeros((SIDE, SIDE))
    view = View(0, 0, none, np.ones((SIDE, SIDE), dtype=np.uint8), 20.0, none)
    known = Known(camera.psf_sigma_px, 0.0, 0.0, 0.0, math.inf, 0.0)
    expected, jacobian = np.zeros(SIDE * SIDE), np.zeros((3 * len(places) + 3, SIDE * SIDE))
    add_seen(np.ones(len(places)), places, 0.0, seen, camera.psf_sigma_px, view, known, expected, jacobian)
    return expected.reshape(SIDE, SIDE)


@pytest.mark.parametrize("lens", list(LENSES))
def test_what_is_seen_of_piles_and_behind_edges(lens: str) -> None:
    """Of one to four discs, each farther one behind all nearer ones: to .1 % of the brightest pixel."""
    camera = _camera(**LENSES[lens])
    at, light = _light(camera)
    rng = random(2901, list(LENSES).index(lens))
    for number in (1, 2, 2, 3, 4):
        places = 27.5 + rng.uniform(-6.0, 6.0, (number, 2))
        radius_rad = -np.sort(-rng.uniform(0.006, 0.015, number))
        axis = direction_camera(places, camera)
        edge = NO_EDGE
        if number < 3:
            edge = np.array([*places[0], rng.uniform(0.0, 2.0 * math.pi), rng.uniform(-2.0, 4.0)])
        uncovered, summed = np.ones(light.shape), np.zeros(light.shape)
        if number < 3:
            grid = (np.arange(SIDE * FINE) + 0.5) / FINE - 0.5
            u, v = np.meshgrid(grid, grid)
            along = (u - edge[0]) * math.cos(edge[2]) + (v - edge[1]) * math.sin(edge[2])
            uncovered = np.clip(0.5 + (edge[3] - along) * FINE, 0.0, 1.0)
        for one in range(number):
            own = _inside(at, axis[one], float(radius_rad[one]))
            summed += light * own * uncovered / float((light * own).sum())
            uncovered = uncovered * (1.0 - own)
        blurred = gaussian_filter(summed, camera.psf_sigma_px * FINE, truncate=6.0)
        by_samples = blurred.reshape(SIDE, FINE, SIDE, FINE).sum(axis=(1, 3))
        hides = [(near, far) for far in range(number) for near in range(far)]
        told = _expected(camera, places, axis, radius_rad, hides, edge)
        assert float(np.abs(told - by_samples).max()) < 1e-3 * float(by_samples.max())


def test_nothing_is_lost_of_what_no_other_hides() -> None:
    """The whole of a disc, and what two that meet show and hide of it adds up to it."""
    camera = _camera()
    places = np.array([[25.0, 28.0], [30.0, 26.0]])
    axis, radius_rad = direction_camera(places, camera), np.array([0.013, 0.011])
    alone = seen_of_discs(places[1:], axis[1:], radius_rad[1:], np.empty((0, 2), dtype=np.int64), camera)
    behind = seen_of_discs(places, axis, radius_rad, np.array([[0, 1]]), camera)
    swapped = seen_of_discs(places[::-1], axis[::-1], radius_rad[::-1], np.array([[0, 1]]), camera)
    assert alone is not None
    assert behind is not None
    assert swapped is not None
    assert alone.shares[0] == pytest.approx(1.0, abs=1e-12)
    # Both hide the same part of the sky, of which discs are as bright as their flux is spread over their area.
    areas = 1.0 - np.cos(radius_rad)
    assert (1.0 - behind.shares[1]) * areas[1] == pytest.approx(
        (1.0 - swapped.shares[1]) * areas[0], rel=2e-4
    )
    assert 0.2 < behind.shares[1] < 0.8


@pytest.mark.parametrize("turn", [0.5 * math.pi, -0.5 * math.pi, 0.5 * math.pi + 1e-9])
def test_an_edge_along_the_rows_hides_as_much_as_one_across(turn: float) -> None:
    camera = _camera()
    place, radius_rad = np.array([[27.5, 27.5]]), np.array([0.015])
    axis, none = direction_camera(place, camera), np.empty((0, 2), dtype=np.int64)
    for beyond_px in (-4.0, 0.0, 3.0):
        along, across = (
            seen_of_discs(place, axis, radius_rad, none, camera, np.array([27.5, 27.5, way, beyond_px]))
            for way in (turn, 0.0)
        )
        assert along is not None
        assert across is not None
        assert along.shares[0] == pytest.approx(across.shares[0], abs=1e-5)
