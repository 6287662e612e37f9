"""One robot of a swarm that stands looks around: its light is rendered once, and exposed set by set."""

import math
import time
from collections.abc import Hashable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.mean_frame import MeanFrame, Rates, electron_rates, exposed_frame, fully_lit_frame
from nir_render.camera.shared_light import SharedLight, shared_light
from nir_render.camera.timing.exposure_control import own_setting
from nir_render.camera.timing.shutter import mid_exposure_s
from nir_render.experiments.loop.journal import Told
from nir_render.experiments.loop.measurement_sight import MeasurementSight
from nir_render.experiments.swarm.film import MOST_PICTURES, encoded, picture_file
from nir_render.experiments.swarm.followed import Followed
from nir_render.experiments.swarm.hall import OBSERVER, hall_scene, names_of, side_m
from nir_render.experiments.swarm.identity import MOST, numbers_told
from nir_render.experiments.swarm.judge import Sight, Word, judged_packets, sights, unlike
from nir_render.experiments.swarm.picture import Moment, SwarmPicture
from nir_render.randomness import RandomKey
from nir_render.run.folder import POSES, SENT
from nir_render.scene.pose import Pose
from nir_render.scene.scene import Scene
from nir_render.scene.snapshot import Snapshot
from nir_render.simulation.calibration import calibration
from nir_render.simulation.clock import frame_of
from nir_render.simulation.lamps import lamp_truth
from nir_render.simulation.sent import sent_packets
from nir_render.simulation.truth import truth_of
from nir_render.truth.lamps import Outline
from nir_render.truth.poses import PoseTruth
from nir_render.truth.sources import SourceTruth
from perception import (
    Calibration,
    Detection,
    Message,
    Odometry,
    Pipeline,
    RawFrame,
    Track,
    detect_frames,
    message_record,
    track_record,
)

Array = NDArray[np.float64]

TRACKS = "tracks.robust.jsonl"
SECONDS = "seconds.jsonl"
"""How long each part of each set took, in a run's folder."""

OFF = 0.01
"""Of a block's temporal variance: by so much may light that many share be off in the mean square."""


@dataclass(frozen=True, kw_only=True)
class Swarm:
    """What a run of the experiment is.

    Attributes
    ----------
    level
        `frames`: rendered, exposed, and read by the whole stack. `measurements`: detections drawn about the
        truth (`MeasurementSight`), fainter where bodies hide a part; what is found of single frames is not
        judged.
    robots, density_per_m2
        How many stand in the hall, the observer among them, and how densely.
    bodies
        `masts` or `columns` (`hall.hall_scene`).
    lasts_s, rate_hz
        How long the observer looks, and how often.
    judged_sets
        In how many sets, evenly over the run, each robot is held against truth.
    """

    level: str = "frames"
    robots: int = 30
    density_per_m2: float = 1.0
    bodies: str = "masts"
    lasts_s: float = 60.0
    rate_hz: float = 30.0
    judged_sets: int = 6

    @property
    def steps(self) -> int:
        """How many sets of frames a whole run has."""
        return round(self.lasts_s * self.rate_hz)

    @property
    def judged(self) -> tuple[int, ...]:
        """The numbers of the sets that are judged: none without frames."""
        count = min(self.judged_sets, self.steps)
        if self.level != "frames":
            return ()
        return tuple(sorted({int((number + 0.5) * self.steps / count) for number in range(count)}))

    def loop(self, scene: Scene, seed: int) -> "SwarmLoop":
        """Return the beginning of a run."""
        return SwarmLoop(scene, self, seed)


class SwarmLoop:
    """A run in the making; a step is a set of frames of all cameras of the observer."""

    def __init__(self, scene: Scene, plan: Swarm, seed: int) -> None:
        if not 2 <= plan.robots <= MOST:
            raise ValueError(
                f"{plan.robots} robots: wanted 2 to {MOST}, one of whom looks; two words tell so many apart"
            )
        self.plan, self.seed = plan, seed
        self._scene = hall_scene(scene, plan.robots, plan.density_per_m2, plan.bodies, plan.lasts_s, seed)
        self._world = self._scene.at(0.0)
        self._others = names_of(plan.robots)[1:]
        cameras = self._scene.document.cameras_of(OBSERVER)
        self._known = {name: calibration(self._scene, name) for name in cameras}
        self._pipeline = Pipeline.of("robust", self._known)
        self._sight: MeasurementSight | None = None
        self._rates: dict[str, Rates] = {}
        self._followed = Followed(self._others, np.empty((0, 3)), {}, self._known)
        self._done = 0
        self._told: list[Word] = []
        self._sights: list[list[Any]] = []
        self._alarms = self._parts = 0
        self._standing: list[list[Any]] = []
        self._shared: dict[str, SharedLight] = {}

    @property
    def steps(self) -> int:
        """How many sets there are."""
        return self.plan.steps

    @property
    def done(self) -> int:
        """How many of them are done."""
        return self._done

    def calibrations(self) -> list[Calibration]:
        """Return what is known of the observer's cameras."""
        return list(self._known.values())

    def __getstate__(self) -> dict[str, Any]:
        """Leave out what is rendered again to the same bits."""
        return {**self.__dict__, "_rates": {}}

    def step(self) -> Told:
        """Take a set of frames, read it, and hold it against truth where its turn is."""
        clock = _Clock()
        if not self._rates and (self.plan.level == "frames" or not self._standing):
            self._render()
            clock.lap("render")
        if not self._standing:
            rows = self._lit()
            self._standing = [one.record() for one in self._could_be_seen(rows)]
            self._followed = self._nobody_yet(rows)
            clock.lap("ceiling")
        if self.plan.level != "frames":
            return self._measured(clock)
        time_s = self._done / self.plan.rate_hz
        means, frames = {}, []
        for name, rates in self._rates.items():
            setting = own_setting(rates.camera, self._done)
            begin_s = time_s - mid_exposure_s(rates.camera, setting.exposure_s)
            means[name] = exposed_frame(rates, setting.exposure_s, begin_s)
            key = RandomKey(self.seed, "read_out", name, self._done)
            frames.append(frame_of(means[name].electrons, rates.camera, setting, begin_s, key))
        clock.lap("expose")
        found = detect_frames(frames, self._known)
        clock.lap("detect")
        heard = self._pipeline.follow(frames, found)
        words = heard.messages
        last = self._done + 1 == self.steps
        if last:
            words += self._pipeline.finish()
        clock.lap("follow")
        self._hear(words, heard.tracks)
        if self._done in self.plan.judged:
            self._judge(means, frames, found)
            clock.lap("judge")
        self._done += 1
        files = self._pictured(frames, heard.tracks, last)
        clock.lap("draw")
        lines = self._lines(words, clock)
        if last:
            lines[TRACKS] = [track_record(track) for track in heard.tracks]
        return Told(lines, frames if last else [], files)

    def _pictured(self, frames: Sequence[RawFrame], tracks: Sequence[Track], last: bool) -> dict[str, bytes]:
        """Draw the set that is done, where the film has it, or the run ends."""
        number = self._done - 1
        if not last and number % math.ceil(self.steps / MOST_PICTURES):
            return {}
        places_m = np.array(
            [self._world.robots[name].pose.position_m[:2] for name in names_of(self.plan.robots)]
        )
        side = side_m(self.plan.robots, self.plan.density_per_m2)
        picture = SwarmPicture(places_m, self._world.robots[OBSERVER].pose, self._known, side)
        words = [word.message for word in self._told]
        drawn = picture.drawn(Moment(number / self.plan.rate_hz, frames, tracks, words))
        return {picture_file(number, last): encoded(drawn, last)}

    def _measured(self, clock: "_Clock") -> Told:
        """Draw the detections of a set, and read them."""
        if self._sight is None:
            self._sight = MeasurementSight(self._scene, OBSERVER, self.seed, visible=self._visible())
            self._rates = {}
        seen = self._sight.look(_Standing(self._world, self._done / self.plan.rate_hz))
        words = seen.messages
        if self._done + 1 == self.steps:
            words += self._sight.finish()
        clock.lap("follow")
        self._hear(words, seen.tracks)
        self._done += 1
        return Told(self._lines(words, clock))

    def _lines(self, words: Sequence[Message], clock: "_Clock") -> dict[str, Any]:
        """Return the lines of a set that is done: with the first one where all stand, and what they send."""
        lines: dict[str, Any] = {
            "messages.robust.jsonl": [message_record(word) for word in words],
            SECONDS: [{"set": self._done - 1, **clock.laps_s}],
        }
        if self._done == 1:
            poses = {name: robot.pose for name, robot in self._world.robots.items()}
            lines[POSES] = [_standing(name, pose) for name, pose in poses.items()]
            lines[SENT] = [packet.record() for packet in sent_packets(self._scene)]
        return lines

    def _visible(self) -> dict[str, dict[str, float]]:
        """Return by camera how much is seen of each source that is not seen whole."""
        found: dict[str, dict[str, float]] = {}
        for name, rates in self._rates.items():
            table, groups = rates.light.direct, rates.light.groups
            rows = np.flatnonzero((table.facet < 0) & (table.visible_fraction < 1.0))
            found[name] = {groups[table.group[row]]: float(table.visible_fraction[row]) for row in rows}
        return found

    def record(self) -> dict[str, Any]:
        """Return a run that is done as plain data: what could be seen, what was, and what was heard."""
        sent = [packet for packet in sent_packets(self._scene) if packet.end_s <= self.plan.lasts_s]
        packets = judged_packets(sent, self._told)
        places_m = [self._world.robots[name].pose.position_m[:2] for name in names_of(self.plan.robots)]
        return {
            "format": 1,
            "seed": self.seed,
            "places_m": np.round(places_m, 4).tolist(),
            "standing": self._standing,
            "sights": self._sights,
            "false_alarms": self._alarms,
            "parts": self._parts,
            "packets": [
                [packet.robot, packet.word, round(packet.start_s, 4), received]
                for packet, received in zip(sent, packets.received, strict=True)
            ],
            "misattributed": packets.misattributed,
            "wrong_words": packets.wrong,
            "identities": self._identities(),
            "tracks": self._followed.now(),
            "shared": {name: asdict(one) for name, one in self._shared.items()},
        }

    def _render(self) -> None:
        """Render the light of every camera, without frames direct light alone; keep what exposing needs."""
        from nir_render.transport.render import direct_lights, render

        if self.plan.level != "frames":
            lights = direct_lights(self._world, list(self._known), self.seed)
            self._rates = {name: electron_rates(light, self._world) for name, light in lights.items()}
            return
        kept: dict[Hashable, Any] = {}
        for name in self._known:
            light = render(self._world, name, self.seed, kept=kept)
            exposure_s = own_setting(self._world.camera(name).camera, 0).exposure_s
            self._shared[name] = shared_light(light, self._world, exposure_s, OFF)
            self._rates[name] = electron_rates(light, self._world, self._shared[name].groups)

    def _hear(self, words: Sequence[Message], tracks: Sequence[Track]) -> None:
        """Note of whom each word is, by truth."""
        self._followed.update(tracks)
        for word in words:
            meant = [word.track] if word.ambiguous_with is None else [word.track, word.ambiguous_with]
            whom = (self._followed.during(track, word.start_s, word.end_s) for track in meant)
            self._told.append(Word(tuple(one for one in whom if one is not None), word))

    def _judge(
        self, means: dict[str, MeanFrame], frames: Sequence[RawFrame], found: Sequence[Sequence[Detection]]
    ) -> None:
        by_camera = {frame.camera: frame for frame in frames}
        hits = {frame.camera: each for frame, each in zip(frames, found, strict=True)}
        lamps_px = {
            name: [lamp.outline_px for lamp in lamp_truth(self._world, name, self._done)] for name in means
        }
        rows = {name: list(truth_of(mean, by_camera[name])) for name, mean in means.items()}
        seen = sights(self._others, rows, hits, lamps_px, self._known)
        self._sights.append([one.record() for one in seen.sights])
        self._alarms += seen.false_alarms
        self._parts += seen.parts

    def _lit(self) -> dict[str, list[SourceTruth]]:
        """Return by camera the truth of a set in which all are lit at once, mirror images left out."""
        rows = {}
        for name, rates in self._rates.items():
            setting = own_setting(rates.camera, 0)
            lit = fully_lit_frame(rates, setting.exposure_s)
            key = RandomKey(self.seed, "read_out", name, 0)
            frame = frame_of(lit.electrons, rates.camera, setting, 0.0, key)
            real = [row for row in truth_of(lit, frame) if row.ghost_of is None]
            rows[name] = [replace(row, on_fraction=1.0) for row in real]
        return rows

    def _could_be_seen(self, rows: dict[str, list[SourceTruth]]) -> tuple[Sight, ...]:
        """Return each robot as it could be seen were all lit at once: the ceiling of what is heard."""
        none: dict[str, list[Detection]] = {name: [] for name in rows}
        lamps_px: dict[str, list[Outline]] = {name: [] for name in rows}
        return sights(self._others, rows, none, lamps_px, self._known).sights

    def _nobody_yet(self, rows: dict[str, list[SourceTruth]]) -> Followed:
        """Return whom tracks follow before there are any."""
        others_m = np.array([self._world.sources[f"{name}.top"].pose.position_m for name in self._others])
        places_m = self._world.robots[OBSERVER].pose.to_local(others_m)
        return Followed(
            self._others,
            places_m,
            {name: unlike(some, self._known[name]) for name, some in rows.items()},
            self._known,
        )

    def _identities(self) -> dict[str, Any]:
        """Return who was told to be who: numbers right, wrong, and robots that told it in full."""
        robots, names = self.plan.robots, names_of(self.plan.robots)
        whom = {word.message: word.robots for word in self._told}
        told = [
            (names[number], all(names[number] in whom[word] for word in words))
            for number, words in numbers_told(whom, robots)
        ]
        right = {name for name, is_right in told if is_right}
        return {"right": sorted(right), "wrong": sum(not is_right for _, is_right in told)}


def _standing(robot: str, pose: Pose) -> dict[str, Any]:
    """Return the line of `poses.jsonl` of a robot that stands, upright."""
    x, y, z = map(float, pose.position_m)
    half_rad = 0.5 * math.atan2(pose.rotation[1, 0], pose.rotation[0, 0])
    turned = (0.0, 0.0, math.sin(half_rad), math.cos(half_rad))
    return PoseTruth(robot, 0.0, (x, y, z), turned, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)).record()


@dataclass(frozen=True)
class _Standing:
    """A world in which nobody moves, at a time."""

    world: Snapshot
    time_s: float

    def snapshot(self) -> Snapshot:
        """Return the world, which is always the same."""
        return self.world

    def odometry(self, _: str) -> list[Odometry]:
        """Return none: who knows nothing of its way stands still."""
        return []


class _Clock:
    """How long the parts of a step took, in seconds of this process's processors."""

    def __init__(self) -> None:
        self.laps_s: dict[str, float] = {}
        self._last_s = (time.perf_counter(), time.process_time())

    def lap(self, name: str) -> None:
        """Note what has gone since the last lap, by the clock and of all processors."""
        now = (time.perf_counter(), time.process_time())
        self.laps_s[f"{name}_s"] = round(now[0] - self._last_s[0], 4)
        self.laps_s[f"{name}_cpu_s"] = round(now[1] - self._last_s[1], 4)
        self._last_s = now
