"""What plots of closed loops share: the ways of robots from above, and the distances of pairs over time."""

from collections.abc import Callable, Sequence

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from nir_render.report.style import FAINT

COLOURS = ("#ffd166", "#5e9bff", "#2ec27e", "#f72585", "#b392f0", "#ff9f1c", "#4cc9f0", "#c8553d")

Array = NDArray[np.float64]


def draw_ways(above: Axes, places_m: Array, names: Sequence[str], at: Sequence[int], marker: str) -> None:
    """Draw the way of each robot, a ring where it begins, and a mark at some of the times.

    Parameters
    ----------
    places_m
        Shape (times, robots, 2).
    at
        The numbers of the times that have a mark, drawn as Matplotlib's `marker`.
    """
    for number, name in enumerate(names):
        colour = COLOURS[number % len(COLOURS)]
        above.plot(*places_m[:, number].T, color=colour, linewidth=1.0, label=name)
        above.plot(*places_m[0, number], "o", color="none", markeredgecolor=colour, markersize=7)
        size = 9 if marker == "*" else 5
        above.plot(*places_m[list(at), number].T, marker, color=colour, markersize=size)
    above.set_aspect("equal")
    above.set_xlabel("x in m")
    above.set_ylabel("y in m")
    above.legend(fontsize=8, loc="best")


def draw_distances(apart: Axes, times_s: Array, places_m: Array, is_near: Callable[[Array], bool]) -> None:
    """Draw the distance of each pair over time, blue where the pair are neighbours by its distances."""
    for one in range(places_m.shape[1]):
        for other in range(one):
            d_m = np.hypot(*(places_m[:, one] - places_m[:, other]).T)
            apart.plot(times_s, d_m, color=COLOURS[1] if is_near(d_m) else FAINT, linewidth=0.9)
    apart.set_ylabel("distance of each pair in m; neighbours are blue")
