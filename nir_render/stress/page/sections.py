"""The part of a campaign's page that shows metrics: against each axis, and over two at once."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from nir_render.report import style
from nir_render.report.drawing import Drawing
from nir_render.stress.bootstrap import AlongAxis
from nir_render.stress.campaign import Campaign
from nir_render.stress.design.axes import Axis
from nir_render.stress.metrics import METRICS, Bound, Metric
from nir_render.stress.page.maps import MOST_VALUES, heat_maps
from nir_render.stress.page.plots import against_axes
from nir_render.stress.page.words import bound_text
from nir_render.stress.sums import JobSums, at_written_values

_ROWS = 4
_UNFOLDED = 3
_MOST_ROWS = 80
"""The last bounds the size of the page."""


@dataclass(frozen=True)
class LineKey:
    """What a line of a plot means; `width` and `dashes` as SVG has them, empty for its own."""

    colour: str
    meaning: str
    width: str = ""
    dashes: str = ""


@dataclass(frozen=True)
class MetricSection:
    """What the page shows of a metric; `cut` where not all is drawn, to keep the page small."""

    title: str
    explained: str
    unfolded: bool
    counts_key: str
    line_key: tuple[LineKey, ...]
    against_axes: tuple[Drawing, ...]
    map_key: str
    over_axes: tuple[Drawing, ...]
    cut: bool


def metric_sections(campaign: Campaign, sums: JobSums, told: Sequence[AlongAxis]) -> list[MetricSection]:
    """Return a section of each metric that is asked for: those with a bound first, the first few unfolded.

    Parameters
    ----------
    sums
        The campaign's table (see `job_sums`).
    told
        The jobs and repetitions for each axis (see `along_axes`).
    """
    bounds = {bound.metric: bound for bound in campaign.bounds}
    sampled = campaign.sample is not None
    sections: list[MetricSection] = []
    drawn = 0
    for name in metrics_shown(campaign):
        metric, bound = METRICS[name], bounds.get(name)
        against, over, wanted = _drawings(metric, bound, campaign.axes, sums, told, _MOST_ROWS - drawn)
        drawn += wanted
        sections.append(
            MetricSection(
                title=_capitalised(metric.title),
                explained=_capitalised(metric.explained),
                unfolded=len(sections) < _UNFOLDED,
                counts_key=_counts_key(metric),
                line_key=tuple(_line_key(sums, metric, bounded=bound is not None, sampled=sampled)),
                against_axes=tuple(against),
                map_key=_map_key(metric, bound) if _small_pairs(campaign.axes) else "",
                over_axes=tuple(over),
                cut=drawn >= _MOST_ROWS,
            )
        )
    return sections


def metrics_shown(campaign: Campaign) -> list[str]:
    """Return the metrics asked for: those with a bound first, as the campaign writes them."""
    return list(dict.fromkeys([*(bound.metric for bound in campaign.bounds), *campaign.metrics]))


def _small_pairs(axes: Sequence[Axis]) -> list[tuple[int, int]]:
    """Return the pairs of axes that a map has room for."""
    pairs = itertools.combinations(range(len(axes)), 2)
    return [pair for pair in pairs if all(len(axes[i].written()) <= MOST_VALUES for i in pair)]


def _drawings(
    metric: Metric,
    bound: Bound | None,
    axes: Sequence[Axis],
    sums: JobSums,
    told: Sequence[AlongAxis],
    room: int,
) -> tuple[list[Drawing], list[Drawing], int]:
    """Draw a metric against each axis and over pairs of them, while there is room for more rows of panels.

    Returns the drawings of both kinds, and how many rows there would be with room for all.
    """
    value = None if bound is None else bound.value
    against, over, rows = [], [], 0
    for first in range(0, len(axes), _ROWS):
        chosen = range(len(axes))[first : first + _ROWS]
        if rows < room:
            svg = against_axes(metric, axes, chosen, told, value)
            against.append(Drawing(svg, f"{metric.title} against {_and(axes[i].title for i in chosen)}"))
        rows += len(chosen)
    small = _small_pairs(axes)
    axes, sums = at_written_values(axes, sums)
    for first in range(0, len(small), _ROWS):
        pairs = small[first : first + _ROWS]
        if rows < room:
            svg = heat_maps(metric, axes, pairs, sums, value)
            titles = "; ".join(_and(axes[i].title for i in pair) for pair in pairs)
            over.append(Drawing(svg, f"{metric.title} over {titles}"))
        rows += len(pairs)
    return against, over, rows


def _capitalised(text: str) -> str:
    return text[0].upper() + text[1:]


def _counts_key(metric: Metric) -> str:
    if metric.kind != "source":
        return f"Below each value stands how many {metric.kind}s there are."
    if metric.higher_is_better:
        return "Below each value stands how many sources count there."
    return "Below each value stands of how many sources, of those that count, the figure is."


def _line_key(sums: JobSums, metric: Metric, *, bounded: bool, sampled: bool) -> Iterator[LineKey]:
    """Explain the lines of a plot against an axis."""
    colour = style.look(sums.estimators[0], sums.estimators).colour if sums.estimators else style.INK
    yield LineKey(
        colour, f"all {'points' if sampled else 'corners'} together, with bars of 68 %", width="2.5"
    )
    if sums.place.shape[1] > 1 and not sampled:
        yield LineKey(colour, "each corner, or many as a band", width="0.8")
    if len(sums.estimators) > 1:
        yield LineKey(style.INK, "the other estimators", dashes="4 2")
    if metric.limit is not None:
        yield LineKey(style.LIMIT, "limit (Cramér–Rao) of the same sources", dashes="1 2")
    if bounded:
        yield LineKey(style.BAD, "bound")


def _map_key(metric: Metric, bound: Bound | None) -> str:
    nothing = "Hatched: no source counts there; “none”: no such figure." if metric.kind == "source" else ""
    beyond = f"A red corner: beyond {bound_text(bound)}. " if bound else ""
    return f"Pooled over all else. Dark is good, bright is bad. {beyond}{nothing}"


def _and(words: Iterable[str]) -> str:
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last
