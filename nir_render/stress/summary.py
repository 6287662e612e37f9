"""What a sweep has found, as one JSON object: every metric over all jobs, and where each bound holds."""

import math
from collections.abc import Sequence
from typing import Any

import pyarrow as pa

from nir_render.stress.campaign import Campaign
from nir_render.stress.crossings import Edge
from nir_render.stress.design.axes import Axis
from nir_render.stress.metrics import METRICS
from nir_render.stress.reach import Extent, Reach, campaign_reaches
from nir_render.stress.sums import COUNT, TOTAL, JobSums, at_written_values, job_sums


def summary_of(campaign: Campaign, rows: pa.Table) -> dict[str, Any]:
    """Return the metrics of a campaign, and how far its bounds hold.

    Values are in m, rad, or plain numbers, places on an axis as they are written.
    """
    sums = job_sums(campaign.axes, rows)
    _, written = at_written_values(campaign.axes, sums)
    return {
        "estimators": {name: _metric_values(written, name) for name in sums.estimators},
        "limits": [_reach_record(campaign.axes, reach) for reach in campaign_reaches(campaign, sums)],
    }


def _metric_values(sums: JobSums, name: str) -> dict[str, float | None]:
    values = {}
    for metric in METRICS.values():
        sums_of_metric = sums.by_metric[name, metric.name].sum(axis=1)
        values[metric.name] = _finite(float(metric.value(sums_of_metric[TOTAL], sums_of_metric[COUNT])))
    return values


def _reach_record(axes: Sequence[Axis], reach: Reach) -> dict[str, Any]:
    axis = axes[reach.axis]
    corner = {
        corner_axis.name: corner_axis.labels[index]
        for corner_axis, index in zip(axes, reach.corner, strict=True)
        if index >= 0 and reach.worst is not None
    }
    return {
        "estimator": reach.estimator,
        "figure": reach.bound.metric,
        "bound": reach.bound.value,
        "axis": axis.name,
        "unit": axis.unit,
        "all": _extent_record(axis, reach.pooled),
        "worst_corner": None
        if reach.worst is None
        else {"corner": corner, **_extent_record(axis, reach.worst)},
    }


def _extent_record(axis: Axis, extent: Extent) -> dict[str, Any]:
    return {
        "holds": extent.status,
        "agree": extent.agree,
        "spans": [
            {**_edge_record("from", span.start), **_edge_record("to", span.end)} for span in extent.spans
        ],
        "at": [label for label, kept in zip(axis.labels, extent.holds, strict=True) if kept],
        "worst": _finite(extent.worst),
    }


def _edge_record(key: str, edge: Edge) -> dict[str, Any]:
    """Return where a span ends, why, and its interval; an open end has no crossing up to `within`."""
    record: dict[str, Any] = {key: edge.value, f"{key}_reason": edge.reason, f"{key}_68": None}
    if edge.low is not None and edge.high is not None and edge.within is not None:
        record[f"{key}_68"] = {
            "low": _finite(edge.low),
            "high": _finite(edge.high),
            "low_open": math.isinf(edge.low),
            "high_open": math.isinf(edge.high),
            "within": list(edge.within),
        }
    return record


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
