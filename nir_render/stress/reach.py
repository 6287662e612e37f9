"""All bounds of a campaign: how far along each axis each estimator keeps them, pooled and at worst."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nir_render.stress.bootstrap import LEAST_OF_ONE, AlongAxis, Repetitions, along_axes, repeated_in_corners
from nir_render.stress.campaign import Campaign
from nir_render.stress.crossings import Span, interval, kept_length, spans
from nir_render.stress.design.axes import Axis
from nir_render.stress.metrics import METRICS, Bound, Metric, Values
from nir_render.stress.sums import ASKED, COUNT, LIMIT, LIMITED, TOTAL, JobSums, pooled, slices

Status = Literal["throughout", "wherever judged", "in part", "nowhere", "nothing to judge"]


@dataclass(frozen=True)
class Point:
    """A metric at one value of an axis, pooled over jobs.

    `value` is NaN where it is not defined; `low` and `high` hold 68 of 100 repetitions, None where nothing
    was repeated. `count` of the `asked` countable sources, or frames, have the metric. `limit` is what the
    same rows of a perfect estimator give, NaN where there is no such limit.
    """

    value: float
    low: float | None
    high: float | None
    count: int
    asked: int
    limit: float


@dataclass(frozen=True)
class Extent:
    """Where along an axis a bound holds.

    `holds` has a word for each value of the axis: True, False, or None where there is nothing to judge. Where
    it holds at all the others, `status` is "wherever judged".
    `spans` are the intervals where it holds, empty for an axis that is no numbers. `agree` is the share of
    repetitions in which the same values hold; None where nothing was repeated, or a single corner too seldom
    (`LEAST_OF_ONE`): there spans have no intervals either. `worst` is the metric at the
    value where it is farthest from the bound, NaN where it is not defined at some value.
    """

    status: Status
    holds: tuple[bool | None, ...]
    spans: tuple[Span, ...]
    agree: float | None
    worst: float


@dataclass(frozen=True)
class Reach:
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
    pooled: Extent
    worst: Extent | None
    corner: tuple[int, ...]
    slices: int
    slices_kept: int


def points_of(
    metric: Metric, sums: Values, at: NDArray[np.int64], size: int, repetitions: Repetitions
) -> tuple[Point, ...]:
    """Return a metric at each value of an axis.

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
    values, limits = metric.value(whole[TOTAL], whole[COUNT]), metric.value(whole[LIMIT], whole[LIMITED])
    draws = repetitions.values(metric, sums, at, size)
    repeated = np.bincount(at, repetitions.repeated, size) > 0
    points = []
    for index, value in enumerate(values):
        low, high = None, None
        if draws is not None and repeated[index] and np.isfinite(value):
            low, high = interval(draws[:, index])
        count, asked = int(whole[COUNT, index]), int(whole[ASKED, index])
        points.append(Point(float(value), low, high, count, asked, float(limits[index])))
    return tuple(points)


def reaches_of(
    axes: Sequence[Axis], bounds: Sequence[Bound], sums: JobSums, seed: int = 0, *, sampled: bool = False
) -> tuple[Reach, ...]:
    """Return where each bound holds along each axis, for each estimator: bound by bound, axis by axis.

    Parameters
    ----------
    sums
        The campaign's table (see `job_sums`).
    seed
        Keys the repetitions: the same table gives the same intervals.
    sampled
        The jobs are samples of the space of all axes: it has no corners, and none is worst.
    """
    told = along_axes(axes, sums, seed, sampled=sampled)
    return tuple(
        _reach(axes, axis, bound, name, told[axis])
        for bound in bounds
        for axis in range(len(axes))
        for name in sums.estimators
    )


def campaign_reaches(campaign: Campaign, sums: JobSums) -> tuple[Reach, ...]:
    """Return where each bound of a campaign holds along each of its axes (`reaches_of`)."""
    return reaches_of(
        campaign.axes, campaign.bounds, sums, campaign.seeds[0], sampled=campaign.sample is not None
    )


def corners_kept(bound: Bound, estimator: str, sums: JobSums) -> tuple[int, int]:
    """Return in how many combinations of all axes' values a bound holds, and how many can be judged."""
    metric = METRICS[bound.metric]
    _, corner = np.unique(sums.place, axis=0, return_inverse=True)
    corner = corner.reshape(-1)
    cells = pooled(sums.by_metric[estimator, bound.metric], corner, int(corner.max(initial=-1)) + 1)
    kept = metric.holds(metric.value(cells[TOTAL], cells[COUNT]), bound.value)
    return int(kept.sum()), int((cells[ASKED] > 0.0).sum())


def _reach(axes: Sequence[Axis], index: int, bound: Bound, name: str, told: AlongAxis) -> Reach:
    sums, repetitions = told.sums, told.repetitions
    axis, metric, size = axes[index], METRICS[bound.metric], len(axes[index].labels)
    totals, at = sums.by_metric[name, bound.metric], sums.place[:, index]
    everywhere = _extent(axis, metric, bound, totals, at, repetitions)
    combinations, slice_of = slices(sums.place, index)
    count = len(combinations)
    reach = Reach(
        estimator=name,
        axis=index,
        bound=bound,
        points=points_of(metric, totals, at, size, repetitions),
        pooled=everywhere,
        worst=None,
        corner=(-1,) * len(axes),
        slices=int(everywhere.status != "nothing to judge"),
        slices_kept=int(everywhere.status in ("throughout", "wherever judged")),
    )
    if count <= 1 or not told.has_corners:
        return reach
    cells = pooled(totals, slice_of * size + at, count * size).reshape(-1, count, size)
    value, judged = metric.value(cells[TOTAL], cells[COUNT]), cells[ASKED] > 0.0
    unbroken = (metric.holds(value, bound.value) | ~judged).all(axis=1)
    usable = np.flatnonzero(judged.any(axis=1))
    if not usable.size:
        return replace(reach, slices=0, slices_kept=0)
    order = _order(axis, metric, bound, value, judged)
    least = usable[np.lexsort([key[usable] for key in (*order[::-1], unbroken)])[0]]
    chosen = slice_of == least
    enough = repeated_in_corners(sums.place[chosen], LEAST_OF_ONE)
    return replace(
        reach,
        worst=_extent(
            axis, metric, bound, totals[:, chosen], at[chosen], repetitions.subset(chosen) if enough else None
        ),
        corner=tuple(int(i) for i in np.insert(combinations[least], index, -1)),
        slices=usable.size,
        slices_kept=int(unbroken[usable].sum()),
    )


def _extent(
    axis: Axis,
    metric: Metric,
    bound: Bound,
    sums: Values,
    at: NDArray[np.int64],
    repetitions: Repetitions | None,
) -> Extent:
    size = len(axis.labels)
    whole = pooled(sums, at, size)
    value, asked = metric.value(whole[TOTAL], whole[COUNT]), whole[ASKED] > 0.0
    kept = metric.holds(value, bound.value)
    draws = None if repetitions is None else repetitions.values(metric, sums, at, size)
    holds = tuple(bool(keeps) if judged else None for keeps, judged in zip(kept, asked, strict=True))
    status: Status = "in part"
    if not asked.any():
        status = "nothing to judge"
    elif not kept.any():
        status = "nowhere"
    elif kept[asked].all():
        status = "throughout" if asked.all() else "wherever judged"
    found: tuple[Span, ...] = ()
    if axis.numbers is not None:
        found = spans(np.array(axis.numbers), axis.log, metric, bound.value, value, asked, draws)
    agree = None
    if draws is not None and asked.any():
        agree = float(np.mean((metric.holds(draws, bound.value) == kept)[:, asked].all(axis=1)))
    seen = value[asked]
    worst = np.nan
    if seen.size and np.isfinite(seen).all():
        worst = float(seen.min() if metric.higher_is_better else seen[np.argmax(np.abs(seen))])
    return Extent(status, holds, found, agree, worst)


def _order(
    axis: Axis, metric: Metric, bound: Bound, value: Values, judged: NDArray[np.bool_]
) -> tuple[Values, Values, Values]:
    """Return what orders slices, the worst first: reach along the axis, a metric undefined, the worst metric.

    `value` and `judged` have the shape (slices, values of the axis), what is returned (slices,).
    """
    number = metric.holds(value, bound.value).sum(axis=1)
    reach = number.astype(np.float64)
    if axis.numbers is not None:
        kept = kept_length(np.array(axis.numbers), axis.log, metric, bound.value, value)
        reach = np.where(number > 0, kept, -1.0)
    good = value if metric.higher_is_better else -np.abs(value)
    worst: Values = np.where(judged & np.isfinite(value), good, np.inf).min(axis=1)
    defined = np.where((np.isfinite(value) | ~judged).all(axis=1), 1.0, 0.0)
    return reach, defined, worst
