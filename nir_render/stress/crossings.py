"""One metric along one axis: where it crosses its bound, between which values it keeps it, and how sure."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from nir_render.stress.metrics import Metric, Values

Reason = Literal["crossing", "end", "nothing there", "not defined"]
_LOW, _HIGH = 0.16, 0.84


@dataclass(frozen=True)
class Edge:
    """One end of a span, in the axis's own unit.

    `reason` says why it ends there: the metric crosses the bound (`value` is interpolated between the two
    neighbours); the axis ends; or the next value has nothing to judge, or no metric, and `value` is the last
    that holds. `low` and `high` hold 68 of 100 repetitions, and `value`; None where nothing was repeated.
    `within` are the axis's values between which repetitions were searched for this crossing: those of no
    other span. An end of the interval is infinite where a repetition has none there: it keeps the bound
    through them, or breaks it. `gap` is the index of the value before the gap that the edge lies in; None at
    the axis's end.
    """

    value: float
    reason: Reason
    low: float | None = None
    high: float | None = None
    within: tuple[float, float] | None = None
    gap: int | None = None


@dataclass(frozen=True)
class Span:
    """An interval of the axis in which the bound holds."""

    start: Edge
    end: Edge


def spans(
    x: Values,
    log: bool,
    metric: Metric,
    bound: float,
    value: Values,
    asked: NDArray[np.bool_],
    draws: Values | None,
) -> tuple[Span, ...]:
    """Return the intervals of an axis in which a metric keeps its bound, in order.

    Between neighbours the metric is taken as a straight line, in the logarithm where it is an error above 0
    and against the logarithm of the axis where `log`.

    Parameters
    ----------
    x
        The axis's values, increasing, shape (n,).
    value
        The metric there, shape (n,); NaN where it is not defined.
    asked
        Whether there was anything to judge, shape (n,).
    draws
        The metric in repetitions, shape (repetitions, n); None where there are none.
    """
    scaled = np.log(x) if log else x
    holds = metric.holds(value, bound)
    places = _crossings(scaled, metric, bound, value[None])[0]
    edges = np.flatnonzero(np.diff(np.concatenate([[False], holds, [False]])))
    found = []
    # Repetitions are searched for a crossing where no other span is: for a start after the span before has
    # ended, for an end before the next span starts.
    ended, starting = np.append(0, edges[1::2]), np.append(edges[2::2], x.size)
    for first, after, left, right in zip(edges[::2], edges[1::2], ended, starting, strict=False):
        start = _edge(x, log, first - 1, first, places, value, asked)
        end = _edge(x, log, after - 1, after, places, value, asked)
        if draws is not None:
            crossings = _crossings(scaled, metric, bound, draws)
            kept = metric.holds(draws, bound)
            start = _with_interval(
                start, x[left:after], log, crossings[:, left : after - 1], kept[:, left:after], falls=False
            )
            end = _with_interval(
                end, x[first:right], log, crossings[:, first : right - 1], kept[:, first:right], falls=True
            )
        found.append(Span(start, end))
    return tuple(found)


def kept_length(x: Values, log: bool, metric: Metric, bound: float, value: Values) -> Values:
    """Return over how much of an axis a metric keeps its bound, in x or its logarithm.

    The sum of what `spans` gives, for many metrics at once: `value` has the shape (…, n).
    """
    scaled = np.log(x) if log else x
    holds = metric.holds(value, bound)
    left, right = holds[..., :-1], holds[..., 1:]
    place = _crossings(scaled, metric, bound, value)
    part = np.where(left & right, np.diff(scaled), 0.0)
    part = np.where(left & ~right, place - scaled[:-1], part)
    part = np.where(~left & right, scaled[1:] - place, part)
    length: Values = part.sum(axis=-1)
    return length


def interval(draws: Values) -> tuple[float, float]:
    """Return what holds 68 of 100 draws, shape (draws,); infinite draws count, NaN do not."""
    ordered = np.sort(draws[~np.isnan(draws)])
    if ordered.size == 0:
        return np.nan, np.nan
    low, high = np.floor(_LOW * (ordered.size - 1)), np.ceil(_HIGH * (ordered.size - 1))
    return float(ordered[int(low)]), float(ordered[int(high)])


def _crossings(scaled: Values, metric: Metric, bound: float, value: Values) -> Values:
    """Return where each gap between neighbours crosses the bound, shape (…, n − 1); NaN where it does not.

    Beside a value that is not defined, the neighbour that holds is the last.
    """
    size = value if metric.higher_is_better else np.abs(value)
    holds = metric.holds(value, bound)
    left, right = size[..., :-1], size[..., 1:]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (bound - left) / (right - left)
        if not metric.higher_is_better and bound > 0.0:
            by_ratio = (np.log(bound) - np.log(left)) / (np.log(right) - np.log(left))
            share = np.where((left > 0.0) & (right > 0.0), by_ratio, share)
    share = np.where(np.isfinite(left) & np.isfinite(right), share, np.where(holds[..., :-1], 0.0, 1.0))
    place = scaled[:-1] + share * np.diff(scaled)
    return np.where(holds[..., :-1] != holds[..., 1:], place, np.nan)


def _edge(
    x: Values, log: bool, left: int, right: int, places: Values, value: Values, asked: NDArray[np.bool_]
) -> Edge:
    if left < 0:
        return Edge(float(x[0]), "end")
    if right == x.size:
        return Edge(float(x[-1]), "end")
    place = float(np.exp(places[left]) if log else places[left])
    for outside, inside in ((left, right), (right, left)):
        if not np.isfinite(value[outside]):
            return Edge(float(x[inside]), "not defined" if asked[outside] else "nothing there", gap=left)
    return Edge(place, "crossing", gap=left)


def _with_interval(
    edge: Edge, x: Values, log: bool, crossings: Values, kept: NDArray[np.bool_], *, falls: bool
) -> Edge:
    """Find the same crossing in each repetition: the nearest in the same direction.

    A repetition without one keeps the bound all through, or breaks it. The interval is widened to hold the
    crossing itself, which may be off the middle of its repetitions.

    Parameters
    ----------
    x
        The axis's values in which to search, shape (m,).
    crossings, kept
        Where each repetition crosses the bound, shape (repetitions, m − 1), and where it keeps it,
        shape (repetitions, m).
    """
    if edge.reason != "crossing":
        return edge
    place = np.log(edge.value) if log else edge.value
    same = kept[:, :-1] if falls else kept[:, 1:]
    away = np.where(np.isfinite(crossings) & same, np.abs(crossings - place), np.inf)
    nearest = np.argmin(away, axis=1)
    rows = np.arange(len(crossings))
    beyond = np.where(kept[:, -1] if falls else ~kept[:, 0], np.inf, -np.inf)
    low, high = interval(np.where(np.isfinite(away[rows, nearest]), crossings[rows, nearest], beyond))
    low, high = (float(np.exp(end)) if log and np.isfinite(end) else end for end in (low, high))
    return replace(
        edge, low=min(low, edge.value), high=max(high, edge.value), within=(float(x[0]), float(x[-1]))
    )
