"""Of two explanations the likelier one, its sigmas wider by what differs in the other."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from perception.robust.solve import Solution

Array = NDArray[np.float64]

_LEAST_SHARE, _DOUBTFUL_SHARE = 1e-4, 0.01
_MOST_COST = 40.0
_ALIKE = 10.0  # in −2 ln of the evidence: discs that hardly overlap add up to the same, but for quadrature

NO_RIVAL = -2.0 * math.log(_LEAST_SHARE)
"""What costs so much more changes nothing."""


def weighed(solution: Solution, *others: Solution) -> Solution:
    """Return a solution, its sigmas wider by what differs in others, weighted by how likely each is.

    Of another number of flares the nearest counts; where it is likelier than a hundredth, that is doubtful.
    """
    costs = [min(max(other.cost - solution.cost, -_MOST_COST), _MOST_COST) for other in others]
    odds = [math.exp(-0.5 * cost) for cost in costs]
    wider = solution
    for other, own_odds in zip(others, odds, strict=True):
        wider = _wider(wider, solution, other, own_odds / (1.0 + sum(odds)))
    return wider


def likelier(one: Solution | None, other: Solution | None) -> Solution | None:
    """Return the likelier of two explanations, if there are two, the other in its sigmas."""
    if one is None or other is None:
        return other or one
    return weighed(other, one) if other.cost < one.cost else weighed(one, other)


def against(solutions: Sequence[Solution | None], rivals: Mapping[int, Solution]) -> list[Solution | None]:
    """Return solutions whose further fits are given up where they are sure to matter nothing beside rivals.

    Rivals by index. A cost is bounded as −2 ln L, which is less by what flares and structure cost.
    """
    return [
        to_beat(one, rivals[index].cost + NO_RIVAL) if one is not None and index in rivals else one
        for index, one in enumerate(solutions)
    ]


def to_beat(one: Solution, most: float) -> Solution:
    """Return a solution whose further fits are given up where −2 ln L is sure to exceed that."""
    return replace(one, window=replace(one.window, to_beat=most))


def better(pair: Solution, other: Solution | None) -> Solution:
    """Return what explains a window better, the other weighed in; of as many flares what knows of hiding."""
    if other is None:
        return pair
    alike = _ALIKE if pair.count == other.count else 0.0
    return weighed(pair, other) if pair.cost < other.cost + alike else weighed(other, pair)


def beside_rival(one: Solution | None, pair: Solution) -> Solution | None:
    """Weigh what explains a window with two spheres that do, too, but may be one that is not round.

    One that is not round is told as one; several flares are no better a guess than the two where these
    explain more.
    """
    if one is None:
        return None
    if one.count > 1 and pair.cost < one.cost:
        return replace(weighed(pair, one), is_doubtful=True)
    return weighed(one, pair)


def _wider(wider: Solution, solution: Solution, other: Solution, share: float) -> Solution:
    """Return a solution as wide as it is so far, and wider by what differs in another of a share."""
    if share < _LEAST_SHARE:
        return wider
    apart = np.hypot(solution.u_px[:, None] - other.u_px, solution.v_px[:, None] - other.v_px)
    nearest = np.argmin(apart, axis=1)

    def and_by(sigma: Array, own: Array, others: Array) -> Array:
        return np.asarray(np.hypot(sigma, math.sqrt(share) * (others[nearest] - own)))

    return replace(
        wider,
        u_sigma_px=and_by(wider.u_sigma_px, solution.u_px, other.u_px),
        v_sigma_px=and_by(wider.v_sigma_px, solution.v_px, other.v_px),
        flux_sigma_e=and_by(wider.flux_sigma_e, solution.flux_e, other.flux_e),
        log_range_sigma=and_by(wider.log_range_sigma, solution.log_range, other.log_range),
        is_doubtful=wider.is_doubtful or (solution.count != other.count and share > _DOUBTFUL_SHARE),
    )
