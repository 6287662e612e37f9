"""A metric of a campaign over two axes at once, as SVG."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.patches import Polygon, Rectangle
from matplotlib.ticker import FuncFormatter, NullFormatter, NullLocator
from numpy.typing import NDArray

from nir_render.report.drawing import ratio_ticks, sheet, short, svg_of
from nir_render.report.style import BAD, FAINT, INK, MATPLOTLIB, PANEL, look
from nir_render.scene.text.units import short_number
from nir_render.stress.design.axes import Axis
from nir_render.stress.metrics import Metric, Values
from nir_render.stress.page.words import marked_unit, metric_text, tick_text
from nir_render.stress.sums import ASKED, COUNT, TOTAL, JobSums, pooled

MOST_VALUES = 30
"""A heat map has no more values than these along a side."""

_MOST_WRITTEN = 12


def heat_maps(
    metric: Metric, axes: Sequence[Axis], pairs: Sequence[tuple[int, int]], sums: JobSums, bound: float | None
) -> str:
    """Draw a metric over pairs of axes, pooled over all else: a map per estimator, on one scale of colours.

    Dark is good. Cells beyond the bound have a marked corner, those without a source that counts are hatched.
    """
    names = sums.estimators
    maps = [_map(metric, axes, pair, sums, name) for pair in pairs for name in names]
    heights = [min(3.4, 0.75 + 0.3 * len(axes[shown.down].labels)) for shown in maps[:: len(names)]]
    with mpl.rc_context(MATPLOTLIB | {"axes.grid": False, "hatch.color": FAINT, "hatch.linewidth": 0.6}):
        drawn = sheet(sum(heights) + 0.2)
        panels = drawn.subplots(len(pairs), len(names), height_ratios=heights, squeeze=False)
        norm, colours = _colours(metric, [shown.value for shown in maps])
        for panel, shown in zip(panels.ravel(), maps, strict=True):
            image = panel.imshow(
                np.ma.masked_invalid(np.abs(shown.value)),
                norm=norm,
                cmap=colours,
                origin="lower",
                aspect="auto",
            )
            _cells(panel, metric, shown, bound, image)
            _labels(panel, axes[shown.along], axes[shown.down])
        for panel in panels[:, 1:].ravel():
            panel.set_yticklabels([])
            panel.set_ylabel("")
        for panel, name in zip(panels[0], names, strict=True):
            panel.set_title(short(name, 40), fontsize=9, color=look(name, names).colour, loc="left")
        bar = drawn.colorbar(image, ax=panels.ravel().tolist(), fraction=0.025, pad=0.01, aspect=30)
        if isinstance(norm, LogNorm):
            unit = marked_unit(metric.name)
            bar.set_ticks(
                (unit * ratio_ticks(float(norm.vmin or 1.0) / unit, float(norm.vmax or 1.0) / unit)).tolist()
            )
            bar.ax.yaxis.set_minor_locator(NullLocator())
        bar.ax.yaxis.set_major_formatter(
            FuncFormatter(lambda value, _: tick_text(metric.name, value).lstrip("+"))
        )
        bar.ax.yaxis.set_minor_formatter(NullFormatter())
        return svg_of(drawn)


@dataclass(frozen=True, eq=False)
class _Map:
    """A metric over two axes, shape (down, along), and whether there was anything to judge."""

    down: int
    along: int
    value: Values
    asked: NDArray[np.bool_]


def _map(metric: Metric, axes: Sequence[Axis], pair: tuple[int, int], sums: JobSums, name: str) -> _Map:
    down, along = sorted(pair, key=lambda i: len(axes[i].labels))
    shape = len(axes[down].labels), len(axes[along].labels)
    index = sums.place[:, down] * shape[1] + sums.place[:, along]
    cells = pooled(sums.by_metric[name, metric.name], index, shape[0] * shape[1]).reshape(-1, *shape)
    return _Map(down, along, metric.value(cells[TOTAL], cells[COUNT]), cells[ASKED] > 0.0)


def _colours(metric: Metric, values: Sequence[Values]) -> tuple[Normalize, str]:
    """Return the scale of all maps; cividis rises evenly in lightness, to those blind to red or green too."""
    known = np.abs(np.concatenate([value[np.isfinite(value)] for value in values]))
    if known.size == 0:
        return Normalize(0.0, 1.0), "cividis"
    low, high = float(known.min()), float(known.max())
    if metric.higher_is_better:
        return Normalize(min(low, 0.9), 1.0), "cividis_r"
    if low > 0.0 and high > 3.0 * low:
        return LogNorm(low, high), "cividis"
    return Normalize(0.0, high or 1.0), "cividis"


def _cells(panel: Axes, metric: Metric, shown: _Map, bound: float | None, image: Any) -> None:
    values, asked = shown.value, shown.asked
    written = max(values.shape) <= _MOST_WRITTEN
    kept = metric.holds(values, bound) if bound is not None else np.ones(values.shape, dtype=bool)
    raster = values.size > _MOST_WRITTEN**2
    for row, column in np.ndindex(values.shape):
        value = float(values[row, column])
        left, below = column - 0.5, row - 0.5
        if not np.isfinite(value):
            hatch = None if asked[row, column] else "////"
            panel.add_patch(
                Rectangle((left, below), 1, 1, facecolor=PANEL, hatch=hatch, linewidth=0, rasterized=raster)
            )
        if asked[row, column] and not kept[row, column]:
            place = [(left + 1, below + 1), (left + 0.86, below + 1), (left + 1, below + 0.68)]
            panel.add_patch(Polygon(place, facecolor=BAD, edgecolor=PANEL, linewidth=0.8, rasterized=raster))
        if written and np.isfinite(value):
            red, green, blue, _ = image.cmap(image.norm(abs(value)))
            dark = 0.2126 * red + 0.7152 * green + 0.0722 * blue < 0.45
            text = metric_text(metric.name, value, bound)
            panel.text(
                column, row, text, ha="center", va="center", fontsize=7.5, color=INK if dark else PANEL
            )
        elif written and asked[row, column]:
            panel.text(column, row, "none", ha="center", va="center", fontsize=7.5, color=INK)


def _labels(panel: Axes, along: Axis, down: Axis) -> None:
    for axis, side in ((along, panel.xaxis), (down, panel.yaxis)):
        size = len(axis.labels)
        chosen = np.unique(np.linspace(0, size - 1, min(size, _MOST_WRITTEN)).round().astype(int))
        labels = [
            short(axis.labels[i], 12) if axis.numbers is None else short_number(axis.numbers[i], 3)
            for i in chosen
        ]
        side.set_ticks(chosen.tolist(), labels, fontsize=8)
        side.set_tick_params(length=0)
        side.set_label_text(short(axis.title, 30) + (f", {axis.unit}" if axis.unit else ""))
