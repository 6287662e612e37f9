"""What is seen of sources, as the search for poses reckons with it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.types import Layout

Array = NDArray[np.float64]


class Sights(NamedTuple):
    """Sightings of sources, n of them.

    Attributes
    ----------
    origin_m
        Camera centres, shape (n, 3).
    axes
        Left, up and along each bearing, as rows, shape (n, 3, 3).
    log_range
        Logarithm of the range (m) by the range constant, NaN where it is not known, shape (n,).
    by_flux
        The share of that range which comes of flux and not of size, shape (n,).
    own
        Covariance of left, up (rad) and logarithm of range, by noise of each sighting, shape (n, 3, 3).
    shared
        What errors of one σ that sightings share do to them, shape (n, 3, errors).
    constant
        What the error of the range constant does to the logarithms, at one σ, shape (n,).
    """

    origin_m: Array
    axes: Array
    log_range: Array
    by_flux: Array
    own: Array
    shared: Array
    constant: Array


class Carried(NamedTuple):
    """A layout: places in body axes, shape (s, 3), logarithms of the fluxes, shape (s,), and their σ."""

    place_m: Array
    log_flux: Array
    flux_sigma_common: float
    flux_sigma_own: float


def carried(layout: Layout) -> Carried:
    """Return a layout as the search for poses reckons with it."""
    return Carried(
        np.array(layout.places_body_m),
        np.log(np.array(layout.relative_flux)),
        layout.flux_sigma_common,
        layout.flux_sigma_own,
    )
