"""`index.html` of the range experiment: the paper's figures, both stacks', the limit, and why."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

from nir_render.experiments.loop.ending import write_ending
from nir_render.experiments.standing.rail_outcome import CALIBRATED_LX, Outcome, held_out
from nir_render.experiments.standing.sightings import STACKS
from nir_render.report.drawing import Drawing, legend, sheet, svg_of
from nir_render.report.parts import Table, render_page
from nir_render.report.style import FAINT, MATPLOTLIB, look
from nir_render.report.wording import counted, metres, share
from perception.calibration.result import IDEAL_MAE

RULES = {
    "MAE": (
        "mean absolute error of the range at every other place, with constants that were fitted at the "
        "places between, at one level of light."
    ),
    "limit": (
        "the MAE of an estimator without bias at the Cramér–Rao bound of these very frames, √(2/π) of it."
    ),
    "found": "a detection within 3 px of the source, or its image's radius.",
    "places": (
        "where it is found in every frame: frames of one place share its light, and are no trials of "
        "their own. Their share has a lower limit, one-sided, 95 %, exact for binomial counts."
    ),
    "false alarms": "detections that are neither of the source nor of a lamp.",
    "robust": "maximum likelihood of the whole flare: place, range, and background together.",
    "paper": "its mask, its mean grey value, and the slope of its regression of m against 1/d².",
}

_WHY = (
    "The paper ranges by the mean grey value over its mask. The flux falls by 1/d², the mean over a mask "
    "does not: near by the disc of the source is resolved and keeps its grey value, and farther off the "
    "mask, all that is above twice the frame's mean, shrinks with the flare and leaves its skirt out. The "
    "regression of m against 1/d² is led by the nearest places, and its line misses the origin, here by "
    "{sigmas:.0f} σ at most. Over 1 to 10 m no constant makes up for that. What it reports could be had over "
    "a short span about where its constant was fitted, or with a flare whose mask does not change. What it "
    "does not find fails its tests of area (> 4 px) and aspect (0.8 to 1.2), or is not above its threshold."
)


def write_outcome(outcome: Outcome, folder: Path) -> Path:
    """Write the page and `outcome.json`; return the page's path."""
    figures = outcome.record()
    html = render_page(
        "experiments/standing/page.html",
        title="calibration: ranges along a rail",
        subtitle=[counted(len(outcome.judged), "seed"), f"{figures['frames']} frames", outcome.scene],
        sentence=sentence(outcome),
        beside=_beside(figures),
        why=_WHY.format(sigmas=figures["intercept_largest_sigmas"]),
        drawing=error_plot(outcome),
        parts_title="By level of light",
        parts=_levels(figures),
        conditions=_conditions(outcome),
        rules=RULES,
    )
    return write_ending(folder, html, figures)


def sentence(outcome: Outcome) -> str:
    """Say in a sentence what was found."""
    figures = outcome.record()
    said = ", ".join(f"{name} {metres(figures['stacks'][name]['mae_m'])}" for name in STACKS)
    found = ", ".join(
        f"{name} {figures['stacks'][name]['found']} of {figures['stacks'][name]['frames']}" for name in STACKS
    )
    return (
        f"Mean absolute error of the range over 1 to 10 m: {said}; the limit is "
        f"{metres(figures['ideal_mae_m'])}. Found: {found}."
    )


def _beside(figures: dict[str, Any]) -> Table:
    stacks = figures["stacks"]
    rows = [
        ("range MAE, 1 to 10 m", "2.8 cm", *(metres(stacks[name]["mae_m"]) for name in STACKS),
         metres(figures["ideal_mae_m"])),
        ("bias", "not said", *(metres(stacks[name]["bias_m"], signed=True) for name in STACKS), "none"),
        ("of places held out: found without a range", "not said",
         *(str(stacks[name]["without_a_range"]) for name in STACKS), "0"),
        ("detection, 300 to 800 lx", "> 99.8 %", *(_found(stacks[name]) for name in STACKS), "100 %"),
        ("false alarms", "not said", *(str(stacks[name]["false_alarms"]) for name in STACKS), "0"),
    ]  # fmt: skip
    return Table(("", "the paper", "stack paper, here", "stack robust, here", "physical limit"), rows)


def _found(figures: dict[str, Any]) -> str:
    return f"{_of(figures)} frames; {_places(figures)}"


def _of(figures: dict[str, Any]) -> str:
    return f"{figures['found']} of {figures['frames']}"


def _places(figures: dict[str, Any]) -> str:
    least = share(figures["places_lower_95"], more=1)
    return f"{figures['places_found']} of {figures['places']} places, at least {least}"


def _levels(figures: dict[str, Any]) -> Table:
    rows = [
        (f"{lux} lx", name, metres(one["mae_m"]), metres(one["rmse_m"]),
         metres(one["bias_m"], signed=True), _of(one), _places(one),
         str(one["false_alarms"]))
        for lux, stacks in figures["levels_lx"].items()
        for name, one in stacks.items()
    ]  # fmt: skip
    headings = ("level", "stack", "MAE", "RMSE", "bias", "found", "in every frame", "false alarms")
    return Table(headings, rows)


def _conditions(outcome: Outcome) -> Table:
    plan = outcome.plan
    rows = [
        ("hall", "12 × 6 m, panels of white LEDs, grey walls (assumed)"),
        ("places", f"{plan.places} a seed, one in each part of 1 to 10 m, up to 15° aside"),
        ("frames", f"{plan.frames} at each place and level, rendered with walls and panels, exposed, read"),
        (
            "exposure",
            "the brightest pixel at 70 % of full scale, 20 µs to 5 ms, as automatic exposure has it",
        ),
        ("constants", f"fitted at every other place, at {CALIBRATED_LX:g} lx or the level nearest to it"),
    ]
    return Table((), rows)


def error_plot(outcome: Outcome) -> Drawing:
    """Draw every error of the range, and the bound."""
    held = held_out(outcome.frames())
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(4.6)
        axes = figure.subplots()
        for name in STACKS:
            said = [(one.range_m, abs(one.said_m[name] - one.range_m)) for one in held if name in one.said_m]
            if said:
                marker, colour = look(name, STACKS)
                axes.plot(*np.array(said).T, marker, color=colour, markersize=3, linestyle="none", label=name)
        order = sorted((one.range_m, IDEAL_MAE * one.limit_m) for one in held)
        axes.plot(*np.array(order).T, color=FAINT, linewidth=1.2, label="MAE at the limit")
        axes.axhline(0.028, color=FAINT, linewidth=0.9, linestyle="--", label="the paper's 2.8 cm")
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")  # style has formulas off
        axes.set_ylim(1e-4, None)
        axes.set_xlabel("range in m")
        axes.set_ylabel("absolute error of the range in m")
        legend(axes)
        return Drawing(svg_of(figure), "absolute error of the range against the range, both stacks")
