"""What lamps, the sun, the sky and beacons bring to a pixel, in closed form, and what the filter keeps out.

The measure is a matt wall of a stated reflectance ρ at a stated place, turned towards each light by itself,
with nothing in between: L = ρ E/π, and a pixel on the axis collects L · A_ap · Ω_px · C(0) electrons a second
(docs/physics.md, From source to pixel). No wall of that reflectance there is brighter by that light alone.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.optics.leak import leak
from nir_render.camera.optics.lens import aperture_area_m2
from nir_render.camera.optics.response import response
from nir_render.camera.timing.drive import drive_of
from nir_render.errors import InputError
from nir_render.geometry import rectangle_frame
from nir_render.scene.documents.ambient.lamps import Lamp
from nir_render.scene.documents.ambient.sun import Skylight, Sun
from nir_render.scene.documents.camera import Camera
from nir_render.scene.emission import Emitter, emission_units
from nir_render.scene.snapshot import Snapshot
from nir_render.spectra.lambert import polygon_share
from nir_render.transport.world.pattern import pattern_of, relative_intensity

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Ambient:
    """One light that is no robot's, before a camera.

    `irradiance_w_per_m2` is what it brings to the wall, from 300 to 1100 nm, with the mean of its drive
    (`drive_mean`, None of what sends messages: then as lit); `wall_e_per_s` and `seen_e_per_s` are electrons
    per second in a pixel on the axis that sees the wall, and that sees the light itself, filling it (None of
    a beacon: as a flare). `rejection` is 1 − ∫ S η τ dλ / ∫ S η dλ in photons, None where the quantum
    efficiency is not known over the whole spectrum. What leaks out of band lies between two bounds.
    """

    name: str
    kind: str
    drive_mean: float | None
    irradiance_w_per_m2: float
    electrons_per_j: float
    wall_e_per_s: float
    seen_e_per_s: float | None
    rejection: float | None
    band_m: tuple[float, float]
    in_band_e_per_j: float
    out_of_band_e_per_j: float
    out_of_band_low_e_per_j: float
    out_of_band_high_e_per_j: float


def ambient_of(snapshot: Snapshot, camera: Camera, wall_m: Array, reflectance: float) -> tuple[Ambient, ...]:
    """Return what each light that is no robot's brings to a wall at a place in the world, and to a camera."""
    return tuple(
        _ambient(snapshot, name, emitter, camera, wall_m, reflectance)
        for name, emitter in snapshot.emitters.items()
        if name not in snapshot.carried_sources
    )


def wall_place_m(snapshot: Snapshot, camera: str) -> Array:
    """Return where the wall stands: in the middle of all robots' sources, or 1 m before a camera."""
    places = [placed.pose.position_m for placed in snapshot.carried_sources.values()]
    if places:
        return np.asarray(np.mean(places, axis=0))
    pose = snapshot.camera(camera).pose
    return pose.position_m + pose.rotation[:, 2]


def radiance_to_e_per_s(camera: Camera, electrons_per_j: float) -> float:
    """Return electrons per second in a pixel on the axis for 1 W/m²/sr: A_ap · Ω_px · C(0)."""
    pixel_sr = (camera.sensor.pixel_pitch_m / camera.lens.focal_length_m) ** 2
    return aperture_area_m2(camera) * pixel_sr * electrons_per_j


def rejection(camera: Camera, emitter: Emitter) -> float | None:
    """Return the share of an emitter's photoelectrons that the filter keeps out, on the axis."""
    bare = camera.model_copy(update={"filter": None})
    try:
        without = float(response(bare, emitter)(0.0))
    except InputError:
        return None
    return 1.0 - float(response(camera, emitter)(0.0)) / without if without > 0.0 else None


def _ambient(
    snapshot: Snapshot, name: str, emitter: Emitter, camera: Camera, wall_m: Array, reflectance: float
) -> Ambient:
    mean = drive_of(emitter).mean
    sent = emission_units(emitter) * (1.0 if mean is None else mean)
    share, radiance = _share_and_radiance(snapshot, name, emitter, wall_m)
    irradiance, electrons_per_j = sent * share, float(response(camera, emitter)(0.0))
    per_radiance, leaks = radiance_to_e_per_s(camera, electrons_per_j), leak(camera, emitter)
    return Ambient(
        name=name,
        kind=_kind(emitter),
        drive_mean=mean,
        irradiance_w_per_m2=irradiance,
        electrons_per_j=electrons_per_j,
        wall_e_per_s=reflectance * irradiance / math.pi * per_radiance,
        seen_e_per_s=None if radiance is None else sent * radiance * per_radiance,
        rejection=rejection(camera, emitter),
        band_m=leaks.band_m,
        in_band_e_per_j=leaks.in_band_e_per_j,
        out_of_band_e_per_j=leaks.out_of_band_e_per_j,
        out_of_band_low_e_per_j=leaks.low_e_per_j,
        out_of_band_high_e_per_j=leaks.high_e_per_j,
    )


def _kind(emitter: Emitter) -> str:
    kinds: Sequence[tuple[type, str]] = ((Lamp, "lamp"), (Sun, "sun"), (Skylight, "sky"))
    return next((name for kind, name in kinds if isinstance(emitter, kind)), "beacon")


def _share_and_radiance(
    snapshot: Snapshot, name: str, emitter: Emitter, wall_m: Array
) -> tuple[float, float | None]:
    """Return, of one unit of emission, the irradiance on the wall in 1/m² and the radiance in 1/(m² sr).

    Of the sun, 1 W/m² across its direction, that is 1, and 1/(π sin² α) of its disc; of the sky, 1 W/m² on
    the level ground, which the wall is, 1 and 1/π on average.
    """
    if isinstance(emitter, Sun):
        return 1.0, 1.0 / (math.pi * math.sin(emitter.angular_radius_rad) ** 2)
    if isinstance(emitter, Skylight):
        return 1.0, 1.0 / math.pi
    if isinstance(emitter, Lamp):
        half_u_m, half_v_m, normal = rectangle_frame(emitter.normal, emitter.size_m, 0.0).T
        corners = [half_u_m + half_v_m, half_v_m - half_u_m, -half_u_m - half_v_m, half_u_m - half_v_m]
        corners_m = np.array(emitter.center_m) + corners
        to_lamp_m = np.array(emitter.center_m) - wall_m
        facing = to_lamp_m / max(float(np.linalg.norm(to_lamp_m)), 1e-9)
        area_m2 = emitter.size_m[0] * emitter.size_m[1]
        return polygon_share(corners_m, normal, wall_m, facing) / area_m2, 1.0 / (math.pi * area_m2)
    placed = snapshot.sources[name]
    away_m = placed.pose.to_local(wall_m)
    distance_m = max(float(np.linalg.norm(away_m)), emitter.radius_m)
    pattern = pattern_of(emitter)
    relative = 1.0 if pattern is None else float(relative_intensity(pattern, away_m / distance_m))
    return relative / (4.0 * math.pi * distance_m**2), None
