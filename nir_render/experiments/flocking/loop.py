"""The paper's flocking experiment: four robots follow a leader by what they see of it and of each other."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.experiments.flocking.spacing import Spacing, spacing
from nir_render.experiments.loop.closed import ClosedLoop, LoopPlan, finite_or_none
from nir_render.experiments.loop.controllers import LAWS
from nir_render.experiments.loop.sight import Seen
from nir_render.randomness import generator
from nir_render.scene.scene import Scene

Array = NDArray[np.float64]

_START_WITHIN_M, _START_APART_M = 1.8, 0.5
_LEADERS_WAY_M = np.array([[-1.2, -2.2], [-1.2, 1.4], [1.2, 1.4]])


@dataclass(frozen=True, kw_only=True)
class Flocking(LoopPlan):
    """What a run of the experiment is, beside what all closed loops are.

    Attributes
    ----------
    law
        `robust` (`controllers.springs`) or `paper` (`controllers.reynolds`).
    spacing_m
        The wished one.
    leader_m_per_s
        How fast the leader goes along its way, 6 m.
    """

    law: str = "robust"
    lasts_s: float = 120.0
    period_s: float = 0.1
    spacing_m: float = 1.0
    leader_m_per_s: float = 0.05

    def loop(self, scene: Scene, seed: int) -> "Loop":
        """Return the beginning of a run."""
        return Loop(scene, self, seed)


class Loop(ClosedLoop):
    """A run in the making: who sees how many, beside what all closed loops know."""

    def __init__(self, scene: Scene, plan: Flocking, seed: int) -> None:
        super().__init__(scene, plan, seed, _starts_m(list(scene.document.robots), seed))
        self.plan = plan
        self.neighbours: list[dict[str, int]] = []

    def _wanted(self, seen: Mapping[str, Seen]) -> dict[str, Array]:
        plan = self.plan
        self.neighbours.append({name: len(one.neighbours) for name, one in seen.items()})
        steer, most_m_per_s = LAWS[plan.law], plan.base.speed_m_per_s
        return {
            self.leader: self._leaders_velocity(),
            **{name: steer(one.neighbours, plan.spacing_m, most_m_per_s) for name, one in seen.items()},
        }

    def record(self) -> dict[str, Any]:
        """Return a run as plain data: its spacing, and who saw how many, beside where all were."""
        plan = self.plan
        kept = spacing(np.array(self.times_s), self.distances_m(), plan.spacing_m, plan.base.diameter_m)
        return super().record() | {
            "spacing": {
                name: finite_or_none(value) if isinstance(value, float) else value
                for name, value in asdict(kept).items()
            },
            "neighbours": [[seen[name] for name in self.followers] for seen in self.neighbours],
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
