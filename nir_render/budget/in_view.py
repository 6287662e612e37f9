"""Sources and beacons where they stand: what a camera would collect of each, if nothing hid it."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.budget.assumptions import Assumptions
from nir_render.budget.causes import Flare, range_error
from nir_render.budget.exposures import Exposure, clip_e
from nir_render.budget.flares import angle_of, brightest_e_per_s, flux_e_per_s
from nir_render.camera.optics.lens import Intrinsics, intrinsics_of
from nir_render.camera.timing.drive import mean_level
from nir_render.camera.timing.exposure_control import Setting
from nir_render.scene.documents.camera import Camera
from nir_render.scene.pose import Pose
from nir_render.scene.snapshot import PlacedSource, Snapshot
from nir_render.simulation.flare_spread import flare_spread
from nir_render.transport.world.fog_depth import optical_depth
from nir_render.transport.world.pattern import pattern_of, relative_intensity
from perception.types import Calibration

Array = NDArray[np.float64]


@dataclass(frozen=True)
class InView:
    """One source in a camera's image, lit: `electrons_e` in all, `brightest_pixel_e` with background.

    Lit is at the level of a drive that is `constant`, and at full power of all others. `relative_intensity`
    is 4π I/Φ towards the camera, `fog_transmittance` what fog on the way leaves, `fog_bias_m` by how much a
    range by flux alone is too long where fog is not known. σ are None of what is not ranged.
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
    u_px: float
    v_px: float
    intensity: float
    passed: float
    is_robots: bool

    @property
    def brought(self) -> float:
        """What arrives over what a source of even intensity would bring in clear air."""
        constant = self.placed.source.drive.constant
        return self.intensity * self.passed * (1.0 if constant is None else constant)

    @property
    def is_strobe(self) -> bool:
        """Whether it is a beacon that goes on and off."""
        return not self.is_robots and self.placed.source.drive.square is not None

    def usual_level(self, exposure_s: float) -> float:
        """Return the median, over when an exposure begins, of what it has of a strobe; 1 of all else."""
        drive = self.placed.source.drive
        if not self.is_strobe or drive.square is None:
            return 1.0
        starts_s = np.arange(128) / (128.0 * drive.square.frequency_hz)
        return float(np.median(mean_level(drive, starts_s, exposure_s)))


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

    An automatic exposure is the one that it would choose by these flares and the wall, with robots lit and
    strobes as at most times: dark, where an exposure is short beside their period.
    """
    pose, lens = snapshot.camera(name).pose, intrinsics_of(camera)
    own = name.partition(".")[0] + "."
    seen = []
    for source_name, placed in snapshot.sources.items():
        if source_name.startswith(own):
            continue
        one = _seen(snapshot, source_name, placed, pose, lens)
        if one.direction[2] > 0.0 and lens.contains(one.u_px, one.v_px):
            seen.append(one)
    seen.sort(key=lambda one: one.range_m)
    dark_e_per_s = camera.sensor.dark_rate_e_per_s
    others_e_per_s = background_e_per_s + dark_e_per_s
    flares_e_per_s = [
        one.brought * brightest_e_per_s(camera, one.placed.source, one.u_px, one.v_px, one.range_m)
        for one in seen
    ]
    setting = _setting(exposure, camera, seen, flares_e_per_s, others_e_per_s)
    rows = []
    for one, flare_e_per_s in zip(seen, flares_e_per_s, strict=True):
        peak = flare_e_per_s + others_e_per_s
        source, angle_rad = one.placed.source, angle_of(one.direction)
        electrons_e = one.brought * setting.exposure_s * flux_e_per_s(camera, source, angle_rad, one.range_m)
        error = None
        if known is not None and one.name in ranged:
            found = Flare(
                one.u_px,
                one.v_px,
                angle_rad,
                one.range_m,
                electrons_e * flare_spread(camera, source.of_its_type).share,
                background_e_per_s * setting.exposure_s,
                dark_e_per_s * setting.exposure_s,
            )
            error = range_error(camera, source, known, setting.gain, found, assumed)
        rows.append(
            InView(
                camera=name,
                source=one.name,
                exposure=exposure.name,
                exposure_s=setting.exposure_s,
                gain=setting.gain,
                range_m=one.range_m,
                field_angle_rad=angle_rad,
                u_px=one.u_px,
                v_px=one.v_px,
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


def _setting(
    exposure: Exposure,
    camera: Camera,
    seen: Sequence[_Seen],
    flares_e_per_s: Sequence[float],
    others_e_per_s: float,
) -> Setting:
    """Return exposure and gain: by what shines steadily, and by what strobes usually have in that time."""

    def chosen(levels: Iterable[float]) -> Setting:
        lit = (level * flare for level, flare in zip(levels, flares_e_per_s, strict=True))
        return exposure.setting(camera, max(lit, default=0.0) + others_e_per_s)

    steady = chosen(0.0 if one.is_strobe else 1.0 for one in seen)
    return chosen(one.usual_level(steady.exposure_s) for one in seen)


def _seen(snapshot: Snapshot, name: str, placed: PlacedSource, pose: Pose, lens: Intrinsics) -> _Seen:
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
        passed = math.exp(-optical_depth(snapshot.fog, pose.position_m[None], towards[None], surface_m)[0])
    direction = towards @ pose.rotation
    u_px, v_px = (float(value) for value in lens.project(direction))
    is_robots = name in snapshot.carried_sources
    return _Seen(name, placed, range_m, direction, u_px, v_px, intensity, passed, is_robots)
