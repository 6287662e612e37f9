"""Limits found more exactly: values are put into an axis where a bound is crossed, and their jobs done."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import pyarrow as pa

from nir_render.errors import InputError
from nir_render.stress.bootstrap import repeated_in_corners
from nir_render.stress.campaign import MOST_JOBS, Campaign
from nir_render.stress.crossings import Edge
from nir_render.stress.design.axes import Axis, with_values
from nir_render.stress.design.points import number_of_points
from nir_render.stress.jobs import Job, plan
from nir_render.stress.reach import Reach, campaign_reaches
from nir_render.stress.store import Store
from nir_render.stress.sums import job_sums
from nir_render.stress.sweep import Progress, Sweep, sweep
from nir_render.stress.workers.cluster import Scheduler

_REASONS = ("crossing", "not defined")


def sweep_refined(
    campaign: Campaign,
    jobs: Sequence[Job],
    folder: Path,
    *,
    workers: int | None,
    bar: Callable[[str], AbstractContextManager[Progress]],
    light: Path | None = None,
    light_limit_bytes: int = 4 * 2**30,
    scheduler: Scheduler | None = None,
    store: Store | None = None,
) -> Sweep:
    """Do a campaign's jobs (`sweep`); then add values where bounds are crossed, until limits are exact.

    Each round halves the gaps that bounds are crossed in. The same campaign adds the same values, so that one
    that was stopped goes on.

    Parameters
    ----------
    bar
        Opens the progress of a round, which it names.

    Raises
    ------
    InputError, StoppedError
        As `sweep`. Values between those written that make no scene, or more than `MOST_JOBS` jobs, end the
        refinement with a warning instead.
    """
    round_name, reused, known = "stress", 0, 0
    while True:
        with bar(round_name) as progress:
            result = sweep(
                campaign,
                jobs,
                folder,
                workers=workers,
                progress=progress,
                light=light,
                light_limit_bytes=light_limit_bytes,
                scheduler=scheduler,
                store=store,
            )
        reused, known = reused + result.reused - known, len(jobs)  # what earlier rounds did is not counted
        result = replace(result, reused=reused)
        if result.failed:
            return result
        finer = refined(campaign, result.table)
        if finer is campaign:
            return result
        try:
            with bar("check") as progress:
                jobs = _planned(finer, progress, jobs)
        except InputError as error:
            unrefined = f"limits are not found more exactly than this: {error.problems[0]}"
            return replace(result, warnings=(*result.warnings, unrefined))
        campaign, round_name = finer, "refine"


def _planned(finer: Campaign, progress: Progress, planned: Sequence[Job]) -> list[Job]:
    number = number_of_points(finer.axes, None) * len(finer.seeds)
    if number > MOST_JOBS:
        raise InputError(
            f"{finer.path}: limits as exact as 'refine' wants take {number} jobs; at most {MOST_JOBS} "
            "are taken: write larger steps"
        )
    return plan(finer, progress, planned)


def refined(campaign: Campaign, table: pa.Table) -> Campaign:
    """Return a campaign with a value halfway in each gap that a bound is crossed in and that is too wide.

    Gaps of both are looked at: all corners together, and the worst one. Where the crossing's own interval is
    wider than the halves would be, no value is added: more seeds would tell more (of one seed there is no
    such interval, nor of a single corner of few, see `bootstrap`). Returns the campaign itself where there is
    nothing to add.
    """
    if all(axis.refinement is None for axis in campaign.axes):
        return campaign
    sums = job_sums(campaign.axes, table)
    reaches, by_seeds = campaign_reaches(campaign, sums), repeated_in_corners(sums.place)
    axes = []
    for index, axis in enumerate(campaign.axes):
        of_axis = (reach for reach in reaches if reach.axis == index)
        added = sorted({value for reach in of_axis for value in _wanted(axis, reach, by_seeds=by_seeds)})
        axes.append(with_values(axis, added) if added else axis)
    if all(new is old for new, old in zip(axes, campaign.axes, strict=True)):
        return campaign
    return replace(campaign, axes=tuple(axes))


def _wanted(axis: Axis, reach: Reach, *, by_seeds: bool) -> Iterator[float]:
    """Yield the values that one estimator's bound is worth on an axis, in its unit."""
    if axis.refinement is None:
        return
    for extent in (reach.pooled, reach.worst):
        for span in () if extent is None else extent.spans:
            for edge in (span.start, span.end):
                width = 0.0
                if by_seeds and edge.low is not None and edge.high is not None:
                    width = edge.high - edge.low
                value = _halfway(axis, edge, width)
                if value is not None:
                    yield value


def _halfway(axis: Axis, edge: Edge, width: float) -> float | None:
    """Return the middle of the gap that an edge lies in; None where it is exact enough, or cannot be more.

    `width` is that of the edge's own interval by seeds, in the axis's unit.
    """
    numbers = axis.numbers or ()
    if edge.reason not in _REASONS or edge.gap is None or axis.refinement is None:
        return None
    low, high = numbers[edge.gap : edge.gap + 2]
    if axis.refinement.is_kept(low, high) or width > 0.5 * (high - low):
        return None
    middle = math.sqrt(low * high) if axis.log else 0.5 * (low + high)
    if all(isinstance(value, int) for value in axis.values):
        middle = float(math.floor(middle))
    middle = float(f"{middle:.6g}")
    return middle if low < middle < high else None
