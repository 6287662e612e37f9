"""Each source's error on the first side against that on the second, as SVG."""

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from nir_render.compare.paired import Values
from nir_render.compare.pairs import FramePair
from nir_render.report.drawing import Drawing, sheet, short, svg_of
from nir_render.report.style import BAD, FAINT, GOOD, MATPLOTLIB
from nir_render.report.wording import degrees, metres

_RASTER_BEYOND = 1500


def error_plots(frames: tuple[FramePair, ...], first: str, second: str) -> Drawing | None:
    """Draw range and bearing errors, first against second, on log scales; None where no source has both."""
    pairs = [pair for frame in frames for pair in frame.sources if pair.countable]
    range_m = _columns([(abs(p.first.range_error_m), abs(p.second.range_error_m)) for p in pairs])
    bearing_deg = _columns([(p.first.bearing_error_deg, p.second.bearing_error_deg) for p in pairs])
    if not (range_m.size or bearing_deg.size):
        return None
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(4.6)
        for axes, values, what, text in zip(
            figure.subplots(1, 2),
            (range_m, bearing_deg),
            ("range", "bearing"),
            (metres, degrees),
            strict=True,
        ):
            _panel(axes, values)
            axes.set_xlabel(f"{what} error, {short(first, 40)}")
            axes.set_ylabel(f"{what} error, {short(second, 40)}")
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_locator(LogLocator(numticks=7))
                axis.set_major_formatter(FuncFormatter(lambda value, _, text=text: text(value)))
                axis.set_minor_formatter(NullFormatter())
        return Drawing(svg_of(figure), "errors of each source, first side against second")


def _columns(rows: list[tuple[float, float]]) -> Values:
    """Return pairs of which both are finite and one is above zero, shape (2, n)."""
    values = np.array(rows, dtype=np.float64).reshape(-1, 2)
    return np.asarray(values[np.isfinite(values).all(axis=1) & (values > 0.0).any(axis=1)].T)


def _panel(axes: Axes, values: Values) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    if not values.size:
        axes.text(0.5, 0.5, "no source has both", ha="center", color=FAINT, transform=axes.transAxes)
        return
    known = values[values > 0.0]
    low, high = float(known.min()) / 1.6, float(known.max()) * 1.6
    first, second = np.maximum(values, low)  # an error of exactly zero stands at the edge
    better = second < first
    many = first.size > _RASTER_BEYOND
    for chosen, colour, words in ((better, GOOD, "smaller"), (~better & (second > first), BAD, "larger")):
        label = f"{words} on the second side: {int(chosen.sum())}"
        axes.plot(first[chosen], second[chosen], "o", color=colour, markersize=3.0 if many else 4.5,
                  alpha=0.6, markeredgewidth=0.0, rasterized=many, label=label)  # fmt: skip
    axes.plot([low, high], [low, high], color=FAINT, linewidth=0.9)
    axes.set_xlim(low, high)
    axes.set_ylim(low, high)
    axes.set_box_aspect(1.0)
    axes.legend(loc="upper left", fontsize=8, frameon=True, framealpha=0.75, edgecolor="none")
