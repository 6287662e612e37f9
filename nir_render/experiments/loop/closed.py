"""What every closed loop is: robots look, a law says where to, bases go; what is told of it as it goes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from nir_render.experiments.loop.frame_sight import FrameSight
from nir_render.experiments.loop.journal import Told
from nir_render.experiments.loop.measurement_sight import MeasurementSight
from nir_render.experiments.loop.sight import Seen, Sight, TrueSight
from nir_render.experiments.loop.world import Base, World
from nir_render.run.folder import POSES, SENT
from nir_render.scene.scene import Scene
from nir_render.simulation.calibration import calibration
from nir_render.truth.poses import PoseTruth
from nir_render.truth.sent import SentTruth
from perception import Calibration, message_record, odometry_record, track_record
from perception.files.tracks import ODOMETRY

Array = NDArray[np.float64]
Pair = tuple[str, str]


@dataclass(frozen=True, kw_only=True)
class LoopPlan:
    """What all closed loops have in common.

    Attributes
    ----------
    level
        What robots see by: `frames`, `measurements`, or `truth`.
    stack
        At the level of frames: the perception stack, `robust` or `paper`.
    lasts_s, period_s
        How long it goes, and how often robots look and decide.
    refresh_s
        At the level of frames: after how long indirect light is rendered again, first (`FrameSight`).
    keep_frames
        At the level of frames: every how many looks frames are kept; 0 for none.
    """

    level: str = "measurements"
    stack: str = "robust"
    lasts_s: float
    period_s: float
    refresh_s: float = 5.0
    keep_frames: int = 0
    base: Base = field(default_factory=Base)

    @property
    def steps(self) -> int:
        """How many steps a whole run has."""
        return round(self.lasts_s / self.period_s)

    @property
    def perceives_by(self) -> str:
        """The name of what perception says in files: the stack's, of measurements always `robust`."""
        return self.stack if self.level == "frames" else "robust"


class ClosedLoop:
    """A run in the making: world, eyes, and what happened so far; it can be pickled between steps.

    Attributes
    ----------
    times_s, places_m
        Every step so far: when robots looked, and where all stood then, each by name, shape (2,).
    """

    listens: ClassVar[bool] = False

    def __init__(
        self,
        scene: Scene,
        plan: LoopPlan,
        seed: int,
        starts_m: Mapping[str, Array],
        sent: Sequence[SentTruth] = (),
    ) -> None:
        self.seed, self.sent = seed, sent
        self.leader, *self.followers = starts_m
        self.world = World(scene, starts_m, plan.base, seed)
        self.sights = {name: _sight(scene, name, plan, seed, sent, self.listens) for name in self.followers}
        self.times_s: list[float] = []
        self.places_m: list[dict[str, Array]] = []
        self._plan, self._scene = plan, scene

    @property
    def steps(self) -> int:
        """How many steps the whole run has."""
        return self._plan.steps

    @property
    def done(self) -> int:
        """How many of them are done."""
        return len(self.times_s)

    def calibrations(self) -> list[Calibration]:
        """Return what is known of the cameras that robots look by."""
        if self._plan.level == "truth":
            return []
        names = [name for robot in self.followers for name in self._scene.document.cameras_of(robot)]
        return [calibration(self._scene, name) for name in names]

    def step(self) -> Told:
        """Look, decide, go; return what there is to tell of it."""
        world = self.world
        seen = {name: sight.look(world) for name, sight in self.sights.items()}
        told = self._told(seen)
        wanted = self._wanted(seen)
        self.times_s.append(world.time_s)
        self.places_m.append({name: mover.place_m for name, mover in world.movers.items()})
        world.step(wanted, self._plan.period_s)
        return told

    def _wanted(self, seen: Mapping[str, Seen]) -> dict[str, Array]:
        """Return the velocity that each robot wants, by what it has seen."""
        raise NotImplementedError

    def record(self) -> dict[str, Any]:
        """Return a run that is done as plain data: all places over time, what held light was off by."""
        names = [self.leader, *self.followers]
        shares = [
            share
            for sight in self.sights.values()
            if isinstance(sight, FrameSight)
            for share in sight.held_shares
        ]
        return {
            "format": 1,
            "seed": self.seed,
            "robots": names,
            "time_s": [round(time_s, 9) for time_s in self.times_s],
            "places_m": np.round([[at[name] for name in names] for at in self.places_m], 6).tolist(),
            "held_light_share": max(shares) if shares else None,
        }

    def distances_m(self) -> dict[Pair, Array]:
        """Return the distance of each pair over time, shape (steps,)."""
        names = [self.leader, *self.followers]
        ways_m = {name: np.array([at[name] for at in self.places_m]) for name in names}
        return {
            (one, other): np.hypot(*(ways_m[one] - ways_m[other]).T)
            for number, one in enumerate(names)
            for other in names[number + 1 :]
        }

    def _told(self, seen: Mapping[str, Seen]) -> Told:
        """Return the lines of this step's poses, odometry, tracks, words and packets that end."""
        world, name = self.world, self._plan.perceives_by
        lines = {
            POSES: [
                PoseTruth(
                    robot, world.time_s, (*map(float, mover.place_m), 0.0), (0.0, 0.0, 0.0, 1.0),
                    (*map(float, mover.velocity_m_per_s), 0.0), (0.0, 0.0, 0.0),
                ).record()
                for robot, mover in world.movers.items()
            ],
            SENT: [
                packet.record()
                for packet in self.sent
                if world.time_s <= packet.end_s < world.time_s + self._plan.period_s
            ],
        }  # fmt: skip
        if self._plan.level != "truth":
            lines |= {
                ODOMETRY: [odometry_record(world.odometry(robot)[-1]) for robot in self.followers],
                f"tracks.{name}.jsonl": [
                    track_record(track) for one in seen.values() for track in one.tracks
                ],
                f"messages.{name}.jsonl": [
                    message_record(word) for one in seen.values() for word in one.messages
                ],
            }
        every = self._plan.keep_frames
        kept = every > 0 and self.done % every == 0
        return Told(lines, [frame for one in seen.values() for frame in one.frames] if kept else [])


def finite_or_none(value: float) -> float | None:
    """Return a number as JSON can hold it."""
    return value if math.isfinite(value) else None


def _sight(
    scene: Scene, robot: str, plan: LoopPlan, seed: int, sent: Sequence[SentTruth], listens: bool
) -> Sight:
    if plan.level == "truth":
        return TrueSight(robot, sent)
    if plan.level == "measurements":
        return MeasurementSight(scene, robot, seed, keep_signals=listens)
    return FrameSight(scene, robot, seed, plan.stack, plan.refresh_s, keep_signals=listens)
