"""Sources as fusion leaves them, and the search for mirrors takes them: arrays."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Joined(NamedTuple):
    """Sources, n of them, and what the search for mirrors must know beside.

    Attributes
    ----------
    time_s, origin_m, bearing, range_m, covariance, common_m
        As in `Measurement` (`common_m` is its `range_sigma_common_m`), shape (n,), (n, 3), (n, 3), (n,),
        (n, 3, 3), (n,).
    seems_m
        How far it seems by flux, from the origin: of a mirror image that is not where it is, shape (n,).
    noise, common
        Standard deviations of the logarithm of that, by noise and by what sightings share, shape (n,).
    moved_m
        By how much a flux that is wrong by its σ moves the place, shape (n, 3).
    noise_m2
        Covariance of the place by all else, shape (n, 3, 3).
    saturated, merged, ghost
        Whether all that count are; whether any is; whether the estimator took all for images, shape (n,).
    """

    time_s: Array
    origin_m: Array
    bearing: Array
    range_m: Array
    covariance: Array
    common_m: Array
    seems_m: Array
    noise: Array
    common: Array
    moved_m: Array
    noise_m2: Array
    saturated: NDArray[np.bool_]
    merged: NDArray[np.bool_]
    ghost: NDArray[np.bool_]
