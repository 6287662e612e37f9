"""What a sweep has found, as one JSON object: every figure over all jobs, and where each bound holds."""

import math
from collections.abc import Sequence
from typing import Any

import pyarrow as pa

from nir_render.stress.axes import Axis
from nir_render.stress.campaign import Campaign
from nir_render.stress.crossings import Edge
from nir_render.stress.figures import FIGURES
from nir_render.stress.limits import Limit, Verdict, limits_of
from nir_render.stress.sums import COUNT, TOTAL, JobSums, job_sums


def summary_of(campaign: Campaign, rows: pa.Table) -> dict[str, Any]:
    """Return the figures and limits of a campaign; values in m, rad, or plain numbers, places as written."""
    sums = job_sums(campaign.axes, rows)
    limits = limits_of(campaign.axes, campaign.bounds, sums, campaign.seeds[0])
    return {
        "estimators": {name: _figures(sums, name) for name in sums.estimators},
        "limits": [_limit(campaign.axes, limit) for limit in limits],
    }


def _figures(sums: JobSums, name: str) -> dict[str, float | None]:
    known = {}
    for figure in FIGURES.values():
        own = sums.of[name, figure.name].sum(axis=1)
        known[figure.name] = _finite(float(figure.value(own[TOTAL], own[COUNT])))
    return known


def _limit(axes: Sequence[Axis], limit: Limit) -> dict[str, Any]:
    axis = axes[limit.axis]
    corner = {
        other.name: other.labels[index]
        for other, index in zip(axes, limit.corner, strict=True)
        if index >= 0 and limit.worst is not None
    }
    return {
        "estimator": limit.estimator,
        "figure": limit.bound.figure,
        "bound": limit.bound.value,
        "axis": axis.name,
        "unit": axis.unit,
        "all": _verdict(axis, limit.pooled),
        "worst_corner": None if limit.worst is None else {"at": corner, **_verdict(axis, limit.worst)},
    }


def _verdict(axis: Axis, verdict: Verdict) -> dict[str, Any]:
    return {
        "holds": verdict.status,
        "agree": verdict.agree,
        "spans": [{**_edge("from", span.start), **_edge("to", span.end)} for span in verdict.spans],
        "at": [label for label, kept in zip(axis.labels, verdict.holds, strict=True) if kept],
        "worst": _finite(verdict.worst),
    }


def _edge(key: str, edge: Edge) -> dict[str, Any]:
    """Return where a span ends, why, and its interval; an open end has no crossing up to `within`."""
    said: dict[str, Any] = {key: edge.value, f"{key}_reason": edge.reason, f"{key}_68": None}
    if edge.low is not None and edge.high is not None and edge.within is not None:
        said[f"{key}_68"] = {
            "low": _finite(edge.low),
            "high": _finite(edge.high),
            "low_open": math.isinf(edge.low),
            "high_open": math.isinf(edge.high),
            "within": list(edge.within),
        }
    return said


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
