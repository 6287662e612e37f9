"""Emission spectra of near-infrared LEDs."""

import math

import numpy as np

from nir_render.spectra.curve import Curve

_FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))


def gaussian_spectrum(centroid_m: float, fwhm_m: float, name: str) -> Curve:
    """Return a Gaussian emission spectrum of unit flux, in 1/m.

    It ends 5.9 standard deviations (2.5 FWHM) from its centre, where 4e-9 of the flux is left outside.
    The step, 1/200 of the FWHM, keeps trapezoidal integrals of smooth products within 1e-5.
    """
    reach_m = 2.5 * fwhm_m
    wavelength_m = np.linspace(centroid_m - reach_m, centroid_m + reach_m, 1001)
    sigma_m = fwhm_m / _FWHM_PER_SIGMA
    density = np.exp(-0.5 * ((wavelength_m - centroid_m) / sigma_m) ** 2)
    return Curve(wavelength_m, density, name).normalised()
