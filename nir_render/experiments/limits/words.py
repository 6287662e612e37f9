"""What the levers of a study are worth, in words."""

import math
from collections.abc import Sequence

from nir_render.experiments.limits.holds import LIMIT_NAME, Hold, hold_text, order_of
from nir_render.experiments.limits.outcome import Crossing, StudyOutcome


def built_hold(outcome: StudyOutcome, estimator: str) -> Hold:
    """Return how far an estimator goes as robots are built."""
    crossing = next(iter(outcome.crossings.values()))
    return crossing.of(estimator)[crossing.built]


def verdict(outcome: StudyOutcome, crossing: Crossing, estimator: str) -> str:
    """Say what a lever wins back, of what an estimator does as built."""
    high, holds, lever = outcome.study.worst_is_high, crossing.of(estimator), crossing.lever
    judged = [hold for hold in holds if hold.status != "nothing to judge"]
    built = holds[crossing.built]
    if built not in judged:
        return "nothing to compare"
    reach = [order_of(hold, worst_is_high=high) for hold in judged]
    best, own = judged[reach.index(max(reach))], order_of(built, worst_is_high=high)
    if max(reach) == min(reach):
        return "throughout, with all of it" if own == math.inf else "makes no difference"
    if own == math.inf:
        worst = judged[reach.index(min(reach))]
        return f"not needed; {lever.labels[worst.lever]} would lose it"
    if best is built or max(reach) == own:
        return f"best as built, {lever.labels[built.lever]}"
    gain = f"{lever.labels[best.lever]}: {hold_text(crossing.threat, best, worst_is_high=high)}"
    if _overlap(built, best):
        return f"no more than seeds differ by ({gain})"
    return gain


def best_levers(outcome: StudyOutcome, estimator: str) -> list[str]:
    """Return what wins something back, by lever."""
    found = []
    for crossing in outcome.crossings.values():
        said = verdict(outcome, crossing, estimator)
        if said.startswith(crossing.lever.labels):
            found.append(f"{crossing.lever.title} {said}")
    return found


def estimators_of(crossings: Sequence[Crossing]) -> list[str]:
    """Return the names of estimators, without the limit."""
    return [name for name in crossings[0].sums.estimators if name != LIMIT_NAME]


def _overlap(one: Hold, other: Hold) -> bool:
    """Tell whether two limits are the same within their 68 % intervals, or lie in one gap of the axis."""
    if one.edge is None or other.edge is None:
        return False
    ends = (one.edge.low, one.edge.high, other.edge.low, other.edge.high)
    if any(end is None for end in ends):
        return one.edge.gap == other.edge.gap
    low, high, other_low, other_high = (float(end) for end in ends if end is not None)
    return low <= other_high and other_low <= high
