"""Which frames of a recording belong together: those that a robot's cameras took within half a period."""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import pairwise
from statistics import median
from typing import Protocol, TypeVar


class Timed(Protocol):
    """What says of which camera it is, and when its exposure began: a frame, or its record."""

    @property
    def camera(self) -> str:
        """Name, `robot.camera`."""

    @property
    def time_s(self) -> float:
        """Start of the exposure."""


Frame = TypeVar("Frame", bound=Timed)


def frame_sets(frames: Iterable[Frame], period_s: float | None = None) -> list[list[Frame]]:
    """Divide frames into sets: those of one robot that began within half a period of the set's first.

    Parameters
    ----------
    frames
        Frames or records of frames, in any order.
    period_s
        From one set to the next; without it the median interval between frames of one camera, of each robot.

    Returns
    -------
    The sets by the time of their first frame, each in the order of time.
    """
    robots: dict[str, list[Frame]] = defaultdict(list)
    for frame in frames:
        robots[frame.camera.rpartition(".")[0]].append(frame)
    sets: list[list[Frame]] = []
    for own in robots.values():
        half_s = 0.5 * (_period_s(own) if period_s is None else period_s)
        of_robot: list[list[Frame]] = []
        for frame in sorted(own, key=lambda each: each.time_s):
            if not of_robot or frame.time_s - of_robot[-1][0].time_s > half_s:
                of_robot.append([])
            of_robot[-1].append(frame)
        sets += of_robot
    return sorted(sets, key=lambda each: each[0].time_s)


def _period_s(frames: Sequence[Timed]) -> float:
    times_s: dict[str, list[float]] = defaultdict(list)
    for frame in frames:
        times_s[frame.camera].append(frame.time_s)
    steps_s = [later - sooner for own in map(sorted, times_s.values()) for sooner, later in pairwise(own)]
    known_s = [step_s for step_s in steps_s if step_s > 0.0]
    return median(known_s) if known_s else math.inf
