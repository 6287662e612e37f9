"""The compiled loops of the search for mirrors, against derivatives by differences and NumPy."""

import numpy as np
import pytest

from perception.rig.mirrors.flares import Flares
from perception.rig.mirrors.model import CONSTANT, PANE, SURFACE, pair_covariance, residual
from perception.rig.rays import axes_into
from perception.types import bearing_axes
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
        flares = Flares(
            origin_m[None], place_m[None], np.array([5.0]), bearing_axes(bearing)[None], angular_rad2[None],
            np.array([0.2]), noise_m2[None], np.array([0.3]), moved_m[None],
        )  # fmt: skip
        slope, covariance = np.empty((3, 3)), np.empty((3, 3))
        pair_covariance(flares, 0, 0, plane, kind, slope, covariance)
        step_m = 1e-6
        wanted = np.transpose(
            [
                np.subtract(
                    residual(flares, 0, plane, kind, *(place_m + step)),
                    residual(flares, 0, plane, kind, *(place_m - step)),
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
