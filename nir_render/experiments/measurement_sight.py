"""A robot that sees by measurements: as the detector makes them, drawn about the truth, without frames."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.experiments.controllers import neighbours_of
from nir_render.experiments.sight import Seen
from nir_render.experiments.world import World
from nir_render.randomness import generator
from nir_render.scene.scene import Scene
from nir_render.scene.snapshot import Snapshot
from nir_render.simulation.calibration import calibration
from perception import Calibration, Detection
from perception.model.bearing import bearing_body
from perception.model.fisher import FlareLimit, flare_limit
from perception.model.lens import project
from perception.model.ranging import flux_at_one_metre_dn
from perception.rig.measure_set import measure_set
from perception.track.tracker import Tracker

Array = NDArray[np.float64]

_RANGES_PER_E, _STEP_PX = 40.0, 60.0  # bounds are looked up at the next of such ranges and places
_LEAST_SNR = 8.0  # from which `robust` finds 99.8 %
_MERGED_PX = 2.0  # down to which it parts two of a like brightness
_RIM_PX = 3.0  # a centre nearer to the edge of a frame is not found


@dataclass(frozen=True)
class _Exposed:
    """What a frame that nobody rendered is to the fusion of cameras."""

    camera: str
    index: int
    time_s: float
    exposure_s: float
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
    merged: bool = False


class MeasurementSight:
    """Measurements as the detector makes them, drawn about the truth with the σ of their Cramér–Rao bound.

    From the detections on everything is the stack itself: fusion of the cameras, ghosts, the tracker. Left
    out is what only frames have: light off walls and lamps, false alarms, bits, flares drawn out. Two within
    2 px are one at their centre of light, and not ranged; below 8 σ of flux nothing is found.
    """

    def __init__(self, scene: Scene, robot: str, seed: int) -> None:
        self._robot, self._seed = robot, seed
        self._cameras = scene.document.cameras_of(robot)
        self._known = {name: calibration(scene, name) for name in self._cameras}
        self._exposure_s = {name: scene.camera(name)[1].exposure_s for name in self._cameras}
        self._bounds: dict[tuple[str, int, int, int], tuple[FlareLimit, float]] = {}
        self._tracker = Tracker()
        self._index = 0

    def look(self, world: World) -> Seen:
        """Draw the detections of a set, and follow them."""
        snapshot = world.snapshot()
        frames = [
            _Exposed(name, self._index, world.time_s - 0.5 * self._exposure_s[name], self._exposure_s[name])
            for name in self._cameras
        ]
        found = [self._detections(frame, snapshot) for frame in frames]
        self._index += 1
        seen = measure_set(frames, found, self._known)
        odometry = world.odometry(self._robot)
        return Seen(neighbours_of(self._tracker.update(world.time_s, seen.measurements, odometry)))

    def _detections(self, frame: _Exposed, snapshot: Snapshot) -> list[Detection]:
        known = self._known[frame.camera]
        pose = snapshot.camera(frame.camera).pose
        random = generator(self._seed, "measurements", frame.camera, frame.index)
        flares = []
        for name, placed in snapshot.carried_sources.items():
            noise = random.standard_normal(
                3
            )  # for all: who is out of view leaves those of the others as they are
            towards_m = pose.to_local(placed.pose.position_m)
            (place_px,) = project(towards_m[None], known)
            if name.startswith(f"{self._robot}.") or not _is_in_view(place_px, known):
                continue
            range_m = float(np.linalg.norm(towards_m))
            bound, flux_e = self._bound(frame, range_m, float(place_px[0]), float(place_px[1]))
            if flux_e < _LEAST_SNR * bound.flux_sigma_e:
                continue
            # A source that is brighter than its type seems so much nearer.
            brighter = placed.source.sent_flux_w / placed.source.of_its_type.sent_flux_w
            sigma_px, share = (bound.u_sigma_px, bound.v_sigma_px), bound.range_sigma_m / range_m
            seen_m = range_m * math.exp(share * noise[2]) / math.sqrt(brighter)
            u_px, v_px = place_px + noise[:2] * sigma_px
            flares.append(_Flare(float(u_px), float(v_px), sigma_px, seen_m, share * seen_m, flux_e))
        return [_detection(frame, known, flare) for flare in _merged(flares)]

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
        one = _Flare(u_px, v_px, (wide_px, wide_px), math.nan, math.nan, float(flux_e.sum()), merged=True)
        found.append(one)
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
        range_sigma_common_m=0.0,
    )
