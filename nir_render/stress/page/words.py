"""What a campaign's metrics, and how far its bounds hold, say, in words."""

import bisect
import math
from collections.abc import Sequence

import pyarrow as pa

from nir_render.report.wording import counted, metres, share, significant
from nir_render.scene.text.units import ANGLE, LENGTH, short_number
from nir_render.stress.campaign import Campaign
from nir_render.stress.crossings import Edge, Span
from nir_render.stress.design.axes import Axis
from nir_render.stress.metrics import COUNTS, METRICS, SHARES, Bound
from nir_render.stress.reach import Extent, Reach, campaign_reaches, corners_kept
from nir_render.stress.sums import at_written_values, job_sums

_BEYOND = {"nothing there": "nothing to judge", "not defined": "no such figure"}
_MOST_NAMED = 6
_MOST_DIGITS = 7
_UNITS = {"m": 1.0, "cm": 0.01, "mm": 1e-3, "%": 0.01, "°": math.pi / 180.0, "": 1.0}


def metric_text(name: str, value: float | None, bound: float | None = None) -> str:
    """Write the value of a metric as a person reads it, so that it tells on which side of a bound it lies."""
    if value is None or not math.isfinite(value):
        return "–"
    text = _metric_text(name, value, 0)
    metric = METRICS[name]
    for more in range(1, _MOST_DIGITS):
        if bound is None or metric.holds(_read(text), bound) == metric.holds(value, bound):
            break
        text = _metric_text(name, value, more)
    return text


def marked_unit(name: str) -> float:
    """Return the unit in which round values of a metric are marked at a scale: degrees, not radians."""
    return math.pi / 180.0 if METRICS[name].quantity is ANGLE else 1.0


def tick_text(name: str, value: float) -> str:
    """Write a value at a scale of a plot, as short as it goes."""
    head, _, unit = metric_text(name, value).partition(" ")
    degree = "°" if head.endswith("°") else ""
    return f"{_shortened(head.removesuffix('°'))}{degree} {unit}".rstrip() if value else "0"


def bound_text(bound: Bound) -> str:
    """Write a bound: range RMSE ≤ 5 cm."""
    metric = METRICS[bound.metric]
    title = f"|{metric.title}|" if bound.metric == "range_bias" else metric.title
    sign = "≥" if metric.higher_is_better else "≤"
    return f"{title} {sign} {bound.text or metric_text(bound.metric, bound.value)}"


def number_text(axis: Axis, value: float) -> str:
    """Write a place on an axis, with its unit."""
    return f"{short_number(value, 3)} {axis.unit}".rstrip().replace("-", "−")


def extent_text(axis: Axis, extent: Extent) -> str:
    """Say where along an axis a bound holds: up to 4.3 m (4.1–4.5)."""
    if extent.status == "nothing to judge":
        return "nothing to judge"
    if extent.status == "nowhere":
        return "nowhere" + _sure(extent)
    if extent.status == "throughout":
        return "throughout" + _sure(extent)
    if axis.numbers is None:
        return _labels_text(axis, extent)
    if extent.status == "wherever judged":
        unjudged = [label for label, one in zip(axis.labels, extent.holds, strict=True) if one is None]
        return f"wherever there is something to judge (nothing at {_listed(unjudged)})"
    if len(extent.spans) > _MOST_NAMED:
        return f"in {len(extent.spans)} separate spans, the first {_span_text(axis, extent.spans[0])}"
    return " and ".join(_span_text(axis, span) for span in extent.spans)


def corner_text(axes: Sequence[Axis], corner: Sequence[int]) -> str:
    """Name a combination of axes' values: visibility 20 m, lamp behind."""
    return ", ".join(
        f"{axis.title} {axis.labels[index]}" for axis, index in zip(axes, corner, strict=True) if index >= 0
    )


def sentence_of(axes: Sequence[Axis], reaches: Sequence[Reach], corners: tuple[int, int]) -> str:
    """Say how one estimator keeps one bound.

    Parameters
    ----------
    reaches
        Those of that estimator and bound, along each axis.
    corners
        In how many combinations of all axes' values it is kept, and in how many there is something to judge.
    """
    kept, judged = corners
    of_what = "values" if all(axis.edges is None for axis in axes) else "parts"
    if not judged:
        return "has nothing to be judged by."
    if not kept:
        return f"keeps it at none of {counted(judged, 'combination')} of {of_what}."
    parts = [f"keeps it at {kept} of {counted(judged, 'combination')} of {of_what}"]
    for reach in reaches:
        axis = axes[reach.axis]
        text = f"along {axis.title} {extent_text(axis, reach.pooled)}"
        if reach.worst is not None and reach.pooled.status != "nowhere":
            several = len(reach.worst.spans) > 1
            worst = "only here and there" if several else extent_text(axis, reach.worst)
            text += f", in its worst corner {worst}"
        parts.append(text)
    return "; ".join(parts) + "."


def _span_text(axis: Axis, span: Span) -> str:
    start, end = span.start, span.end
    if start.reason == "end" and end.reason == "end":
        return "throughout"
    if start.reason == "end":
        return f"up to {_edge_text(axis, end, 'beyond')}"
    if end.reason == "end":
        return f"from {_edge_text(axis, start, 'below')} up"
    if start.value == end.value:
        return f"at {number_text(axis, start.value)} alone"
    return f"from {_edge_text(axis, start, 'below')} to {_edge_text(axis, end, 'beyond')}"


def _edge_text(axis: Axis, edge: Edge, where: str) -> str:
    """Write where a span ends: how sure that is, or else between which values of the axis it lies."""
    text = number_text(axis, edge.value)
    if edge.reason in _BEYOND:
        return f"{text} ({_BEYOND[edge.reason]} {where})"
    numbers = axis.numbers or ()
    if edge.low is not None and edge.high is not None:
        first, last = edge.within or (numbers[0], numbers[-1])
        low = short_number(edge.low, 3) if math.isfinite(edge.low) else f"below {short_number(first, 3)}"
        high = short_number(edge.high, 3) if math.isfinite(edge.high) else f"beyond {short_number(last, 3)}"
        # Repetitions that agree on what is printed tell of the few that there are, not of how sure it is.
        if low != high:
            return f"{text} ({low}–{high})".replace("-", "−")
    right = bisect.bisect_right(numbers, edge.value)
    if not 0 < right < len(numbers) or edge.value == numbers[right - 1]:
        return text
    before, behind = (number_text(axis, number) for number in numbers[right - 1 : right + 1])
    return f"about {text} (between {before} and {behind})"


def _metric_text(name: str, value: float, more: int) -> str:
    """Write a value with three digits, a share of sources with one decimal, or with `more`."""
    quantity = METRICS[name].quantity
    if quantity is LENGTH:
        return metres(value, signed=name == "range_bias", more=more)
    if quantity is ANGLE:
        return f"{significant(math.degrees(value), 3 + more)}°"
    if name in SHARES:
        return share(value, more=more)
    if name == "range_rmse_share":
        return f"{significant(100.0 * value, 3 + more)} %"
    if name in COUNTS:
        return _shortened(significant(value, 2 + more))
    return significant(value, 3 + more)


def _read(text: str) -> float:
    """Return what `_metric_text` has written, in the metric's unit."""
    head, _, unit = text.replace("−", "-").replace("°", " °").partition(" ")
    return float(f"{float(head) * _UNITS[unit]:.12g}")


def _shortened(number: str) -> str:
    return number.rstrip("0").rstrip(".") if "." in number else number


def _labels_text(axis: Axis, extent: Extent) -> str:
    named = [
        (word, [label for label, one in zip(axis.labels, extent.holds, strict=True) if one is value])
        for word, value in (("at", True), ("not at", False), ("nothing to judge at", None))
    ]
    return ", ".join(f"{word} {_listed(labels)}" for word, labels in named if labels) + _sure(extent)


def _sure(extent: Extent) -> str:
    if extent.agree is None or extent.agree >= 0.95:
        return ""
    return f" (narrowly: {100.0 * extent.agree:.0f} of 100 repetitions agree)"


def _listed(labels: Sequence[str]) -> str:
    shown = list(labels[:_MOST_NAMED])
    more = len(labels) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")


def reach_lines(campaign: Campaign, rows: pa.Table) -> list[str]:
    """Say of each bound how each estimator keeps it, in lines for a terminal."""
    sums = job_sums(campaign.axes, rows)
    reaches = campaign_reaches(campaign, sums)
    _, written = at_written_values(campaign.axes, sums)
    lines = []
    for bound in campaign.bounds:
        lines.append(bound_text(bound))
        for name in sums.estimators:
            of_estimator = [reach for reach in reaches if reach.bound == bound and reach.estimator == name]
            lines.append(
                f"  {name} {sentence_of(campaign.axes, of_estimator, corners_kept(bound, name, written))}"
            )
    return lines
