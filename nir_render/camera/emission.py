"""What a light group sends: its spectrum of unit flux, and how many units of emission."""

from nir_render.scene.curves import CurveDocument
from nir_render.scene.devices import Source
from nir_render.scene.world import Lamp, Sun
from nir_render.spectra.curve import Curve, constant_curve, curve_from_points
from nir_render.spectra.illuminants import SILICON_M, incandescent_flux_w, incandescent_spectrum
from nir_render.spectra.led import gaussian_spectrum

Emitter = Source | Lamp | Sun


def emission_spectrum(emitter: Emitter) -> Curve:
    """Return the spectrum of an emitter, of unit flux, in 1/m."""
    if isinstance(emitter, Lamp):
        return incandescent_spectrum(emitter.temperature_k, "the lamp's spectrum")
    if isinstance(emitter, Sun):
        return constant_curve(1.0, *SILICON_M, "the sun's spectrum").normalised()
    return curve_of(emitter.spectrum, "the source's spectrum").normalised()


def emission_units(emitter: Emitter) -> float:
    """Return how many of its units an emitter sends, over its whole spectrum.

    The unit of a source and of a lamp is 1 W of radiant flux, a lamp's from 300 to 1100 nm; that of the sun
    is 1 W/m² of irradiance across its direction, from 300 to 1100 nm too.
    """
    if isinstance(emitter, Lamp):
        return incandescent_flux_w(emitter.luminous_flux_lm, emitter.temperature_k)
    if isinstance(emitter, Sun):
        return emitter.irradiance_w_per_m3 * (SILICON_M[1] - SILICON_M[0])
    return emitter.flux_w


def curve_of(document: CurveDocument, name: str) -> Curve:
    """Return the curve that a document describes; a constant holds over what silicon sees."""
    if document.gaussian is not None:
        return gaussian_spectrum(document.gaussian.centroid_m, document.gaussian.fwhm_m, name)
    if document.points is not None:
        return curve_from_points(document.points, name)
    assert document.constant is not None  # noqa: S101 (the model admits no fourth form)
    return constant_curve(document.constant, *SILICON_M, name)
