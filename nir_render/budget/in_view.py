"""Sources and beacons where they stand: what a camera would collect of each, if nothing hid it."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.budget.assumptions import Assumptions
from nir_render.budget.causes import Flare, range_error
from nir_render.budget.exposures import Exposure, clip_e
from nir_render.budget.flares import angle_of, brightest_e_per_s, flux_e_per_s
from nir_render.camera.optics.lens import intrinsics_of
from nir_render.scene.documents.camera import Camera
from nir_render.scene.pose import Pose
from nir_render.scene.snapshot import PlacedSource, Snapshot
from nir_render.simulation.flare_spread import flare_spread
from nir_render.transport.direct.rays import length_in_box_m
from nir_render.transport.world.pattern import pattern_of, relative_intensity
from perception.types import Calibration

Array = NDArray[np.float64]


@dataclass(frozen=True)
class InView:
    """One source in a camera's image, fully lit: `electrons_e` in all, `brightest_pixel_e` with background.

    `relative_intensity` is 4π I/Φ towards the camera, `fog_transmittance` what fog on the way leaves,
    `fog_bias_m` by how much a range by flux alone is too long where fog is not known. σ are None of what is
    not ranged.
    """

    camera: str
    source: str
    exposure: str
    exposure_s: float
    gain: float
    range_m: float
    field_angle_rad: float
    u_px: float
    v_px: float
    relative_intensity: float
    fog_transmittance: float
    electrons_e: float
    brightest_pixel_e: float
    saturated: bool
    fog_bias_m: float
    range_limit_m: float | None
    range_sigma_m: float | None


@dataclass(frozen=True, eq=False)
class _Seen:
    name: str
    placed: PlacedSource
    range_m: float
    direction: Array
    intensity: float
    passed: float


def in_view(
    snapshot: Snapshot,
    name: str,
    exposure: Exposure,
    camera: Camera,
    known: Calibration | None,
    ranged: set[str],
    background_e_per_s: float,
    assumed: Assumptions,
) -> list[InView]:
    """Return the sources in the image of the camera `name`, nearest first.

    An automatic exposure is the one that it would choose by these flares and the wall, were all lit.
    """
    pose, lens = snapshot.camera(name).pose, intrinsics_of(camera)
    own = name.partition(".")[0] + "."
    seen = []
    for source_name, placed in snapshot.sources.items():
        if source_name.startswith(own):
            continue
        one = _seen(snapshot, source_name, placed, pose)
        u_px, v_px = lens.project(one.direction)
        if one.direction[2] > 0.0 and lens.contains(float(u_px), float(v_px)):
            seen.append(one)
    seen.sort(key=lambda one: one.range_m)
    dark_e_per_s = camera.sensor.dark_rate_e_per_s
    others_e_per_s = background_e_per_s + dark_e_per_s
    peaks = []
    for one in seen:
        u_px, v_px = (float(value) for value in lens.project(one.direction))
        peak = brightest_e_per_s(camera, one.placed.source, u_px, v_px, one.range_m)
        peaks.append(one.intensity * one.passed * peak + others_e_per_s)
    setting = exposure.setting(camera, max(peaks, default=others_e_per_s))
    rows = []
    for one, peak in zip(seen, peaks, strict=True):
        source, angle_rad = one.placed.source, angle_of(one.direction)
        u_px, v_px = (float(value) for value in lens.project(one.direction))
        brought = one.intensity * one.passed * setting.exposure_s
        electrons_e = brought * flux_e_per_s(camera, source, angle_rad, one.range_m)
        error = None
        if known is not None and one.name in ranged:
            flare = Flare(
                u_px,
                v_px,
                angle_rad,
                one.range_m,
                electrons_e * flare_spread(camera, source.of_its_type).share,
                background_e_per_s * setting.exposure_s,
                dark_e_per_s * setting.exposure_s,
            )
            error = range_error(camera, source, known, setting.gain, flare, assumed)
        rows.append(
            InView(
                camera=name,
                source=one.name,
                exposure=exposure.name,
                exposure_s=setting.exposure_s,
                gain=setting.gain,
                range_m=one.range_m,
                field_angle_rad=angle_rad,
                u_px=u_px,
                v_px=v_px,
                relative_intensity=one.intensity,
                fog_transmittance=one.passed,
                electrons_e=electrons_e,
                brightest_pixel_e=peak * setting.exposure_s,
                saturated=peak * setting.exposure_s >= clip_e(camera, setting.gain),
                fog_bias_m=one.range_m * (one.passed**-0.5 - 1.0) if one.passed > 0.0 else math.inf,
                range_limit_m=None if error is None else error.limit_m,
                range_sigma_m=None if error is None else error.sigma_m,
            )
        )
    return rows


def _seen(snapshot: Snapshot, name: str, placed: PlacedSource, pose: Pose) -> _Seen:
    """Return where a source stands from a camera, its intensity towards it, and what fog leaves of that."""
    offset_m = placed.pose.position_m - pose.position_m
    range_m = max(float(np.linalg.norm(offset_m)), 1e-9)
    towards = offset_m / range_m
    pattern = pattern_of(placed.source)
    leaving = -towards @ placed.pose.rotation
    intensity = 1.0 if pattern is None else float(relative_intensity(pattern, leaving))
    passed = 1.0
    if snapshot.fog is not None:
        # Up to the source's surface, as light is rendered.
        surface_m = np.array([max(range_m - placed.source.radius_m, 0.0)])
        box = snapshot.fog.region_m()
        in_fog_m = length_in_box_m(pose.position_m[None], towards[None], surface_m, *box)
        passed = math.exp(-snapshot.fog.extinction_per_m * float(in_fog_m[0]))
    return _Seen(name, placed, range_m, towards @ pose.rotation, intensity, passed)
