"""Compared figures as a person reads them: numbers with their units, and a sentence of what came out."""

import math

from nir_render.compare.figures import Compared, Figure
from nir_render.compare.paired import LEAST_FRAMES
from nir_render.report.wording import counted, degrees, metres, share, significant

HEADINGS = (
    "figure", "first", "second", "difference", "95 % interval", "verdict", "would have seen", "over",
)  # fmt: skip
LEVELS = {"better": "good", "worse": "bad", "differs": "fair"}
"""How verdicts are coloured."""

RULES = {
    "Pairs": "frames by camera and index, sources by robot and name. Recall is over sources that count in "
    "both runs; errors are over those that both sides found and ranged. Differences are second − first.",
    "Sets": "what the cameras of a rig measure together, where both sides have measurements: robots that "
    "count in both runs; errors over those that both measured and took for robots, not for mirror images.",
    "Interval": "paired bootstrap over frames, or sets, 95 %: what other ones like these would give. Frames "
    "of one moment count as independent. Counts get some room for what happened in none of these frames.",
    "Verdict": "better or worse where the interval leaves out zero and six frames or more differ; of counts, "
    "where moreover a coin tossed in each differing frame would seldom do so (exact, 5 %). A bias is better "
    "where it is closer to zero. Of twenty figures without a difference, chance makes one better or worse.",
    "Would have seen": "the smallest difference that four of five such comparisons tell from none. It falls "
    "with the square root of the number of frames.",
}


def row_of(compared: Compared) -> tuple[str, ...]:
    """Return the cells of a figure, in the order of `HEADINGS`."""
    figure = compared.figure
    of = figure.per if figure.unit.startswith("per ") else "source"
    over = counted(compared.count, of)
    return (
        figure.title,
        value_text(figure, compared.first),
        value_text(figure, compared.second),
        difference_text(figure, compared.difference),
        interval_text(compared),
        compared.verdict,
        difference_text(figure, compared.least_seen).lstrip("+"),
        over if of == figure.per else f"{over} in {counted(compared.frames, figure.per)}",
    )


def has_content(compared: Compared) -> bool:
    """Tell whether a figure is worth a row: what is counted apart is, where there is any."""
    plain = {
        "ranged": (1.0, 1.0),
        "ghosts_reported_per_frame": (0.0, 0.0),
        "lamps_reported_per_frame": (0.0, 0.0),
        "set_false_alarms_per_set": (0.0, 0.0),
    }
    return (compared.first, compared.second) not in ((None, None), plain.get(compared.figure.name))


def sentence_of(figures: tuple[Compared, ...], identical: bool) -> str:
    """Say what came out, in a sentence or two."""
    if identical:
        return "The two agree in every frame: all differences are zero."
    said = []
    for verdict, words in (("better", "Better"), ("worse", "Worse"), ("differs", "Different")):
        titles = [each.figure.title for each in figures if each.verdict == verdict]
        said += [f"{words}: {', '.join(titles)}."] if titles else []
    few = any(each.verdict == "too few frames" for each in figures)
    if not said and not few:
        return "No difference seen in any figure."
    if few:
        said.append(f"Some figures have fewer than {LEAST_FRAMES} frames or sets, too few to tell.")
    return " ".join(said)


def counts_sentence(compared: Compared) -> str:
    """Say who found what alone, and how likely chance makes such a difference."""
    if not (compared.only_first or compared.only_second) or compared.probability is None:
        return ""
    return (
        f"Found by the first only: {compared.only_first}; by the second only: {compared.only_second} "
        f"(exact probability that chance does this: {significant(compared.probability, 2)})."
    )


def value_text(figure: Figure, value: float | None) -> str:
    """Write a figure's value."""
    if value is None:
        return "–"
    if figure.unit == "share":
        return share(value)
    if figure.unit == "m":
        return metres(value, signed=figure.kind == "bias")
    return degrees(value) if figure.unit == "deg" else f"{value:.3f}"


def interval_text(compared: Compared, *, difference: bool = False) -> str:
    """Write where the difference lies, both ends in one unit, and if wanted the difference before it."""
    if compared.low is None or compared.high is None or compared.difference is None:
        return difference_text(compared.figure, compared.difference) if difference else "–"
    if compared.low == compared.high == 0.0:
        return "0"
    largest = max(abs(compared.low), abs(compared.high))
    unit = compared.figure.unit
    if unit == "m":
        steps = (("m", 1.0, 0.9995), ("cm", 100.0, 0.009995), ("mm", 1e3, 0.0))
        name, factor, _ = next(step for step in steps if largest >= step[2])
    else:
        name, factor = {"share": ("pp", 100.0), "deg": ("°", 1.0), "per frame": ("", 1.0)}[unit]
    digits = max(0, 2 - math.floor(math.log10(largest * factor)))
    middle, low, high = (
        f"{value * factor:+.{min(digits, 6)}f}".replace("-", "−")
        for value in (compared.difference, compared.low, compared.high)
    )
    text = f"{middle} ({low} … {high})" if difference else f"{low} … {high}"
    return f"{text}{'' if unit in ('deg', 'per frame') else ' '}{name}"


def difference_text(figure: Figure, value: float | None) -> str:
    """Write a difference of a figure, with its sign; of shares in percentage points."""
    if value is None:
        return "–"
    if value == 0.0:
        return "0"
    if figure.unit == "m":
        return metres(value, signed=True)
    sign = "+" if value > 0.0 else "−"
    if figure.unit == "deg":
        return sign + degrees(abs(value))
    return f"{sign}{abs(100.0 * value):.1f} pp" if figure.unit == "share" else f"{sign}{abs(value):.3f}"
