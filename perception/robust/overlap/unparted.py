"""Lone flares that may be two too near to be told apart: their sigmas cover both.

Two sources within a width of the point spread are one flare, hardly longer than wide, as bright as both:
taken for one it is too near by up to a factor of √2, which no σ of a lone flare says. Where an image is
longer than wide, or smaller than its flux says, two are tried; they need not explain it so much better that
they are told as two.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from perception.model.window import Camera
from perception.robust.overlap.deblend import gain, halves
from perception.robust.overlap.pairs import longer_chi2
from perception.robust.overlap.rivals import weighed
from perception.robust.problem import Problem, Start
from perception.robust.solve import NEIGHBOURS_PER_PX2, Solution, solve

Array = NDArray[np.float64]

LONGER_CHI2, LEAST_CHI2 = 9.0, 17.0
"""Of two degrees of freedom, from which two are tried; the second with what others around make two likelier.

Noise passes 9 once in 90; alone 12.9 must be passed, once in 600. Two bring about such a χ², cost 28 to 34 a
priori, and count only if that leaves them a hundredth, 9.2.
"""

_AROUND_PX = 50.0
_STEP_PX = 0.25
_NEAR_WIDTHS = 0.6


def doubted(
    chosen: Sequence[Solution | None], at_rest: Sequence[Solution | None], camera: Camera
) -> dict[int, Solution]:
    """Return by index lone flares that may be two, their sigmas wider by what those differ.

    How likely two are is a matter of how much better they explain the window, with a point spread that is not
    quite known (`deblend.gain`), of what their unknowns cost (`Solution.cost`), and of how many flares there
    are around: of a robot in a crowd a second one is likelier than of one far from all others.

    Parameters
    ----------
    chosen, at_rest
        What explains each window, and what a single flare at rest does; None where there is none.
    """
    tried: list[int] = []
    problems = []
    places_px = np.array([(one.u_px[0], one.v_px[0]) for one in chosen if one is not None])
    for index, (one, lone) in enumerate(zip(chosen, at_rest, strict=True)):
        if one is None or lone is None or one.count != 1 or lone.count != 1 or one.is_eclipse:
            continue
        longer = longer_chi2(lone)
        is_long = longer > LONGER_CHI2 and longer + _likelier_around(one, places_px) > LEAST_CHI2
        if is_long or not lone.left_over.is_good:
            for starts in (halves(lone, 0), halves(lone, 0, _NEAR_WIDTHS) or _beside(lone)):
                if starts is not None:
                    tried.append(index)
                    problems.append(Problem(one.window, starts, one.background_e))
    if not tried:
        return {}
    pairs: dict[int, Solution] = {}
    for index, two in zip(tried, solve(problems, camera), strict=True):
        if two is not None and two.left_over.is_good and two.ranged.all():
            pairs[index] = min(pairs.get(index, two), two, key=lambda pair: pair.cost)
    wider = {}
    for index, two in pairs.items():
        one = chosen[index]
        assert one is not None
        two = replace(two, deviance=one.deviance - gain(one, two) - _likelier_around(one, places_px))
        both = weighed(replace(one, is_doubtful=False), two)
        if not both.is_doubtful:
            continue
        # The flux is that of all that is seen, one or two.
        wider[index] = replace(
            both,
            flux_sigma_e=one.flux_sigma_e,
            log_range_sigma=one.log_range_sigma,
            log_range_of_two=math.sqrt(float(both.log_range_sigma[0] ** 2 - one.log_range_sigma[0] ** 2)),
        )
    return wider


def _likelier_around(one: Solution, places_px: Array) -> float:
    """Return how much likelier a neighbour is where others are around, itself counted, as 2 Δ ln L."""
    apart_px = np.hypot(*(places_px - [one.u_px[0], one.v_px[0]]).T)
    density_per_px2 = np.count_nonzero(apart_px < _AROUND_PX) / (math.pi * _AROUND_PX**2)
    return 2.0 * math.log(max(density_per_px2 / NEIGHBOURS_PER_PX2, 1.0))


def _beside(lone: Solution) -> tuple[Start, Start]:
    """Return two flares of half the light, close to each other."""
    u_px, v_px, log_range = lone.starts[0]
    farther = log_range + 0.5 * math.log(2.0)
    return (u_px - _STEP_PX, v_px, farther), (u_px + _STEP_PX, v_px, farther)
