"""A source before a camera, in closed form: what passes the filter, its electrons, those of a pixel.

    F = I(ω) e^(−σ_t d) / d² · A_ap cos θ · C(θ) · t

(docs/physics.md, From source to pixel). The brightest pixel is that of the camera's own image of the sphere.
"""

import itertools
import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from nir_render.budget.exposures import clip_e, read_e
from nir_render.camera.beams import beam_window
from nir_render.camera.optics.lens import aperture_area_m2, intrinsics_of
from nir_render.camera.optics.response import incidence, merged_grid, response
from nir_render.camera.timing.exposure_control import Setting
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.emitters import Source
from nir_render.scene.emission import emission_spectrum
from nir_render.simulation.flare_spread import source_beam
from nir_render.transport.world.pattern import pattern_of

_EDGES = (0.9, 0.7, 0.5, 0.3)  # of the way to the right edge: the first within a fisheye's image circle
_RESOLVED_PX = 12.0
_FARTHEST_M = 1e4

RANGES_M = (
    0.1, 0.15, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0, 12.0, 15.0, 20.0, 30.0,
)  # fmt: skip
"""At which curves are drawn."""


@dataclass(frozen=True)
class Place:
    """A direction in which flares are looked at: its name, the pixel's middle and the field angle there."""

    name: str
    u_px: float
    v_px: float
    field_angle_rad: float


@dataclass(frozen=True)
class FieldResponse:
    """C(θ) over the field, and cos θ C(θ)/C(0): how a flare's electrons go with the field angle."""

    field_angle_rad: tuple[float, ...]
    electrons_per_j: tuple[float, ...]
    relative_signal: tuple[float, ...]


@dataclass(frozen=True)
class Saturation:
    """From which range on a flare is not clipped; `when` is nearer, never (it is not clipped) or always."""

    when: str
    range_m: float | None


def places_of(camera: Camera) -> tuple[Place, ...]:
    """Return the axis, and a place near the image's right edge, where neighbouring cameras take over."""
    lens = intrinsics_of(camera)
    places = []
    for name, ways in (("axis", (0.0,)), ("edge", _EDGES)):
        for way in ways:
            wanted = (lens.cx_px + way * (lens.width_px - 1 - lens.cx_px), lens.cy_px)
            pixel = np.clip(np.round(wanted), 0, (lens.width_px - 1, lens.height_px - 1))
            direction = lens.unproject(pixel)
            if np.isfinite(direction).all():
                places.append(Place(name, float(pixel[0]), float(pixel[1]), angle_of(direction)))
                break
    return tuple(places)


def angle_of(direction: NDArray[np.float64]) -> float:
    """Return the field angle of a unit direction in camera axes."""
    return math.atan2(math.hypot(direction[0], direction[1]), direction[2])


def field_response(camera: Camera, source: Source) -> FieldResponse:
    """Return the response over the field, from the axis to the image's corner."""
    unit, corner_rad = response(camera, source), intrinsics_of(camera).corner_angle_rad
    angle_rad = np.linspace(0.0, corner_rad, 25)
    electrons_per_j = unit(angle_rad)
    signal = np.cos(angle_rad) * electrons_per_j / electrons_per_j[0]
    columns = (angle_rad, electrons_per_j, signal)
    return FieldResponse(*(tuple(float(value) for value in column) for column in columns))


def in_band_share(camera: Camera, source: Source) -> float:
    """Return the share of a source's radiant flux that the filter passes on the axis."""
    bandpass = camera.filter
    if bandpass is None:
        return 1.0
    cosines, weights = incidence(camera, np.zeros(1))
    spectrum = emission_spectrum(source)
    wavelength_m = merged_grid(spectrum, camera, ())
    passed = weights @ bandpass.transmission(wavelength_m, cosines[0][:, None])
    return float(np.trapezoid(passed * spectrum(wavelength_m), wavelength_m))


def largest_relative_intensity(source: Source) -> float:
    """Return 4π I/Φ where a source is brightest."""
    pattern = pattern_of(source)
    return 1.0 if pattern is None else float(pattern.values.max())


def flux_e_per_s(camera: Camera, source: Source, field_angle_rad: float, range_m: float) -> float:
    """Return all electrons of a flare per second, in clear air, of a source's mean intensity Φ/4π."""
    irradiance_w_per_m2 = source.sent_flux_w / (4.0 * math.pi * range_m**2)
    electrons_per_j = float(response(camera, source)(field_angle_rad))
    return irradiance_w_per_m2 * aperture_area_m2(camera) * math.cos(field_angle_rad) * electrons_per_j


def brightest_e_per_s(camera: Camera, source: Source, u_px: float, v_px: float, range_m: float) -> float:
    """Return the electrons per second in a flare's brightest pixel, of the mean intensity, in clear air.

    Nearer than where the image has a radius of 12 px it is as bright as there: its radiance is its own.
    """
    lens = intrinsics_of(camera)
    resolved_m = source.radius_m * max(lens.fx_px, lens.fy_px) / _RESOLVED_PX
    return _brightest_e_per_s(camera, source, u_px, v_px, max(range_m, resolved_m))


@lru_cache(maxsize=4096)
def _brightest_e_per_s(camera: Camera, source: Source, u_px: float, v_px: float, range_m: float) -> float:
    direction = intrinsics_of(camera).unproject(np.array([u_px, v_px]))
    beam = source_beam(source, response(camera, source), direction, range_m)
    values = beam_window(camera, beam, 1.0).values
    return float(values.max()) if values.size else 0.0


def saturation(
    camera: Camera,
    source: Source,
    place: Place,
    setting: Setting,
    others_e_per_s: float,
    extinction_per_m: float,
    intensity: float = 1.0,
) -> Saturation:
    """Return where the brightest pixel, with what else falls on it, reaches the level of clipping.

    `intensity` is the source's towards the camera over its mean.
    """
    level_e = clip_e(camera, setting.gain)

    def beyond(log_range: float) -> float:
        range_m = math.exp(log_range)
        rate = brightest_e_per_s(camera, source, place.u_px, place.v_px, range_m)
        rate = intensity * rate * math.exp(-extinction_per_m * range_m) + others_e_per_s
        return read_e(camera, rate * setting.exposure_s) - level_e

    if read_e(camera, others_e_per_s * setting.exposure_s) >= level_e:
        return Saturation("always", None)
    # From afar to near, by steps that the curves look at too; the own image of a sphere seen as a disc grows
    # no brighter.
    trials = [_FARTHEST_M, *(range_m for range_m in reversed(RANGES_M) if range_m > source.radius_m)]
    for outer_m, inner_m in itertools.pairwise(trials):
        if beyond(math.log(inner_m)) >= 0.0:
            bracket = math.log(inner_m), math.log(outer_m)
            return Saturation("nearer", math.exp(brentq(beyond, *bracket, xtol=1e-4)))
    return Saturation("never", None)
