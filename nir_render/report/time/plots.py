"""Plots of tracks: from above over truth, their errors over time, and who was followed by which track."""

from collections.abc import Mapping, Sequence

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke

from nir_render.report.drawing import Drawing, legend, sheet, short, svg_of
from nir_render.report.style import BAD, FAINT, INK, LINE, MATPLOTLIB, PANEL, TRUTH, look
from nir_render.report.time.lanes import Flags, Lane, Values, spans

COLOURS = ("#70e000", "#ff9f1c", "#f72585", "#b392f0", "#ffd166", "#5e9bff", "#4dd6c1", "#ff8fab")
"""Of tracks, or of sources, in turn."""

_MOST_COLOURED = 4


def above_plot(lanes: Mapping[str, Sequence[Lane]], observer: str) -> Drawing:
    """Draw true ways and tracks from above in the observer's body axes, ahead up the page."""
    names = list(lanes)
    some = next(iter(lanes.values()))
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(7.4)
        axes = figure.subplots()
        for k, lane in enumerate(some):
            x, y = _page(_where(lane.place_m, lane.counts))
            axes.plot(x, y, color=TRUTH, linewidth=5.0, alpha=0.45, label="truth" if k == 0 else None)
            top = int(np.nanargmax(y))
            text = axes.annotate(
                _label(lane, some), (float(x[top]), float(y[top])), (0, 7), textcoords="offset points",
                fontsize=8, color=TRUTH, ha="center", zorder=5,
            )  # fmt: skip
            text.set_path_effects([withStroke(linewidth=2.5, foreground=PANEL)])
        for name, own in lanes.items():
            colour = look(name, names).colour
            labels = iter((name,))
            for lane in own:
                for number in dict.fromkeys(lane.track[lane.track >= 0].tolist()):
                    x, y = _page(lane.of_track(number))
                    axes.plot(x, y, color=colour, linewidth=1.1, label=next(labels, None))
                    x, y = _page(_where(lane.of_track(number), ~lane.seen))
                    axes.plot(x, y, ".", color=colour, markersize=3.0, alpha=0.8)
            axes.plot([], [], ".", color=colour, markersize=3.0, label=f"{name}: predicted, not seen")
        axes.plot(0.0, 0.0, "^", color=INK, markersize=9, label=f"{observer}, looking up the page")
        axes.margins(0.12)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("to the right, m")
        axes.set_ylabel("ahead, m")
        legend(axes)
        return Drawing(svg_of(figure), "the ways of sources from above, and the tracks that followed them")


def error_plot(lanes: Sequence[Lane], name: str) -> Drawing:
    """Draw the errors of range and bearing over time, and the claimed σ.

    A colour and a band a source, where they are few; of many, each in grey and the RMS of all.
    """
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(5.6)
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=[1.3, 1.0])
        held = [lane.counts & (lane.track >= 0) for lane in lanes]
        errors = [_where(lane.range_error_m, where) for lane, where in zip(lanes, held, strict=True)]
        angles = [_where(lane.bearing_error_deg, where) for lane, where in zip(lanes, held, strict=True)]
        (_few if len(lanes) <= _MOST_COLOURED else _many)(lanes, held, (above, below), (errors, angles))
        above.axhline(0.0, color=FAINT, linewidth=0.7)
        reach_m = _reach(errors)
        above.set_ylim(-reach_m, reach_m)
        below.set_ylim(0.0, _reach(angles))
        above.set_ylabel("range error, m")
        below.set_ylabel("bearing error, °")
        below.set_xlabel("time, s")
        handles, labels = above.get_legend_handles_labels()
        shown = [short(label, 60) for label in labels]
        figure.legend(handles, shown, loc="outside upper right", ncols=6, fontsize=8)
        return Drawing(svg_of(figure), f"{name}: errors of range and bearing of each source over time")


_Both = tuple[Axes, Axes]


def _few(lanes: Sequence[Lane], held: Sequence[Flags], axes: _Both, errors: tuple[list[Values], ...]) -> None:
    for k, lane in enumerate(lanes):
        colour = COLOURS[k % len(COLOURS)]
        sigma_m, sigma_deg = (
            _where(sigma, held[k]) for sigma in (lane.range_sigma_m, lane.bearing_sigma_deg)
        )
        axes[0].fill_between(lane.time_s, -sigma_m, sigma_m, color=colour, alpha=0.12, linewidth=0)
        axes[0].plot(lane.time_s, errors[0][k], color=colour, linewidth=1.1, label=_label(lane, lanes))
        axes[1].plot(lane.time_s, errors[1][k], color=colour, linewidth=1.1)
        axes[1].plot(lane.time_s, sigma_deg, color=colour, linewidth=0.9, linestyle=":")
    axes[0].fill_between([], [], color=FAINT, alpha=0.3, linewidth=0, label="claimed ±1 σ")
    axes[0].plot([], [], color=FAINT, linewidth=0.9, linestyle=":", label="claimed σ of bearing")


def _many(
    lanes: Sequence[Lane], held: Sequence[Flags], axes: _Both, errors: tuple[list[Values], ...]
) -> None:
    claimed = (
        [_where(lane.range_sigma_m, where) for lane, where in zip(lanes, held, strict=True)],
        [_where(lane.bearing_sigma_deg, where) for lane, where in zip(lanes, held, strict=True)],
    )
    time_s = lanes[0].time_s
    for part, off, sigma in zip(axes, errors, claimed, strict=True):
        for values in off:
            part.plot(time_s, values, color=FAINT, linewidth=0.6, alpha=0.45)
        reach = _rms_of_all(sigma)
        part.fill_between(
            time_s, -reach, reach, color=TRUTH, alpha=0.22, linewidth=0,
            label="±σ claimed, RMS of all sources",
        )  # fmt: skip
        part.plot(time_s, _rms_of_all(off), color=INK, linewidth=1.3, label="error, RMS of all sources")
    axes[0].plot([], [], color=FAINT, linewidth=0.6, label=f"each of {len(lanes)} sources")


def _rms_of_all(values: Sequence[Values]) -> Values:
    """Return the root mean square over sources at each time, NaN where there is none."""
    rows = np.array(values)
    known = np.isfinite(rows)
    count = known.sum(axis=0)
    mean = np.divide(
        (np.where(known, rows, 0.0) ** 2).sum(axis=0),
        count,
        out=np.full(rows.shape[1], np.nan),
        where=count > 0,
    )
    return np.asarray(np.sqrt(mean))


def _label(lane: Lane, others: Sequence[Lane]) -> str:
    """Return what a source is called: its robot alone where that has no other."""
    alone = sum(other.name[0] == lane.name[0] for other in others) == 1
    return lane.name[0] if alone and lane.name[2] is None else lane.label


def life_plot(lanes: Mapping[str, Sequence[Lane]]) -> Drawing:
    """Draw a bar per source and estimator: which track followed it when, and when it was dark."""
    rows = [(name, lane) for name, own in lanes.items() for lane in own]
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(1.0 + 0.34 * len(rows))
        axes = figure.subplots()
        labelled: set[str] = set()
        for row, (_, lane) in enumerate(rows):
            away = ~lane.counts
            _shade(axes, lane, away, row, INK, 0.10, "hidden or out of view", labelled)
            _shade(axes, lane, lane.counts & ~lane.lit, row, "#000000", 0.65, "dark", labelled)
            for track in dict.fromkeys(lane.track[lane.track >= 0].tolist()):
                whole = spans(lane.time_s, lane.track == track)
                colour = COLOURS[track % len(COLOURS)]
                axes.broken_barh([(a, b - a) for a, b in whole], (row - 0.14, 0.28), color=colour)
                axes.text(whole[0][0], row - 0.17, f" {track}", fontsize=7, va="bottom", color=colour)
            for at in lane.switches():
                label = _once("another track takes over", labelled)
                axes.plot(lane.time_s[at], row, "x", color=BAD, markersize=8, label=label)
        axes.set_yticks(range(len(rows)), [f"{lane.label}  {short(name)}" for name, lane in rows])
        axes.set_ylim(len(rows) - 0.5, -0.6)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel("time, s")
        handles, labels = axes.get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="outside upper right", ncols=3, fontsize=8)
        return Drawing(svg_of(figure), "which track followed which source when")


def _shade(
    axes: Axes, lane: Lane, where: Flags, row: int, colour: str, alpha: float, text: str, said: set[str]
) -> None:
    found = spans(lane.time_s, where)
    if found:
        axes.broken_barh(
            [(a, b - a) for a, b in found], (row - 0.4, 0.8), facecolor=colour, alpha=alpha, edgecolor=LINE,
            linewidth=0.3, label=_once(text, said),
        )  # fmt: skip


def _once(text: str, said: set[str]) -> str | None:
    if text in said:
        return None
    said.add(text)
    return text


def _where(values: Values, where: Flags) -> Values:
    """Return values with NaN where a flag does not hold: lines break there."""
    chosen = values.astype(np.float64, copy=True)
    chosen[~where] = np.nan
    return chosen


def _page(place_m: Values) -> tuple[Values, Values]:
    return -place_m[:, 1], place_m[:, 0]


def _reach(errors: Sequence[Values]) -> float:
    """Return how far an axis goes: beyond 99 % of errors, so that one start does not flatten all."""
    sizes = np.abs(np.concatenate([*errors, np.empty(0)]))
    sizes = sizes[np.isfinite(sizes)]
    return 1.4 * max(float(np.quantile(sizes, 0.99)), 1e-6) if sizes.size else 1.0
