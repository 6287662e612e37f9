"""Transmission of narrowband interference filters against wavelength and angle."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nir_render.scene.bandpass import Bandpass


def transmission(bandpass: Bandpass, wavelength_m: ArrayLike, cos_angle: ArrayLike) -> NDArray[np.float64]:
    """Return a filter's transmission; the arguments broadcast.

    The passband moves to shorter wavelengths with the angle of incidence, λ_c(θ) = λ_0 √(1 − (sin θ/n_eff)²).
    Its shape is that of `cavities` coupled cavities, a Butterworth curve, above a floor of 10^(−OD).

    Parameters
    ----------
    wavelength_m
        Wavelength in vacuum.
    cos_angle
        Cosine of the angle of incidence in air.
    """
    wavelength, cosine = np.broadcast_arrays(np.asarray(wavelength_m, float), np.asarray(cos_angle, float))
    sin_squared = 1.0 - cosine**2
    centre_m = bandpass.centre_m * np.sqrt(1.0 - sin_squared / bandpass.effective_index**2)
    detuning = (wavelength - centre_m) / (0.5 * bandpass.fwhm_m)
    passband = bandpass.peak_transmission / (1.0 + detuning ** (2 * bandpass.cavities))
    return np.asarray(np.maximum(passband, 10.0**-bandpass.blocking_od))
