"""Directions in cones, for whoever looks at a small sphere from outside; frames of rectangles."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_GOLDEN_ANGLE_RAD = np.pi * (3.0 - np.sqrt(5.0))


def perpendiculars(direction: Array) -> tuple[Array, Array]:
    """Return two unit vectors that make a right-handed frame with a unit vector, shape (3,) each."""
    helper = np.zeros(3)
    helper[np.argmin(np.abs(direction))] = 1.0
    x_axis = np.cross(direction, helper)
    x_axis /= np.linalg.norm(x_axis)
    return x_axis, np.cross(direction, x_axis)


def cone_directions(direction: Array, versine: Array, azimuth_rad: Array) -> Array:
    """Return unit directions at 1 − cos ψ = `versine` from an axis and at an azimuth about it.

    `versine` and `azimuth_rad` broadcast; the result has their shape and a last axis of 3. Solid angle is
    even in the versine, and the versine keeps its digits where the cosine of a small angle loses them.
    """
    x_axis, y_axis = perpendiculars(direction)
    sine = np.sqrt(versine * (2.0 - versine))[..., None]
    around = np.cos(azimuth_rad)[..., None] * x_axis + np.sin(azimuth_rad)[..., None] * y_axis
    return (1.0 - versine)[..., None] * direction + sine * around


@lru_cache(maxsize=256)
def legendre(count: int) -> tuple[Array, Array]:
    """Return nodes in −1 to 1 and weights of Gauss–Legendre quadrature, shape (count,) each, read-only."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    nodes.setflags(write=False)
    weights.setflags(write=False)
    return nodes, weights


def sunflower(direction: Array, angular_radius_rad: float, count: int) -> Array:
    """Return unit directions that cover a cone evenly, each for an equal solid angle, shape (count, 3)."""
    turn = np.arange(count)
    versine = (turn + 0.5) / count * cone_versine(angular_radius_rad)
    return cone_directions(direction, versine, _GOLDEN_ANGLE_RAD * turn)


def cone_versine(angular_radius_rad: float) -> float:
    """Return 1 − cos of a cone's half angle, exact for small ones."""
    return 2.0 * float(np.sin(0.5 * angular_radius_rad)) ** 2


def rectangle_frame(normal: Sequence[float], size_m: tuple[float, float], rotation_rad: float) -> Array:
    """Return half width, half height and unit normal of a rectangle as the columns of a matrix, shape (3, 3).

    Width runs horizontally, along world x where the normal is vertical, before it is turned about the normal.
    """
    facing = np.array(normal) / np.linalg.norm(normal)
    across = np.cross([0.0, 0.0, 1.0], facing)
    if np.linalg.norm(across) < 1e-9:
        across = np.array([1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    up = np.cross(facing, across)
    c, s = np.cos(rotation_rad), np.sin(rotation_rad)
    width, height = 0.5 * size_m[0], 0.5 * size_m[1]
    return np.stack([width * (c * across + s * up), height * (c * up - s * across), facing], axis=1)
