"""The paper's flocking experiment: four robots follow a leader by what they see of it and of each other."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.experiments.controllers import LAWS
from nir_render.experiments.frame_sight import FrameSight
from nir_render.experiments.measurement_sight import MeasurementSight
from nir_render.experiments.sight import Sight, TrueSight
from nir_render.experiments.spacing import Spacing, spacing
from nir_render.experiments.world import Base, World
from nir_render.randomness import generator
from nir_render.scene.scene import Scene

Array = NDArray[np.float64]

_START_WITHIN_M, _START_APART_M = 1.8, 0.5
_LEADERS_WAY_M = np.array([[-1.2, -2.2], [-1.2, 1.4], [1.2, 1.4]])


@dataclass(frozen=True)
class Flocking:
    """What a run of the experiment is.

    Attributes
    ----------
    law
        `robust` (`controllers.springs`) or `paper` (`controllers.reynolds`).
    level
        What robots see by: `frames`, `measurements`, or `truth`.
    stack
        At the level of frames: the perception stack, `robust` or `paper`.
    lasts_s, period_s
        How long it goes, and how often robots look and decide.
    spacing_m
        The wished one.
    leader_m_per_s
        How fast the leader goes along its way, 6 m.
    refresh_s
        At the level of frames: how often indirect light is rendered.
    """

    law: str = "robust"
    level: str = "measurements"
    stack: str = "robust"
    lasts_s: float = 120.0
    period_s: float = 0.1
    spacing_m: float = 1.0
    leader_m_per_s: float = 0.05
    refresh_s: float = 5.0
    base: Base = field(default_factory=Base)

    def loop(self, scene: Scene, seed: int) -> "Loop":
        """Return the beginning of a run."""
        return Loop(scene, self, seed)


@dataclass(frozen=True, eq=False)
class Instant:
    """Where everybody is at a time, shape (2,) each, and who sees how many."""

    time_s: float
    places_m: Mapping[str, Array]
    neighbours: Mapping[str, int]


class Loop:
    """A run in the making: world, eyes, and what happened so far; it can be pickled between steps."""

    def __init__(self, scene: Scene, plan: Flocking, seed: int) -> None:
        self.plan, self.seed = plan, seed
        names = list(scene.document.robots)
        self.leader, self.followers = names[0], names[1:]
        self.world = World(scene, _starts_m(names, seed), plan.base, seed)
        self.sights = {name: _sight(scene, name, plan, seed) for name in self.followers}
        self.instants: list[Instant] = []

    @property
    def steps(self) -> int:
        """How many steps the whole run has."""
        return round(self.plan.lasts_s / self.plan.period_s)

    @property
    def done(self) -> int:
        """How many of them are done."""
        return len(self.instants)

    def step(self) -> Instant:
        """Look, decide, go; return how it was when robots looked."""
        plan, world = self.plan, self.world
        wanted: dict[str, Array] = {self.leader: self._leaders_velocity()}
        counts: dict[str, int] = {}
        for name, sight in self.sights.items():
            neighbours = sight.look(world).neighbours
            counts[name] = len(neighbours)
            wanted[name] = LAWS[plan.law](neighbours, plan.spacing_m, plan.base.speed_m_per_s)
        places_m = {name: mover.place_m for name, mover in world.movers.items()}
        instant = Instant(world.time_s, places_m, counts)
        self.instants.append(instant)
        world.step(wanted, plan.period_s)
        return instant

    def record(self) -> dict[str, Any]:
        """Return a run as plain data: its spacing, all places over time, what held light was off by."""
        names = list(self.world.movers)
        places_m = np.array([[instant.places_m[name] for name in names] for instant in self.instants])
        shares = [
            share
            for sight in self.sights.values()
            if isinstance(sight, FrameSight)
            for share in sight.held_shares
        ]
        return {
            "format": 1,
            "seed": self.seed,
            "spacing": {
                name: value if math.isfinite(value) else None  # no number is no JSON
                for name, value in asdict(spacing_of(self.instants, self.plan)).items()
            },
            "robots": names,
            "time_s": [round(instant.time_s, 9) for instant in self.instants],
            "places_m": np.round(places_m, 6).tolist(),
            "neighbours": [
                [instant.neighbours.get(name, 0) for name in self.followers] for instant in self.instants
            ],
            "held_light_share": max(shares) if shares else None,
        }

    def _leaders_velocity(self) -> Array:
        """Return the velocity that brings the leader to where its way has it after this step."""
        after_s = self.world.time_s + self.plan.period_s
        ahead_m = _along_way_m(self.plan.leader_m_per_s * after_s) - self.world.movers[self.leader].place_m
        return np.asarray(ahead_m / self.plan.period_s)


@dataclass(frozen=True)
class Run:
    """A run of one seed that is done: its spacing, where everybody was, and how well held light held."""

    seed: int
    spacing: Spacing
    record: dict[str, Any]


def run_of(record: dict[str, Any]) -> Run:
    """Return a run from its record."""
    said: dict[str, Any] = {
        name: math.nan if value is None else value for name, value in record["spacing"].items()
    }
    return Run(record["seed"], Spacing(**said), record)


def spacing_of(instants: Sequence[Instant], plan: Flocking) -> Spacing:
    """Return how well a run kept its spacing."""
    names = list(instants[0].places_m)
    distances_m = {
        (one, other): np.array([float(np.hypot(*(at.places_m[one] - at.places_m[other]))) for at in instants])
        for number, one in enumerate(names)
        for other in names[number + 1 :]
    }
    times_s = np.array([instant.time_s for instant in instants])
    return spacing(times_s, distances_m, plan.spacing_m, plan.base.diameter_m)


def _sight(scene: Scene, robot: str, plan: Flocking, seed: int) -> Sight:
    if plan.level == "truth":
        return TrueSight(robot)
    if plan.level == "measurements":
        return MeasurementSight(scene, robot, seed)
    return FrameSight(scene, robot, seed, plan.stack, plan.refresh_s)


def _along_way_m(gone_m: float) -> Array:
    """Return the place on the leader's way after so many metres; it ends where the way does."""
    legs_m = np.linalg.norm(np.diff(_LEADERS_WAY_M, axis=0), axis=1)
    at_m = np.concatenate([[0.0], np.cumsum(legs_m)])
    return np.array([np.interp(gone_m, at_m, axis) for axis in _LEADERS_WAY_M.T])


def _starts_m(names: list[str], seed: int) -> dict[str, Array]:
    """Return where robots start: followers anywhere within 1.8 m of the leader, half a metre apart."""
    random = generator(seed, "starts", "flocking", 0)
    places = [_along_way_m(0.0)]
    while len(places) < len(names):
        reach_m, angle = _START_WITHIN_M * math.sqrt(random.random()), random.uniform(0.0, 2.0 * math.pi)
        place = places[0] + reach_m * np.array([math.cos(angle), math.sin(angle)])
        if all(np.hypot(*(place - other)) > _START_APART_M for other in places):
            places.append(place)
    return dict(zip(names, places, strict=True))
