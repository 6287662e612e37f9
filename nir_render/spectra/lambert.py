"""What an even, flat lamp brings to a small plane: Lambert's formula for polygons."""

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def polygon_share(corners_m: Array, shines: Array, at_m: Array, facing: Array) -> float:
    """Return the irradiance of a small plane by a polygon that shines after Lambert, over its exitance.

    E/M = 1/(2π) Σ θᵢ (n · eᵢ), where θᵢ is the angle that an edge fills and eᵢ the normal of the plane
    through it and the point (J. H. Lambert, Photometria, 1760; the configuration factor of a polygon, Hottel
    and Sarofim, Radiative Transfer, 1967). Exact at any distance; what is below the plane is cut off.

    Parameters
    ----------
    corners_m
        In order, either way round, shape (n, 3).
    shines
        Where the polygon shines, a vector of any length, shape (3,): behind it there is nothing.
    at_m, facing
        The point, and the unit normal of the plane, shape (3,).
    """
    to_m = np.asarray(corners_m, dtype=np.float64) - at_m
    if float(to_m[0] @ shines) >= 0.0:
        return 0.0
    seen = _above(to_m, facing)
    if len(seen) < 3:
        return 0.0
    units = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    total = 0.0
    for one, other in zip(units, np.roll(units, -1, axis=0), strict=True):
        normal = np.cross(one, other)
        sine = float(np.linalg.norm(normal))
        if sine > 0.0:
            total += math.atan2(sine, float(one @ other)) * float(normal @ facing) / sine
    return abs(total) / (2.0 * math.pi)


def _above(corners_m: Array, facing: Array) -> Array:
    """Return the part of a convex polygon that a plane through the origin sees (Sutherland and Hodgman)."""
    heights_m = corners_m @ facing
    kept = []
    for index in range(len(corners_m)):
        one, other = corners_m[index - 1], corners_m[index]
        low_m, high_m = heights_m[index - 1], heights_m[index]
        if (low_m > 0.0) != (high_m > 0.0):
            kept.append(one + low_m / (low_m - high_m) * (other - one))
        if high_m > 0.0:
            kept.append(other)
    return np.array(kept).reshape(-1, 3)
