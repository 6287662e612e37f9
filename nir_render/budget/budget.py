"""The photon budget of a scene: per camera and source, per light, and eye safety; nothing is rendered.

Cameras that are alike stand together, and so do sources: a budget is of a kind. `in_view` is of each where it
stands, as if no body hid it.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from nir_render.budget.ambient import Ambient, ambient_of, wall_place_m
from nir_render.budget.assumptions import Assumptions
from nir_render.budget.curves import Curve, curve_of
from nir_render.budget.exposures import Exposure, clip_e, exposures_of
from nir_render.budget.eye_safety import EyeSafety, eye_safety
from nir_render.budget.flares import (
    FieldResponse,
    field_response,
    in_band_share,
    largest_relative_intensity,
    places_of,
)
from nir_render.budget.in_view import InView, in_view
from nir_render.camera.optics.leak import leak
from nir_render.camera.optics.lens import aperture_area_m2
from nir_render.camera.optics.response import response
from nir_render.errors import InputError
from nir_render.scene.documents.base import Orientation
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.emitters import Source
from nir_render.scene.documents.times.drives import FULL_DRIVE
from nir_render.scene.scene import Scene
from nir_render.scene.snapshot import Snapshot
from nir_render.simulation.calibration import calibration
from nir_render.simulation.flare_spread import Progress, flare_spread
from nir_render.simulation.fog_known import extinction_among_robots_per_m
from perception.types import Calibration


@dataclass(frozen=True)
class SourceBudget:
    """One kind of source before one kind of camera. `drives` says of each source what it sends over time.

    `out_of_band_share` is what leaks over what is in band, on the axis, and lies within the next two: None
    where nothing is in band.
    """

    sources: tuple[str, ...]
    drives: Mapping[str, str]
    sent_flux_w: float
    intensity_w_per_sr: float
    largest_intensity_w_per_sr: float
    in_band_share: float
    electrons_per_j: float
    out_of_band_share: float | None
    out_of_band_share_within: tuple[float, float] | None
    flare_share: float
    field: FieldResponse
    curves: tuple[Curve, ...]

    @property
    def largest_relative_intensity(self) -> float:
        """The largest intensity over the mean."""
        return self.largest_intensity_w_per_sr / self.intensity_w_per_sr


@dataclass(frozen=True)
class CameraBudget:
    """One kind of camera, `cameras` by name; `background_e_per_s` is the wall's under all lights together.

    `stated_exposure_s` is what an automatic exposure would choose by what is in view, or its longest.
    """

    cameras: tuple[str, ...]
    exposures: tuple[str, ...]
    shortest_exposure_s: tuple[float, ...]
    stated_exposure_s: tuple[float, ...]
    clip_e: tuple[float, ...]
    aperture_area_m2: float
    read_noise_e: float
    dark_rate_e_per_s: float
    background_e_per_s: float
    wall_m: tuple[float, float, float]
    sources: tuple[SourceBudget, ...]
    ambient: tuple[Ambient, ...]
    in_view: tuple[InView, ...]


@dataclass(frozen=True)
class Budget:
    """The photon budget of a scene at a time; `fog` is what `Fog.facts` tells, None in clear air.

    Where fog varies over height, `extinction_per_m` is the mean over the heights of robots' sources.
    """

    name: str
    scene: str
    time_s: float
    extinction_per_m: float
    fog: Mapping[str, Any] | None
    assumptions: Assumptions
    cameras: tuple[CameraBudget, ...]
    eye_safety: tuple[EyeSafety, ...]

    def record(self) -> dict[str, Any]:
        """Return it as a JSON object; what is not finite is null."""
        return {"format": 1, **_finite(asdict(self))}


def photon_budget(
    scene: Scene,
    time_s: float = 0.0,
    assumed: Assumptions | None = None,
    progress: Progress | None = None,
) -> Budget:
    """Return the photon budget of the cameras that take a scene's frames, of all where none does.

    Parameters
    ----------
    time_s
        When robots are looked at.
    assumed
        What the scene does not say.
    progress
        Told of the measurement of a point spread that is no Gaussian, which takes seconds.

    Raises
    ------
    InputError
        The scene has no camera.
    """
    snapshot, assumed = scene.at(time_s), assumed or Assumptions()
    names = scene.cameras() or scene.all_cameras()
    if not names:
        raise InputError(f"{scene.path}: robots: no robot has a camera, so there is no budget")
    kinds: dict[tuple[Camera, frozenset[Source]], list[str]] = {}
    for name in names:
        ranged = frozenset(_kind_of(source) for source in _ranged(snapshot, name).values())
        kinds.setdefault((_bare(snapshot.camera(name).camera), ranged), []).append(name)
    return Budget(
        name=scene.document.name or "",
        scene=scene.path,
        time_s=time_s,
        extinction_per_m=extinction_among_robots_per_m(snapshot)[0],
        fog=None if snapshot.fog is None else snapshot.fog.facts(),
        assumptions=assumed,
        cameras=tuple(
            _camera_budget(snapshot, camera, alike, assumed, progress) for (camera, _), alike in kinds.items()
        ),
        eye_safety=tuple(
            eye_safety(alike, source)
            for source, alike in _alike(
                {name: placed.source for name, placed in snapshot.sources.items()}, with_drive=True
            ).items()
        ),
    )


def _camera_budget(
    snapshot: Snapshot, camera: Camera, names: list[str], assumed: Assumptions, progress: Progress | None
) -> CameraBudget:
    wall_m = wall_place_m(snapshot, names[0])
    ambient = ambient_of(snapshot, camera, wall_m, assumed.wall_reflectance)
    background_e_per_s = sum(one.wall_e_per_s for one in ambient)
    ranged = {
        name: source for camera_name in names for name, source in _ranged(snapshot, camera_name).items()
    }
    known = calibration(snapshot, names[0], progress) if ranged else None
    exposures = exposures_of(camera)
    shortest = [exposure.shortest(camera) for exposure in exposures]
    shown = tuple(
        row
        for name in names
        for exposure in exposures
        for row in in_view(
            snapshot,
            name,
            exposure,
            camera,
            known,
            set(_ranged(snapshot, name)),
            background_e_per_s,
            assumed,
        )
    )
    x_m, y_m, z_m = (float(value) for value in wall_m)
    return CameraBudget(
        cameras=tuple(names),
        exposures=tuple(exposure.name for exposure in exposures),
        shortest_exposure_s=tuple(setting.exposure_s for setting in shortest),
        stated_exposure_s=tuple(_stated_exposure_s(camera, exposure, shown) for exposure in exposures),
        clip_e=tuple(clip_e(camera, setting.gain) for setting in shortest),
        aperture_area_m2=aperture_area_m2(camera),
        read_noise_e=camera.sensor.read_noise_e,
        dark_rate_e_per_s=camera.sensor.dark_rate_e_per_s,
        background_e_per_s=background_e_per_s,
        wall_m=(x_m, y_m, z_m),
        sources=tuple(
            _source_budget(snapshot, camera, source, alike, ranged, known, background_e_per_s, assumed)
            for source, alike in _alike(ranged).items()
            if known is not None
        ),
        ambient=ambient,
        in_view=shown,
    )


def _source_budget(
    snapshot: Snapshot,
    camera: Camera,
    source: Source,
    names: list[str],
    ranged: Mapping[str, Source],
    known: Calibration,
    background_e_per_s: float,
    assumed: Assumptions,
) -> SourceBudget:
    mean_intensity = source.sent_flux_w / (4.0 * math.pi)
    extinction_per_m, _ = extinction_among_robots_per_m(snapshot)
    leaks = leak(camera, source).out_of_band_shares
    return SourceBudget(
        sources=tuple(names),
        drives={name: drive_text(ranged[name]) for name in names},
        sent_flux_w=source.sent_flux_w,
        intensity_w_per_sr=mean_intensity,
        largest_intensity_w_per_sr=mean_intensity * largest_relative_intensity(source),
        in_band_share=in_band_share(camera, source),
        electrons_per_j=float(response(camera, source)(0.0)),
        out_of_band_share=None if leaks is None else leaks[0],
        out_of_band_share_within=None if leaks is None else leaks[1:],
        flare_share=flare_spread(camera, source.of_its_type).share,
        field=field_response(camera, source),
        curves=tuple(
            curve_of(camera, source, known, exposure, place, background_e_per_s, extinction_per_m, assumed)
            for exposure in exposures_of(camera)
            for place in places_of(camera)
        ),
    )


def _stated_exposure_s(camera: Camera, exposure: Exposure, shown: tuple[InView, ...]) -> float:
    if exposure.fixed is not None:
        return exposure.fixed.exposure_s
    assert camera.auto_exposure is not None
    chosen_s = [row.exposure_s for row in shown if row.exposure == exposure.name]
    return min(chosen_s, default=camera.auto_exposure.longest_s)


def drive_text(source: Source) -> str:
    """Return what a source sends over time, in words."""
    drive = source.drive
    if drive.square is not None:
        return f"square wave, {drive.square.frequency_hz:g} Hz, duty {drive.square.duty:g}"
    if drive.bits is not None:
        return f"bits {drive.bits.pattern} at {drive.bits.rate_hz:g} Hz"
    if drive.packets is not None:
        return f"packets at {drive.packets.rate_hz:g} Hz, lit between"
    return "fully lit" if drive == FULL_DRIVE else f"lit at {drive.constant:g}"


def _ranged(snapshot: Snapshot, camera: str) -> dict[str, Source]:
    """Return the sources that a camera ranges to: other robots', its own where there are no others."""
    own = camera.partition(".")[0] + "."
    everyone = {name: placed.source for name, placed in snapshot.carried_sources.items()}
    return {name: source for name, source in everyone.items() if not name.startswith(own)} or everyone


def _alike(sources: Mapping[str, Source], with_drive: bool = False) -> dict[Source, list[str]]:
    kinds: dict[Source, list[str]] = {}
    for name, source in sources.items():
        kind = _kind_of(source)
        kinds.setdefault(kind.model_copy(update={"drive": source.drive}) if with_drive else kind, []).append(
            name
        )
    return kinds


def _kind_of(source: Source) -> Source:
    placeless = {"position_m": (0.0, 0.0, 0.0), "orientation": Orientation(), "drive": FULL_DRIVE}
    return source.model_copy(update=placeless)


def _bare(camera: Camera) -> Camera:
    placeless = {"position_m": (0.0, 0.0, 0.0), "orientation": Orientation(), "serial": None, "clock": None}
    return camera.model_copy(update=placeless)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value
