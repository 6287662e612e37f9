"""Transmission of narrowband filters against wavelength and angle (docs/physics.md, Narrowband filter)."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def transmission(
    wavelength_m: ArrayLike,
    cos_angle: ArrayLike,
    *,
    centre_m: float,
    fwhm_m: float,
    peak: float,
    effective_index: float,
    cavities: int,
    blocking_od: float,
) -> NDArray[np.float64]:
    """Return a filter's transmission; the arguments broadcast.

    The passband moves to shorter wavelengths with the angle of incidence, λ_c(θ) = λ_0 √(1 − (sin θ/n_eff)²).
    Its shape is that of `cavities` coupled cavities, a Butterworth curve, above a floor of 10^(−OD).

    Parameters
    ----------
    wavelength_m
        Wavelength in vacuum.
    cos_angle
        Cosine of the angle of incidence in air.
    centre_m, fwhm_m, peak
        Where the passband lies at normal incidence, how wide it is at half its height, and its height.
    effective_index
        The refractive index that sets how far it moves with the angle.
    cavities
        How steep its flanks are; 1 is Lorentzian.
    blocking_od
        The optical density out of band.
    """
    wavelength, cosine = np.broadcast_arrays(np.asarray(wavelength_m, float), np.asarray(cos_angle, float))
    sin_squared = 1.0 - cosine**2
    shifted_m = centre_m * np.sqrt(1.0 - sin_squared / effective_index**2)
    detuning = (wavelength - shifted_m) / (0.5 * fwhm_m)
    passband = peak / (1.0 + detuning ** (2 * cavities))
    return np.asarray(np.maximum(passband, 10.0**-blocking_od))
