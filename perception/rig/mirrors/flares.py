"""Flares as the search for mirrors reckons with them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
