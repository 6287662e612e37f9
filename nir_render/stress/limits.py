"""How far along each axis each estimator keeps each bound: in the whole campaign, and in its worst corner."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nir_render.stress.axes import Axis
from nir_render.stress.crossings import Span, interval, kept_length, spans
from nir_render.stress.figures import FIGURES, Bound, Figure, Values
from nir_render.stress.repeats import LEAST_OF_ONE, Again, repeated_in_corners, repetitions
from nir_render.stress.sums import ASKED, COUNT, LIMIT, LIMITED, TOTAL, JobSums, pooled, slices

Status = Literal["throughout", "wherever judged", "in part", "nowhere", "nothing to judge"]


@dataclass(frozen=True)
class Point:
    """A figure at one value of an axis, pooled over jobs.

    `value` is NaN where it is not defined; `low` and `high` hold 68 of 100 repetitions, None where nothing
    was repeated. `count` of the `asked` countable sources, or frames, have the figure. `limit` is what the
    same rows of a perfect estimator give, NaN where there is no such limit.
    """

    value: float
    low: float | None
    high: float | None
    count: int
    asked: int
    limit: float


@dataclass(frozen=True)
class Verdict:
    """Where along an axis a bound holds.

    `holds` has a word for each value of the axis: True, False, or None where there is nothing to judge. Where
    it holds at all the others, `status` is "wherever judged".
    `spans` are the intervals where it holds, empty for an axis that is no numbers. `agree` is the share of
    repetitions in which the same values hold; None where nothing was repeated, or a single corner too seldom
    (`LEAST_OF_ONE`): there spans have no intervals either. `worst` is the figure at the
    value where it is farthest from the bound, NaN where it is not defined at some value.
    """

    status: Status
    holds: tuple[bool | None, ...]
    spans: tuple[Span, ...]
    agree: float | None
    worst: float


@dataclass(frozen=True)
class Limit:
    """One estimator, one axis, one bound.

    `corner` holds the index of each other axis's value (in the order of the axes, -1 for the axis itself) of
    the slice in which the bound holds over the least of the axis, and `worst` says where it does; it is None
    where there is but one slice. Slices that break the bound somewhere come before those that cannot be
    judged everywhere. The bound is broken nowhere in `slices_kept` of the `slices` that can be judged.
    """

    estimator: str
    axis: int
    bound: Bound
    points: tuple[Point, ...]
    pooled: Verdict
    worst: Verdict | None
    corner: tuple[int, ...]
    slices: int
    slices_kept: int


def points_of(
    figure: Figure, sums: Values, at: NDArray[np.int64], size: int, again: Again
) -> tuple[Point, ...]:
    """Return a figure at each value of an axis.

    Parameters
    ----------
    sums
        Of the jobs to pool, shape (5, jobs).
    at
        Index into the axis's values, shape (jobs,).
    size
        How many values the axis has.
    """
    whole = pooled(sums, at, size)
    values, limits = figure.value(whole[TOTAL], whole[COUNT]), figure.value(whole[LIMIT], whole[LIMITED])
    draws = again.figure(figure, sums, at, size)
    repeated = np.bincount(at, again.repeated, size) > 0
    points = []
    for index, value in enumerate(values):
        low, high = None, None
        if draws is not None and repeated[index] and np.isfinite(value):
            low, high = interval(draws[:, index])
        count, asked = int(whole[COUNT, index]), int(whole[ASKED, index])
        points.append(Point(float(value), low, high, count, asked, float(limits[index])))
    return tuple(points)


def limits_of(
    axes: Sequence[Axis], bounds: Sequence[Bound], sums: JobSums, seed: int = 0
) -> tuple[Limit, ...]:
    """Return where each bound holds along each axis, for each estimator: bound by bound, axis by axis.

    Parameters
    ----------
    sums
        The campaign's table (see `job_sums`).
    seed
        Keys the repetitions: the same table gives the same intervals.
    """
    again = repetitions(sums.place, seed)
    return tuple(
        _limit(axes, axis, bound, name, sums, again[axis])
        for bound in bounds
        for axis in range(len(axes))
        for name in sums.estimators
    )


def corners_kept(bound: Bound, estimator: str, sums: JobSums) -> tuple[int, int]:
    """Return in how many combinations of all axes' values a bound holds, and how many can be judged."""
    figure = FIGURES[bound.figure]
    _, corner = np.unique(sums.place, axis=0, return_inverse=True)
    corner = corner.reshape(-1)
    cells = pooled(sums.of[estimator, bound.figure], corner, int(corner.max(initial=-1)) + 1)
    kept = figure.holds(figure.value(cells[TOTAL], cells[COUNT]), bound.value)
    return int(kept.sum()), int((cells[ASKED] > 0.0).sum())


def _limit(axes: Sequence[Axis], index: int, bound: Bound, name: str, sums: JobSums, again: Again) -> Limit:
    axis, figure = axes[index], FIGURES[bound.figure]
    own, at, size = sums.of[name, bound.figure], sums.place[:, index], len(axes[index].labels)
    points = points_of(figure, own, at, size, again)
    whole = _verdict(axis, figure, bound, own, at, again)
    combinations, slice_of = slices(sums.place, index)
    nowhere = (-1,) * len(axes)
    if len(combinations) <= 1:
        judged_at_all = int(whole.status != "nothing to judge")
        return Limit(name, index, bound, points, whole, None, nowhere, judged_at_all, int(_kept(whole)))
    count = len(combinations)
    cells = pooled(own, slice_of * size + at, count * size).reshape(-1, count, size)
    value, judged = figure.value(cells[TOTAL], cells[COUNT]), cells[ASKED] > 0.0
    unbroken = (figure.holds(value, bound.value) | ~judged).all(axis=1)
    usable = np.flatnonzero(judged.any(axis=1))
    if not usable.size:
        return Limit(name, index, bound, points, whole, None, nowhere, 0, 0)
    order = _order(axis, figure, bound, value, judged)
    least = usable[np.lexsort([key[usable] for key in (*order[::-1], unbroken)])[0]]
    chosen = slice_of == least
    drawn = again.of(chosen) if repeated_in_corners(sums.place[chosen], LEAST_OF_ONE) else None
    worst = _verdict(axis, figure, bound, own[:, chosen], at[chosen], drawn)
    corner = tuple(int(i) for i in np.insert(combinations[least], index, -1))
    return Limit(name, index, bound, points, whole, worst, corner, usable.size, int(unbroken[usable].sum()))


def _verdict(
    axis: Axis, figure: Figure, bound: Bound, sums: Values, at: NDArray[np.int64], again: Again | None
) -> Verdict:
    size = len(axis.labels)
    whole = pooled(sums, at, size)
    value, asked = figure.value(whole[TOTAL], whole[COUNT]), whole[ASKED] > 0.0
    kept = figure.holds(value, bound.value)
    draws = None if again is None else again.figure(figure, sums, at, size)
    holds = tuple(bool(one) if judged else None for one, judged in zip(kept, asked, strict=True))
    status: Status = "in part"
    if not asked.any():
        status = "nothing to judge"
    elif not kept.any():
        status = "nowhere"
    elif kept[asked].all():
        status = "throughout" if asked.all() else "wherever judged"
    found: tuple[Span, ...] = ()
    if axis.numbers is not None:
        found = spans(np.array(axis.numbers), axis.log, figure, bound.value, value, asked, draws)
    agree = None
    if draws is not None and asked.any():
        agree = float(np.mean((figure.holds(draws, bound.value) == kept)[:, asked].all(axis=1)))
    seen = value[asked]
    worst = np.nan
    if seen.size and np.isfinite(seen).all():
        worst = float(seen.min() if figure.higher_is_better else seen[np.argmax(np.abs(seen))])
    return Verdict(status, holds, found, agree, worst)


def _kept(verdict: Verdict) -> bool:
    return verdict.status in ("throughout", "wherever judged")


def _order(
    axis: Axis, figure: Figure, bound: Bound, value: Values, judged: NDArray[np.bool_]
) -> tuple[Values, Values, Values]:
    """Return what orders slices, the worst first: reach along the axis, a figure undefined, the worst figure.

    `value` and `judged` have the shape (slices, values of the axis), what is returned (slices,).
    """
    number = figure.holds(value, bound.value).sum(axis=1)
    reach = number.astype(np.float64)
    if axis.numbers is not None:
        kept = kept_length(np.array(axis.numbers), axis.log, figure, bound.value, value)
        reach = np.where(number > 0, kept, -1.0)
    good = value if figure.higher_is_better else -np.abs(value)
    worst: Values = np.where(judged & np.isfinite(value), good, np.inf).min(axis=1)
    defined = np.where((np.isfinite(value) | ~judged).all(axis=1), 1.0, 0.0)
    return reach, defined, worst
