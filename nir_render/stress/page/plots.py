"""A metric of a campaign against its axes, as SVG."""

from collections.abc import Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FixedLocator, FuncFormatter, NullFormatter, NullLocator
from numpy.typing import NDArray

from nir_render.report.drawing import ratio_ticks, rounded_up, sheet, short, svg_of, symmetric_log
from nir_render.report.style import BAD, LIMIT, MATPLOTLIB, look
from nir_render.scene.text.units import short_number
from nir_render.stress.bootstrap import AlongAxis
from nir_render.stress.design.axes import Axis
from nir_render.stress.metrics import Metric, Values
from nir_render.stress.page.words import marked_unit, tick_text
from nir_render.stress.reach import Point, points_of
from nir_render.stress.sums import COUNT, TOTAL, pooled, slices

_MOST_LINES = 24
_RASTER_BEYOND = 400
_MOST_TICKS = 8


def against_axes(
    metric: Metric,
    axes: Sequence[Axis],
    chosen: Sequence[int],
    told: Sequence[AlongAxis],
    bound: float | None,
) -> str:
    """Draw a metric against axes: a row of panels for each, a panel per estimator, all on one scale.

    Each panel has the metric pooled over all else, with its 68 % interval; every corner (combination of the
    other axes' values) as a thin line, or many of them as a band; the other estimators' pooled metrics,
    dashed; the limit, dotted; the bound.

    Parameters
    ----------
    chosen
        Indices of the axes to draw.
    told
        The jobs and repetitions for each axis (see `along_axes`).
    """
    names = told[0].sums.estimators
    with mpl.rc_context(MATPLOTLIB):
        drawn = sheet(2.35 * len(chosen) + 0.2)
        panels = drawn.subplots(len(chosen), len(names), sharey=True, squeeze=False)
        shown: list[Values] = []
        for row, index in zip(panels, chosen, strict=True):
            axis, sums = axes[index], told[index].sums
            at, size = sums.place[:, index], len(axis.labels)
            x = np.arange(size, dtype=np.float64) if axis.numbers is None else np.array(axis.numbers)
            of = {name: sums.by_metric[name, metric.name] for name in names}
            points = {name: points_of(metric, of[name], at, size, told[index].repetitions) for name in names}
            for panel, name in zip(row, names, strict=True):
                corners = np.empty((0, size))
                if told[index].has_corners:
                    corners = _corners(metric, of[name], sums.place, index, size)
                _panel(panel, metric, name, names, x, points, corners, bound)
                _ticks_x(panel, axis, x, points[name], metric)
                panel.set_xlabel(short(axis.title, 40) + (f", {axis.unit}" if axis.unit else ""))
                shown += [
                    corners.ravel(),
                    *(np.array([said.value, said.limit]) for said in points[name]),
                ]
            row[0].set_ylabel(metric.title)
        for panel, name in zip(panels[0], names, strict=True):
            panel.set_title(short(name, 40), fontsize=9, color=look(name, names).colour, loc="left")
        _scale_y(panels[0, 0], metric, np.concatenate(shown), bound)
        return svg_of(drawn)


def _corners(metric: Metric, sums: Values, place: NDArray[np.int64], index: int, size: int) -> Values:
    """Return a metric along an axis for each combination of the other axes' values, shape (slices, size)."""
    combinations, slice_of = slices(place, index)
    count = len(combinations)
    cells = pooled(sums[[TOTAL, COUNT]], slice_of * size + place[:, index], count * size)
    return metric.value(*cells).reshape(count, size)


def _panel(
    panel: Axes,
    metric: Metric,
    name: str,
    names: Sequence[str],
    x: Values,
    points: dict[str, tuple[Point, ...]],
    corners: Values,
    bound: float | None,
) -> None:
    marker, colour = look(name, names)
    limit = np.array([point.limit for point in points[name]])
    if np.isfinite(limit).any():
        panel.plot(x, limit, color=LIMIT, linewidth=1.2, linestyle=(0, (1, 1.5)))
    if bound is not None:
        for side in (bound, -bound) if metric.name == "range_bias" else (bound,):
            panel.axhline(side, color=BAD, linewidth=1.1)
    if len(corners) > _MOST_LINES:
        some = np.isfinite(corners).any(axis=0)
        low, high = (np.full(x.shape, np.nan) for _ in range(2))
        low[some], high[some] = np.nanmin(corners[:, some], axis=0), np.nanmax(corners[:, some], axis=0)
        panel.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)
    elif len(corners) > 1:
        # All as one line with gaps: as a path each they would take most of the page.
        gaps = np.concatenate([corners, np.full((len(corners), 1), np.nan)], axis=1).ravel()
        panel.plot(
            np.tile(np.append(x, np.nan), len(corners)), gaps, color=colour, linewidth=0.8, alpha=0.45,
            marker=".", markersize=2.5, rasterized=gaps.size > _RASTER_BEYOND,
        )  # fmt: skip
    for other in names:
        if other != name:
            value = [point.value for point in points[other]]
            panel.plot(x, value, color=look(other, names).colour, linewidth=1.1, linestyle="--")
    known = np.array([point.value for point in points[name]])
    low, high = (
        np.array([np.nan if end is None else end for end in ends])
        for ends in zip(*((point.low, point.high) for point in points[name]), strict=True)
    )
    # Where nothing was repeated there is no bar, rather than one of no length.
    bars = np.nan_to_num(np.stack([known - low, high - known])).clip(min=0.0)
    panel.errorbar(
        x, known, bars, color=colour, linewidth=2.0, marker=marker, markersize=6.0, fillstyle="none",
        elinewidth=1.2, capsize=2.5,
    )  # fmt: skip


def _ticks_x(panel: Axes, axis: Axis, x: Values, points: Sequence[Point], metric: Metric) -> None:
    """Write the values of the axis, and below each how many of the sources, or frames, the metric is of."""
    if axis.log:
        panel.set_xscale("log")
    chosen = np.unique(np.linspace(0, x.size - 1, min(x.size, _MOST_TICKS)).round().astype(int))
    labels = []
    for i in chosen:
        label = (
            short(axis.labels[i], 14)
            if axis.numbers is None
            else short_number(axis.numbers[i], 3).replace("-", "−")
        )
        point = points[i]
        of = (
            f"{point.count}/{point.asked}"
            if metric.kind == "source" and point.count < point.asked
            else str(point.asked)
        )
        labels.append(f"{label}\n{of if point.asked else 'none'}")
    panel.xaxis.set_major_locator(FixedLocator(x[chosen].tolist()))
    panel.xaxis.set_minor_locator(NullLocator())
    panel.set_xticklabels(labels, fontsize=8)
    if axis.numbers is None:
        panel.set_xlim(-0.4, x.size - 0.6)


def _scale_y(panel: Axes, metric: Metric, values: Values, bound: float | None) -> None:
    known = values[np.isfinite(values)]
    if metric.higher_is_better:
        low = min([*known.tolist(), 0.9 if bound is None else bound, 0.9])
        panel.set_ylim(low - 0.06 * (1.02 - low), 1.02)
    elif metric.name == "range_bias":
        linear = rounded_up(bound or 0.02 * (float(np.abs(known).max(initial=0.0)) or 1.0))
        symmetric_log(panel, linear, linear * np.array([-1.0, 0.0, 1.0]), [known])
    elif known.size and (known > 0.0).all():
        unit = marked_unit(metric.name)
        low, high = 0.8 * min(known.min(), bound or np.inf), 1.25 * max(known.max(), bound or 0.0)
        panel.set_yscale("log")
        panel.set_ylim(low, high)
        panel.yaxis.set_major_locator(FixedLocator((unit * ratio_ticks(low / unit, high / unit)).tolist()))
        panel.yaxis.set_minor_locator(NullLocator())
    else:
        nothing = not known.any() and not bound
        panel.set_ylim(bottom=0.0, top=1.0 if nothing else None)
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: tick_text(metric.name, value)))
    panel.yaxis.set_minor_formatter(NullFormatter())
