"""The bootstrap: repetitions of a campaign, drawn from its own jobs, say how sure a metric is.

The corners of a campaign (the combinations of its axes' values) are chosen, not drawn; what varies is the
seed. So jobs are drawn again within their own corner, and intervals say what the same campaign with other
seeds would give. A campaign of one seed has nothing to draw from within a corner: there all jobs of one value
of the axis are drawn from, so that intervals hold the differences between corners too, and are too wide
rather than too narrow.

The points of a campaign of samples are drawn themselves: what varies is which points, and each carries its
seeds along. So points are drawn again within their part of the axis, each with all of its seeds.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.randomness import generator
from nir_render.stress.design.axes import Axis
from nir_render.stress.metrics import Metric, Values
from nir_render.stress.sums import COUNT, TOTAL, JobSums, along, slices

LEAST_OF_ONE = 5
"""A single corner has no interval below so many jobs: of fewer it would hold far less than it says."""

_MOST, _LEAST = 1000, 100
_MOST_NUMBERS = 20_000_000
"""Large campaigns get fewer repetitions, so that they fit in memory."""


@dataclass(frozen=True, eq=False)
class Repetitions:
    """A campaign repeated: how often each job is in each, shape (repetitions, jobs).

    `repeated` tells which jobs were drawn among others, shape (jobs,); the rest are in all alike.
    """

    weight: NDArray[np.float32]
    repeated: NDArray[np.bool_]

    def subset(self, chosen: NDArray[np.bool_]) -> "Repetitions":
        """Return the repetitions of some of the jobs."""
        return Repetitions(self.weight[:, chosen], self.repeated[chosen])

    def values(self, metric: Metric, sums: Values, at: NDArray[np.int64], size: int) -> Values | None:
        """Return a metric at each value of an axis in each repetition, shape (repetitions, size).

        None where no job was drawn. Parameters as those of `points_of`.
        """
        if not self.repeated.any():
            return None
        onto = at[:, None] == np.arange(size)
        total, count = (self.weight @ (sums[row][:, None] * onto) for row in (TOTAL, COUNT))
        return metric.value(total, count)


@dataclass(frozen=True, eq=False)
class AlongAxis:
    """The jobs that tell of one axis (`sums.along`), and their repetitions.

    `has_corners` is false where jobs are samples of the space of all axes: no combination of the others is
    run at all values of this one.
    """

    sums: JobSums
    repetitions: Repetitions
    has_corners: bool


def along_axes(
    axes: Sequence[Axis], sums: JobSums, seed: int, *, sampled: bool = False
) -> tuple[AlongAxis, ...]:
    """Return the jobs and the repetitions for each axis; `seed` keys them, as in `draw_repetitions`."""
    if sampled:
        drawn = draw_points(sums.place, sums.points(), seed)
        return tuple(AlongAxis(sums, one, has_corners=False) for one in drawn)
    if not any(any(axis.added) for axis in axes):
        return tuple(AlongAxis(sums, drawn, has_corners=True) for drawn in draw_repetitions(sums.place, seed))
    found = []
    for index in range(len(axes)):
        own = along(axes, sums, index)
        found.append(AlongAxis(own, draw_repetitions(own.place, seed)[index], has_corners=True))
    return tuple(found)


def draw_repetitions(place: NDArray[np.int64], seed: int) -> tuple[Repetitions, ...]:
    """Draw jobs again, with replacement: within their corner, or with one seed within their axis's value.

    Of n jobs n − 1 are drawn, weighted to n: so the mean of few jobs has its right variance, where n draws
    would have (n − 1)/n of it (Rao and Wu 1988, Resampling Inference with Complex Survey Data, JASA 83).

    Parameters
    ----------
    place
        Index into each axis's values, shape (jobs, axes).
    seed
        Keys the draws: the same campaign gives the same intervals.

    Returns
    -------
    One for each axis; none drawn (`repeated`) for an axis that has a single corner at each value, of too few
    jobs (`LEAST_OF_ONE`).
    """
    jobs, axes = place.shape
    if repeated_in_corners(place):
        _, corner = np.unique(place, axis=0, return_inverse=True)
        drawn = [_drawn(corner.reshape(-1), seed, "corners", _number(jobs))] * axes
    else:
        drawn = [_drawn(place[:, axis], seed, f"axis {axis}", _number(jobs * axes)) for axis in range(axes)]
    if repeated_in_corners(place, LEAST_OF_ONE):
        return tuple(drawn)
    none = np.zeros(jobs, dtype=np.bool_)
    return tuple(
        repetitions if len(slices(place, axis)[0]) > 1 else Repetitions(repetitions.weight, none)
        for axis, repetitions in enumerate(drawn)
    )


def draw_points(place: NDArray[np.int64], point: NDArray[np.int64], seed: int) -> tuple[Repetitions, ...]:
    """Draw the points of a campaign of samples again, within their part of each axis, as `draw_repetitions`.

    Parameters
    ----------
    place, seed
        As in `draw_repetitions`.
    point
        The point of each job, numbers from 0 up, shape (jobs,): its jobs are drawn together.

    Returns
    -------
    One for each axis; none drawn for an axis whose parts hold too few points (`LEAST_OF_ONE`).
    """
    _, first = np.unique(point, return_index=True)
    of_points = place[first]
    found = []
    for axis in range(place.shape[1]):
        drawn = _drawn(of_points[:, axis], seed, f"points {axis}", _number(place.size))
        enough = repeated_in_corners(of_points[:, [axis]], LEAST_OF_ONE)
        found.append(Repetitions(drawn.weight[:, point], drawn.repeated[point] & enough))
    return tuple(found)


def repeated_in_corners(place: NDArray[np.int64], least: int = 2) -> bool:
    """Tell whether corners have several jobs each, or at least so many; a tenth may have lost theirs."""
    _, count = np.unique(place, axis=0, return_counts=True)
    return bool(np.mean(count >= least) >= 0.9) if count.size else False


def _number(numbers: int) -> int:
    return min(max(_MOST_NUMBERS // max(numbers, 1), _LEAST), _MOST)


def _drawn(within: NDArray[np.int64], seed: int, purpose: str, number: int) -> Repetitions:
    sizes = np.bincount(within)[within]
    weight = np.ones((number, within.size), dtype=np.float32)
    for size in np.unique(sizes[sizes > 1]):
        jobs = np.flatnonzero(sizes == size)
        jobs = jobs[np.argsort(within[jobs], kind="stable")]
        random = generator(seed, f"stress/repeat/{purpose}/{size}", "", 0)
        drawn = random.multinomial(size - 1, np.full(size, 1.0 / size), size=(number, jobs.size // size))
        weight[:, jobs] = drawn.reshape(number, -1) * (size / (size - 1))
    return Repetitions(weight, sizes > 1)
