"""A robot that sees by measurements: as the detector makes them, drawn about the truth, without frames."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import cast

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.timing.drive import drive_of, mean_level
from nir_render.experiments.loop.controllers import neighbours_of
from nir_render.experiments.loop.sight import Around, Seen
from nir_render.randomness import generator
from nir_render.scene.scene import Scene
from nir_render.scene.snapshot import Snapshot
from nir_render.simulation.calibration import calibration
from perception import Calibration, Detection, Message, Pipeline, RawFrame, Signal
from perception.model.bearing import bearing_body
from perception.model.fisher import FlareLimit, flare_limit
from perception.model.flare import PixelBox, flare_image
from perception.model.lens import project
from perception.model.ranging import angular_radius_rad, flux_at_one_metre_dn

Array = NDArray[np.float64]

_RANGES_PER_E, _STEP_PX = 40.0, 60.0  # bounds are looked up at the next of such ranges and places
_LEAST_SNR = 8.0  # from which `robust` finds 99.8 %
_MERGED_PX = 2.0  # down to which it parts two of a like brightness
_FAR_PX = 12.0  # from the rim of a flare, beyond which its light is less than read noise
_RIM_PX = 3.0  # a centre nearer to the edge of a frame is not found


@dataclass(frozen=True)
class _Image:
    """A source in view, found or not: its place, its range, and the electrons of it in this frame."""

    u_px: float
    v_px: float
    range_m: float
    flux_e: float


class _Pixels:
    """The pixels of a frame that nobody rendered: windows of it, drawn as photometry asks for them.

    Flares as the calibration has them, shot noise of their light, read noise and rounding; no other light.
    """

    def __init__(self, known: Calibration, images: Sequence[_Image], random: np.random.Generator) -> None:
        self._known, self._images, self._random = known, images, random

    def __getitem__(self, window: tuple[slice, slice]) -> NDArray[np.uint16]:
        known, (rows, columns) = self._known, window
        box = PixelBox(rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start)
        mean_e = np.zeros((box.height, box.width))
        for one in self._images:
            radius = float(angular_radius_rad(np.array([one.range_m]), known.source_radius_m)[0])
            reach_px = _FAR_PX + radius * known.fx_px
            right, bottom = box.left + box.width, box.top + box.height
            beside = box.left - reach_px < one.u_px < right + reach_px
            if beside and box.top - reach_px < one.v_px < bottom + reach_px:
                mean_e += one.flux_e * flare_image(one.u_px, one.v_px, radius, box, known).fraction
        noise_e = math.hypot(known.read_noise_e, known.dsnu_e) * self._random.standard_normal(mean_e.shape)
        electrons = self._random.poisson(np.maximum(mean_e, 0.0)) + noise_e
        counts = np.rint(known.black_level_dn + known.system_gain_dn_per_e * electrons)
        return np.clip(counts, 0.0, known.saturation_dn).astype(np.uint16)


@dataclass(frozen=True)
class _Exposed:
    """What a frame that nobody rendered is to the stack behind the detector."""

    camera: str
    index: int
    time_s: float
    exposure_s: float
    black_level_dn: float
    data_dn: _Pixels | None = None
    line_time_s: float = 0.0
    gain: float = 1.0


@dataclass(frozen=True)
class _Flare:
    """A flare as it is found."""

    u_px: float
    v_px: float
    place_sigma_px: tuple[float, float]
    range_m: float
    range_sigma_m: float
    flux_e: float
    flux_sigma_e: float
    merged: bool = False


class MeasurementSight:
    """Measurements as the detector makes them, drawn about the truth with the σ of their Cramér–Rao bound.

    From the detections on everything is the stack itself: fusion of the cameras, ghosts, the tracker,
    brightness, the decoder. Left out is what only frames have: light off walls and lamps, false alarms,
    flares drawn out. Two within 2 px are one at their centre of light, and not ranged; below 8 σ of flux
    nothing is found. Where a source was not found its pixels are drawn: how dark it is the stack measures.

    `visible` says by camera how much of sources it sees whom bodies hide, in part or whole: of so much less
    light, they seem so much farther, and σ does not know it. Of resolved ones the detector does know it
    mostly: this is the harsher.
    """

    def __init__(
        self,
        scene: Scene,
        robot: str,
        seed: int,
        keep_signals: bool = False,
        visible: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
    ) -> None:
        self._robot, self._seed = robot, seed
        self._visible = {name: dict(visible.get(name, {})) for name in scene.document.cameras_of(robot)}
        self._cameras = scene.document.cameras_of(robot)
        self._known = {name: calibration(scene, name) for name in self._cameras}
        self._exposure_s = {name: scene.camera(name)[1].exposure_s for name in self._cameras}
        self._bounds: dict[tuple[str, int, int, int], tuple[FlareLimit, float]] = {}
        self._pipeline = Pipeline(self._known, keep_signals=keep_signals)
        self._index = 0

    def look(self, world: Around) -> Seen:
        """Draw the detections of a set, and take them in."""
        snapshot = world.snapshot()
        frames, found = [], []
        for name in self._cameras:
            frame = self._exposed(name, self._index, world.time_s)
            images, hits = self._images_and_detections(frame, snapshot)
            random = generator(self._seed, "pixels", name, self._index)
            frames.append(replace(frame, data_dn=_Pixels(self._known[name], images, random)))
            found.append(hits)
        self._index += 1
        # They are no raw frames: of their pixels there are only the windows that photometry looks at.
        heard = self._pipeline.follow(cast(list[RawFrame], frames), found, world.odometry(self._robot))
        return Seen(neighbours_of(heard.tracks), heard.messages, heard.tracks)

    def finish(self) -> tuple[Message, ...]:
        """Return the words that can be told as no more sets will come."""
        return self._pipeline.finish()

    def signals(self) -> tuple[Signal, ...]:
        """Return how bright every track was so far, where that is kept."""
        return self._pipeline.signals()

    def _exposed(self, camera: str, index: int, middle_s: float) -> _Exposed:
        exposure_s = self._exposure_s[camera]
        black_dn = self._known[camera].black_level_dn
        return _Exposed(camera, index, middle_s - 0.5 * exposure_s, exposure_s, black_dn)

    def _images_and_detections(
        self, frame: _Exposed, snapshot: Snapshot
    ) -> tuple[list[_Image], list[Detection]]:
        known = self._known[frame.camera]
        pose = snapshot.camera(frame.camera).pose
        random = generator(self._seed, "measurements", frame.camera, frame.index)
        images, flares = [], []
        sources = snapshot.carried_sources
        # For all: who is out of view leaves the noise of the others as it is.
        noises = random.standard_normal((len(sources), 3))
        towards_m = pose.to_local(np.array([placed.pose.position_m for placed in sources.values()]))
        places_px, ranges_m = project(towards_m, known), np.linalg.norm(towards_m, axis=1)
        for (name, placed), place_px, range_m, noise in zip(
            sources.items(), places_px, ranges_m.tolist(), noises, strict=True
        ):
            if name.startswith(f"{self._robot}.") or not _is_in_view(place_px, known):
                continue
            shown = self._visible[frame.camera].get(name, 1.0)
            bound, lit_e = self._bound(frame, range_m, float(place_px[0]), float(place_px[1]))
            # A source that is brighter than its type seems so much nearer, and one that was lit for a part
            # of the exposure, or seen in part, so much farther.
            brighter = placed.source.sent_flux_w / placed.source.of_its_type.sent_flux_w
            level = (
                float(mean_level(drive_of(placed.source), frame.time_s, frame.exposure_s)) * brighter * shown
            )
            flux_e = level * lit_e
            images.append(_Image(float(place_px[0]), float(place_px[1]), range_m, flux_e))
            if flux_e < _LEAST_SNR * bound.flux_sigma_e:
                continue
            sigma_px, share = (bound.u_sigma_px, bound.v_sigma_px), bound.range_sigma_m / range_m
            seen_m = range_m * math.exp(share * noise[2]) / math.sqrt(level)
            u_px, v_px = place_px + noise[:2] * sigma_px
            flux_sigma_e = bound.flux_sigma_e
            seen_e = flux_e - flux_sigma_e * noise[2]  # who seems farther seems fainter
            flares.append(
                _Flare(float(u_px), float(v_px), sigma_px, seen_m, share * seen_m, seen_e, flux_sigma_e)
            )
        return images, [_detection(frame, known, flare) for flare in _merged(flares)]

    def _bound(self, frame: _Exposed, range_m: float, u_px: float, v_px: float) -> tuple[FlareLimit, float]:
        """Return the bound of a flare, and its electrons: those of the next range and place looked up."""
        step = round(_RANGES_PER_E * math.log(range_m))
        column, row = round(u_px / _STEP_PX), round(v_px / _STEP_PX)
        key = (frame.camera, step, column, row)
        if key not in self._bounds:
            known, near_m = self._known[frame.camera], math.exp(step / _RANGES_PER_E)
            at_px = (column * _STEP_PX, row * _STEP_PX)
            flux_dn = float(flux_at_one_metre_dn(*at_px, frame.exposure_s, frame.gain, known)) / near_m**2
            flux_e = flux_dn / known.system_gain_dn_per_e
            self._bounds[key] = flare_limit(known, *at_px, near_m, flux_e, 0.0), flux_e
        return self._bounds[key]


def _is_in_view(place_px: Array, known: Calibration) -> bool:
    most_px = np.array([known.width_px, known.height_px]) - 1.0 - _RIM_PX
    return bool(((place_px > _RIM_PX) & (place_px < most_px)).all())


def _merged(flares: Sequence[_Flare]) -> list[_Flare]:
    """Return flares, those within 2 px of each other as one at their centre of light, without a range."""
    left, found = list(flares), []
    while left:
        first = left.pop(0)
        near = [one for one in left if math.hypot(one.u_px - first.u_px, one.v_px - first.v_px) < _MERGED_PX]
        if not near:
            found.append(first)
            continue
        left = [one for one in left if one not in near]
        group = [first, *near]
        flux_e = np.array([one.flux_e for one in group])
        places_px = np.array([(one.u_px, one.v_px) for one in group])
        u_px, v_px = (flux_e @ places_px / flux_e.sum()).tolist()
        wide_px = 0.5 * _MERGED_PX
        sigma_e = math.hypot(*(one.flux_sigma_e for one in group))
        wide = (wide_px, wide_px)
        found.append(_Flare(u_px, v_px, wide, math.nan, math.nan, float(flux_e.sum()), sigma_e, merged=True))
    return found


def _detection(frame: _Exposed, known: Calibration, flare: _Flare) -> Detection:
    bearing = bearing_body(np.array([[flare.u_px, flare.v_px]]), known)[0]
    return Detection(
        camera=frame.camera,
        index=frame.index,
        time_s=frame.time_s,
        u_px=flare.u_px,
        v_px=flare.v_px,
        u_sigma_px=flare.place_sigma_px[0],
        v_sigma_px=flare.place_sigma_px[1],
        flux_dn=flare.flux_e * known.system_gain_dn_per_e,
        mean_dn=known.black_level_dn,
        background_dn=known.black_level_dn,
        area_px=1,
        saturated=False,
        merged=flare.merged,
        ghost=False,
        range_m=flare.range_m,
        range_sigma_m=flare.range_sigma_m,
        bearing_body=(float(bearing[0]), float(bearing[1]), float(bearing[2])),
        flux_sigma_dn=flare.flux_sigma_e * known.system_gain_dn_per_e,
        range_sigma_common_m=0.0,
    )
