"""How far into a threat an estimator keeps all bounds, from where it is harmless on, and how sure that is."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from nir_render.scene.text.units import short_number
from nir_render.stress.crossings import Edge, Span
from nir_render.stress.design.axes import Axis
from nir_render.stress.metrics import METRICS, Bound
from nir_render.stress.page.words import metric_text, number_text
from nir_render.stress.reach import Reach, reaches_of
from nir_render.stress.sums import ASKED, COUNT, LIMIT, LIMITED, TOTAL, JobSums

LIMIT_NAME = "physical limit"
"""As what the Cramér–Rao bound of the same sources stands among estimators."""

Status = Literal["throughout", "to", "nowhere", "nothing to judge"]


@dataclass(frozen=True)
class Hold:
    """How far one estimator keeps all bounds at one value of a lever.

    `edge` is where the first of them is broken, seen from the harmless end of the threat, and `breaks` are
    those broken first; both only where `status` is "to". Where it is "nowhere", `breaks` are those broken at
    the harmless end, and `values` what the figures of all bounds are there.
    """

    estimator: str
    lever: int
    status: Status
    edge: Edge | None
    breaks: tuple[Bound, ...]
    values: Mapping[str, float]

    def record(self, threat: Axis, lever: Axis) -> dict[str, Any]:
        """Return it as plain data, places in the threat's own unit."""
        edge = self.edge
        interval = None
        if edge is not None and edge.low is not None and edge.high is not None:
            interval = [end if math.isfinite(end) else None for end in (edge.low, edge.high)]
        return {
            "estimator": self.estimator,
            "lever": lever.name,
            "at": lever.labels[self.lever],
            "holds": self.status,
            "limit": None if edge is None else edge.value,
            "limit_68": interval,
            "between": None if edge is None else _neighbours(threat, edge),
            "breaks": [bound.metric for bound in self.breaks],
            "harmless": {
                name: value if math.isfinite(value) else None for name, value in self.values.items()
            },
        }


def with_limit(sums: JobSums) -> JobSums:
    """Return sums in which the Cramér–Rao bound of the same sources is an estimator too.

    It is that of the sources which the last estimator has ranged; of other figures it has none.
    """
    name = sums.estimators[-1]
    limits = {}
    for metric in METRICS:
        own = sums.by_metric[name, metric]
        moved = own.copy()
        moved[TOTAL], moved[COUNT] = own[LIMIT], own[LIMITED]
        moved[ASKED] = np.where(own[LIMITED] > 0.0, own[ASKED], 0.0)
        limits[LIMIT_NAME, metric] = moved
    return replace(sums, estimators=(*sums.estimators, LIMIT_NAME), by_metric={**sums.by_metric, **limits})


def holds_of(
    axes: Sequence[Axis], bounds: Sequence[Bound], sums: JobSums, seed: int, *, worst_is_high: bool
) -> tuple[Hold, ...]:
    """Return how far each estimator goes at each value of a lever, lever by lever, estimator by estimator.

    Parameters
    ----------
    axes
        The threat, the lever, and what is repeated.
    sums
        Of a campaign over them (`job_sums`, `with_limit`).
    seed
        Keys the repetitions.
    worst_is_high
        Whether the threat grows with the numbers of its axis.
    """
    found = []
    for lever in range(len(axes[1].labels)):
        chosen = sums.subset(sums.place[:, 1] == lever)
        chosen = replace(chosen, place=np.delete(chosen.place, 1, axis=1))
        reaches = reaches_of([axes[0], *axes[2:]], bounds, chosen, seed)
        for name in sums.estimators:
            own = [reach for reach in reaches if reach.estimator == name and reach.axis == 0]
            found.append(_hold(axes[0], own, name, lever, worst_is_high=worst_is_high))
    return tuple(found)


def hold_text(threat: Axis, hold: Hold, *, worst_is_high: bool) -> str:
    """Say how far bounds are kept: down to 62 m (58–66); throughout; not even at 640 m (RMSE 52 %)."""
    if hold.status == "nothing to judge":
        return "nothing to judge"
    if hold.status == "throughout":
        worst = threat.labels[-1 if worst_is_high else 0]
        return f"throughout, {'up' if worst_is_high else 'down'} to {worst}"
    if hold.edge is None:
        harmless = threat.labels[0 if worst_is_high else -1]
        said = ", ".join(
            f"{METRICS[one.metric].title} {metric_text(one.metric, hold.values[one.metric], one.value)}"
            for one in hold.breaks
        )
        return f"not even at {harmless}: {said}"
    way = "up to" if worst_is_high else "down to"
    breaks = " and ".join(METRICS[bound.metric].title for bound in hold.breaks)
    return f"{way} {_place_text(threat, hold.edge)}, by {breaks}"


def order_of(hold: Hold, *, worst_is_high: bool) -> float:
    """Return a number that is the larger the farther bounds are kept: −∞ nowhere, ∞ throughout."""
    if hold.edge is None:
        return math.inf if hold.status == "throughout" else -math.inf
    return hold.edge.value if worst_is_high else -hold.edge.value


def _hold(threat: Axis, reaches: Sequence[Reach], name: str, lever: int, *, worst_is_high: bool) -> Hold:
    harmless = 0 if worst_is_high else len(threat.labels) - 1
    judged = [reach for reach in reaches if any(point.asked for point in reach.points)]
    values = {reach.bound.metric: reach.points[harmless].value for reach in judged}
    if not judged:
        return Hold(name, lever, "nothing to judge", None, (), values)
    edges = [(reach.bound, _first_edge(reach, harmless, worst_is_high=worst_is_high)) for reach in judged]
    broken = tuple(bound for bound, edge in edges if edge is None)
    if broken:
        return Hold(name, lever, "nowhere", None, broken, values)
    known = [(bound, edge) for bound, edge in edges if edge is not None and edge.reason != "end"]
    if not known:
        return Hold(name, lever, "throughout", None, (), values)
    first = (min if worst_is_high else max)(edge.value for _, edge in known)
    at_first = [(bound, edge) for bound, edge in known if edge.value == first]
    return Hold(name, lever, "to", at_first[0][1], tuple(bound for bound, _ in at_first), values)


def _first_edge(reach: Reach, harmless: int, *, worst_is_high: bool) -> Edge | None:
    """Return where a bound is broken first; an edge at the axis's end where it is not, None if at once.

    Values at which nothing is to be judged break nothing at the harmless end: the bound begins behind them.
    """
    spans: Sequence[Span] = reach.pooled.spans if worst_is_high else reach.pooled.spans[::-1]
    step = 1 if worst_is_high else -1
    beginning = harmless
    while reach.pooled.holds[beginning] is None:
        beginning += step
    if not reach.pooled.holds[beginning]:
        return None
    return spans[0].end if worst_is_high else spans[0].start


def _neighbours(threat: Axis, edge: Edge) -> list[float] | None:
    numbers = threat.numbers or ()
    return None if edge.gap is None else list(numbers[edge.gap : edge.gap + 2])


def _place_text(threat: Axis, edge: Edge) -> str:
    """Write a limit with its 68 % interval, or else the values between which it lies."""
    text = number_text(threat, edge.value)
    between = _neighbours(threat, edge)
    if edge.reason != "crossing":
        return f"{text} (beyond it nothing that could be judged)"
    if edge.low is not None and edge.high is not None:
        first, last = edge.within or (edge.low, edge.high)
        low = short_number(edge.low, 3) if math.isfinite(edge.low) else f"below {short_number(first, 3)}"
        high = short_number(edge.high, 3) if math.isfinite(edge.high) else f"beyond {short_number(last, 3)}"
        if low != high:
            return f"{text} ({low}–{high})"
    if between is None:
        return text
    return f"about {text} (between {short_number(between[0], 3)} and {number_text(threat, between[1])})"
