"""Transmission of narrowband filters against wavelength and angle (docs/physics.md, Narrowband filter)."""

import math

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
    cavities: float,
    blocking_od: float,
) -> NDArray[np.float64]:
    """Return a filter's transmission; the arguments broadcast.

    The passband moves to shorter wavelengths with the angle of incidence, λ_c(θ) = λ_0 √(1 − (sin θ/n_eff)²).
    Its shape is that of `cavities` coupled cavities, a Butterworth curve, above a floor of 10^(−OD); a number
    between whole ones has a flank between theirs (`cavities_of_edge`).

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
    shifted_m = centre_m * blue_shift(cosine, effective_index)
    detuning = (wavelength - shifted_m) / (0.5 * fwhm_m)
    if not float(cavities).is_integer():
        detuning = np.abs(detuning)  # only then: powers of ±x differ in their last bit on some processors
    with np.errstate(over="ignore"):  # far from a steep passband nothing is left but the floor
        passband = peak / (1.0 + detuning ** (2 * cavities))
    return np.asarray(np.maximum(passband, 10.0**-blocking_od))


def blue_shift(cos_angle: ArrayLike, effective_index: float) -> NDArray[np.float64]:
    """Return √(1 − (sin θ/n_eff)²), by which a filter's wavelengths shrink at an angle in air."""
    sin_squared = 1.0 - np.asarray(cos_angle, float) ** 2
    return np.asarray(np.sqrt(1.0 - sin_squared / effective_index**2))


def cavities_of_edge(edge_m: float, fwhm_m: float) -> float:
    """Return the cavities whose flanks fall from 90 to 10 % of the peak within `edge_m`.

    T/T_0 = 1/(1 + δ^2m) is 0.9 and 0.1 at δ = 9^(∓1/2m), so the edge is FWHM · sinh(ln 9 / 2m).
    """
    return math.log(9.0) / (2.0 * math.asinh(edge_m / fwhm_m))


def width_at_half_m(wavelength_m: NDArray[np.float64], transmission_there: NDArray[np.float64]) -> float:
    """Return the width of a table's passband between the outermost crossings of half its height."""
    half = 0.5 * transmission_there.max()
    above = np.flatnonzero(transmission_there >= half)
    ends = []
    for inner, outer in ((above[0], above[0] - 1), (above[-1], above[-1] + 1)):
        if not 0 <= outer < len(wavelength_m):
            ends.append(wavelength_m[inner])
            continue
        share = (half - transmission_there[outer]) / (transmission_there[inner] - transmission_there[outer])
        ends.append(wavelength_m[outer] + share * (wavelength_m[inner] - wavelength_m[outer]))
    return float(ends[1] - ends[0])
