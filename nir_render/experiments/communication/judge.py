"""Whether commands were read, obeyed, reached and held."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from nir_render.experiments.loop.controllers import COMMANDED_M
from nir_render.truth.sent import SentTruth

Array = NDArray[np.float64]
Pair = tuple[str, str]

NEAR_M = 0.05
"""So near to the commanded spacing must the worst pair be,"""
WITHIN_S = 10.0
"""no later than this after the last follower has read the command,"""
HELD_S = 5.0
"""and stay for so long."""

_READ_LATEST_S = 4.0  # after its packet: the decoder waits 1.3 s for idle, and a little
_READ_EARLIEST_S = 1.0  # before its end: it needs no more than most of a packet


@dataclass(frozen=True)
class Command:
    """What became of a command that was sent.

    Attributes
    ----------
    command, sent_s, ended_s
        What was sent when, and when its packet ended.
    read_s
        When the last follower had read it; None where one has not.
    reached_s
        From when on, after that, the worst pair is within 5 cm for 5 s; None where it never is.
    worst_m
        The worst pair's |d − d₀| in the 5 s from 10 s after `read_s`; None where the next command may have
        been read before their end, or the run was over.
    """

    command: str
    sent_s: float
    ended_s: float
    read_s: float | None
    reached_s: float | None
    worst_m: float | None

    @property
    def met(self) -> bool:
        """Whether all have read it, and the worst pair was near in time, and stayed."""
        return self.read_s is not None and self.reached_s is not None and self.reached_s <= WITHIN_S


@dataclass(frozen=True)
class Judged:
    """A run.

    Attributes
    ----------
    commands
        Those that set the spacing, in order.
    packets, received, wrong_words
        Packets times followers; how many of them were told with their word; what was told besides.
    wrong_obeyed
        How often a follower did what was not sent to it then.
    touched
        Whether two bodies touched.
    """

    commands: tuple[Command, ...]
    packets: int
    received: int
    wrong_words: int
    wrong_obeyed: int
    touched: bool

    @property
    def met(self) -> bool:
        """Whether every command was, nothing else was obeyed, and no bodies touched."""
        every = bool(self.commands) and all(command.met for command in self.commands)
        return every and self.wrong_obeyed == 0 and not self.touched


def judged(
    times_s: Array,
    distances_m: Mapping[Pair, Array],
    sent: Sequence[SentTruth],
    told: Sequence[tuple[str, float, int]],
    obeyed: Mapping[str, Sequence[tuple[float, str]]],
    touched: bool,
) -> Judged:
    """Judge a run.

    Parameters
    ----------
    times_s, distances_m
        Distances of neighbours over time, shape (times,).
    sent
        All packets, in order, of one sender.
    told
        What followers were told: who, when, which word.
    obeyed
        What each follower obeyed, and when.
    """
    in_time = [
        (packet, robot)
        for packet in sent
        for robot in obeyed
        if any(name == robot and word == packet.word and _belongs(at_s, packet) for name, at_s, word in told)
    ]
    right = [any(word == packet.word and _belongs(at_s, packet) for packet in sent) for _, at_s, word in told]
    wrong_obeyed = sum(
        not any(packet.command == command and _belongs(at_s, packet) for packet in sent)
        for of_one in obeyed.values()
        for at_s, command in of_one
    )
    commands = [packet for packet in sent if packet.command in COMMANDED_M]
    worst = {
        packet.command: np.max(
            [abs(d_m - COMMANDED_M[packet.command]) for d_m in distances_m.values()], axis=0
        )
        for packet in commands
    }
    reads_s = [_read_s(packet, obeyed) for packet in commands]
    # Nobody goes elsewhere before the next command can have been read.
    later_s = [packet.end_s - _READ_EARLIEST_S for packet in commands[1:]]
    later_s = [*later_s, float(times_s[-1])][: len(commands)]
    found = tuple(
        Command(
            packet.command, packet.start_s, packet.end_s, read_s,
            *_held(times_s, worst[packet.command], read_s, until_s),
        )
        for packet, read_s, until_s in zip(commands, reads_s, later_s, strict=True)
    )  # fmt: skip
    return Judged(found, len(sent) * len(obeyed), len(in_time), right.count(False), wrong_obeyed, touched)


def _belongs(at_s: float, packet: SentTruth) -> bool:
    return packet.end_s - _READ_EARLIEST_S <= at_s <= packet.end_s + _READ_LATEST_S


def _read_s(packet: SentTruth, obeyed: Mapping[str, Sequence[tuple[float, str]]]) -> float | None:
    reads_s = []
    for of_one in obeyed.values():
        own = [at_s for at_s, command in of_one if command == packet.command and _belongs(at_s, packet)]
        if len(own) != 1:
            return None
        reads_s.append(own[0])
    return max(reads_s, default=None)


def _held(
    times_s: Array, worst_m: Array, read_s: float | None, until_s: float
) -> tuple[float | None, float | None]:
    """Return how long after the reading the worst pair came near and stayed for 5 s, and how near it was."""
    if read_s is None:
        return None, None
    after = (times_s >= read_s) & (times_s <= until_s)
    at_s, off_m = times_s[after] - read_s, worst_m[after]
    reached_s = None
    far = np.flatnonzero(off_m > NEAR_M)
    edges = [-1, *far.tolist(), len(off_m)]
    for before, end in pairwise(edges):
        if end - before > 1 and at_s[end - 1] - at_s[before + 1] >= HELD_S - 1e-6:
            reached_s = float(at_s[before + 1])
            break
    counted = (at_s >= WITHIN_S) & (at_s <= WITHIN_S + HELD_S)
    ended = not len(at_s) or at_s[-1] < WITHIN_S + HELD_S - 0.1
    return reached_s, None if ended else float(off_m[counted].max())
