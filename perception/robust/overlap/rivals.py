"""Of two explanations the likelier one, its sigmas wider by what differs in the other."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from perception.robust.solve import Solution

Array = NDArray[np.float64]

_LEAST_SHARE, _DOUBTFUL_SHARE = 1e-4, 0.01
_MOST_COST = 40.0

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
