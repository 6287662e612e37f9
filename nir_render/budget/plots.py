"""The plots of a budget, as SVG: electrons and σ against range, response over the field, light per pixel."""

from collections.abc import Sequence
from typing import Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from nir_render.budget.budget import CameraBudget, SourceBudget
from nir_render.budget.curves import Curve
from nir_render.budget.tables import GROUPS, LOBE, grouped
from nir_render.report.drawing import Drawing, legend, sheet, short, svg_of
from nir_render.report.style import BAD, FAINT, INK, LIMIT, MATPLOTLIB, TRUTH
from nir_render.report.wording import metres

_COLOURS = (
    "#ff9f1c", "#ffd166", "#b08968", "#c8553d", "#5e9bff",
    "#b392f0", "#f72585", "#4cc9f0", "#2ec27e", "#9aa4ad",
)  # fmt: skip
_TICKS_M = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0)
_DASHES = ("-", "--", ":", "-.")
_FLOOR = 1e-3  # of the smallest σ in all: causes below are not drawn


def electrons_plot(camera: CameraBudget, source: SourceBudget) -> Drawing:
    """Draw electrons in all and in the brightest pixel against range, with the level of clipping."""
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(3.8)
        left, right = figure.subplots(1, 2, width_ratios=[1.5, 1.0])
        curves = [curve for curve in source.curves if curve.place.name == "axis"]
        for number, curve in enumerate(curves):
            dash, end = _DASHES[number % len(_DASHES)], f", {curve.exposure}" if len(curves) > 1 else ""
            left.plot(curve.range_m, curve.electrons_e, dash, color=TRUTH, label=f"in all{end}")
            left.plot(
                curve.range_m, curve.brightest_pixel_e, dash, color="#ff9f1c", label=f"brightest pixel{end}"
            )
            if curve.saturation.range_m is not None and curve.exposure != "automatic":
                left.axvline(curve.saturation.range_m, color=BAD, linewidth=0.8, linestyle=dash)
            brightest = source.largest_relative_intensity
            if brightest > LOBE:
                most_e = [min(brightest * one, camera.clip_e[0]) for one in curve.brightest_pixel_e]
                left.plot(
                    curve.range_m, most_e, dash, color="#ff9f1c", linewidth=0.8, alpha=0.7,
                    label=f"of its brightest side{end}",
                )  # fmt: skip
        left.axhline(camera.clip_e[0], color=BAD, linewidth=0.9, label="a pixel clips")
        _range_axis(left)
        _electron_axis(left, "y")
        left.set_ylabel("electrons")
        legend(left)
        _field(right, source)
        return Drawing(
            svg_of(figure), "electrons against range on the axis; response against the field angle"
        )


def sigma_plot(curves: Sequence[Curve]) -> Drawing:
    """Draw the σ of ranges by cause against range: on the axis and near the edge."""
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(4.6)
        panels = np.atleast_1d(figure.subplots(1, len(curves), sharey=True))
        for axes, curve in zip(panels, curves, strict=True):
            _sigma_panel(axes, curve)
        panels[0].set_ylabel("σ of the range")
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside right upper", fontsize=8)
        return Drawing(svg_of(figure), "σ of the range by cause, against range")


def ambient_plot(camera: CameraBudget) -> Drawing:
    """Draw the electrons that each light brings to a pixel, on the wall and seen itself."""
    with mpl.rc_context(MATPLOTLIB):
        count = len(camera.ambient)
        figure = sheet(1.1 + 0.42 * count)
        axes = figure.subplots()
        places = np.arange(count)[::-1]
        exposure_s = camera.stated_exposure_s[0]
        wall = [one.wall_e_per_s * exposure_s for one in camera.ambient]
        seen = [
            np.nan if one.seen_e_per_s is None else one.seen_e_per_s * exposure_s for one in camera.ambient
        ]
        axes.plot(wall, places, "o", color=TRUTH, label="grey wall, turned to it")
        if np.isfinite(seen).any():
            axes.plot(seen, places, "D", color="#ffd166", markersize=5, label="the light itself")
        axes.axvline(camera.clip_e[0], color=BAD, linewidth=0.9, label="a pixel clips")
        axes.axvline(camera.read_noise_e, color=FAINT, linewidth=0.9, linestyle="--", label="read noise")
        _electron_axis(axes, "x")
        axes.set_yticks(places, [short(one.name, 28) for one in camera.ambient])
        axes.set_ylim(-0.6, count - 0.4)
        axes.set_xlabel(f"electrons per pixel in {1e3 * exposure_s:.3g} ms")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
        return Drawing(svg_of(figure), "electrons per pixel of each light")


def _sigma_panel(axes: Axes, curve: Curve) -> None:
    by_range = [grouped(curve, index) for index in range(len(curve.range_m))]
    total = np.array([np.nan if one is None else one for one in curve.range_sigma_m])
    limit = np.array([np.nan if one is None else one for one in curve.range_limit_m])
    known = total[np.isfinite(total)]
    least = _FLOOR * float(known.min()) if known.size else 0.0
    for (name, _), colour in zip(GROUPS.items(), _COLOURS, strict=True):
        values = np.array([causes.get(name, np.nan) for causes in by_range])
        if np.nanmax(np.nan_to_num(values)) > least:
            axes.plot(
                curve.range_m, np.where(values > 0.0, values, np.nan), color=colour, linewidth=1.2, label=name
            )
    axes.plot(curve.range_m, limit, "--", color=LIMIT, linewidth=1.6, label="the limit (Cramér–Rao)")
    axes.plot(curve.range_m, total, color=INK, linewidth=2.2, label="all together")
    _range_axis(axes)
    axes.set_yscale("log")
    if known.size:
        axes.set_ylim(max(float(known.min()) * 1e-3, 1e-7), 2.0 * float(known.max()))
    else:
        axes.set_ylim(1e-4, 10.0)
        axes.text(0.5, 0.5, "no range", ha="center", color=FAINT, transform=axes.transAxes)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _metres_tick(value)))
    axes.yaxis.set_minor_locator(NullLocator())
    angle_deg = np.degrees(curve.place.field_angle_rad)
    where = "on the axis" if curve.place.name == "axis" else f"near the edge, {angle_deg:.0f}°"
    axes.set_title(where, fontsize=9, loc="left")


def _metres_tick(value: float) -> str:
    return metres(value).replace(".00", "").replace(".0 ", " ") if value >= 1e-3 else f"{1e6 * value:g} µm"


def _field(axes: Axes, source: SourceBudget) -> None:
    field = source.field
    angle_deg = np.degrees(field.field_angle_rad)
    relative = np.array(field.electrons_per_j) / source.electrons_per_j
    axes.plot(angle_deg, relative, color=TRUTH, label="response C(θ)/C(0)")
    axes.plot(angle_deg, field.relative_signal, "--", color="#ff9f1c", label="flare: cos θ C(θ)/C(0)")
    axes.set_ylim(0.0, 1.05 * max(1.0, float(relative.max())))
    axes.set_xlim(0.0, float(angle_deg[-1]))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}°"))
    axes.set_xlabel("field angle, to the image's corner")
    legend(axes)


def _electron_axis(axes: Axes, which: Literal["x", "y"]) -> None:
    (axes.set_xscale if which == "x" else axes.set_yscale)("log")
    axis = axes.xaxis if which == "x" else axes.yaxis
    axis.set_major_locator(LogLocator(numticks=8))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}" if value < 1e6 else f"{value:.0e}"))
    axis.set_minor_formatter(NullFormatter())


def _range_axis(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_xticks(_TICKS_M, [f"{tick:g}" for tick in _TICKS_M])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("range, m")
