"""Emission spectra: LEDs as Gaussians, lamps by Planck's law or by tables, scaled by what the eye sees."""

import math
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from nir_render.spectra.curve import Curve

# Second radiation constant h c / k_B, and the luminous efficacy of 555 nm light (both exact in the SI).
_HC_OVER_K_M_K = 6.62607015e-34 * 299_792_458.0 / 1.380649e-23
_EFFICACY_LM_PER_W = 683.0
_FIRST_RADIATION_W_M2 = 2.0 * math.pi * 6.62607015e-34 * 299_792_458.0**2

# The sun: its effective temperature (IAU 2015, resolution B3), and its radius as seen at its mean distance.
_SUN_K = 5772.0
SUN_RADIUS_RAD = math.radians(0.2666)

# What silicon sees: a lamp's flux counts over this range.
SILICON_M = (300e-9, 1100e-9)

# What a table must cover so that lumens say how much a lamp sends: 99.9 % of what the eye sees of even light.
VISIBLE_M = (400e-9, 700e-9)

# Tables of lamps in CIE 15:2018 (fluorescent: FL2 cool white, FL7 daylight, FL11 and FL12 three bands; high
# pressure sodium HP1; white LEDs: B1 to B5 blue chip and phosphor, 2733 to 6598 K, V1 violet chip).
CieLamp = Literal[
    "FL2", "FL7", "FL11", "FL12", "HP1", "LED-B1", "LED-B2", "LED-B3", "LED-B4", "LED-B5", "LED-V1"
]  # fmt: skip
CIE_END_M = 780e-9

_FWHM_PER_SIGMA = 2.0 * math.sqrt(2.0 * math.log(2.0))


@lru_cache(maxsize=256)
def gaussian_spectrum(centroid_m: float, fwhm_m: float, name: str) -> Curve:
    """Return a Gaussian emission spectrum of unit flux, in 1/m.

    It ends 5.9 standard deviations (2.5 FWHM) from its centre, where 4e-9 of the flux is left outside.
    The step, 1/200 of the FWHM, keeps trapezoidal integrals of smooth products within 1e-5.
    """
    reach_m = 2.5 * fwhm_m
    wavelength_m = np.linspace(centroid_m - reach_m, centroid_m + reach_m, 1001)
    sigma_m = fwhm_m / _FWHM_PER_SIGMA
    density = np.exp(-0.5 * ((wavelength_m - centroid_m) / sigma_m) ** 2)
    curve = Curve(wavelength_m, density, name).normalised()
    curve.wavelength_m.flags.writeable = curve.value.flags.writeable = False  # many have it
    return curve


def planck_shape(wavelength_m: NDArray[np.float64], temperature_k: float) -> NDArray[np.float64]:
    """Return the spectral exitance of a black body over wavelength, up to a constant."""
    return wavelength_m**-5.0 / np.expm1(_HC_OVER_K_M_K / (wavelength_m * temperature_k))


def sunlight_ceiling(wavelength_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a spectral irradiance in W/m³ that no light of the sun exceeds, at its mean distance.

    A quarter more than that of a black body of 5772 K of the sun's size: of the extraterrestrial column of
    ASTM G173, 300 to 1100 nm, the largest value is 1.235 times that (at 451 nm).
    """
    exitance = _FIRST_RADIATION_W_M2 * planck_shape(wavelength_m, _SUN_K)
    return 1.25 * exitance * math.sin(SUN_RADIUS_RAD) ** 2


def incandescent_spectrum(temperature_k: float, name: str) -> Curve:
    """Return Planck's spectrum over what silicon sees, of unit flux there, in 1/m."""
    wavelength_m = np.linspace(*SILICON_M, 1601)
    return Curve(wavelength_m, planck_shape(wavelength_m, temperature_k), name).normalised()


@lru_cache(maxsize=64)
def table_of(lamp: CieLamp) -> Curve:
    """Return the table of a lamp of CIE 15, 380 to 780 nm in steps of 5 nm, any scale."""
    table = _colour().SDS_ILLUMINANTS[lamp]
    return Curve(np.asarray(table.wavelengths) * 1e-9, np.asarray(table.values, dtype=np.float64), lamp)


def with_infrared(table: Curve, share: float) -> Curve:
    """Return a table continued to 1100 nm, flat, by this share of the flux within it, of unit flux, in 1/m.

    From 380 nm, where tables begin, down to 300 nm nothing is added.
    """
    end_m, beyond_m = table.high_m, SILICON_M[1] - table.high_m
    level = share * table.integral() / beyond_m
    wavelength_m = np.concatenate([table.wavelength_m, [end_m * (1.0 + 1e-9), SILICON_M[1]]])
    return Curve(wavelength_m, np.concatenate([table.value, [level, level]]), table.name).normalised()


@lru_cache(maxsize=64)
def incandescent_flux_w(luminous_flux_lm: float, temperature_k: float) -> float:
    """Return the radiant flux, over what silicon sees, of an incandescent lamp of a luminous flux."""
    return radiant_flux_w(luminous_flux_lm, incandescent_spectrum(temperature_k, "lamp"))


def radiant_flux_w(luminous_flux_lm: float, spectrum: Curve) -> float:
    """Return the radiant flux of light of a luminous flux and a spectrum of unit flux.

    Φ_v = 683 lm/W ∫ V(λ) Φ_λ dλ with the CIE 1924 photopic V(λ), which colour-science tabulates. Where a
    spectrum begins later or ends earlier, nothing is seen.
    """
    return luminous_flux_lm / _luminous_lm(spectrum)


def efficacy_lm_per_w(spectrum: Curve) -> float:
    """Return the luminous flux of a watt of light of a spectrum of any scale; of no light, 0."""
    sent = spectrum.integral()
    return _luminous_lm(spectrum) / sent if sent > 0.0 else 0.0


def _luminous_lm(spectrum: Curve) -> float:
    photopic = _colour().SDS_LEFS["CIE 1924 Photopic Standard Observer"]
    wavelength_m, value = np.asarray(photopic.wavelengths) * 1e-9, np.asarray(photopic.values)
    within = (wavelength_m >= spectrum.low_m) & (wavelength_m <= spectrum.high_m)
    wavelength_m = wavelength_m[within]
    seen = np.trapezoid(value[within] * spectrum(wavelength_m), wavelength_m)
    return float(_EFFICACY_LM_PER_W * seen)


def _colour() -> Any:
    import colour  # takes a second to import; only scenes with lamps need it

    return colour
