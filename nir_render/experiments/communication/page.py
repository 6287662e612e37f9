"""`index.html` of the communication experiment: the paper, what came out here, the conditions, the limit."""

from pathlib import Path

import matplotlib as mpl
import numpy as np

from nir_render.experiments.communication.judge import Command
from nir_render.experiments.communication.loop import ORDER, PACKET_S, PAPERS_INTERVALS_S
from nir_render.experiments.communication.outcome import Outcome, Run, off_by_timetable_m
from nir_render.experiments.loop.controllers import COMMANDED_M
from nir_render.experiments.loop.ending import LEVEL_RULE, base_rows, frame_rows, show_run, write_ending
from nir_render.experiments.loop.plots import COLOURS, draw_distances, draw_ways
from nir_render.report.drawing import Drawing, sheet, svg_of
from nir_render.report.parts import Table, render_page
from nir_render.report.style import FAINT, INK, MATPLOTLIB
from nir_render.report.wording import counted, metres, share

RULES = {
    "met": (
        "all followers read the command; no later than 10 s after the last has read it, |d − d₀| of the "
        "worst pair of neighbours is below 5 cm and stays so for 5 s. A run is met if all its commands are, "
        "nothing else was obeyed, and no bodies touched. Neighbours are those of the start, 1 m apart."
    ),
    "bits": (
        "bits sent times receivers, each decided by itself: the mean of its samples against half of what the "
        "lit source has, by the sender's true clock. The decoder does better: it reads whole packets."
    ),
    "upper limit": "one-sided, 95 %, exact for binomial counts (Clopper and Pearson).",
    "by truth": (
        "the same seeds, each robot knowing where the others are, and each word as its packet ends: what is "
        "left is the law's and the base's."
    ),
    "level": LEVEL_RULE,
}


def write_outcome(outcome: Outcome, folder: Path) -> Path:
    """Write the page, `outcome.json`, and the film of the slowest run; return the page's path."""
    plan = outcome.plan
    slowest = max(outcome.runs, key=lambda run: max(_reached(one) for one in run.judged.commands or [_NONE]))
    title = f"communication, {plan.level}, seed {slowest.seed}"
    shown = show_run(folder, slowest.seed, plan, title)
    html = render_page(
        "experiments/loop/page.html",
        title=f"communication: {plan.robots} robots, {plan.level}",
        subtitle=[counted(len(outcome.runs), "seed"), f"{plan.lasts_s:g} s each", outcome.scene],
        sentence=sentence(outcome),
        beside=_beside(outcome),
        why=_WHY,
        timetable=_timetable(outcome),
        shown=slowest.seed,
        which="the slowest",
        files=shown,
        drawing=formation_plot(slowest),
        seeds=_seeds(outcome),
        conditions=_conditions(outcome),
        rules=RULES,
    )
    return write_ending(folder, html, outcome.record())


def sentence(outcome: Outcome) -> str:
    """Say in a sentence what was found."""
    figures = outcome.record()
    bits = "no bits were sampled"
    if figures["bits"]:
        rate = share(figures["bit_error_rate_upper_95"], more=2)
        bits = f"{figures['wrong_bits']} of {figures['bits']} bits wrong, at most {rate} (95 %)"
    return (
        f"Met in {figures['met']} of {len(outcome.runs)} runs, {figures['commands_met']} of "
        f"{figures['commands']} commands; reached {_seconds(figures['reached_latest_s'])} after the reading "
        f"at the latest; {bits}; {figures['wrong_obeyed']} wrong commands obeyed, "
        f"{figures['wrong_words']} wrong words told."
    )


_NONE = Command("", 0.0, 0.0, None, None, None)

_WHY = (
    f"A packet takes {PACKET_S:g} s: 55 bits at 10 Hz. The base goes 0.1 m/s at most and gathers speed by "
    "0.2 m/s²: 0.2 m take 2.5 s, 0.6 m 6.5 s, 0.4 m 4.5 s, if a follower need only go straight. Where "
    "sending begins at the paper's marks, an interval leaves less after its packet than the way takes: "
    "either they do not begin with the sending, or its robots were faster than it says. Below: the best of "
    "all seeds of robots that know the truth, sending begun at the marks."
)


def _timetable(outcome: Outcome) -> Table:
    ways_m = dict(zip(ORDER, (0.2, 0.6, 0.4), strict=True))
    rows = []
    for command, (begin_s, end_s), off_m in zip(
        ORDER, PAPERS_INTERVALS_S, off_by_timetable_m(outcome), strict=True
    ):
        least_s = PACKET_S + ways_m[command] / 0.1 + 0.5
        off = metres(off_m) if np.isfinite(off_m) else "–"
        rows.append(
            (f"{command}, {COMMANDED_M[command]:g} m", f"{begin_s:g} to {end_s:g} s",
             f"{end_s - begin_s:g} s", f"{least_s:g} s", off)
        )  # fmt: skip
    return Table(("", "the paper", "it has", "it takes", "worst pair off at its end, by truth"), rows)


def _beside(outcome: Outcome) -> Table:
    figures, count = outcome.record(), len(outcome.runs)
    truth = [one for run in outcome.by_truth for one in run.judged.commands]
    latest = max((_reached(one) for one in truth), default=np.inf)
    held = [one.worst_m for one in truth if one.worst_m is not None]
    rate = "–"
    if figures["bits"]:
        limit = share(figures["bit_error_rate_upper_95"], more=2)
        rate = f"{figures['wrong_bits']} of {figures['bits']}; upper 95 % limit {limit}"
    spread = ", ".join(f"{COMMANDED_M[command]:g}" for command in ORDER)
    rows = [
        ("formation", f"1.0, then {spread} m; not said how near", f"met in {figures['met']} of {count}",
         f"{sum(run.judged.met for run in outcome.by_truth)} of {count} by truth"),
        ("commands obeyed by all", "three of three",
         f"{figures['commands_read']} of {figures['commands']}", "all"),
        ("reached after the reading", "by its marks, a packet taken off: −0.5, 0.5, 0.5 s",
         f"{_seconds(figures['reached_latest_s'])} at the latest", f"{_seconds(latest)} by truth"),
        ("worst pair while held", "not said", metres(figures["worst_pair_held_m"]),
         f"{metres(max(held, default=None))} by truth"),
        ("bit error rate", "< 0.1 %", rate, _bit_limit(outcome)),
        ("packets", "not said", f"{figures['packets_received']} of {figures['packets']} read", "all"),
        ("words that were not sent", "not said", str(figures["wrong_words"]), "none"),
        ("wrong commands obeyed", "none reported", str(figures["wrong_obeyed"]), "none"),
    ]  # fmt: skip
    return Table(("", "the paper", "here", "what the law, or light, allows"), rows)


def _bit_limit(outcome: Outcome) -> str:
    """Return what white noise of the levels' σ would make of a single sample: Q(A / 2σ), the wider σ."""
    from scipy.special import log_ndtr

    dark, lit = outcome.levels("dark"), outcome.levels("lit")
    if dark is None or lit is None:
        return "–"
    ratio = (lit[1] - dark[1]) / max(dark[2], lit[2], 1e-9)
    log10 = float(log_ndtr(-0.5 * ratio)) / np.log(10.0)
    return f"10^{log10:.0f} of a sample, amplitude over σ {ratio:.0f}"


def _seeds(outcome: Outcome) -> Table:
    def row(run: Run) -> tuple[str, ...]:
        commands = run.judged.commands
        return (
            str(run.seed), "yes" if run.judged.met else "no",
            ", ".join("–" if one.read_s is None else f"{one.read_s - one.ended_s:.1f}" for one in commands),
            ", ".join("–" if one.reached_s is None else f"{one.reached_s:.1f}" for one in commands),
            ", ".join(metres(one.worst_m) for one in commands),
            f"{run.judged.received} of {run.judged.packets}",
            f"{run.record['wrong_bits']} of {run.record['bits']}",
        )  # fmt: skip

    headings = (
        "seed", "met", "read, s after the packet", "reached, s after the reading", "worst pair held",
        "packets", "wrong bits",
    )  # fmt: skip
    return Table(headings, [row(run) for run in outcome.runs])


def _conditions(outcome: Outcome) -> Table:
    plan, figures = outcome.plan, outcome.record()
    rows = [
        ("robots", f"{plan.robots}: a leader at rest, followers around it, 60° from each other"),
        ("sent", "a command every 20 s, and two packets after it that say nothing of the spacing"),
        ("the leader's clock", "off by up to 1 % (assumed)"),
        ("law", "springs to the commanded spacing, which goes there at 0.09 m/s; reach 1.3 times it"),
        ("looks", f"{1.0 / plan.period_s:g} a second"),
        *base_rows(plan),
    ]
    for name, said in figures["levels"].items():
        if said is not None:
            rows.append(
                (
                    f"{name} samples",
                    f"{said[1]:.4f} of the lit level in the mean, σ {said[2]:.4f}; {said[0]:.0f}",
                )
            )
    rows += frame_rows(plan, figures["held_light_share_largest"])
    return Table((), rows)


def formation_plot(run: Run) -> Drawing:
    """Draw the ways of all robots from above, and the distances of neighbours over time, with the words."""
    places_m, times_s = np.array(run.record["places_m"]), np.array(run.record["time_s"])
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(5.4)
        above, apart = figure.subplots(1, 2, width_ratios=[1.0, 1.4])
        draw_ways(above, places_m, run.record["robots"], [-1], "*")
        draw_distances(apart, times_s, places_m, lambda d_m: bool(d_m[0] < 1.35))
        for packet in run.record["sent"]:
            commands = packet["command"] in COMMANDED_M
            colour = COLOURS[0] if commands else FAINT
            apart.axvspan(packet["start_s"], packet["end_s"], color=colour, alpha=0.3, linewidth=0.0)
            if commands:
                apart.text(packet["start_s"], 0.06, packet["command"], fontsize=8, color=INK)
        for heard in run.judged.commands:
            if heard.read_s is not None:
                wished_m = COMMANDED_M[heard.command]
                apart.plot(
                    [heard.read_s, min(heard.read_s + 15.0, times_s[-1])], [wished_m] * 2,
                    color=INK, linestyle="--", linewidth=0.9,
                )  # fmt: skip
        apart.set_xlim(0.0, times_s[-1])
        apart.set_xlabel("time in s; packets are shaded, dashes begin where the last has read")
        apart.set_ylim(0.0, None)
        return Drawing(svg_of(figure), "ways of the robots from above; distances of pairs over time")


def _reached(one: Command) -> float:
    return np.inf if one.reached_s is None else one.reached_s


def _seconds(value: float | None) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:.1f} s"
