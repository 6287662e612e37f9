"""A flock from above, and its distances over time, as SVG."""

import matplotlib as mpl
import numpy as np

from nir_render.experiments.flocking.loop import Flocking, Run
from nir_render.experiments.flocking.spacing import COUNTED_S, NEIGHBOURS
from nir_render.report.drawing import Drawing, sheet, svg_of
from nir_render.report.style import FAINT, INK, MATPLOTLIB

_COLOURS = ("#ffd166", "#5e9bff", "#2ec27e", "#f72585", "#b392f0", "#ff9f1c", "#4cc9f0", "#c8553d")
_MARKS_EVERY_S = 30.0


def flock_plot(run: Run, plan: Flocking) -> Drawing:
    """Draw the ways of all robots from above, and the distances of all pairs over time."""
    places_m, times_s = np.array(run.record["places_m"]), np.array(run.record["time_s"])
    names = run.record["robots"]
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(5.4)
        above, apart = figure.subplots(1, 2, width_ratios=[1.0, 1.4])
        marked = [
            int(np.argmin(abs(times_s - at_s))) for at_s in np.arange(0.0, times_s[-1] + 1.0, _MARKS_EVERY_S)
        ]
        for at in marked[1:]:
            for one in range(len(names)):
                for other in range(one):
                    ends = places_m[at, [one, other]]
                    if np.hypot(*(ends[0] - ends[1])) < NEIGHBOURS * plan.spacing_m:
                        above.plot(*ends.T, color=FAINT, linewidth=0.5, zorder=1)
        for number, name in enumerate(names):
            colour = _COLOURS[number % len(_COLOURS)]
            above.plot(*places_m[:, number].T, color=colour, linewidth=1.0, label=name)
            above.plot(*places_m[0, number], "o", color="none", markeredgecolor=colour, markersize=7)
            above.plot(*places_m[marked[1:], number].T, "o", color=colour, markersize=5)
        above.set_aspect("equal")
        above.set_xlabel("x in m")
        above.set_ylabel("y in m")
        above.legend(fontsize=8, loc="best")
        for one in range(len(names)):
            for other in range(one):
                d_m = np.hypot(*(places_m[:, one] - places_m[:, other]).T)
                near = d_m[times_s > times_s[-1] - COUNTED_S].mean() < NEIGHBOURS * plan.spacing_m
                apart.plot(times_s, d_m, color=_COLOURS[1] if near else FAINT, linewidth=0.9)
        apart.axhline(plan.spacing_m, color=INK, linewidth=0.9, linestyle="--")
        apart.axvline(times_s[-1] - COUNTED_S, color=FAINT, linewidth=0.8)
        apart.set_xlabel("time in s; what lies right of the line counts")
        apart.set_ylabel("distance of each pair in m; neighbours are blue")
        apart.set_ylim(0.0, None)
        return Drawing(
            svg_of(figure), "ways of the robots from above, every 30 s a dot; distances of pairs over time"
        )
