"""Where a sensor saturates: EMVA 1288's saturation capacity, and the charge at which its pixels clip.

Data sheets measured by the standard give the former: the mean photoelectrons at which the temporal variance
is largest. Shot noise of some pixels is clipped before the mean reaches the clip, so it lies 2 to 4 % below.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize_scalar
from scipy.special import ndtr

Real = TypeVar("Real", bound=np.floating)

_PIXEL_NODES = 401  # over the pixels' unlike responses
_CHARGE_NODES = 1601  # over shot noise, where the response is not linear
_REACH_SIGMAS = 8.0


@dataclass(frozen=True)
class Compression:
    """A soft non-linearity: of q electrons, q (1 − loss · (q / full well)^exponent) are read."""

    loss: float
    exponent: float

    def __call__(self, charge_e: NDArray[Real], full_well_e: float) -> NDArray[Real]:
        """Return the electrons that are read of a charge, same shape and type."""
        return charge_e * (1.0 - self.loss * (charge_e / full_well_e) ** self.exponent)


def temporal_variance_e2(
    mean_e: float, full_well_e: float, prnu: float = 0.0, compression: Compression | None = None
) -> float:
    """Return the mean over pixels of the variance of shot noise that a full well clips.

    Charge is Gaussian of variance equal to its mean, which it is to 1e-3 at the hundreds of electrons that
    any full well holds; the means of pixels spread by `prnu`, the standard deviation of their responses.
    """
    # An even grid: a clip is a corner, which Gauss–Hermite nodes would step over.
    nodes = np.linspace(-_REACH_SIGMAS, _REACH_SIGMAS, _PIXEL_NODES) if prnu else np.zeros(1)
    weights = np.exp(-0.5 * nodes**2)
    weights /= weights.sum()
    means_e = np.maximum(mean_e * (1.0 + prnu * nodes), 1e-9)
    sigma_e = np.sqrt(means_e)
    clip = (full_well_e - means_e) / sigma_e
    if compression is None:
        # Moments of min(z, c), z standard normal: E = c (1 − Φ) − φ, E² = Φ − c φ + c² (1 − Φ).
        phi, below = np.exp(-0.5 * clip**2) / math.sqrt(2.0 * math.pi), ndtr(clip)
        first = clip * (1.0 - below) - phi
        second = below - clip * phi + clip**2 * (1.0 - below)
        return float(weights @ (means_e * (second - first**2)))
    z = np.linspace(-_REACH_SIGMAS, _REACH_SIGMAS, _CHARGE_NODES)
    density = np.exp(-0.5 * z**2)
    density /= density.sum()
    charge_e = np.clip(means_e[:, None] + sigma_e[:, None] * z, 0.0, full_well_e)
    read_e = compression(charge_e, full_well_e)
    first = read_e @ density
    return float(weights @ (((read_e - first[:, None]) ** 2) @ density))


@lru_cache(maxsize=256)
def saturation_capacity_e(
    full_well_e: float, prnu: float = 0.0, compression: Compression | None = None
) -> float:
    """Return the mean photoelectrons at which the temporal variance is largest (EMVA 1288, section 6.6)."""

    def darkness(mean_e: float) -> float:
        return -temporal_variance_e2(mean_e, full_well_e, prnu, compression)

    # The variance has one peak; a coarse search brackets it, so that flat tails beyond cannot mislead.
    places = np.linspace(0.3 * full_well_e, full_well_e, 71)
    best = int(np.argmin([darkness(float(place)) for place in places]))
    low, high = places[max(best - 1, 0)], places[min(best + 1, len(places) - 1)]
    found = minimize_scalar(darkness, bounds=(low, high), method="bounded", options={"xatol": 1e-5 * high})
    return float(found.x)


@lru_cache(maxsize=256)
def full_well_e(capacity_e: float, prnu: float = 0.0, compression: Compression | None = None) -> float:
    """Return the charge at which pixels of a saturation capacity clip."""

    def beyond(well_e: float) -> float:
        return saturation_capacity_e(well_e, prnu, compression) - capacity_e

    return float(brentq(beyond, capacity_e, 3.0 * capacity_e + 100.0, xtol=1e-6 * capacity_e, rtol=1e-9))
