"""How flares are parted into robots, of all ways in which they could be: the most probable, and its odds."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perception.rig.pose.posterior import Posterior
from perception.types import Layout

MOST_TOGETHER = 10


@dataclass(frozen=True, eq=False)
class Candidate:
    """Some flares as one robot: posteriors by which source each is; the logarithm of its evidence."""

    members: tuple[int, ...]
    layout: Layout
    ways: tuple[tuple[tuple[int, ...], Posterior, float], ...]
    log_evidence: float


def told_apart(candidates: Sequence[Candidate], alone: Sequence[float]) -> list[tuple[Candidate, float]]:
    """Return the most probable way to part all flares into robots, each with its odds over all ways.

    Flares that no chain of candidates connects are parted by themselves.
    """
    chosen: list[tuple[Candidate, float]] = []
    for part in _connected(candidates):
        gain = [each.log_evidence - sum(alone[k] for k in each.members) for each in part]
        order = sorted(range(len(part)), key=lambda k: -gain[k])[: 4 * MOST_TOGETHER]
        best: list[tuple[float, tuple[int, ...]]] = []
        _part(order, [part[k].members for k in range(len(part))], gain, 0, (), 0.0, best)
        top = max(best)
        logs = np.array([log for log, _ in best])
        total = float(np.logaddexp.reduce(logs))
        for k in top[1]:
            with_it = [log for log, picked in best if k in picked]
            odds = math.exp(float(np.logaddexp.reduce(np.array(with_it))) - total)
            chosen.append((part[k], min(odds, 1.0)))
    return chosen


_MOST_PARTINGS = 20_000


def _part(
    order: Sequence[int],
    members: Sequence[tuple[int, ...]],
    gain: Sequence[float],
    begin: int,
    picked: tuple[int, ...],
    log: float,
    found: list[tuple[float, tuple[int, ...]]],
) -> None:
    """Gather all ways to pick candidates that share no flare."""
    found.append((log, picked))
    used = {flare for k in picked for flare in members[k]}
    for n in range(begin, len(order)):
        if len(found) > _MOST_PARTINGS:
            return
        k = order[n]
        if not used.intersection(members[k]):
            _part(order, members, gain, n + 1, (*picked, k), log + gain[k], found)


def _connected(candidates: Sequence[Candidate]) -> list[list[Candidate]]:
    """Return candidates that share flares together."""
    parts: list[tuple[set[int], list[Candidate]]] = []
    for each in candidates:
        touching = [part for part in parts if part[0].intersection(each.members)]
        parts = [part for part in parts if part not in touching]
        joined = set(each.members).union(*(part[0] for part in touching))
        parts.append((joined, [*(one for part in touching for one in part[1]), each]))
    return [part for _, part in parts]
