"""Light out of band: what a camera sees of an emitter beside its filter's passband, and how surely.

A filter's floor of 10⁻⁴ counts for little with an LED and for much under a lamp or the sun, which shine over
all that silicon sees. The floor is stated as a bound, quantum efficiencies are published at few wavelengths,
tables end, and of a sun by its `irradiance` at 940 nm nothing else is known: so what leaks is an interval,
beside what frames are rendered with.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import constants

from nir_render.camera.optics.response import incidence, kind_alone, merged_grid, optics_alone
from nir_render.scene.documents.ambient.sun import Skylight, Sun
from nir_render.scene.documents.camera import Camera
from nir_render.scene.emission import Emitter, emission_spectrum
from nir_render.spectra.illuminants import sunlight_ceiling
from nir_render.spectra.nodes import BAND_M

_HALF_BAND_M = 5e-9  # what counts as in band where there is no filter

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Leak:
    """What one joule of an emitter's light becomes on the axis, in electrons: in band, and out of it.

    `band_m` are the ends of the band; `out_of_band_e_per_j` is what frames are rendered with, `low_e_per_j`
    and `high_e_per_j` between what it is known to lie.
    """

    band_m: tuple[float, float]
    in_band_e_per_j: float
    out_of_band_e_per_j: float
    low_e_per_j: float
    high_e_per_j: float

    @property
    def out_of_band_shares(self) -> tuple[float, float, float] | None:
        """What is out of band over what is in band: as rendered, at least, at most; None of nothing."""
        if self.in_band_e_per_j == 0.0:
            return None
        rendered, low, high = (
            part / self.in_band_e_per_j
            for part in (self.out_of_band_e_per_j, self.low_e_per_j, self.high_e_per_j)
        )
        return rendered, low, high


def leak(camera: Camera, emitter: Emitter) -> Leak:
    """Return what a camera sees of an emitter in band and out of band, on its axis.

    The band is where the filter passes more than 1 % of its peak at the angles of light on the axis; without
    a filter, 935 to 945 nm.
    """
    return _leak(optics_alone(camera), kind_alone(emitter), _flat_w_per_m3(emitter))


def _flat_w_per_m3(emitter: Emitter) -> float | None:
    """Return the spectral irradiance of a sun or sky of which it is known at 940 nm alone."""
    if isinstance(emitter, Sun) and emitter.air is None:
        return emitter.irradiance_w_per_m3
    return emitter.sky.irradiance_w_per_m3 if isinstance(emitter, Skylight) else None


@lru_cache(maxsize=256)
def _leak(camera: Camera, emitter: Emitter, flat_w_per_m3: float | None) -> Leak:
    rays, of_ray = incidence(camera, np.zeros(1))
    # On the axis the rays of a ring about it meet the filter alike.
    cosines, ring = np.unique(rays[0].round(12), return_inverse=True)
    weights = np.bincount(ring, of_ray)
    band_m = (BAND_M - _HALF_BAND_M, BAND_M + _HALF_BAND_M)
    if camera.filter is not None:
        band_m = camera.filter.band_m(float(cosines.min()))
    spectrum = emission_spectrum(emitter)
    envelope = camera.sensor.efficiency_envelope
    bends_m = () if envelope is None else tuple(envelope.wavelengths_m.tolist())
    wavelength_m = merged_grid(spectrum, camera, (*band_m, *bends_m))
    density = camera.lens.transmission * spectrum(wavelength_m) * wavelength_m / (constants.h * constants.c)
    within = (wavelength_m >= band_m[0]) & (wavelength_m <= band_m[1])
    nominal = camera.sensor.efficiency()
    efficiency = np.interp(wavelength_m, nominal.wavelength_m, nominal.value, 0.0, 0.0)
    low, high = camera.sensor.efficiency_bounds(wavelength_m)
    passed = passed_low = passed_high = np.ones(wavelength_m.size)
    if camera.filter is not None:
        passed = weights @ camera.filter.transmission(wavelength_m, cosines[:, None])
        bounds = camera.filter.bounds(wavelength_m, cosines[:, None])
        passed_low, passed_high = (weights @ bound for bound in bounds)

    def electrons_per_j(share: Array, where: NDArray[np.bool_]) -> float:
        # A step of the grid is in band or out of it by its middle.
        steps = 0.5 * np.diff(wavelength_m) * (share[1:] + share[:-1])
        return float(steps[where[1:] & where[:-1]].sum())

    whole = np.ones(wavelength_m.size, dtype=bool)
    seen = density * efficiency * passed
    in_band = electrons_per_j(seen, within)
    sent_low, sent_high = density, density
    if flat_w_per_m3 is not None:
        most = np.maximum(sunlight_ceiling(wavelength_m) / flat_w_per_m3, 1.0)
        sent_low, sent_high = np.zeros_like(density), density * most
    bounded = [sent_low * low * passed_low, sent_high * high * passed_high]
    return Leak(
        band_m=band_m,
        in_band_e_per_j=in_band,
        out_of_band_e_per_j=electrons_per_j(seen, whole) - in_band,
        low_e_per_j=electrons_per_j(bounded[0], whole) - electrons_per_j(bounded[0], within),
        high_e_per_j=electrons_per_j(bounded[1], whole) - electrons_per_j(bounded[1], within),
    )
