"""Of two explanations the likelier one, its sigmas wider by what differs in the other."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from perception.robust.solve import Solution

Array = NDArray[np.float64]

_LEAST_SHARE, _DOUBTFUL_SHARE = 1e-4, 0.01
_MOST_COST = 40.0

NOT_WEIGHED_COST = -2.0 * math.log(_LEAST_SHARE)
"""What costs more than another explanation by so much is not weighed in: −2 ln of its share."""


def weighed(solution: Solution, other: Solution) -> Solution:
    """Return a solution, its sigmas wider by what differs in another, weighted by how likely that one is.

    Of another number of flares the nearest counts; where it is likelier than a hundredth, that is doubtful.
    """
    odds = math.exp(-0.5 * min(max(other.cost - solution.cost, -_MOST_COST), _MOST_COST))
    share = odds / (1.0 + odds)
    if share < _LEAST_SHARE:
        return solution
    apart = np.hypot(solution.u_px[:, None] - other.u_px, solution.v_px[:, None] - other.v_px)
    nearest = np.argmin(apart, axis=1)

    def wider(sigma: Array, own: Array, others: Array) -> Array:
        return np.asarray(np.hypot(sigma, math.sqrt(share) * (others[nearest] - own)))

    return replace(
        solution,
        u_sigma_px=wider(solution.u_sigma_px, solution.u_px, other.u_px),
        v_sigma_px=wider(solution.v_sigma_px, solution.v_px, other.v_px),
        flux_sigma_e=wider(solution.flux_sigma_e, solution.flux_e, other.flux_e),
        log_range_sigma=wider(solution.log_range_sigma, solution.log_range, other.log_range),
        is_doubtful=solution.is_doubtful or (solution.count != other.count and share > _DOUBTFUL_SHARE),
    )
