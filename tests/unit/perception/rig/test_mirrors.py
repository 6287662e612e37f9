"""The compiled loops of the search for mirrors, against derivatives by differences and NumPy."""

import numpy as np
import pytest

from perception.rig.joined import Joined
from perception.rig.mirrors.flares import Flares, flares_of
from perception.rig.mirrors.model import (
    CONSTANT,
    PANE,
    SURFACE,
    _chi2,
    log_determinant,
    pair_covariance,
    residual,
)
from perception.rig.mirrors.odds import _log_sum
from perception.rig.mirrors.planes import prior_of
from perception.rig.rays import axes_into
from perception.types import MirrorPlane, bearing_axes
from tests.unit.perception.simulation import random


@pytest.mark.parametrize(("kind", "parameter"), [(CONSTANT, 0.1), (SURFACE, 1.5), (PANE, 1.6)])
def test_the_covariance_of_a_pair_is_by_its_derivatives(kind: int, parameter: float) -> None:
    rng = random(1700, kind)
    for _ in range(20):
        normal = rng.normal(size=3)
        plane = np.array([*normal / np.linalg.norm(normal), 2.0, parameter])
        place_m, origin_m = rng.normal(size=3), 0.05 * rng.normal(size=3)
        shown_m = place_m + 2.0 * (2.0 - plane[:3] @ place_m) * plane[:3] + 0.02 * rng.normal(size=3)
        bearing = (shown_m - origin_m) / np.linalg.norm(shown_m - origin_m)
        root, angular = rng.normal(size=(3, 3)), rng.normal(size=(2, 2))
        noise_m2, angular_rad2, moved_m = root @ root.T, angular @ angular.T, rng.normal(size=3)
        # The parent's own bearing, noise and flux have no say, nor what the image's place is known by.
        flares = Flares(
            np.array([[9.0] * 3, origin_m]), np.array([place_m, [9.0] * 3]), np.array([9.0, 5.0]),
            np.array([np.eye(3), bearing_axes(bearing)]), np.array([9.0 * np.eye(2), angular_rad2]),
            np.array([9.0, 0.2]), np.array([noise_m2, 9.0 * np.eye(3)]), np.array([9.0, 0.3]),
            np.array([moved_m, [9.0] * 3]),
        )  # fmt: skip
        slope, covariance = np.empty((3, 3)), np.empty((3, 3))
        off = pair_covariance(flares, 0, 1, plane, kind, slope, covariance)
        assert off == residual(flares, 1, plane, kind, *place_m)
        wanted_off = np.linalg.solve(covariance, off) @ off
        assert _chi2(covariance, *off) == pytest.approx(wanted_off, rel=1e-9)
        step_m = 1e-6
        wanted = np.transpose(
            [
                np.subtract(
                    residual(flares, 1, plane, kind, *(place_m + step)),
                    residual(flares, 1, plane, kind, *(place_m - step)),
                )
                / (2.0 * step_m)
                for step in step_m * np.eye(3)
            ]
        )
        np.testing.assert_allclose(slope, wanted, rtol=1e-5, atol=1e-6)
        shared = wanted @ moved_m + np.array([0.0, 0.0, 0.3])
        of_image = np.zeros((3, 3))
        of_image[:2, :2], of_image[2, 2] = angular_rad2, 0.2**2
        wanted = wanted @ noise_m2 @ wanted.T + np.outer(shared, shared) + of_image
        np.testing.assert_allclose(covariance, wanted, rtol=1e-4, atol=1e-6)


def test_axes_of_bearings_are_those_of_the_contract() -> None:
    bearings = random(1701).normal(size=(50, 3))
    bearings[0], bearings[1] = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    axes = np.empty((len(bearings), 3, 3))
    for own, bearing in zip(axes, bearings, strict=True):
        axes_into(own, bearing)
    np.testing.assert_allclose(axes, bearing_axes(bearings), atol=1e-15)


def test_logarithms_are_numpys() -> None:
    root = random(1702).normal(size=(4, 6))
    matrix = root @ root.T
    assert log_determinant(matrix, 2.5) == pytest.approx(np.linalg.slogdet(2.5 * matrix)[1], rel=1e-12)
    for one, other in ((-3.0, -2.0), (5.0, -700.0), (-np.inf, 1.0), (-np.inf, -np.inf), (1.0, -np.inf)):
        assert _log_sum(one, other) == pytest.approx(np.logaddexp(one, other), rel=1e-14)
    assert _log_sum(1.0, np.nan) == 1.0  # a fit that has failed


@pytest.mark.parametrize("own", [0, 2])
def test_flares_are_what_sources_are(own: int) -> None:
    draw, n = random(1703, own), 4
    bearing = draw.normal(size=(n, 3))
    bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
    covariance = draw.normal(size=(n, 3, 3))
    covariance[2, 2, 2] = np.nan
    joined = Joined(
        np.zeros(n), draw.normal(size=(n, 3)), bearing, draw.uniform(1.0, 5.0, n), covariance, np.zeros(n),
        draw.uniform(1.0, 5.0, n), draw.random(n), draw.random(n), draw.normal(size=(n, 3)),
        draw.normal(size=(n, 3, 3)), *np.zeros((3, n), dtype=np.bool_),
    )  # fmt: skip
    rows, places = np.array([3, 0, 2]), draw.normal(size=(own, 3))
    flares = flares_of(joined, rows, places)
    wanted_m = joined.origin_m[rows] + joined.range_m[rows, None] * bearing[rows]
    np.testing.assert_allclose(flares.place_m, [*wanted_m, *places], rtol=1e-14)
    np.testing.assert_array_equal(flares.origin_m, [*joined.origin_m[rows], *np.zeros((own, 3))])
    for name, rest in (("seems_m", 1.0), ("noise", 0.0), ("common", 0.0)):
        wanted = [*getattr(joined, name)[rows], *[rest] * own]
        np.testing.assert_array_equal(getattr(flares, name), wanted)
    np.testing.assert_allclose(flares.axes, [*bearing_axes(bearing[rows]), *[np.eye(3)] * own], atol=1e-15)
    angular = [covariance[3, :2, :2], covariance[0, :2, :2], 1e-6 * np.eye(2), *[np.zeros((2, 2))] * own]
    np.testing.assert_array_equal(flares.angular_rad2, angular)
    np.testing.assert_allclose(
        flares.noise_m2, [*joined.noise_m2[rows], *[4e-6 * np.eye(3)] * own], rtol=1e-14
    )
    np.testing.assert_array_equal(flares.moved_m, [*joined.moved_m[rows], *np.zeros((own, 3))])


def test_a_known_plane_of_whole_numbers_is_one_of_floats() -> None:
    known, _, _ = prior_of(MirrorPlane((0, 1, 0), 2, "pane", 2, np.eye(4), 1))
    assert known.dtype == np.float64
