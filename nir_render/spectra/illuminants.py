"""Emission spectra: LEDs as Gaussians, lamps by Planck's law, scaled by what the eye sees of them."""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nir_render.spectra.curve import Curve

# Second radiation constant h c / k_B, and the luminous efficacy of 555 nm light (both exact in the SI).
_HC_OVER_K_M_K = 6.62607015e-34 * 299_792_458.0 / 1.380649e-23
_EFFICACY_LM_PER_W = 683.0

# What silicon sees: a lamp's flux counts over this range.
SILICON_M = (300e-9, 1100e-9)

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


def planck_shape(wavelength_m: NDArray[np.float64], temperature_k: float) -> NDArray[np.float64]:
    """Return the spectral exitance of a black body over wavelength, up to a constant."""
    return wavelength_m**-5.0 / np.expm1(_HC_OVER_K_M_K / (wavelength_m * temperature_k))


def incandescent_spectrum(temperature_k: float, name: str) -> Curve:
    """Return Planck's spectrum over what silicon sees, of unit flux there, in 1/m."""
    wavelength_m = np.linspace(*SILICON_M, 1601)
    return Curve(wavelength_m, planck_shape(wavelength_m, temperature_k), name).normalised()


@lru_cache(maxsize=64)
def incandescent_flux_w(luminous_flux_lm: float, temperature_k: float) -> float:
    """Return the radiant flux, over what silicon sees, of a lamp of a luminous flux.

    Φ_v = 683 lm/W ∫ V(λ) Φ_λ dλ with the CIE 1924 photopic V(λ), which colour-science tabulates.
    """
    import colour  # takes a second to import; only scenes with lamps need it

    photopic = colour.SDS_LEFS["CIE 1924 Photopic Standard Observer"]
    wavelength_m = np.asarray(photopic.wavelengths) * 1e-9
    spectrum = incandescent_spectrum(temperature_k, "lamp")
    seen = np.trapezoid(np.asarray(photopic.values) * spectrum(wavelength_m), wavelength_m)
    return float(luminous_flux_lm / (_EFFICACY_LM_PER_W * seen))
