"""The picture of a goniometer: intensity over the turn of a source, with and without its cover."""

import io

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes

from nir_render.report.style import FAINT, GOOD, GROUND, MATPLOTLIB, TRUTH
from nir_render.transport.goniometer.goniogram import Goniogram, Variation, turned, variation

_BARE = "#ff9f1c"
_WITHIN = 0.1


def polar_png(name: str, gram: Goniogram, uncovered: Goniogram | None) -> bytes:
    """Draw intensity over its mean within ±85°: around a circle, and over the angle as the paper's Exp. 2.

    `uncovered` is the same source without its cover.
    """
    drawn = [(name, gram, TRUTH)]
    if uncovered is not None:
        drawn.append(("without its cover", uncovered, _BARE))
    with mpl.rc_context(MATPLOTLIB):
        figure = Figure((11.0, 5.4), dpi=130, facecolor=GROUND, layout="constrained")
        FigureCanvasAgg(figure)
        around = figure.add_subplot(1, 2, 1, projection="polar")
        across = figure.add_subplot(1, 2, 2)
        for label, each, colour in drawn:
            _draw(around, across, label, each, colour)
        _dress(around, across)
        figure.suptitle(f"{name}: radiant intensity at {gram.distance_m:g} m", fontweight="bold")
        file = io.BytesIO()
        figure.savefig(file, format="png", metadata={"Software": None})
    return file.getvalue()


def figures_text(figures: Variation) -> str:
    """Return how much a source varies, in words."""
    reach = f"±{np.rad2deg(figures.reach_rad):.0f}°"
    return (
        f"varies by {100.0 * figures.peak_to_peak:.1f} % over {reach} (±{100.0 * figures.plus_minus:.1f} %; "
        f"at most {100.0 * figures.about_mean:.1f} % from the mean; "
        f"noise alone: {100.0 * figures.noise_alone:.2g} %)"
    )


def _draw(around: Axes, across: Axes, label: str, gram: Goniogram, colour: str) -> None:
    figures = variation(gram)
    angle_rad, intensity = turned(gram, gram.intensity_per_sr)
    _, sigma = turned(gram, gram.sigma_per_sr)
    within = np.abs(angle_rad) <= figures.reach_rad + 1e-9
    mean = float(intensity[within].mean()) or 1.0
    around.plot(angle_rad, intensity / mean, color=colour, linewidth=1.6)
    angle_deg = np.rad2deg(angle_rad)
    words = f"{label}:\n{figures_text(figures)}"
    across.plot(angle_deg, intensity / mean, color=colour, linewidth=1.4, label=words)
    low, high = (intensity - 2.0 * sigma) / mean, (intensity + 2.0 * sigma) / mean
    across.fill_between(angle_deg, low, high, color=colour, alpha=0.25, linewidth=0.0)


def _dress(around: Axes, across: Axes) -> None:
    assert isinstance(around, PolarAxes)
    around.set_theta_zero_location("N")
    around.set_theta_direction(-1)
    around.set_thetagrids(range(0, 360, 30), [f"{a if a <= 180 else a - 360}°" for a in range(0, 360, 30)])
    around.set_rlabel_position(157.5)
    turn = np.linspace(-np.deg2rad(85.0), np.deg2rad(85.0), 200)
    for level in (1.0 - _WITHIN, 1.0 + _WITHIN):
        around.plot(turn, np.full_like(turn, level), color=GOOD, linewidth=0.8, linestyle="--")
    around.set_ylim(0.0, around.get_ylim()[1])
    across.axhspan(
        1.0 - _WITHIN, 1.0 + _WITHIN, color=GOOD, alpha=0.12, label="±10 %, the paper's with its shade"
    )
    for edge_deg in (-85.0, 85.0):
        across.axvline(edge_deg, color=FAINT, linewidth=0.8, linestyle=":")
    across.set_xlim(-180.0, 180.0)
    across.set_ylim(0.0, None)
    across.set_xticks(range(-180, 181, 45))
    across.set_xlabel("turned by, degrees (dotted: ±85°)")
    across.set_ylabel("intensity over its mean within ±85°")
    across.legend(loc="upper center", bbox_to_anchor=(0.5, -0.13), fontsize=8.0)
