"""`index.html` of the limits: for each threat how far it is borne, what would win more, and maps."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from nir_render.experiments.limits.holds import LIMIT_NAME, hold_text
from nir_render.experiments.limits.outcome import Crossing, Outcome, StudyOutcome
from nir_render.experiments.limits.words import (
    best_levers,
    built_hold,
    estimators_of,
    verdict,
)
from nir_render.experiments.loop.ending import write_ending
from nir_render.report.drawing import Drawing
from nir_render.report.parts import Table, render_page
from nir_render.report.wording import counted
from nir_render.stress.metrics import METRICS, Bound
from nir_render.stress.page.maps import heat_maps
from nir_render.stress.page.words import bound_text

RULES = {
    "holds": (
        "all bounds of the study are kept at every value of the threat from its harmless end up to there; "
        "between two values the figure is taken as a straight line (its logarithm, where it is an error)."
    ),
    "in brackets": (
        "what 68 of 100 repetitions with other seeds, or with other places of the crowd, would give; without "
        "them, the two values between which the limit lies."
    ),
    LIMIT_NAME: "the Cramér–Rao bound of the same sources, of those that the last estimator ranges.",
    "received": (
        "of the packets of robots that are in view, those that the robot's own track says: one that is where "
        "the robot is. What ranges claim wrongly loses words too."
    ),
    "as built": "the value that the paper's rig has, or that the study takes for it.",
    "maps": (
        "the figure over threat × lever; dark is good. A red corner: beyond the bound. Hatched: nothing "
        "counts there; “none”: no such figure."
    ),
    "paper": (
        "the paper's mean grey value over its mask, with the constant that its own regression over 1 to 10 "
        "m gives without any threat. Where it breaks its bound at the harmless end, it is not the threat "
        "that does it."
    ),
}


@dataclass(frozen=True)
class LeverPart:
    """What the page says of one lever of a study."""

    title: str
    verdicts: Table
    table: Table
    maps: Sequence[Drawing]
    more_maps: Sequence[Drawing]


@dataclass(frozen=True)
class StudyPart:
    """What the page says of one study."""

    title: str
    description: str
    bounds: str
    expected: str
    levers: Sequence[LeverPart]


def write_outcome(outcome: Outcome, folder: Path) -> Path:
    """Write the page and `outcome.json`; return the page's path."""
    jobs = sum(of.jobs for of in outcome.studies)
    warnings = [
        f"{of.study.title}: {line}"
        for of in outcome.studies
        for line in (*((f"{counted(of.failed, 'job')} failed",) if of.failed else ()), *of.warnings)
    ]
    names = estimators_of([one for of in outcome.studies for one in of.crossings.values()])
    html = render_page(
        "experiments/limits/page.html",
        title="limits: where it breaks, and what wins it back",
        subtitle=[counted(len(outcome.studies), "study", "studies"), counted(jobs, "job"), ", ".join(names)],
        names=names,
        warnings=warnings,
        summary=_summary(outcome, names),
        studies=[_study(of) for of in outcome.studies],
        rules=RULES,
    )
    return write_ending(folder, html, outcome.record())


def sentence(outcome: Outcome) -> str:
    """Say in a line for each study how far each estimator goes as robots are built."""
    lines = []
    for of in outcome.studies:
        said = []
        for name in estimators_of(list(of.crossings.values())):
            held = hold_text(of.campaign.axes[0], built_hold(of, name), worst_is_high=of.study.worst_is_high)
            said.append(f"{name} {held}")
        lines.append(f"{of.study.title}: {'; '.join(said)}")
    return "\n".join(lines)


def _summary(outcome: Outcome, names: Sequence[str]) -> Table:
    rows = []
    for of in outcome.studies:
        cells = []
        for name in (*names, LIMIT_NAME):
            hold = built_hold(of, name)
            cells.append(
                "–"
                if hold.status == "nothing to judge"
                else hold_text(of.campaign.axes[0], hold, worst_is_high=of.study.worst_is_high)
            )
        wins = best_levers(of, names[-1])
        rows.append(
            [of.study.title, of.campaign.axes[0].title, *cells, "; ".join(wins) or "nothing that was tried"]
        )
    headings = [
        "",
        "threat",
        *(f"{name}, as built" for name in names),
        LIMIT_NAME,
        f"what wins more for {names[-1]}",
    ]
    return Table(headings, rows)


def _study(of: StudyOutcome) -> StudyPart:
    return StudyPart(
        title=of.study.title,
        description=of.campaign.description,
        bounds=" and ".join(bound_text(bound) for bound in of.campaign.bounds),
        expected=of.study.expected,
        levers=[_lever(of, crossing) for crossing in of.crossings.values()],
    )


def _lever(of: StudyOutcome, crossing: Crossing) -> LeverPart:
    names = estimators_of([crossing])
    first, *others = of.campaign.bounds
    more = [
        metric
        for metric in of.campaign.metrics
        if metric not in {bound.metric for bound in of.campaign.bounds}
    ]
    return LeverPart(
        title=crossing.lever.title,
        verdicts=Table((), [(name, verdict(of, crossing, name)) for name in names]),
        table=_table(of, crossing),
        maps=[_map(crossing, first.metric, first)],
        more_maps=[_map(crossing, bound.metric, bound) for bound in others]
        + [_map(crossing, metric, None) for metric in more],
    )


def _table(of: StudyOutcome, crossing: Crossing) -> Table:
    shown = [
        name
        for name in crossing.sums.estimators
        if any(hold.status != "nothing to judge" for hold in crossing.of(name))
    ]
    rows = [
        [
            f"{label} (as built)" if index == crossing.built else label,
            *(
                hold_text(crossing.threat, crossing.of(name)[index], worst_is_high=of.study.worst_is_high)
                for name in shown
            ),
        ]
        for index, label in enumerate(crossing.lever.labels)
    ]
    return Table([crossing.lever.title, *shown], rows)


def _map(crossing: Crossing, metric: str, bound: Bound | None) -> Drawing:
    known = METRICS[metric]
    sums = crossing.sums
    if known.limit is None or metric == "range_pull":
        names = tuple(estimators_of([crossing]))
        sums = type(sums)(sums.jobs, sums.seeds, sums.place, sums.written, names, sums.by_metric)
    svg = heat_maps(known, crossing.axes, [(0, 1)], sums, None if bound is None else bound.value)
    return Drawing(svg, f"{known.title} over {crossing.threat.title} and {crossing.lever.title}")
