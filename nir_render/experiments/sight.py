"""What robots of a closed loop know after a look around, however they look."""

from dataclasses import dataclass
from typing import Protocol

from nir_render.experiments.controllers import Neighbour
from nir_render.experiments.world import World
from perception import Message


@dataclass(frozen=True, eq=False)
class Seen:
    """What a robot knows now: its neighbours, and what it has just been told."""

    neighbours: list[Neighbour]
    messages: tuple[Message, ...] = ()


class Sight(Protocol):
    """The eyes of one robot."""

    def look(self, world: World) -> Seen:
        """Look around now."""


class TrueSight:
    """Knows where everybody is: what perception is held against."""

    def __init__(self, robot: str) -> None:
        self._robot = robot

    def look(self, world: World) -> Seen:
        """Return the others as they are."""
        own = world.movers[self._robot]
        return Seen(
            [
                Neighbour(mover.place_m - own.place_m, mover.velocity_m_per_s)
                for name, mover in world.movers.items()
                if name != self._robot
            ]
        )
