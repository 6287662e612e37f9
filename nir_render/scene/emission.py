"""What a light group sends: its spectrum of unit flux, and how many units of emission."""

from dataclasses import replace

from nir_render.scene.documents.emitters import Lamp, Source, Sun
from nir_render.spectra.curve import Curve, constant_curve
from nir_render.spectra.illuminants import SILICON_M, incandescent_flux_w, incandescent_spectrum

Emitter = Source | Lamp | Sun


def emission_spectrum(emitter: Emitter) -> Curve:
    """Return the spectrum of an emitter, of unit flux, in 1/m."""
    if isinstance(emitter, Lamp):
        return incandescent_spectrum(emitter.temperature_k, "the lamp's spectrum")
    if isinstance(emitter, Sun):
        return constant_curve(1.0, *SILICON_M, "the sun's spectrum").normalised()
    curve = emitter.spectrum.curve("the source's spectrum").normalised()
    offset_m = emitter.unit.wavelength_m
    return replace(curve, wavelength_m=curve.wavelength_m + offset_m) if offset_m else curve


def emission_units(emitter: Emitter) -> float:
    """Return how many of its units an emitter sends, over its whole spectrum.

    The unit of a source and of a lamp is 1 W of radiant flux, a lamp's from 300 to 1100 nm; that of the sun
    is 1 W/m² of irradiance across its direction, from 300 to 1100 nm too.
    """
    if isinstance(emitter, Lamp):
        return incandescent_flux_w(emitter.luminous_flux_lm, emitter.temperature_k)
    if isinstance(emitter, Sun):
        return emitter.irradiance_w_per_m3 * (SILICON_M[1] - SILICON_M[0])
    return emitter.sent_flux_w
