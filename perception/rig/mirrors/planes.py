"""Mirrors as they are handed in and out, and as the search for them reckons: n, c and a parameter.

Of a constant reflectance R the search has −½ ln R, of a dielectric its refractive index.
"""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from perception.rig.mirrors.model import CONSTANT
from perception.types import MirrorPlane

Array = NDArray[np.float64]

KINDS: tuple[Literal["constant", "surface", "pane"], ...] = ("constant", "surface", "pane")


def check_planes(planes: Sequence[MirrorPlane]) -> None:
    """Refuse mirrors that cannot be.

    Raises
    ------
    ValueError
        If a normal is no unit vector, a kind is unknown, a parameter or covariance is out of bounds.
    """
    for number, plane in enumerate(planes):
        least = 1e-4 if plane.kind == "constant" else 1.0
        most = 1.0 if plane.kind == "constant" else 5.0
        covariance = np.asarray(plane.covariance)
        right = (
            plane.kind in KINDS
            and abs(math.hypot(*plane.normal_body) - 1.0) < 1e-6
            and math.isfinite(plane.distance_m)
            and least <= plane.parameter <= most
            and covariance.shape == (4, 4)
            and bool(np.isfinite(covariance).all())
            and bool((np.linalg.eigvalsh(covariance) >= -1e-12).all())
        )
        if not right:
            raise ValueError(
                f"planes[{number}] is {plane}; wanted a unit normal, a kind of {', '.join(KINDS)}, a "
                "reflectance up to 1 or an index from 1 to 5, and a covariance of shape (4, 4)"
            )


def prior_of(plane: MirrorPlane) -> tuple[Array, int, Array]:
    """Return a mirror as the search has it, shape (5,), its kind, and the precision of it, shape (4, 4)."""
    kind = KINDS.index(plane.kind)
    known = np.array([*plane.normal_body, plane.distance_m, plane.parameter], dtype=np.float64)
    covariance = np.asarray(plane.covariance, dtype=np.float64)
    if kind == CONSTANT:  # R → −½ ln R
        known[4] = -0.5 * math.log(plane.parameter)
        scale = np.diag([1.0, 1.0, 1.0, -0.5 / plane.parameter])
        covariance = scale @ covariance @ scale
    precision = np.asarray(np.linalg.inv(covariance + 1e-12 * np.eye(4)), dtype=np.float64)
    return known, kind, precision


def mirror_plane(plane: Array, kind: int, covariance: Array, images: int) -> MirrorPlane:
    """Return what the search has found, shape (5,), with its covariance, shape (4, 4), as a mirror."""
    x, y, z, distance_m, parameter = plane.tolist()
    if kind == CONSTANT:  # −½ ln R → R
        parameter = min(math.exp(-2.0 * parameter), 1.0)
        scale = np.diag([1.0, 1.0, 1.0, -2.0 * parameter])
        covariance = scale @ covariance @ scale
    return MirrorPlane((x, y, z), distance_m, KINDS[kind], parameter, covariance, images)
