"""The part of a campaign's page that shows figures: against each axis, and over two at once."""

import itertools
from collections.abc import Iterable, Sequence
from html import escape

from nir_render.report import style
from nir_render.report.campaign_maps import MOST_VALUES, heat_maps
from nir_render.report.campaign_plots import against_axes
from nir_render.report.campaign_words import bound_text
from nir_render.report.parts import plot
from nir_render.stress.campaign import Campaign
from nir_render.stress.figures import FIGURES, Bound, Figure
from nir_render.stress.repeats import Again
from nir_render.stress.sums import JobSums

_ROWS = 4
_UNFOLDED = 3
_MOST_ROWS = 80
"""The last bounds the size of the page."""


def figure_sections(campaign: Campaign, sums: JobSums, again: Sequence[Again]) -> list[str]:
    """Return a section of each figure that is asked for: those with a bound first, the first few unfolded.

    Parameters
    ----------
    sums
        The campaign's table (see `job_sums`).
    again
        The repetitions for each axis (see `repetitions`).
    """
    axes = campaign.axes
    bounds = {bound.figure: bound for bound in campaign.bounds}
    small = [
        pair
        for pair in itertools.combinations(range(len(axes)), 2)
        if all(len(axes[i].labels) <= MOST_VALUES for i in pair)
    ]
    panels, parts = 0, []
    for number, name in enumerate(figures_shown(campaign)):
        figure, bound = FIGURES[name], bounds.get(name)
        value = None if bound is None else bound.value
        inner = []
        for first in range(0, len(axes), _ROWS):
            chosen = range(len(axes))[first : first + _ROWS]
            if panels < _MOST_ROWS:
                svg = against_axes(figure, axes, chosen, sums, again, value)
                inner.append(plot(svg, f"{figure.title} against {_and(axes[i].title for i in chosen)}"))
            panels += len(chosen)
        if small:
            inner.append(f"<h3>Over two axes</h3><p class='faint'>{_map_key(figure, bound)}</p>")
        for first in range(0, len(small), _ROWS):
            pairs = small[first : first + _ROWS]
            if panels < _MOST_ROWS:
                svg = heat_maps(figure, axes, pairs, sums, value)
                said = "; ".join(_and(axes[i].title for i in pair) for pair in pairs)
                inner.append(plot(svg, f"{figure.title} over {said}"))
            panels += len(pairs)
        if panels >= _MOST_ROWS:
            inner.append("<p>Not all are drawn, to keep the page small; the table has the numbers.</p>")
        parts.append(_folded(campaign, sums, figure, inner, unfolded=number < _UNFOLDED))
    return parts


def figures_shown(campaign: Campaign) -> list[str]:
    """Return the figures asked for: those with a bound first, as the campaign writes them."""
    return list(dict.fromkeys([*(bound.figure for bound in campaign.bounds), *campaign.figures]))


def _folded(
    campaign: Campaign, sums: JobSums, figure: Figure, inner: Sequence[str], *, unfolded: bool
) -> str:
    title = figure.title[0].upper() + figure.title[1:]
    about = f"<p>{escape(figure.explained[0].upper() + figure.explained[1:])}. {_counts_key(figure)}</p>"
    bounded = any(bound.figure == figure.name for bound in campaign.bounds)
    return (
        f"<h2>{escape(title)}</h2><details{' open' if unfolded else ''}><summary>against each axis, and over "
        f"two at once</summary>{about}{_line_key(sums, figure, bounded=bounded)}{''.join(inner)}</details>"
    )


def _counts_key(figure: Figure) -> str:
    if figure.kind == "frame":
        return "Below each value stands how many frames there are."
    if figure.higher_is_better:
        return "Below each value stands how many sources count there."
    return "Below each value stands of how many sources, of those that count, the figure is."


def _line_key(sums: JobSums, figure: Figure, *, bounded: bool) -> str:
    """Explain the lines of a plot against an axis."""
    colour = style.look(sums.estimators[0], sums.estimators).colour if sums.estimators else style.INK
    lines = [(colour, 'stroke-width="2.5"', "all corners together, with bars of 68 %")]
    if sums.place.shape[1] > 1:
        lines.append((colour, 'stroke-width="0.8"', "each corner, or many as a band"))
    if len(sums.estimators) > 1:
        lines.append((style.INK, 'stroke-dasharray="4 2"', "the other estimators"))
    if figure.limit is not None:
        lines.append((style.LIMIT, 'stroke-dasharray="1 2"', "limit (Cramér–Rao) of the same sources"))
    if bounded:
        lines.append((style.BAD, "", "bound"))
    drawn = (
        f'<span><svg viewBox="0 0 16 16"><path d="M0 8h16" stroke="{colour}" {how}/></svg> {said}</span>'
        for colour, how, said in lines
    )
    return f'<div class="key">{"".join(drawn)}</div>'


def _map_key(figure: Figure, bound: Bound | None) -> str:
    nothing = "Hatched: no source counts there; “none”: no such figure." if figure.kind == "source" else ""
    beyond = f"A red corner: beyond {escape(bound_text(bound))}. " if bound else ""
    return f"Pooled over all else. Dark is good, bright is bad. {beyond}{nothing}"


def _and(words: Iterable[str]) -> str:
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last
