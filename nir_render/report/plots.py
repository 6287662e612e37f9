"""The plots of a report, as SVG: errors against true range, with the limit drawn in."""

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullFormatter

from nir_render.evaluate.estimator_errors import EstimatorErrors, Values, limit_curve
from nir_render.report.drawing import legend, rounded_up, sheet, short, svg_of, symmetric_log
from nir_render.report.style import BAD, FAINT, LIMIT, MATPLOTLIB, look
from nir_render.report.wording import metres
from perception.causes import DetectionCauses

_RASTER_BEYOND = 1500
"""More points than these become a bitmap within the SVG: it bounds the size of the page."""

_PULL_SHOWN = 5.0


def range_error_plot(by_estimator: Mapping[str, EstimatorErrors]) -> str:
    """Draw signed range errors against true range on a symmetric log scale, and below what was missed."""
    strip_in = 0.35 + 0.22 * len(by_estimator)
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(4.6 + strip_in)
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[4.6, strip_in])
        some = next(iter(by_estimator.values()))
        x, limit_m = _band(some.range_m, some.range_limit_m)
        if x.size:
            above.fill_between(x, -limit_m, limit_m, color=LIMIT, alpha=0.22, linewidth=0, label="limit ±1 σ")
            for sign in (-1.0, 1.0):
                above.plot(x, sign * limit_m, color=LIMIT, linewidth=0.9)
        above.axhline(0.0, color=FAINT, linewidth=0.7)
        for name, own in by_estimator.items():
            _scatter(above, own.range_m, own.error_m, name, list(by_estimator))
        linear_m = rounded_up(float(limit_m.max())) if x.size and limit_m.max() > 0.0 else 0.1
        ticks_m = linear_m * np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
        symmetric_log(above, linear_m, ticks_m, [own.error_m for own in by_estimator.values()] + [limit_m])
        above.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _metres_tick(value)))
        above.set_ylabel("range error, estimated − true")
        legend(above)
        _found_strip(below, by_estimator)
        below.set_xlabel("true range, m")
        return _svg(figure)


def pull_plot(by_estimator: Mapping[str, EstimatorErrors]) -> str:
    """Draw range errors in units of their own limit: against true range, and as a histogram."""
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(4.2)
        left, right = figure.subplots(1, 2, width_ratios=[1.5, 1.0])
        for reach, alpha in ((2.0, 0.10), (1.0, 0.16)):
            left.axhspan(-reach, reach, color=LIMIT, alpha=alpha, linewidth=0)
        left.axhline(0.0, color=FAINT, linewidth=0.7)
        for name, own in by_estimator.items():
            _scatter(left, own.range_m, own.pull, name, list(by_estimator))
        symmetric_log(left, 3.0, np.arange(-3.0, 4.0), [own.pull for own in by_estimator.values()])
        left.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}".replace("-", "−")))
        left.set_ylabel("range error / limit σ")
        left.set_xlabel("true range, m")
        legend(left)
        _pull_histogram(right, by_estimator)
        return _svg(figure)


def bearing_plot(by_estimator: Mapping[str, EstimatorErrors]) -> str:
    """Draw the angle between estimated and true bearing against true range, on a log scale."""
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(3.8)
        axes = figure.subplots()
        some = next(iter(by_estimator.values()))
        x, limit_deg = _band(some.range_m, some.bearing_limit_deg)
        if x.size:
            axes.plot(x, limit_deg, color=LIMIT, linewidth=1.4, label="limit, RMS")
        for name, own in by_estimator.items():
            # An angle of exactly zero has no place on a log scale, and says nothing but that.
            _scatter(
                axes,
                own.range_m,
                np.where(own.bearing_deg > 0.0, own.bearing_deg, np.nan),
                name,
                list(by_estimator),
            )
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}°"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_ylabel("angle between estimated and true bearing")
        axes.set_xlabel("true range, m")
        legend(axes)
        return _svg(figure)


def causes_plot(by_estimator: Mapping[str, Sequence[DetectionCauses]]) -> str:
    """Draw the σ that ranges claim against range, and what each cause brings to it: root mean squares."""
    shown = {name: causes for name, causes in by_estimator.items() if causes}
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(4.2)
        panels = np.atleast_1d(figure.subplots(1, len(shown), sharey=True))
        for axes, (name, causes) in zip(panels, shown.items(), strict=True):
            range_m = np.array([one.range_m for one in causes])
            x, whole_m = _band(range_m, np.array([one.range_sigma_m for one in causes]))
            axes.plot(x, whole_m, color=LIMIT, linewidth=2.2, label="all")
            for colour, (cause, words) in enumerate(_CAUSE_WORDS.items()):
                _, part_m = _band(range_m, np.array([one.part_m(cause) for one in causes]))
                if (part_m > _LEAST_SHARE * whole_m).any():
                    style = {"color": _CAUSE_COLOURS[colour], "markersize": 2.5, "linewidth": 0.9}
                    axes.plot(x, part_m, "o-", label=words, **style)
            axes.set_yscale("log")
            axes.set_ylim(bottom=_LEAST_SHARE * float(whole_m.min()))
            axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _metres_tick(value).lstrip("+")))
            axes.yaxis.set_minor_formatter(NullFormatter())
            axes.set_xlabel("range, m")
            axes.set_title(short(name), fontsize=9)
        panels[0].set_ylabel("σ of the range")
        shown_lines = {line.get_label(): line for axes in panels for line in axes.get_lines()}
        figure.legend(shown_lines.values(), shown_lines, loc="outside right upper", fontsize=8)
        return _svg(figure)


_LEAST_SHARE = 0.01
_CAUSE_COLOURS = mpl.colormaps["Paired"].colors  # type: ignore[attr-defined]
_CAUSE_WORDS = {
    "own_light_m": "shot noise of its own light", "background_m": "shot noise of the background",
    "prnu_m": "unlike pixels", "read_noise_m": "read noise", "dsnu_m": "offsets", "rounding_m": "rounding",
    "range_constant_m": "K, the LED's flux", "source_radius_m": "source's radius",
    "point_spread_m": "point spread", "fog_m": "fog", "other_m": "neighbours, misfit",
    "response_m": "filter and vignetting (not in all)",
}  # fmt: skip


def _band(range_m: Values, limit: Values) -> tuple[Values, Values]:
    """Return the limit as a line; one flare alone gets a line wide enough to be seen."""
    x, y = limit_curve(range_m, limit)
    return (np.array([0.98, 1.02]) * x[0], np.repeat(y, 2)) if x.size == 1 else (x, y)


def _scatter(axes: Axes, x: Values, y: Values, name: str, names: list[str]) -> None:
    marker, colour = look(name, names)
    known = np.isfinite(x) & np.isfinite(y)
    many = int(known.sum()) > _RASTER_BEYOND
    axes.plot(
        x[known],
        y[known],
        marker,
        color=colour,
        markersize=3.5 if many else 6.0,
        fillstyle="none",
        markeredgewidth=0.7 if many else 1.1,
        alpha=0.5 if many else 0.9,
        rasterized=many,
        label=name,
    )


def _found_strip(axes: Axes, by_estimator: Mapping[str, EstimatorErrors]) -> None:
    """One row per estimator: which sources it found, and which it missed."""
    for row, (name, own) in enumerate(by_estimator.items()):
        colour = look(name, list(by_estimator)).colour
        many = own.found.size > _RASTER_BEYOND
        for chosen, drawn, size in ((own.found, colour, 6.0), (~own.found, BAD, 9.0)):
            place = own.range_m[chosen]
            axes.plot(
                place, np.full(place.shape, row), "|" if drawn is colour else "x", color=drawn,
                markersize=size if drawn is colour else 5.0, rasterized=many,
                label="missed" if drawn is BAD and row == 0 else None,
            )  # fmt: skip
    axes.set_ylim(len(by_estimator) - 0.4, -0.6)
    labels = [f"{short(name)}  {int(own.found.sum())}/{own.found.size}" for name, own in by_estimator.items()]
    axes.set_yticks(range(len(by_estimator)), labels)
    axes.grid(visible=False)
    axes.set_title("found |  missed ×", fontsize=8, loc="right", color=FAINT, pad=3)


def _pull_histogram(axes: Axes, by_estimator: Mapping[str, EstimatorErrors]) -> None:
    x = np.linspace(-_PULL_SHOWN, _PULL_SHOWN, 201)
    axes.plot(x, np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi), color=LIMIT, linewidth=1.2, label="at the limit")
    for name, own in by_estimator.items():
        known = own.pull[np.isfinite(own.pull)]
        within = known[np.abs(known) <= _PULL_SHOWN]
        label = f"{name}: {within.size} of {known.size} within ±{_PULL_SHOWN:g}"
        # As many steps as the flares fill: 12 at least, one per 0.2 σ at most.
        edges = np.linspace(-_PULL_SHOWN, _PULL_SHOWN, int(np.clip(2.0 * np.sqrt(known.size), 12, 50)) + 1)
        count, _ = np.histogram(within, edges)
        density = count / (max(known.size, 1) * (edges[1] - edges[0]))
        colour = look(name, list(by_estimator)).colour
        axes.stairs(density, edges, color=colour, linewidth=1.3, label=label)
    axes.set_xlabel("range error / limit σ")
    axes.set_ylabel("share of flares per σ")
    axes.set_xlim(-_PULL_SHOWN, _PULL_SHOWN)
    top = max(axes.get_ylim()[1], 0.45)
    axes.set_ylim(0.0, top * (1.12 + 0.09 * len(by_estimator)))
    legend(axes, loc="upper left")


def _metres_tick(value: float) -> str:
    return "0" if value == 0.0 else metres(value, signed=True).replace(".00", "").replace(".0 ", " ")


def _svg(figure: Figure) -> str:
    for axes in figure.axes:
        axes.xaxis.set_major_locator(MaxNLocator(nbins=12, steps=[1, 2, 5, 10]))
    return svg_of(figure)
