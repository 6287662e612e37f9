"""What all plots share: the sheet they are drawn on, its legend, and how it becomes SVG."""

import io
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from nir_render.evaluate.estimator_errors import Values

_WIDTH_IN = 11.0


@dataclass(frozen=True)
class Drawing:
    """A plot as SVG, and what it shows, for those who do not see it."""

    svg: str
    description: str


def sheet(height_in: float) -> Figure:
    """Return an empty figure of the page's width."""
    return Figure((_WIDTH_IN, height_in), layout="constrained", dpi=130)


def svg_of(figure: Figure) -> str:
    """Return a figure as SVG; the same figure gives the same text."""
    file, dpi = io.StringIO(), figure.dpi
    # Not `savefig`, which draws all that a layout places twice.
    canvas = FigureCanvasSVG(figure)
    canvas.print_svg(file, metadata={"Date": None, "Creator": None})  # type: ignore[no-untyped-call]
    figure.dpi = dpi
    return file.getvalue()


def legend(axes: Axes, loc: Literal["best", "upper left"] = "best") -> None:
    """Draw a legend of what has a label, if anything has."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        shown = [short(label, 60) for label in labels]
        axes.legend(handles, shown, loc=loc, fontsize=8, frameon=True, framealpha=0.75, edgecolor="none")


def short(name: str, most: int = 18) -> str:
    """Cut a long name."""
    return name if len(name) <= most else name[: most - 1] + "…"


def symmetric_log(axes: Axes, linear: float, ticks: Values, values: list[Values]) -> None:
    """Scale y linearly within ±`linear`, by decades beyond, and reach as far as the values do."""
    axes.set_yscale("symlog", linthresh=linear, linscale=1.2)
    known = np.concatenate([value[np.isfinite(value)] for value in values])
    low, high = (float(known.min()), float(known.max())) if known.size else (-linear, linear)
    low, high = 1.6 * min(low, -linear), 1.6 * max(high, linear)
    axes.set_ylim(low, high)
    decades = 10.0 ** np.arange(np.floor(np.log10(linear)) + 1.0, np.log10(max(-low, high)) + 1.0)
    beyond = np.concatenate([-decades, decades])
    # Next to the linear part's own last tick a decade's would be written over it.
    beyond = beyond[(abs(beyond) > 1.5 * linear) & (beyond >= low) & (beyond <= high)]
    axes.set_yticks(np.sort(np.concatenate([ticks, beyond])))
    axes.yaxis.set_minor_locator(NullLocator())


def ratio_ticks(low: float, high: float) -> Values:
    """Return round numbers for a log scale: 1, 2, 5, 10, 20, … within two decades, else powers of ten."""
    decades = 10.0 ** np.arange(np.floor(np.log10(low)), np.ceil(np.log10(high)) + 1.0)
    steps = [1.0, 2.0, 5.0] if high < 100.0 * low else [1.0]
    ticks: Values = np.outer(decades, steps).ravel()
    return ticks[(ticks >= low * (1.0 - 1e-9)) & (ticks <= high * (1.0 + 1e-9))]


def rounded_up(value: float) -> float:
    """Return the next number of 1, 2, 5, 10, 20, …."""
    decade = 10.0 ** np.floor(np.log10(value))
    return float(next(step * decade for step in (1.0, 2.0, 5.0, 10.0) if step * decade >= value))
