"""Which frames of a recording belong together: those that a robot's cameras took within half a period."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import pairwise
from statistics import median
from typing import Protocol, TypeVar

_PERIOD_S = 0.1


class Exposed(Protocol):
    """What says when a camera exposed, and how: a frame, or its record."""

    @property
    def camera(self) -> str:
        """Name, `robot.camera`."""

    @property
    def index(self) -> int:
        """Number of the frame among those of its camera."""

    @property
    def time_s(self) -> float:
        """Start of the exposure."""

    @property
    def exposure_s(self) -> float:
        """Exposure of each row."""

    @property
    def line_time_s(self) -> float:
        """Delay between rows."""

    @property
    def gain(self) -> float:
        """Factor on the calibrated system gain."""


Frame = TypeVar("Frame", bound=Exposed)


def set_time_s(frames: Sequence[Exposed]) -> float:
    """Return when a set was taken: the mean of the middles of its exposures, of their first rows."""
    return sum(frame.time_s + 0.5 * frame.exposure_s for frame in frames) / len(frames)


def mid_exposure_s(frame: Exposed, rows: int) -> float:
    """Return when the middle row of a frame of so many rows was in the middle of its exposure."""
    return frame.time_s + 0.5 * (frame.exposure_s + frame.line_time_s * (rows - 1))


def robot_of(camera: str) -> str:
    """Return the robot that carries a camera, `robot.camera`.

    >>> robot_of("r1.front")
    'r1'
    """
    return camera.rpartition(".")[0]


def frame_sets(frames: Iterable[Frame], period_s: float | None = None) -> list[list[Frame]]:
    """Divide frames into sets: those of one robot that began within half a period of the set's first.

    A camera's second frame of one exposure opens a set of its own.

    Parameters
    ----------
    frames
        Frames or records of frames, in any order.
    period_s
        From one set to the next; without it the median interval between frames of one camera, of each robot.
        Where the exposures of a bracket follow each other at once, it is the bracket's that is wanted here.

    Returns
    -------
    The sets by the time of their first frame, each in the order of time.

    Raises
    ------
    ValueError
        If the period is not positive.
    """
    if period_s is not None and not period_s > 0.0:
        raise ValueError(f"period_s is {period_s!r}; wanted a time above 0")
    by_robot: dict[str, list[Frame]] = defaultdict(list)
    for frame in frames:
        by_robot[robot_of(frame.camera)].append(frame)
    sets = [each for own in by_robot.values() for each in _of_one_robot(own, period_s)]
    return sorted(sets, key=lambda each: each[0].time_s)


def _of_one_robot(frames: list[Frame], period_s: float | None) -> list[list[Frame]]:
    half_s = 0.5 * (_period_s(frames) if period_s is None else period_s)
    sets: list[list[Frame]] = []
    for frame in sorted(frames, key=lambda each: each.time_s):
        again = bool(sets) and any(
            (frame.camera, frame.exposure_s) == (other.camera, other.exposure_s) for other in sets[-1]
        )
        if not sets or again or frame.time_s - sets[-1][0].time_s > half_s:
            sets.append([])
        sets[-1].append(frame)
    return sets


def _period_s(frames: Iterable[Frame]) -> float:
    """Return the median interval between frames of one camera; a tenth of a second where none has two."""
    times: dict[str, list[float]] = defaultdict(list)
    for frame in frames:
        times[frame.camera].append(frame.time_s)
    intervals_s = [
        later - sooner
        for own in map(sorted, times.values())
        for sooner, later in pairwise(own)
        if later > sooner
    ]
    return median(intervals_s) if intervals_s else _PERIOD_S
