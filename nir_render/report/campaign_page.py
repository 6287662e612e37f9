"""The page of a campaign: where each estimator keeps its bounds, where not, and by how much."""

import math
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import pyarrow as pa

from nir_render.report.campaign_figures import figure_sections, figures_shown
from nir_render.report.campaign_tables import (
    axes_table,
    false_alarms_table,
    overall_table,
    render_noise_sentence,
    worst_table,
)
from nir_render.report.campaign_words import bound_text, corner_text, figure_text, sentence_of, verdict_text
from nir_render.report.parts import facts_table, mark, page, table
from nir_render.report.wording import counted, share, significant
from nir_render.stress.campaign import Campaign
from nir_render.stress.figures import FIGURES
from nir_render.stress.limits import Limit, corners_kept, limits_of
from nir_render.stress.repeats import LEAST_OF_ONE, repeated_in_corners, repetitions
from nir_render.stress.sums import ASKED, COUNT, LIMIT, LIMITED, TOTAL, JobSums, job_sums

_MOST_WARNINGS = 12
_MOST_LETTERS = 400
"""These bound the size of the page."""


def campaign_html(campaign: Campaign, rows: pa.Table, facts: Mapping[str, Any]) -> str:
    """Write the page.

    Parameters
    ----------
    campaign
        What was asked.
    rows
        Its table: a row per frame, per source in view, per ghost and per false alarm, for each estimator.
    facts
        How it was made. `commands` holds, by job, the command that renders it as a run of its own;
        `warnings` lines for the reader; `failed` what was not done, `{"job": …, "error": …}` each. All else
        is shown as it stands.

    Returns
    -------
    An HTML document that needs no network and no scripts. Whatever comes from outside is escaped in it.
    """
    axes, sums = campaign.axes, job_sums(campaign.axes, rows)
    seed = campaign.seeds[0] if campaign.seeds else 0
    limits = limits_of(axes, campaign.bounds, sums, seed)
    again = repetitions(sums.place, seed)
    frames = _frames(sums)
    subtitle = [
        f"{counted(len(sums.jobs), 'job')}, {counted(frames, 'frame')}",
        " × ".join(f"{axis.title} ({len(axis.labels)})" for axis in axes),
        counted(len(campaign.seeds), "seed"),
        f"estimators: {', '.join(sums.estimators) or 'none'}",
    ]
    body = [
        f"<p>{escape(campaign.description)}</p>" if campaign.description else "",
        _warnings(facts),
        _summary(campaign, sums, limits),
        "<h2>Over the whole campaign</h2>" + overall_table(sums),
        _limits(campaign, sums, limits),
        *figure_sections(campaign, sums, again),
        _worst(campaign, sums, facts),
        "<h2>False alarms</h2>" + false_alarms_table(rows, sums),
        "<h2>Render noise</h2>" + render_noise_sentence(rows),
        _made(campaign, facts),
    ]
    return page(campaign.name, subtitle, body)


def _frames(sums: JobSums) -> int:
    return int(sums.of[sums.estimators[0], "false_alarms"][ASKED].sum()) if sums.estimators else 0


def _warnings(facts: Mapping[str, Any]) -> str:
    lines = [str(line) for line in facts.get("warnings", ())]
    failed = list(facts.get("failed", ()))
    if failed:
        first = failed[0]
        said = first.get("error", first) if isinstance(first, Mapping) else first
        lines.insert(
            0, f"{counted(len(failed), 'job')} failed, missing in all figures here. The first: {said}"
        )
    more = len(lines) - _MOST_WARNINGS
    shown = [line[:_MOST_LETTERS] for line in lines[:_MOST_WARNINGS]] + (
        [f"… and {more} more"] if more > 0 else []
    )
    return "".join(f'<p class="warning">{escape(line)}</p>' for line in shown)


def _summary(campaign: Campaign, sums: JobSums, limits: Sequence[Limit]) -> str:
    """Say it in words, made from the numbers."""
    parts = [f"<p>{escape(' '.join(_overall_sentence(sums, name) for name in sums.estimators))}</p>"]
    compared = _compared(sums)
    if compared:
        parts.append(f"<p>{escape(compared)}</p>")
    for bound in campaign.bounds:
        lines = []
        for name in sums.estimators:
            own = [limit for limit in limits if limit.bound == bound and limit.estimator == name]
            said = sentence_of(campaign.axes, own, corners_kept(bound, name, sums))
            lines.append(f"<li>{mark(name, sums.estimators)} <b>{escape(name)}</b> {escape(said)}</li>")
        parts.append(f'<p class="bound"><b>{escape(bound_text(bound))}</b></p>')
        parts.append(f'<ul class="plain">{"".join(lines)}</ul>')
    return "<h2>In short</h2>" + "".join(parts)


def _overall_sentence(sums: JobSums, name: str) -> str:
    recall, ranged, rmse, bias = (
        _overall(sums, name, figure) for figure in ("recall", "ranged", "range_rmse", "range_bias")
    )
    asked = int(sums.of[name, "recall"][ASKED].sum())
    if not asked:
        return f"{name} met no source that counts: there is nothing to judge."
    if not math.isfinite(rmse):
        return f"{name} finds {share(recall)} of {counted(asked, 'source')}, and gives none a range."
    own = sums.of[name, "range_rmse"].sum(axis=1)
    limit = float(FIGURES["range_rmse"].value(own[LIMIT], own[LIMITED]))
    at_limit = ""
    if limit > 0.0:
        at_limit = f", {significant(rmse / limit)} × the physical limit of {figure_text('range_rmse', limit)}"
    return (
        f"{name} finds {share(recall)} of {counted(asked, 'source')} and ranges {share(ranged)}, with an RMS "
        f"error of {figure_text('range_rmse', rmse)} (bias {figure_text('range_bias', bias)}){at_limit}."
    )


def _compared(sums: JobSums) -> str:
    if not {"paper", "robust"} <= set(sums.estimators):
        return ""
    paper, robust = (_overall(sums, name, "range_rmse") for name in ("paper", "robust"))
    if not (math.isfinite(paper) and math.isfinite(robust) and min(paper, robust) > 0.0):
        return ""
    more, less = ("paper", "robust") if paper >= robust else ("robust", "paper")
    ratio = max(paper, robust) / min(paper, robust)
    return (
        f"Over all, the range errors of {more} are {significant(ratio)} × those of {less}, each of the "
        "sources that it ranges."
    )


def _overall(sums: JobSums, name: str, figure: str) -> float:
    own = sums.of[name, figure].sum(axis=1)
    return float(FIGURES[figure].value(own[TOTAL], own[COUNT]))


def _limits(campaign: Campaign, sums: JobSums, limits: Sequence[Limit]) -> str:
    if not campaign.bounds:
        return "<h2>Limits</h2><p>The campaign states no bounds: there are no limits to tell.</p>"
    parts = ["<h2>Limits</h2>", f"<p class='faint'>{_how_sure(sums)}</p>"]
    for bound in campaign.bounds:
        rows = []
        for index, axis in enumerate(campaign.axes):
            row = [escape(axis.title)]
            for name in sums.estimators:
                limit = next(
                    one for one in limits if (one.bound, one.axis, one.estimator) == (bound, index, name)
                )
                row += [_pooled_cell(campaign, limit), _worst_cell(campaign, limit)]
            rows.append(row)
        headings = [
            "along",
            *(
                f"{name}: {what}"
                for name in sums.estimators
                for what in ("all corners together", "worst corner")
            ),
        ]
        parts.append(f"<h3>{escape(bound_text(bound))}</h3>")
        parts.append(table(headings, rows, text=range(len(headings))))
    return "\n".join(parts)


def _pooled_cell(campaign: Campaign, limit: Limit) -> str:
    figure = FIGURES[limit.bound.figure]
    text = _worded(verdict_text(campaign.axes[limit.axis], limit.pooled), limit.pooled.status)
    worst = limit.pooled.worst
    if limit.pooled.status in ("in part", "nowhere") and math.isfinite(worst):
        said = figure_text(figure.name, worst, limit.bound.value)
        text += f'<br><span class="faint">worst {escape(said)}</span>'
    asked, count = sum(point.asked for point in limit.points), sum(point.count for point in limit.points)
    if figure.kind == "source" and not figure.higher_is_better and count < 0.95 * asked:
        text += f'<br><span class="faint">of {share(count / asked)} of the sources</span>'
    return text


def _worst_cell(campaign: Campaign, limit: Limit) -> str:
    if limit.worst is None:
        return '<span class="faint">there is but one</span>' if limit.slices else "nothing to judge"
    text = _worded(verdict_text(campaign.axes[limit.axis], limit.worst), limit.worst.status)
    where = corner_text(campaign.axes, limit.corner)
    kept = f"kept all along in {limit.slices_kept} of {limit.slices}"
    return f'{text}<br><span class="faint">{escape(where)}; {kept}</span>'


def _worded(text: str, status: str) -> str:
    level = {"throughout": "good", "wherever judged": "good", "in part": "fair", "nowhere": "bad"}.get(
        status, "none"
    )
    return f'<span class="word {level}">{escape(text)}</span>'


def _how_sure(sums: JobSums) -> str:
    corner = (
        "A limit is where the figure crosses the bound, between two values of the axis. “All corners "
        "together” pools everything else that was varied; it hides the corners (combinations of the other "
        "axes' values), so the worst of them stands beside it. Where nothing counts, or an estimator gives "
        "no range, no bound is kept. "
    )
    if repeated_in_corners(sums.place):
        return corner + (
            "In brackets what 68 of 100 repetitions with other seeds would give (bootstrap over jobs within "
            "their corner); those of two seeds are rather narrow. A single corner has them from "
            f"{LEAST_OF_ONE} seeds on; else the two values are named between which the limit lies. The worst "
            "of many corners is also the unluckiest: more seeds make it fairer."
        )
    return corner + (
        "In brackets the 68 % interval of a bootstrap over the jobs of each value. With one seed it holds "
        "the differences between corners too, and is wider than what other seeds would give. A single corner "
        "has none: there the two values are named between which the limit lies."
    )


def _worst(campaign: Campaign, sums: JobSums, facts: Mapping[str, Any]) -> str:
    commands = facts.get("commands", {})
    parts = []
    bounds = {bound.figure: bound.value for bound in campaign.bounds}
    for number, name in enumerate(figures_shown(campaign)):
        listed = worst_table(campaign.axes, sums, FIGURES[name], commands, bounds.get(name))
        if listed:
            opened = " open" if number == 0 else ""
            parts.append(
                f"<details{opened}><summary>by {escape(FIGURES[name].title)}</summary>{listed}</details>"
            )
    if not parts:
        return ""
    intro = (
        "The worst jobs of each estimator, and the command that renders each as a run, to look at its frames."
    )
    return f"<h2>Look into these first</h2><p class='faint'>{intro}</p>{''.join(parts)}"


def _made(campaign: Campaign, facts: Mapping[str, Any]) -> str:
    shown = {
        key: str(value)[:_MOST_LETTERS] if isinstance(value, str | list | tuple) else value
        for key, value in facts.items()
        if key not in ("commands", "warnings", "failed", "format")
    }
    seeds = list(campaign.seeds)
    listed = ", ".join(map(str, seeds[:12])) + (", …" if len(seeds) > 12 else "")
    explained = "".join(
        f"<dt>{escape(FIGURES[name].title)}</dt><dd>{escape(FIGURES[name].explained)}</dd>"
        for name in FIGURES
    )
    return (
        "<h2>How it was made</h2>"
        f"{axes_table(campaign.axes)}<p>Every combination of these values was rendered with each of the "
        f"seeds {escape(listed)}.</p>{facts_table(shown)}"
        f'<h3>Figures</h3><dl class="rules">{explained}<dt>countable</dt><dd>in the image, lit, at least '
        "half visible, brightest pixel at least 5 σ above the noise; mirror images never</dd></dl>"
    )
