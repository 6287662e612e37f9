"""What a light group sends: its spectrum of unit flux, and its flux."""

from nir_render.scene.devices import CurveDocument, Source
from nir_render.scene.world import Lamp
from nir_render.spectra.curve import Curve, constant_curve, curve_from_points
from nir_render.spectra.illuminants import SILICON_M, incandescent_flux_w, incandescent_spectrum
from nir_render.spectra.led import gaussian_spectrum

Emitter = Source | Lamp


def emission_spectrum(emitter: Emitter) -> Curve:
    """Return the spectrum of an emitter, of unit flux, in 1/m."""
    if isinstance(emitter, Lamp):
        return incandescent_spectrum(emitter.temperature_k, "the lamp's spectrum")
    return curve_of(emitter.spectrum, "the source's spectrum").normalised()


def radiant_flux_w(emitter: Emitter) -> float:
    """Return the radiant flux of an emitter over its spectrum; a lamp's over 300 to 1100 nm."""
    if isinstance(emitter, Lamp):
        return incandescent_flux_w(emitter.luminous_flux_lm, emitter.temperature_k)
    return emitter.flux_w


def curve_of(document: CurveDocument, name: str) -> Curve:
    """Return the curve that a document describes; a constant holds over what silicon sees."""
    if document.gaussian is not None:
        return gaussian_spectrum(document.gaussian.centroid_m, document.gaussian.fwhm_m, name)
    if document.points is not None:
        return curve_from_points(document.points, name)
    assert document.constant is not None  # noqa: S101 (the model admits no fourth form)
    return constant_curve(document.constant, *SILICON_M, name)
