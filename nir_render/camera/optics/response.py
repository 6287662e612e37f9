"""Spectral response: what one joule of a source's light becomes, in electrons, against the field angle.

Everything spectral about a light group and a camera folds into one factor (docs/physics.md, From source to
pixel),

    C(θ) = V(θ) ∫ S(λ) τ_lens τ_filter(λ, θ) η(λ) λ / (h c) dλ,

with S the group's spectrum of unit flux and V the lens's vignetting. Geometry (aperture, cos θ, distance) is
not part of it.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import constants
from scipy.interpolate import PchipInterpolator

from nir_render.camera.optics.lens import field_of, intrinsics_of
from nir_render.scene.documents.ambient.lamps import Lamp
from nir_render.scene.documents.ambient.sun import Skylight, Sun
from nir_render.scene.documents.base import Orientation
from nir_render.scene.documents.camera import Camera, GlobalShutter
from nir_render.scene.documents.times.drives import FULL_DRIVE
from nir_render.scene.emission import Emitter, emission_spectrum
from nir_render.spectra.curve import Curve
from nir_render.spectra.nodes import ONE_NODE, Node

_ANGLES = 129
_COSINES = 257
_SENSED_ANGLES = 4
_PUPIL_RINGS = 6
_PUPIL_SPOKES = 12  # over half the pupil; the other half mirrors it


@dataclass(frozen=True, eq=False)
class Response:
    """C(θ): `angle_rad`, increasing from 0, and `electrons_per_j`, shape (n,) each."""

    angle_rad: NDArray[np.float64]
    electrons_per_j: NDArray[np.float64]

    def __call__(self, angle_rad: ArrayLike) -> NDArray[np.float64]:
        """Return C at field angles of any shape, in electrons per joule, by monotone cubic interpolation.

        Beyond the last angle, outside the image, it keeps its last value.
        """
        angle = np.clip(angle_rad, self.angle_rad[0], self.angle_rad[-1])
        return np.asarray(PchipInterpolator(self.angle_rad, self.electrons_per_j)(angle))


def response(camera: Camera, emitter: Emitter, node: Node = ONE_NODE) -> Response:
    """Return how a camera responds to the light of a source, a lamp, the sun or the sky.

    Of several wavelength nodes each stands for the part of the spectrum that its hat function takes.

    Raises
    ------
    InputError
        The quantum efficiency does not cover the whole spectrum of the emitter.
    """
    return _response(optics_alone(camera), kind_alone(emitter), None if node.is_alone else node)


def response_map(camera: Camera, emitter: Emitter, node: Node = ONE_NODE) -> NDArray[np.float64]:
    """Return cos θ · Ω/Ω_axis · C(θ) at each pixel's centre, in electrons per joule, shape (rows, columns).

    Ω is the pixel's solid angle; outside a fisheye's image circle there is no light.
    """
    return _response_map(optics_alone(camera), kind_alone(emitter), None if node.is_alone else node)


def optics_alone(camera: Camera) -> Camera:
    """Return the camera without what its response does not depend on, so that equal ones share a table."""
    return camera.model_copy(
        update={
            "position_m": (0.0, 0.0, 0.0),
            "orientation": Orientation(),
            "exposure_s": 1.0,
            "gain": 1.0,
            "auto_exposure": None,
            "bracket": None,
            "shutter": GlobalShutter(),
            "serial": None,
        }
    )


def kind_alone(emitter: Emitter) -> Emitter:
    """Return the emitter without its place, size, directions, flux and drive, likewise."""
    if isinstance(emitter, Lamp):
        update = {
            "center_m": (0.0, 0.0, 0.0),
            "size_m": (1.0, 1.0),
            "normal": (0.0, 0.0, 1.0),
            "luminous_flux_lm": 1.0,
            "drive": FULL_DRIVE,
        }
        return emitter.model_copy(update=update)
    if isinstance(emitter, Sun):
        return emitter.model_copy(
            update={"azimuth_rad": 0.0, "clouds": None}
            if emitter.air is not None
            else {"azimuth_rad": 0.0, "elevation_rad": 1.0, "irradiance_w_per_m3": 1.0, "clouds": None}
        )
    if isinstance(emitter, Skylight):
        sun = emitter.sun.model_copy(update={"azimuth_rad": 0.0, "clouds": None})
        return emitter.model_copy(
            update={"sky": emitter.sky.model_copy(update={"cie": 12, "clouds": 1.0}), "sun": sun}
        )
    update = {"position_m": (0.0, 0.0, 0.0), "radius_m": 1.0, "flux_w": 1.0}
    update |= {"orientation": Orientation(), "pattern": None, "drive": FULL_DRIVE}
    return emitter.model_copy(update=update)


@lru_cache(maxsize=16)
def _response_map(camera: Camera, emitter: Emitter, node: Node | None) -> NDArray[np.float64]:
    lens = intrinsics_of(camera)
    field = field_of(lens)
    of_angle = _response(camera, emitter, node)
    # C is smooth in the angle: a table of it, finer than a pixel, read linearly, keeps 1e-6.
    angle_rad = np.linspace(0.0, lens.corner_angle_rad, 4096)
    return np.asarray(np.interp(field.angle_rad, angle_rad, of_angle(angle_rad)) * field.weight)


@lru_cache(maxsize=256)
def _response(camera: Camera, emitter: Emitter, node: Node | None) -> Response:
    # A little beyond the corner, for sources that are centred outside the image and reach into it.
    last_rad = min(1.2 * intrinsics_of(camera).corner_angle_rad, 0.5 * np.pi)
    angle_rad = np.linspace(0.0, last_rad, _ANGLES)
    bends = [bend for bend, _ in camera.lens.vignetting or () if np.abs(angle_rad - bend).min() > 1e-6]
    angle_rad = np.union1d(angle_rad, [bend for bend in bends if bend < last_rad])
    cosines, weights = incidence(camera, angle_rad)
    at_cosines = np.linspace(cosines.min(), 1.0, _COSINES)
    of_cosine = PchipInterpolator(at_cosines, _electrons_per_j(camera, emitter, node, at_cosines))
    passed = np.asarray(of_cosine(cosines)) @ weights
    return Response(angle_rad, passed * vignetting(camera, angle_rad))


def _electrons_per_j(
    camera: Camera, emitter: Emitter, node: Node | None, cosines: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return electrons per joule of parallel light that meets the filter at given cosines, shape (n,)."""
    spectrum = emission_spectrum(emitter)
    wavelength_m = merged_grid(spectrum, camera, () if node is None else node.wavelengths_m)
    efficiency = _efficiency(camera, wavelength_m)
    photons_per_j = wavelength_m / (constants.h * constants.c)
    integrand = camera.lens.transmission * spectrum(wavelength_m) * efficiency * photons_per_j
    if node is not None:
        integrand = integrand * node.weight(wavelength_m)
    if camera.filter is None:
        return np.full(cosines.shape, np.trapezoid(integrand, wavelength_m))
    passed = camera.filter.transmission(wavelength_m, cosines[:, None])
    return np.asarray(np.trapezoid(passed * integrand, wavelength_m, axis=1))


def sensed(camera: Camera, emitter: Emitter, wavelength_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how much of an emitter's light each wavelength brings, at angles from the axis to the corner.

    In electrons, of unit sum on an even grid, shape (angles, n), less angles at which nothing is seen.
    """
    spectrum = emission_spectrum(emitter)
    density = np.interp(wavelength_m, spectrum.wavelength_m, spectrum.value, 0.0, 0.0)
    efficiency = camera.sensor.efficiency()
    density *= np.interp(wavelength_m, efficiency.wavelength_m, efficiency.value, 0.0, 0.0) * wavelength_m
    if camera.filter is None:
        passed = np.ones((1, wavelength_m.size))
    else:
        angle_rad = np.linspace(0.0, intrinsics_of(camera).corner_angle_rad, _SENSED_ANGLES)
        rays, weights = incidence(camera, angle_rad)
        passed = np.array([weights @ camera.filter.transmission(wavelength_m, ray[:, None]) for ray in rays])
    seen = passed * density
    seen = seen[seen.any(axis=1)]
    return np.asarray(seen / seen.sum(axis=1, keepdims=True))


def vignetting(camera: Camera, angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the throughput at field angles relative to the axis: monotone cubic between the lens's points.

    Beyond the last of them, outside the image, it keeps its last value.
    """
    points = camera.lens.vignetting
    if points is None:
        return np.ones_like(angle_rad)
    angles_rad, values = np.array(points).T
    return np.asarray(PchipInterpolator(angles_rad, values)(np.minimum(angle_rad, angles_rad[-1])))


def incidence(
    camera: Camera, angle_rad: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return how the light of field angles, shape (n,), meets the filter.

    In front of the lens the light of a distant point is parallel and meets the filter at the field angle.
    Behind it, a cone meets the filter about the chief ray; the mean is over the exit pupil by area.

    Returns
    -------
    Cosines of incidence, shape (n, rays), and the weights of the rays (sum 1), shape (rays,).
    """
    bandpass = camera.filter
    if bandpass is None or bandpass.placement == "in_front_of_lens":
        return np.cos(angle_rad)[:, None], np.ones(1)
    # The chief ray's angle grows linearly with the image height (beyond the corner: up to 85 degrees).
    lens = intrinsics_of(camera)
    height = lens.distortion.image_height(angle_rad)
    height = height / lens.distortion.image_height(np.array(lens.corner_angle_rad))
    chief = np.tan(np.clip(height * bandpass.chief_ray_angle_at_corner_rad, 0.0, np.radians(85.0)))
    nodes, ring_weights = np.polynomial.legendre.leggauss(_PUPIL_RINGS)
    radius = np.sqrt(0.5 * (nodes + 1.0)) / (2.0 * camera.lens.f_number)  # Gauss–Legendre in area
    turn = np.pi * (np.arange(_PUPIL_SPOKES) + 0.5) / _PUPIL_SPOKES
    x = chief[:, None, None] + radius[:, None] * np.cos(turn)
    y = radius[:, None] * np.sin(turn)
    cosines = 1.0 / np.sqrt(1.0 + x**2 + y**2)
    weights = np.repeat(0.5 * ring_weights / _PUPIL_SPOKES, _PUPIL_SPOKES)
    return cosines.reshape(angle_rad.size, -1), weights


def _efficiency(camera: Camera, wavelength_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the quantum efficiency; 0 beyond its data, where a filter blocks (what then leaks: `leak`)."""
    known = camera.sensor.efficiency()
    if camera.filter is None:
        return known(wavelength_m)
    return np.interp(wavelength_m, known.wavelength_m, known.value, 0.0, 0.0)


def merged_grid(spectrum: Curve, camera: Camera, nodes_m: tuple[float, ...]) -> NDArray[np.float64]:
    """Return wavelengths that resolve spectrum, filter's flanks, quantum efficiency and hat functions.

    `nodes_m` are other places to have among them, such as the bends of hat functions.
    """
    parts = [spectrum.wavelength_m]
    if camera.filter is not None:
        step_m = camera.filter.step_m
        parts.append(np.arange(spectrum.low_m, spectrum.high_m, step_m))
    efficiency = camera.sensor.efficiency().wavelength_m
    bends = np.concatenate([efficiency, nodes_m])
    parts.append(bends[(bends > spectrum.low_m) & (bends < spectrum.high_m)])
    return np.unique(np.concatenate(parts))
