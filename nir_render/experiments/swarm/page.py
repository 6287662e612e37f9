"""`index.html` of the swarm: recall, ranges, words and identities against density, and what could be."""

import math
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes

from nir_render.experiments.loop.ending import BAG, write_ending
from nir_render.experiments.loop.runs import run_folder
from nir_render.experiments.loop.shares import lower_limit
from nir_render.experiments.swarm.film import show_run
from nir_render.experiments.swarm.hall import BODIES
from nir_render.experiments.swarm.judge import WHYS
from nir_render.experiments.swarm.outcome import Condition, Outcome
from nir_render.export.mcap_file import export_mcap
from nir_render.report.drawing import Drawing, legend, sheet, svg_of
from nir_render.report.parts import Table, render_page
from nir_render.report.style import FAINT, INK, MATPLOTLIB
from nir_render.report.wording import counted, metres, share
from nir_render.run.folder import POSES

RULES = {
    "ceiling": (
        "the share of lit robots that stand free by truth: 99 % of the source seen or more (eclipsed: half "
        "or more; hidden: less), its centre 3 px or more within the frame (else cut), peak SNR 5 or more "
        "(else faint), and no other that brings a tenth of its light or more within 2 px (else merged). The "
        "best of the four cameras counts."
    ),
    "recall": (
        "robots that are lit, of which a detection is within 3 px; of all, those that are hidden, cut, faint "
        "and merged too, and of those that stand free. False alarms are of no robot, lamp or mirror image; "
        "parts are further detections of a robot of which a column hides a part, and which has one already: "
        "a disc with a dark edge through it is taken for several, each merged, of hardly known range."
    ),
    "ranges": (
        "of robots that stand free and are lit all through the exposure, held against the Cramér–Rao bound "
        "of these very frames, flares that overlap told apart: 1 is as good as can be. typical: the "
        "median of the errors in place of their mean square. σ is what the detector claims."
    ),
    "what ranges claim": (
        "of all that are lit all through the exposure, by how they can be seen: how many have a detection, a "
        "range with a σ, and the truth within three of them. Error and σ are shares of the range, in the "
        "median. Who is eclipsed, hidden or merged shows a part of its light, or more than it: its range may "
        "be far off, and its σ is to say so."
    ),
    "packets": (
        "sent in full while the observer looked; received if the track of that robot says the word, read in "
        "all five frames or in some. A word that another one sent just then is misattributed, one that "
        "nobody sent is wrong. Tracks: of whom they are by truth, within five σ; off are those on the "
        "bearing of a robot that is partly hidden, or has another within 4 px: its flux says a wrong range."
    ),
    "identity": (
        "each says its number once a minute: one word up to 128 robots, beyond that two, one after the "
        "other. Who says only one of two, or what is nobody's, is refused."
    ),
    "masts, columns": (
        "masts: hulls end below all lines of sight, and sources merge. columns: hulls of 0.1 m reach up "
        "to 2.5 cm below the source, and hide those behind, in part or whole."
    ),
    "light": (
        "direct light is each robot's own, in closed form. Indirect light of the faintest shares one image, "
        "driven by the mean of their drives: off by no more than the share said here of the noise's variance."
    ),
}

_COLOURS = dict(
    zip(WHYS, ("#2ec27e", "#ffd166", "#f72585", "#b392f0", FAINT, "#5e9bff", "#ff9f1c"), strict=True)
)


def write_outcome(outcome: Outcome, folder: Path) -> Path:
    """Write the page and `outcome.json`; return the page's path."""
    figures = outcome.record()
    shown = (
        outcome.conditions[len(outcome.conditions) // 2 - 1]
        if len(outcome.conditions) > 1
        else outcome.conditions[0]
    )
    run = run_folder(folder / shown.name, shown.records[0]["seed"])
    film, picture = show_run(run, folder)
    bag = None
    if find_spec("mcap") is not None and (run / POSES).is_file():
        bag = BAG
        export_mcap(run, folder / BAG)
    html = render_page(
        "experiments/swarm/page.html",
        title=f"swarm: {outcome.robots} robots",
        subtitle=[
            counted(len(outcome.seeds), "seed"),
            f"{shown.plan.lasts_s:g} s each",
            shown.plan.level,
            outcome.scene,
        ],
        sentence=sentence(outcome),
        seen=_seen(figures),
        ranges=_ranges(figures),
        claims=_claims(figures),
        heard=_heard(figures),
        took=_took(outcome, figures),
        against=density_plot(figures),
        above=above_plot(shown),
        film=film,
        picture=picture,
        bag=bag,
        shown=f"{shown.plan.bodies}, {shown.plan.density_per_m2:g} per m², seed {shown.records[0]['seed']}",
        conditions=_conditions(outcome),
        rules=RULES,
    )
    return write_ending(folder, html, figures)


def sentence(outcome: Outcome) -> str:
    """Say in a sentence what was found."""
    conditions = outcome.record()["conditions"]
    found, lit, free, free_found, packets, received, right, full, bad = (
        sum(one[name] for one in conditions)
        for name in (
            "found", "lit", "free", "free_found", "packets", "packets_received", "identities_right",
            "told_in_full", "identities_wrong",
        )
    )  # fmt: skip
    seen = ""
    if lit:
        seen = (
            f"Of {lit} sights of lit robots {_part(found, lit)} were found; {_part(free, lit)} stood free, "
            f"and of these {_part(free_found, free)} were found. "
        )
    return (
        f"{seen}{received} of {packets} packets received; who it is was told of {right} of {full}, "
        f"wrongly {counted(bad, 'time')}."
    )


def _where(one: dict[str, Any]) -> tuple[str, str]:
    return one["bodies"], f"{one['density_per_m2']:g}"


def _seen(figures: dict[str, Any]) -> Table:
    rows = []
    for one in figures["conditions"]:
        could = one["could_be_seen"]
        rows.append(
            (*_where(one), _part(one["found"], one["lit"]), _part(one["free"], one["lit"]),
             _of(one["free_found"], one["free"]),
             *(share(could[why], more=1) for why in ("eclipsed", "merged", "hidden", "faint", "cut")),
             share(one["within_4_px"], more=1), f"{one['false_alarms']} in {one['sets_judged']}",
             f"{one['parts']} in {one['sets_judged']}")
        )  # fmt: skip
    headings = (
        "bodies", "per m²", "recall", "ceiling: stand free", "found of the free", "eclipsed", "merged",
        "hidden", "faint", "cut", "another within 4 px", "false alarms in sets",
        "parts in sets",
    )  # fmt: skip
    return Table(headings, rows)


def _ranges(figures: dict[str, Any]) -> Table:
    rows = []
    for one in figures["conditions"]:
        said = one["range"]
        rows.append(
            (*_where(one), f"{said['number']:.0f}", f"{said['unranged']:.0f}",
             *(metres(said[name]) for name in ("rmse_m", "limit_m")),
             *(_number(said[name]) for name in ("of_limit", "typical_of_limit", "bias_sigmas", "of_sigma")))
        )  # fmt: skip
    headings = (
        "bodies", "per m²", "ranges", "found without one", "RMSE", "RMS of the limit",
        "error over limit, RMS", "typical", "bias, of limits",
        "error over σ, RMS",
    )  # fmt: skip
    return Table(headings, rows)


def _claims(figures: dict[str, Any]) -> Table:
    rows = []
    for one in figures["conditions"]:
        for why, said in one["ranges_by_sight"].items():
            counts = [int(said[name]) for name in ("lit", "found", "ranged", "within_3_sigmas")]
            if counts[0]:
                rows.append(
                    (*_where(one), why, str(counts[0]), _part(counts[1], counts[0]), str(counts[2]),
                     _part(counts[3], counts[2]), _number(said["of_sigma"]),
                     *(_percent(said[name]) for name in ("off_typical", "sigma_typical")))
                )  # fmt: skip
    headings = (
        "bodies", "per m²", "seen as", "lit", "found", "ranges", "within 3 σ", "error over σ, RMS",
        "typical error", "typical σ",
    )  # fmt: skip
    return Table(headings, rows)


def _heard(figures: dict[str, Any]) -> Table:
    rows = []
    for one in figures["conditions"]:
        by_sight = [one["packets_by_sight"].get(why, (0, 0)) for why in ("free", "merged", "hidden")]
        rows.append(
            (*_where(one), _of(one["packets_received"], one["packets"]),
             *(f"{received} of {sent}" if sent else "–" for sent, received in by_sight),
             str(one["misattributed"]), str(one["wrong_words"]),
             f"{one['identities_right']} of {one['told_in_full']}", str(one["identities_wrong"]),
             *(str(one[name]) for name in ("tracks", "tracks_off", "tracks_of_nobody", "tracks_twice")))
        )  # fmt: skip
    headings = (
        "bodies", "per m²", "packets received", "from the free", "from the merged", "from the hidden",
        "misattributed", "wrong words", "identities right", "identities wrong",
        "tracks at the end", "off, on its bearing", "of nobody", "of one robot twice",
    )  # fmt: skip
    return Table(headings, rows)


def _took(outcome: Outcome, figures: dict[str, Any]) -> Table:
    rows = []
    for one in figures["conditions"]:
        took = one["seconds"]
        parts = [took[name] for name in ("expose", "detect", "follow")]
        each = "–"
        known = [part for part in parts if part is not None]
        if len(known) == len(parts):
            each = f"{1e6 * sum(known) / (4 * outcome.robots):.0f} µs"
        rows.append(
            (*_where(one), _seconds(took["light_of_a_set"]), *(_seconds(part) for part in parts), each,
             share(one["shared_light_worst"], more=1), share(one["shared_light_mean"], more=1))
        )  # fmt: skip
    headings = (
        "bodies", "per m²", "light of four cameras", "expose a set", "detect", "follow and read",
        "a robot and frame", "shared light: worst block", "mean",
    )  # fmt: skip
    return Table(headings, rows)


def _conditions(outcome: Outcome) -> Table:
    plan = outcome.conditions[0].plan
    rows = [
        ("robots", f"{outcome.robots} in a square hall, anywhere, 0.3 m apart at least; all stand"),
        ("observer", f"in the middle; {plan.rate_hz:g} sets of four frames a second for {plan.lasts_s:g} s"),
        (
            "light",
            "walls, floor, hulls, panels of white LEDs at 500 lx; rendered once a run, exposed set by set",
        ),
        ("judged", f"{len(plan.judged)} sets of each run against truth; all packets"),
        ("sent", "who it is, once a minute each, at a time of its own; clocks off by up to 1 % (assumed)"),
        ("stack", "robust"),
    ]
    return Table((), rows)


def density_plot(figures: dict[str, Any]) -> Drawing:
    """Draw recall and its ceiling, errors over the limit, and packets received, against density."""
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(3.6)
        recall, ranges, heard = figure.subplots(1, 3)
        for bodies, colour in zip(BODIES, ("#2ec27e", "#5e9bff"), strict=True):
            some = [one for one in figures["conditions"] if one["bodies"] == bodies]
            if not some:
                continue
            at = [one["density_per_m2"] for one in some]
            _line(recall, at, [_ratio(one["found"], one["lit"]) for one in some], colour, bodies)
            ceiling = [_ratio(one["free"], one["lit"]) for one in some]
            recall.plot(at, ceiling, "--", color=colour, linewidth=0.9)
            _line(ranges, at, [one["range"]["of_limit"] or math.nan for one in some], colour, bodies)
            received = [_ratio(one["packets_received"], one["packets"]) for one in some]
            _line(heard, at, received, colour, bodies)
            free = [one["could_be_seen"]["free"] for one in some]
            heard.plot(at, free, "--", color=colour, linewidth=0.9)
        recall.set_ylabel("found, of lit robots; dashes: stand free")
        ranges.set_ylabel("error of ranges over the limit, RMS")
        ranges.axhline(1.0, color=FAINT, linewidth=0.9)
        heard.set_ylabel("packets received; dashes: senders stand free")
        for axes in (recall, heard):
            axes.set_ylim(0.0, 1.02)
        ranges.set_ylim(0.0, None)
        for axes in (recall, ranges, heard):
            axes.set_xlabel("robots per m²")
            axes.set_xlim(0.0, 1.1 * max(one["density_per_m2"] for one in figures["conditions"]))
            legend(axes)
        return Drawing(svg_of(figure), "recall, ranges and packets against density")


def _line(axes: Axes, at: Sequence[float], values: Sequence[float], colour: str, label: str) -> None:
    axes.plot(at, values, "o-", color=colour, markersize=4, linewidth=1.2, label=label)


def above_plot(condition: Condition) -> Drawing:
    """Draw the hall of a run from above: how each robot can be seen, and whom the observer identified."""
    record = condition.records[0]
    places_m = np.array(record["places_m"])
    right = set(record["identities"]["right"])
    heard = {packet[0] for packet in record["packets"] if packet[3]}
    with mpl.rc_context(MATPLOTLIB):
        figure = sheet(6.4)
        axes = figure.subplots()
        size = float(np.clip(60.0 / math.sqrt(len(places_m)), 2.0, 7.0))
        for why in WHYS:
            some = [number for number, one in enumerate(record["standing"], 1) if one[1] == why]
            if some:
                look: dict[str, Any] = {"color": _COLOURS[why], "markersize": size, "linestyle": "none"}
                axes.plot(*places_m[some].T, "o", **look, label=f"{why}: {len(some)}")
        for names, marker, label in ((heard, "+", "a packet received"), (right, "s", "identity told")):
            some = [number for number, one in enumerate(record["standing"], 1) if one[0] in names]
            if some:
                look = {"markeredgecolor": INK, "markersize": 2.0 + size, "linestyle": "none"}
                axes.plot(*places_m[some].T, marker, color="none", **look, markeredgewidth=0.7, label=label)
        axes.plot(*places_m[0], "*", color=INK, markersize=12, label="the observer")
        axes.set_aspect("equal")
        axes.set_xlabel("x in m")
        axes.set_ylabel("y in m")
        axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
        return Drawing(
            svg_of(figure), "the hall from above: how each robot can be seen, who was heard and identified"
        )


def _of(number: int, of: int) -> str:
    return f"{number} of {of}; at least {share(lower_limit(number, of), more=1)}" if of else "–"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f}"


def _percent(value: float | None) -> str:
    return "–" if value is None else share(value, more=1)


def _seconds(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g} s"


def _ratio(number: int, of: int) -> float:
    return number / of if of else math.nan


def _part(number: int, of: int) -> str:
    return share(number / of, more=1) if of else "–"
