"""The page of a campaign: where each estimator keeps its bounds, where not, and by how much."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
from markupsafe import Markup

from nir_render.report.parts import Table, facts_table, render_page
from nir_render.report.wording import counted, share, significant
from nir_render.stress.bootstrap import LEAST_OF_ONE, along_axes, repeated_in_corners
from nir_render.stress.campaign import Campaign
from nir_render.stress.metrics import METRICS, Bound
from nir_render.stress.page.sections import metric_sections, metrics_shown
from nir_render.stress.page.tables import (
    axes_table,
    false_alarms_table,
    overall_table,
    render_noise_sentences,
    worst_table,
)
from nir_render.stress.page.words import bound_text, corner_text, extent_text, metric_text, sentence_of
from nir_render.stress.reach import Extent, Reach, campaign_reaches, corners_kept
from nir_render.stress.sums import ASKED, COUNT, LIMIT, LIMITED, TOTAL, JobSums, at_written_values, job_sums

_MOST_WARNINGS = 12
_MOST_LETTERS = 400
_MOST_SEEDS = 12
"""These bound the size of the page."""

_LEVELS = {"throughout": "good", "wherever judged": "good", "in part": "fair", "nowhere": "bad"}


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
    reaches = campaign_reaches(campaign, sums)
    _, written = at_written_values(axes, sums)
    told = along_axes(axes, sums, campaign.seeds[0], sampled=campaign.sample is not None)
    noise_sentence, noise_warning = render_noise_sentences(rows)
    return render_page(
        "stress/page/page.html",
        title=campaign.name,
        subtitle=[
            f"{counted(len(sums.jobs), 'job')}, {counted(_frames(sums), 'frame')}",
            _design(campaign),
            counted(len(campaign.seeds), "seed"),
            f"estimators: {', '.join(sums.estimators) or 'none'}",
        ],
        names=sums.estimators,
        description=campaign.description,
        warnings=_warnings(facts),
        overall_sentences=" ".join(_overall_sentence(written, name) for name in sums.estimators),
        compared=_compared(written),
        bounds=[_bound_section(campaign, bound, written, reaches) for bound in campaign.bounds],
        overall=overall_table(written),
        repeated_in_corners=repeated_in_corners(written.place),
        least_of_one=LEAST_OF_ONE,
        sampled=campaign.sample is not None,
        metrics=metric_sections(campaign, sums, told),
        worst=_worst(campaign, sums, facts),
        false_alarms=false_alarms_table(rows, written),
        render_noise={"sentence": noise_sentence, "warning": noise_warning},
        axes=axes_table(axes),
        refined=any(any(axis.added) for axis in axes),
        seeds=", ".join(map(str, campaign.seeds[:_MOST_SEEDS]))
        + (", …" if len(campaign.seeds) > _MOST_SEEDS else ""),
        facts=_facts(facts),
        known_metrics=list(METRICS.values()),
    )


def _design(campaign: Campaign) -> str:
    """Say how many points there are, and of what: 32 Sobol points of range × exposure."""
    if campaign.sample is not None:
        words = {"sobol": "Sobol points", "latin_hypercube": "points of a Latin hypercube"}
        kind = words.get(campaign.sample.design, "random points")
        return f"{campaign.sample.count} {kind} of {' × '.join(axis.title for axis in campaign.axes)}"
    parts = []
    for axis in campaign.axes:
        written, added = len(axis.written()), sum(axis.added)
        parts.append(f"{axis.title} ({written}{f' + {added} at limits' if added else ''})")
    return " × ".join(parts)


@dataclass(frozen=True)
class BoundSection:
    """What the page says of a bound: a sentence for each estimator, and how far it holds along each axis."""

    text: str
    sentences: Mapping[str, str]
    reaches: Table


@dataclass(frozen=True)
class WorstJobs:
    """The jobs that are worst by one metric."""

    title: str
    unfolded: bool
    table: Table


def _frames(sums: JobSums) -> int:
    return int(sums.by_metric[sums.estimators[0], "false_alarms"][ASKED].sum()) if sums.estimators else 0


def _warnings(facts: Mapping[str, Any]) -> list[str]:
    lines = [str(line) for line in facts.get("warnings", ())]
    failed = list(facts.get("failed", ()))
    if failed:
        first = failed[0]
        error = first.get("error", first) if isinstance(first, Mapping) else first
        lines.insert(
            0, f"{counted(len(failed), 'job')} failed, missing in all figures here. The first: {error}"
        )
    more = len(lines) - _MOST_WARNINGS
    shown = [line[:_MOST_LETTERS] for line in lines[:_MOST_WARNINGS]]
    return [*shown, f"… and {more} more"] if more > 0 else shown


def _bound_section(campaign: Campaign, bound: Bound, sums: JobSums, reaches: Sequence[Reach]) -> BoundSection:
    of_bound = [reach for reach in reaches if reach.bound == bound]
    sentences = {
        name: sentence_of(
            campaign.axes,
            [reach for reach in of_bound if reach.estimator == name],
            corners_kept(bound, name, sums),
        )
        for name in sums.estimators
    }
    rows: list[list[str]] = []
    for index, axis in enumerate(campaign.axes):
        row: list[str] = [axis.title]
        for name in sums.estimators:
            reach = next(reach for reach in of_bound if (reach.axis, reach.estimator) == (index, name))
            row.append(_pooled_cell(campaign, reach))
            if campaign.sample is None:
                row.append(_worst_cell(campaign, reach))
        rows.append(row)
    slices = ("all corners together", "worst corner") if campaign.sample is None else ("all points",)
    headings = ["along", *(f"{name}: {which}" for name in sums.estimators for which in slices)]
    return BoundSection(bound_text(bound), sentences, Table(headings, rows))


def _overall_sentence(sums: JobSums, name: str) -> str:
    recall, ranged, rmse, bias = (
        _overall(sums, name, metric) for metric in ("recall", "ranged", "range_rmse", "range_bias")
    )
    asked = int(sums.by_metric[name, "recall"][ASKED].sum())
    if not asked:
        return f"{name} met no source that counts: there is nothing to judge."
    if not math.isfinite(rmse):
        return f"{name} finds {share(recall)} of {counted(asked, 'source')}, and gives none a range."
    totals = sums.by_metric[name, "range_rmse"].sum(axis=1)
    limit = float(METRICS["range_rmse"].value(totals[LIMIT], totals[LIMITED]))
    at_limit = ""
    if limit > 0.0:
        at_limit = f", {significant(rmse / limit)} × the physical limit of {metric_text('range_rmse', limit)}"
    return (
        f"{name} finds {share(recall)} of {counted(asked, 'source')} and ranges {share(ranged)}, with an RMS "
        f"error of {metric_text('range_rmse', rmse)} (bias {metric_text('range_bias', bias)}){at_limit}."
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


def _overall(sums: JobSums, name: str, metric: str) -> float:
    totals = sums.by_metric[name, metric].sum(axis=1)
    return float(METRICS[metric].value(totals[TOTAL], totals[COUNT]))


def _pooled_cell(campaign: Campaign, reach: Reach) -> Markup:
    metric, extent = METRICS[reach.bound.metric], reach.pooled
    text = _extent_cell(campaign, reach, extent)
    if extent.status in ("in part", "nowhere") and math.isfinite(extent.worst):
        text += _faint_line(f"worst {metric_text(metric.name, extent.worst, reach.bound.value)}")
    asked, count = sum(point.asked for point in reach.points), sum(point.count for point in reach.points)
    if metric.kind == "source" and not metric.higher_is_better and count < 0.95 * asked:
        text += _faint_line(f"of {share(count / asked)} of the sources")
    return text


def _worst_cell(campaign: Campaign, reach: Reach) -> str:
    if reach.worst is None:
        return Markup('<span class="faint">there is but one</span>') if reach.slices else "nothing to judge"
    corner = corner_text(campaign.axes, reach.corner)
    kept = f"kept all along in {reach.slices_kept} of {reach.slices}"
    return _extent_cell(campaign, reach, reach.worst) + _faint_line(f"{corner}; {kept}")


def _extent_cell(campaign: Campaign, reach: Reach, extent: Extent) -> Markup:
    level = _LEVELS.get(extent.status, "none")
    text = extent_text(campaign.axes[reach.axis], extent)
    return Markup('<span class="word {}">{}</span>').format(level, text)


def _faint_line(text: str) -> Markup:
    return Markup('<br><span class="faint">{}</span>').format(text)


def _worst(campaign: Campaign, sums: JobSums, facts: Mapping[str, Any]) -> list[WorstJobs]:
    commands = facts.get("commands", {})
    bounds = {bound.metric: bound.value for bound in campaign.bounds}
    shown = []
    for number, name in enumerate(metrics_shown(campaign)):
        listed = worst_table(campaign.axes, sums, METRICS[name], commands, bounds.get(name))
        if listed is not None:
            shown.append(WorstJobs(METRICS[name].title, number == 0, listed))
    return shown


def _facts(facts: Mapping[str, Any]) -> Table:
    shortened = {
        key: str(value)[:_MOST_LETTERS] if isinstance(value, str | list | tuple) else value
        for key, value in facts.items()
    }
    return facts_table(shortened, but=("commands", "warnings", "failed", "format"))
