"""A campaign's table as sums per job, of which every metric is made, for any part of the campaign."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from nir_render.stress.design.axes import Axis, without_added
from nir_render.stress.metrics import METRICS, Metric, Values

TOTAL, COUNT, ASKED, LIMIT, LIMITED = range(5)
"""The sums of a metric: its terms; how many there are; of how many rows there could be; the limit's; its."""

_COLUMNS = {
    "source": (
        *("found", "ranged", "true_range_m", "range_error_m", "range_limit_m", "bearing_error_deg"),
        "bearing_limit_deg",
    ),
    "frame": ("frame_false_alarms",),
    "sequence": ("track_hota", "track_idf1", "track_switches", "message_wrong", "message_bit_error_rate"),
    "packet": ("received",),
}


@dataclass(frozen=True, eq=False)
class JobSums:
    """What each job adds to each metric of each estimator.

    Attributes
    ----------
    jobs
        Names of the jobs, shape (jobs,).
    seeds
        Their seeds, shape (jobs,).
    place
        Index into each axis's values, shape (jobs, axes).
    written
        What the table holds for each axis: a number in SI units, or a label, shape (jobs, axes).
    estimators
        In the order in which the table has them.
    by_metric
        By estimator and metric: `TOTAL`, `COUNT`, `ASKED`, `LIMIT` and `LIMITED`, shape (5, jobs).
    """

    jobs: tuple[str, ...]
    seeds: NDArray[np.int64]
    place: NDArray[np.int64]
    written: tuple[tuple[float | str, ...], ...]
    estimators: tuple[str, ...]
    by_metric: Mapping[tuple[str, str], Values]

    def points(self) -> NDArray[np.int64]:
        """Return the point of each job, those of all seeds alike, as numbers from 0 up, shape (jobs,)."""
        number = {values: index for index, values in enumerate(dict.fromkeys(self.written))}
        return np.array([number[values] for values in self.written], dtype=np.int64)

    def subset(self, chosen: NDArray[np.bool_]) -> "JobSums":
        """Return the sums of some of the jobs; `chosen` has the shape (jobs,)."""
        return replace(
            self,
            jobs=tuple(itertools.compress(self.jobs, chosen)),
            seeds=self.seeds[chosen],
            place=self.place[chosen],
            written=tuple(itertools.compress(self.written, chosen)),
            by_metric={key: sums[:, chosen] for key, sums in self.by_metric.items()},
        )


def along(axes: Sequence[Axis], sums: JobSums, index: int) -> JobSums:
    """Return the jobs that tell of one axis: all its values, and of the other axes those that were written.

    Values that were put in to find a limit on another axis would count twice the places where it is reached.
    """
    return sums.subset(_all_of(np.delete(_is_written(axes, sums), index, axis=1)))


def at_written_values(axes: Sequence[Axis], sums: JobSums) -> tuple[tuple[Axis, ...], JobSums]:
    """Return axes and jobs without the values that were added."""
    chosen = sums.subset(_all_of(_is_written(axes, sums)))
    place = [np.searchsorted(axis.written(), at) for axis, at in zip(axes, chosen.place.T, strict=True)]
    written = np.stack(place, axis=1) if place else chosen.place
    return tuple(without_added(axis) for axis in axes), replace(chosen, place=written)


def _all_of(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    return np.asarray(flags.all(axis=1), dtype=np.bool_)


def _is_written(axes: Sequence[Axis], sums: JobSums) -> NDArray[np.bool_]:
    """Return which values of which jobs were written, shape (jobs, axes)."""
    flags: NDArray[np.bool_] = np.ones(sums.place.shape, dtype=np.bool_)
    for index, axis in enumerate(axes):
        if axis.added:
            flags[:, index] = ~np.array(axis.added)[sums.place[:, index]]
    return flags


def job_sums(axes: Sequence[Axis], table: pa.Table) -> JobSums:
    """Add up a campaign's table.

    Raises
    ------
    ValueError
        The table has a value that the axis has not.
    """
    job = pc.dictionary_encode(table["job"].combine_chunks())
    jobs = tuple(job.dictionary.to_pylist())
    index = job.indices.to_numpy(zero_copy_only=False).astype(np.int64)
    _, first = np.unique(index, return_index=True)
    of_job = table.select(["seed", *(f"axis.{axis.name}" for axis in axes)]).take(pa.array(first))
    columns = [of_job[f"axis.{axis.name}"].to_pylist() for axis in axes]
    places = [_place(axis, column) for axis, column in zip(axes, columns, strict=True)]
    written = tuple(zip(*columns, strict=True)) if columns else ((),) * len(jobs)
    estimators = tuple(pc.unique(table["estimator"]).to_pylist())
    sums: dict[tuple[str, str], Values] = {}
    for name in estimators:
        for kind, of_kind in _COLUMNS.items():
            chosen = pc.and_(pc.equal(table["estimator"], name), pc.equal(table["kind"], kind))
            if kind == "source":
                chosen = pc.and_(chosen, pc.fill_null(table["countable"], False))
            mask = chosen.to_numpy()
            rows = {column: _numbers(table[column]).compress(mask) for column in of_kind}
            at = index[mask]
            for metric in METRICS.values():
                if metric.kind == kind:
                    sums[name, metric.name] = _sums(metric, rows, at, len(jobs))
    place = np.stack(places, axis=1) if places else np.zeros((len(jobs), 0), dtype=np.int64)
    return JobSums(jobs, of_job["seed"].to_numpy(), place, written, estimators, sums)


def pooled(sums: Values, index: NDArray[np.int64], size: int) -> Values:
    """Add sums of jobs up by where they belong.

    Parameters
    ----------
    sums
        Shape (…, jobs).
    index
        Where each job belongs, shape (jobs,).
    size
        How many places there are.

    Returns
    -------
    Shape (…, size).
    """
    flat = sums.reshape(math.prod(sums.shape[:-1]), sums.shape[-1])
    added: Values = np.stack([np.bincount(index, weights=row, minlength=size) for row in flat]).astype(
        np.float64
    )
    return added.reshape(*sums.shape[:-1], size)


def slices(place: NDArray[np.int64], axis: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the combinations of the other axes' values, and the one that each job belongs to.

    Shapes (slices, axes − 1) and (jobs,).
    """
    others = np.delete(place, axis, axis=1)
    if others.shape[1] == 0:
        return np.zeros((min(1, len(place)), 0), dtype=np.int64), np.zeros(len(place), dtype=np.int64)
    combinations, index = np.unique(others, axis=0, return_inverse=True)
    return combinations, index.reshape(-1)


def _sums(metric: Metric, rows: Mapping[str, NDArray[Any]], at: NDArray[np.int64], size: int) -> Values:
    terms = metric.term(rows)
    limits = metric.limit(rows) if metric.limit else np.full(terms.shape, np.nan)
    known, limited = np.isfinite(terms), np.isfinite(limits)
    parts = (
        np.where(known, terms, 0.0),
        known,
        np.ones(terms.shape),
        np.where(limited, limits, 0.0),
        limited,
    )
    return pooled(np.stack([part.astype(np.float64) for part in parts]), at, size)


def _place(axis: Axis, values: Sequence[Any]) -> NDArray[np.int64]:
    if axis.edges_si is not None:
        return np.array([axis.part_of(value) for value in values], dtype=np.int64)
    known = {
        value: index for index, value in enumerate(axis.labels if axis.values_si is None else axis.values_si)
    }
    for value in values:
        if value not in known:
            raise ValueError(f"the table has {value!r} on the axis {axis.name!r}, which the campaign has not")
    return np.array([known[value] for value in values], dtype=np.int64)


def _numbers(column: pa.ChunkedArray) -> NDArray[Any]:
    if pa.types.is_boolean(column.type):
        column = pc.fill_null(column, False)
    return np.asarray(pc.cast(column, pa.float64()).to_numpy(), dtype=np.float64)
