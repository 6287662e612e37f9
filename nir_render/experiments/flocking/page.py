"""`index.html` of an experiment: the paper's figures, ours, their conditions, and what truth would allow."""

import math
from pathlib import Path

import numpy as np

from nir_render.experiments.flocking.loop import Run
from nir_render.experiments.flocking.outcome import Outcome
from nir_render.experiments.flocking.plots import flock_plot
from nir_render.experiments.loop.ending import LEVEL_RULE, base_rows, frame_rows, show_run, write_ending
from nir_render.report.parts import Table, render_page
from nir_render.report.wording import counted, metres

RULES = {
    "spacing error": (
        "mean of |d − d₀| over the last 60 s and over neighbours, pairs whose mean distance is below 1.2 d₀. "
        "It counts only where neighbours join all robots and no two bodies touch. The paper gives a figure "
        "and no definition."
    ),
    "spread": "largest less smallest of the neighbours' mean distances.",
    "by truth": (
        "the same seeds, each robot knowing where the others are and how they move: what is left is the "
        "law's."
    ),
    "level": LEVEL_RULE,
    "law": (
        "robust: springs at rest at the wished spacing. paper: separation, alignment and cohesion at the "
        "paper's ranges and weights, in the forms that come nearest to what it reports; it keeps neighbours "
        "at 0.8 m, and the mean of all pairs near 1 m."
    ),
    "held light": (
        "indirect light is rendered at intervals and held between them: the mean square of what that was off "
        "at their ends, over the variance of shot and read noise."
    ),
}


def write_outcome(outcome: Outcome, folder: Path) -> Path:
    """Write the page, `outcome.json`, and the film of the run in the middle; return the page's path."""
    order = np.argsort(outcome.errors_m(), kind="stable")
    middle = outcome.runs[int(order[(len(order) - 1) // 2])]
    plan = outcome.plan
    title = f"flocking, {plan.level}, law {plan.law}, seed {middle.seed}"
    shown = show_run(folder, middle.seed, plan, title)
    html = render_page(
        "experiments/loop/page.html",
        title=f"flocking: law {plan.law}, {plan.level}",
        subtitle=[counted(len(outcome.runs), "seed"), f"{plan.lasts_s:g} s each", outcome.scene],
        sentence=sentence(outcome),
        beside=_beside(outcome),
        timetable=None,
        shown=middle.seed,
        which="in the middle of all",
        files=shown,
        drawing=flock_plot(middle, plan),
        seeds=_seeds(outcome),
        conditions=_conditions(outcome),
        rules=RULES,
    )
    return write_ending(folder, html, outcome.record())


def sentence(outcome: Outcome) -> str:
    """Say in a sentence what was found."""
    figures, count = outcome.record(), len(outcome.runs)
    return (
        f"Spacing error below 5 cm in {figures['below_5_cm']} of {count} runs, "
        f"{metres(figures['spacing_error_median_m'])} in the median, "
        f"{metres(figures['loss_against_truth_median_m'])} of it more than by truth; "
        f"neighbours' mean distances within 5 cm of each other in {figures['spread_below_5_cm']}; "
        f"bodies touched in {figures['touched']}."
    )


def _beside(outcome: Outcome) -> Table:
    figures, count = outcome.record(), len(outcome.runs)
    truth = [run.spacing.error_m for run in outcome.by_truth if run.spacing.valid]
    middle, most = figures["spacing_error_median_m"], figures["spacing_error_largest_m"]
    below = f"below 5 cm in {figures['below_5_cm']} of {count}"
    by_truth = metres(float(np.median(truth)) if truth else None)
    apart_m = math.fsum(run.spacing.all_pairs_m for run in outcome.by_truth) / count
    found = f"{metres(middle)} in the median, {metres(most)} at most; {below}"
    pairs = f"{metres(figures['mean_distance_of_all_pairs_m'])}, all pairs"
    rows = [
        ("spacing error", "< 5 cm, not defined", found, f"{by_truth} by truth"),
        ("average distance", "1 m, of whom is not said", pairs, f"{metres(apart_m)} by truth"),
        ("bodies that touch", "none reported", f"in {figures['touched']} of {count}", "none"),
    ]
    return Table(("", "the paper", "here", "what the law allows"), rows)


def _seeds(outcome: Outcome) -> Table:
    def row(run: Run, known: Run) -> tuple[str, ...]:
        one = run.spacing
        return (
            str(run.seed), metres(one.error_m), metres(one.bias_m, signed=True), metres(one.spread_m),
            metres(one.worst_m), metres(one.all_pairs_m), metres(one.nearest_m),
            "yes" if one.joined else "no", "yes" if one.touched else "no", metres(known.spacing.error_m),
        )  # fmt: skip

    headings = (
        "seed", "spacing error", "bias", "spread", "worst instant", "all pairs", "nearest ever", "one flock",
        "touched", "by truth",
    )  # fmt: skip
    return Table(headings, [row(*each) for each in zip(outcome.runs, outcome.by_truth, strict=True)])


def _conditions(outcome: Outcome) -> Table:
    plan = outcome.plan
    rows = [
        ("robots", "a leader on a way of its own, and those that follow; starts within 1.8 m of it"),
        ("the leader", f"goes {plan.leader_m_per_s:g} m/s"),
        ("wished spacing", metres(plan.spacing_m)),
        ("looks", f"every {plan.period_s:g} s"),
        *base_rows(plan),
        *frame_rows(plan, outcome.record()["held_light_share_largest"]),
    ]
    return Table((), rows)
