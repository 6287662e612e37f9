"""Spectra of LEDs: two half Gaussians, and what junction temperature and drive current make of them.

Data sheets give a centroid, a width at half height, and often a peak that lies elsewhere: the flanks differ.
Half a Gaussian on each side of the peak, of widths σ(1 ∓ skew) about their mean, has that width at half
height, and its centroid lies √(2/π) (σ_long − σ_short) beyond its peak (the two-piece normal distribution;
S. John, Commun. Stat. Theory Methods 11, 879, 1982).
"""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nir_render.spectra.curve import Curve

_HALF_WIDTH_SIGMAS = math.sqrt(2.0 * math.log(2.0))
_REACH_SIGMAS = 5.9  # as of a Gaussian spectrum: 4e-9 of the flux is left outside
_POINTS = 1001


def led_spectrum(centroid_m: float, fwhm_m: float, skew: float, name: str) -> Curve:
    """Return an LED's spectrum of unit flux, in 1/m.

    `skew`, from −1 to 1, is by how much the flank to longer wavelengths is wider than the mean of both; a
    peak at longer wavelengths than the centroid is a negative one (`skew_of_peak`).
    """
    mean_sigma_m = 0.5 * fwhm_m / _HALF_WIDTH_SIGMAS
    short_m, long_m = mean_sigma_m * (1.0 - skew), mean_sigma_m * (1.0 + skew)
    peak_m = centroid_m - math.sqrt(2.0 / math.pi) * (long_m - short_m)
    shorter = np.linspace(peak_m - _REACH_SIGMAS * short_m, peak_m, _POINTS // 2 + 1)
    longer = np.linspace(peak_m, peak_m + _REACH_SIGMAS * long_m, _POINTS // 2 + 1)
    wavelength_m = np.concatenate([shorter, longer[1:]])
    sigma_m = np.where(wavelength_m < peak_m, short_m, long_m)
    density = np.exp(-0.5 * ((wavelength_m - peak_m) / sigma_m) ** 2)
    return Curve(wavelength_m, density, name).normalised()


def skew_of_peak(centroid_m: float, fwhm_m: float, peak_m: float) -> float:
    """Return the skew of an LED whose peak does not lie at its centroid.

    >>> round(skew_of_peak(940e-9, 42e-9, 950e-9), 3)
    -0.351
    """
    mean_sigma_m = 0.5 * fwhm_m / _HALF_WIDTH_SIGMAS
    return (centroid_m - peak_m) / (math.sqrt(8.0 / math.pi) * mean_sigma_m)


def power_at_current(current_a: ArrayLike, points_a: tuple[tuple[float, float], ...]) -> NDArray[np.float64]:
    """Return the relative flux at currents of any shape: straight between points on logarithmic axes.

    `points_a` are (current, relative flux), both above 0; beyond their ends it keeps the last value: who
    calls refuses such currents.
    """
    currents_a, power = np.array(points_a).T
    return np.asarray(np.exp(np.interp(np.log(current_a), np.log(currents_a), np.log(power))))
