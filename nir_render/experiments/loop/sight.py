"""What robots of a closed loop know after a look around, however they look."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from nir_render.experiments.loop.controllers import Neighbour
from nir_render.experiments.loop.world import World
from nir_render.scene.snapshot import Snapshot
from nir_render.truth.sent import SentTruth
from perception import Message, Odometry, RawFrame, Signal, Track
from perception.messages.uart import REPEATS


@dataclass(frozen=True, eq=False)
class Seen:
    """What a robot knows now: its neighbours, what it has just been told, whom it follows; its frames."""

    neighbours: list[Neighbour]
    messages: tuple[Message, ...] = ()
    tracks: tuple[Track, ...] = ()
    frames: tuple[RawFrame, ...] = ()


class Around(Protocol):
    """What there is to look at: the world at one time, and what a robot knows of its own way."""

    @property
    def time_s(self) -> float:
        """Now."""

    def snapshot(self) -> Snapshot:
        """Return the world as light meets it now."""

    def odometry(self, robot: str) -> list[Odometry]:
        """Return what a robot knows of its last seconds."""


class Sight(Protocol):
    """The eyes of one robot."""

    def look(self, world: World) -> Seen:
        """Look around now."""

    def signals(self) -> tuple[Signal, ...]:
        """Return how bright every track was so far, where that is kept."""


class TrueSight:
    """Knows where everybody is, and what was sent as it ends: what perception is held against."""

    def __init__(self, robot: str, sent: Sequence[SentTruth] = ()) -> None:
        self._robot, self._to_come = robot, sorted(sent, key=lambda packet: packet.end_s)

    def look(self, world: World) -> Seen:
        """Return the others as they are."""
        own = world.movers[self._robot]
        ended = [packet for packet in self._to_come if packet.end_s <= world.time_s]
        self._to_come = self._to_come[len(ended) :]
        neighbours = [
            Neighbour(mover.place_m - own.place_m, mover.velocity_m_per_s)
            for name, mover in world.movers.items()
            if name != self._robot
        ]
        return Seen(neighbours, tuple(self._told(packet) for packet in ended))

    def signals(self) -> tuple[Signal, ...]:
        """Return none: nothing is seen."""
        return ()

    def _told(self, packet: SentTruth) -> Message:
        span_s = (packet.start_s, packet.end_s)
        return Message(self._robot, 0, *span_s, packet.word, packet.command, confidence=1.0, frames=REPEATS)
