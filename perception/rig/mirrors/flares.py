"""Flares as the search for mirrors reckons with them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.rig.joined import Joined
from perception.rig.rays import axes_into

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

UNCLAIMED_RAD = 1e-3
"""Standard deviation that a bearing is given where none is claimed."""

OWN_SIGMA_M = 2e-3
"""How well the observer knows where its own sources sit."""


class Flares(NamedTuple):
    """Flares of known range, n of them, and behind them the observer's own sources.

    Attributes
    ----------
    origin_m, place_m
        Where bearings count from, and where flares are, in body axes, shape (m, 3).
    seems_m
        How far they seem by flux, shape (m,): mirror images are nearer.
    axes
        Left, up and along each bearing, as rows, shape (m, 3, 3).
    angular_rad2
        Covariance of the bearing, shape (m, 2, 2).
    noise
        Standard deviation of the logarithm of the range, by noise, shape (m,).
    noise_m2
        Covariance of the place by noise, shape (m, 3, 3).
    common, moved_m
        Standard deviation of the logarithm of the range by what all images of a source share, shape (m,), and
        by how much that moves the place, shape (m, 3).
    """

    origin_m: Array
    place_m: Array
    seems_m: Array
    axes: Array
    angular_rad2: Array
    noise: Array
    noise_m2: Array
    common: Array
    moved_m: Array


@compiled
def flares_of(joined: Joined, rows: Indices, own_sources_body_m: Array) -> Flares:
    """Return some sources as the search reckons with them, and behind them the observer's own."""
    n = len(rows)
    m = n + len(own_sources_body_m)
    flares = Flares(
        np.zeros((m, 3)), np.empty((m, 3)), np.ones(m), np.zeros((m, 3, 3)), np.zeros((m, 2, 2)),
        np.zeros(m), np.zeros((m, 3, 3)), np.zeros(m), np.zeros((m, 3)),
    )  # fmt: skip
    for k in range(n):
        row = rows[k]
        flares.origin_m[k], flares.moved_m[k] = joined.origin_m[row], joined.moved_m[row]
        for x in range(3):
            flares.place_m[k, x] = flares.origin_m[k, x] + joined.range_m[row] * joined.bearing[row, x]
        flares.seems_m[k] = joined.seems_m[row]
        flares.noise[k], flares.common[k] = joined.noise[row], joined.common[row]
        flares.noise_m2[k] = joined.noise_m2[row]
        axes_into(flares.axes[k], joined.bearing[row])
        claimed = np.isfinite(joined.covariance[row]).all()
        for a in range(2):
            for b in range(2):
                unclaimed_rad2 = UNCLAIMED_RAD**2 if a == b else 0.0
                flares.angular_rad2[k, a, b] = joined.covariance[row, a, b] if claimed else unclaimed_rad2
    for k in range(n, m):
        flares.place_m[k] = own_sources_body_m[k - n]
        for x in range(3):
            flares.axes[k, x, x], flares.noise_m2[k, x, x] = 1.0, OWN_SIGMA_M**2
    return flares
