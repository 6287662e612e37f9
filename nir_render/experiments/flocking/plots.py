"""A flock from above, and its distances over time, as SVG."""

import matplotlib as mpl
import numpy as np

from nir_render.experiments.flocking.loop import Flocking, Run
from nir_render.experiments.flocking.spacing import COUNTED_S, NEIGHBOURS
from nir_render.experiments.loop.plots import draw_distances, draw_ways
from nir_render.report.drawing import Drawing, sheet, svg_of
from nir_render.report.style import FAINT, INK, MATPLOTLIB

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
        draw_ways(above, places_m, names, marked[1:], "o")
        counted = times_s > times_s[-1] - COUNTED_S
        draw_distances(
            apart, times_s, places_m, lambda d_m: bool(d_m[counted].mean() < NEIGHBOURS * plan.spacing_m)
        )
        apart.axhline(plan.spacing_m, color=INK, linewidth=0.9, linestyle="--")
        apart.axvline(times_s[-1] - COUNTED_S, color=FAINT, linewidth=0.8)
        apart.set_xlabel("time in s; what lies right of the line counts")
        apart.set_ylim(0.0, None)
        return Drawing(
            svg_of(figure), "ways of the robots from above, every 30 s a dot; distances of pairs over time"
        )
