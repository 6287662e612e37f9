"""The world of a closed loop: robots on omnidirectional bases, moved by what they want."""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.experiments.loop.controllers import clipped
from nir_render.scene.documents.times.clocks import OdometryNoise
from nir_render.scene.pose import Pose
from nir_render.scene.scene import Scene
from nir_render.scene.snapshot import Snapshot
from nir_render.simulation.odometry import DeadReckoning
from perception.types import Odometry

Array = NDArray[np.float64]

_KEPT_RECORDS = 32  # of a robot's odometry: some seconds


@dataclass(frozen=True)
class Base:
    """What an omnidirectional base can do: it holds its heading, and goes any way at once.

    The paper's robots go at 0.1 m/s at most; how fast they gather speed, and how wide they are, is assumed.
    """

    speed_m_per_s: float = 0.1
    acceleration_m_per_s2: float = 0.2
    diameter_m: float = 0.2


@dataclass
class Mover:
    """Where a robot stands, and how fast it goes, shape (2,) each."""

    place_m: Array
    velocity_m_per_s: Array = field(default_factory=lambda: np.zeros(2))


class World:
    """Robots of a scene at places of one's own, over time.

    Attributes
    ----------
    time_s
        Now.
    movers
        Each robot, by name.
    kept_of_snapshot
        What whoever renders keeps of `snapshot` for the next camera; it goes with it.
    """

    def __init__(self, scene: Scene, places_m: Mapping[str, Array], base: Base, seed: int) -> None:
        self.time_s = 0.0
        self.movers = {name: Mover(np.array(place_m, dtype=float)) for name, place_m in places_m.items()}
        self._scene, self._base = scene, base
        self._snapshot: Snapshot | None = None  # all look at the same one
        self.kept_of_snapshot: dict[Hashable, Any] = {}
        self._reckoned = {
            name: DeadReckoning(name, scene.document.robots[name].rig.odometry or OdometryNoise(), seed)
            for name in places_m
        }
        self._records: dict[str, list[Odometry]] = {name: [] for name in places_m}
        self._note()

    def snapshot(self) -> Snapshot:
        """Return the world as light meets it now.

        Flares are not drawn out: at 0.1 m/s and 1 m an exposure of 0.2 ms moves one by 0.01 px.
        """
        if self._snapshot is None:
            poses = {name: _pose(mover) for name, mover in self.movers.items()}
            self._snapshot = self._scene.at(0.0).moved(poses, self.time_s)
        return self._snapshot

    def odometry(self, robot: str) -> list[Odometry]:
        """Return what a robot knows of its last seconds."""
        return self._records[robot]

    def step(self, wanted_m_per_s: Mapping[str, Array], lasts_s: float) -> None:
        """Go on for some time, towards the velocities that robots want; who wants nothing comes to rest.

        Speed changes as fast as the base can, at once; places follow by the velocity after that.
        """
        most = self._base.acceleration_m_per_s2 * lasts_s
        for name, mover in self.movers.items():
            wanted = clipped(wanted_m_per_s.get(name, np.zeros(2)), self._base.speed_m_per_s)
            mover.velocity_m_per_s = mover.velocity_m_per_s + clipped(wanted - mover.velocity_m_per_s, most)
            mover.place_m = mover.place_m + lasts_s * mover.velocity_m_per_s
        self.time_s += lasts_s
        self._snapshot, self.kept_of_snapshot = None, {}
        self._note()

    def _note(self) -> None:
        for name, mover in self.movers.items():
            records = self._records[name]
            records.append(self._reckoned[name].record(self.time_s, _pose(mover)))
            del records[:-_KEPT_RECORDS]


def _pose(mover: Mover) -> Pose:
    return Pose.of((float(mover.place_m[0]), float(mover.place_m[1]), 0.0))
