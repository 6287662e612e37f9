"""Ranges in fog: what extinction takes from flux makes sources seem farther than they are.

F = K t c e^(−σ d)/d², so the range D that flux says in clear air is D = d e^(σ d/2). The size of a near
source is that of d all the same.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perception.model.ranging import constant_spread
from perception.types import Calibration

Array = NDArray[np.float64]

LOOSE = 0.6
"""σ_K / K with which flares are fitted where fog may have taken light: V = 50 m takes 0.6 of it on 12 m."""

_STEPS = 12
_TOLD_BY_SIZE = 0.5


@dataclass(frozen=True)
class RangeInFog:
    """Ranges, their standard deviations, and the part of these that measurements of one source share."""

    range_m: Array
    range_sigma_m: Array
    range_sigma_common_m: Array

    def doubted(self, log_sigma: Array, log_sigma_common: Array) -> "RangeInFog":
        """Return the ranges, the σ of their logarithms wider by so much, whatever fog, flux and size say.

        Of `log_sigma`, that of all measurements together is `log_sigma_common`.
        """
        sigma_m = np.hypot(self.range_sigma_m, self.range_m * log_sigma)
        return RangeInFog(
            self.range_m, sigma_m, np.hypot(self.range_sigma_common_m, self.range_m * log_sigma_common)
        )


def may_be_in_fog(calibration: Calibration) -> bool:
    """Tell whether a calibration knows of fog, or does not exclude it: an extinction that is not 0 ± 0."""
    return calibration.extinction_per_m > 0.0 or extinction_sigma_per_m(calibration) > 0.0


def extinction_sigma_per_m(calibration: Calibration) -> float:
    """Return the standard deviation of what the calibration states of the extinction."""
    return calibration.sigma.get("extinction_per_m", 0.0)


def forward_sigma(calibration: Calibration) -> float:
    """Return the relative standard deviation of the forward light that a calibration states, 0 of none."""
    return max((light.share_sigma for light in calibration.forward_light), default=0.0)


def loosened(calibration: Calibration) -> Calibration:
    """Return a calibration that ties sizes to fluxes no closer than fog allows."""
    constant = calibration.range_constant_dn_m2_per_s
    spread = max(LOOSE * constant, calibration.sigma.get("range_constant_dn_m2_per_s", 0.0))
    return replace(calibration, sigma={**calibration.sigma, "range_constant_dn_m2_per_s": spread})


def range_in_fog_m(clear_air_range_m: ArrayLike, extinction_per_m: float) -> Array:
    """Return the range d of which flux says D in clear air: ln d + σ d/2 = ln D, by Newton's method in ln d.

    Parameters
    ----------
    clear_air_range_m
        D, any shape.
    extinction_per_m
        σ, light lost per metre; 0 is clear air.

    Examples
    --------
    >>> round(float(range_in_fog_m(10.0, 0.078)), 3)
    7.472
    """
    log_said = np.log(np.asarray(clear_air_range_m, dtype=np.float64))
    log_range = log_said.copy()
    for _ in range(_STEPS):
        half_depth = 0.5 * extinction_per_m * np.exp(log_range)
        log_range = log_range - (log_range + half_depth - log_said) / (1.0 + half_depth)
    return np.asarray(np.exp(log_range))


def size_alone(
    range_m: Array,
    sigma_m: Array,
    by_flux_m: Array,
    flux_share_sigma: Array,
    constant_sigma: Array | float = LOOSE,
    least: float = _TOLD_BY_SIZE,
) -> tuple[Array, Array]:
    """Return what size alone says of ranges that were fitted to size and flux, NaN where nothing.

    Parameters
    ----------
    range_m, sigma_m
        By size and flux together.
    by_flux_m
        By flux in clear air.
    flux_share_sigma
        Standard deviation of the flux, relatively.
    constant_sigma
        That of the range constant, relatively, with which they were fitted: that of `loosened` as it is.
    least
        Of what flux tells, with that constant, so much at least must size tell to be heard.

    Returns
    -------
    Ranges and their standard deviations, of the shape of what is given.
    """
    of_flux2 = (0.5 * constant_sigma) ** 2 + (0.5 * flux_share_sigma) ** 2
    both2 = (sigma_m / range_m) ** 2
    precision = 1.0 / both2 - 1.0 / of_flux2
    told = precision > least / of_flux2
    precision = np.where(told, precision, 1.0)
    log_range = (np.log(range_m) / both2 - np.log(by_flux_m) / of_flux2) / precision
    log_range = np.where(told, log_range, 0.0)
    return np.where(told, np.exp(log_range), np.nan), np.where(
        told, np.exp(log_range) / np.sqrt(precision), np.nan
    )


def ranged_in_fog(
    by_flux_m: Array,
    flux_share_sigma: Array,
    by_size_m: Array,
    by_size_sigma_m: Array,
    calibration: Calibration,
) -> RangeInFog:
    """Join what flux and size say of ranges, by what a calibration knows of fog, K and radius.

    Parameters
    ----------
    by_flux_m
        Ranges by flux in clear air.
    flux_share_sigma
        Standard deviation of the fluxes by noise, relatively.
    by_size_m, by_size_sigma_m
        Ranges by size alone, NaN where size tells nothing.
    calibration
        Its `extinction_per_m`, and the standard deviations of that, of the range constant and the radius.
    """
    range_m = range_in_fog_m(by_flux_m, calibration.extinction_per_m)
    # ln d moves by 1/(1 + σ d/2) of what ln D does.
    slope = 1.0 / (1.0 + 0.5 * calibration.extinction_per_m * range_m)
    noise = 0.5 * flux_share_sigma * slope
    constant = constant_spread(calibration)
    by_extinction = 0.5 * range_m * extinction_sigma_per_m(calibration)
    common = slope * np.hypot(0.5 * constant, by_extinction)
    radius = calibration.sigma.get("source_radius_m", 0.0) / max(calibration.source_radius_m, 1e-12)
    has_size = np.isfinite(by_size_m)
    size_noise2 = np.where(has_size, (by_size_sigma_m / by_size_m) ** 2 - radius**2, 1.0)
    size_noise2 = np.maximum(size_noise2, 1e-12)
    flux_weight = 1.0 / (noise**2 + common**2)
    size_weight = np.where(has_size, 1.0 / (size_noise2 + radius**2), 0.0)
    total = flux_weight + size_weight
    by_size = np.log(np.where(has_size, by_size_m, 1.0))
    log_range = (flux_weight * np.log(range_m) + size_weight * by_size) / total
    shared = np.hypot(flux_weight * common, size_weight * radius) / total
    joined_m = np.exp(log_range)
    return RangeInFog(joined_m, joined_m / np.sqrt(total), joined_m * shared)
