"""Flares that are drawn out, as they move while they are exposed: rivals of round ones and of pairs."""

import math
from collections.abc import Sequence

from perception.model.window import Camera
from perception.robust.goodness import drawn_out
from perception.robust.solve import Problem, Solution, solve

SEEMS_CHI2 = 12.0
"""Of two degrees of freedom, what a lone flare longer than wide leaves over: noise does it once in 400."""

LEAST_PX = 0.2
"""A flare that seems to move less is taken to rest: it changes its flux by less than a thousandth."""


def moving(solutions: Sequence[Solution | None], camera: Camera) -> dict[int, Solution]:
    """Fit lone flares that are longer than wide as moving ones, and return by index which are likelier so."""
    tried: list[tuple[int, Solution]] = []
    problems = []
    for index, solution in enumerate(solutions):
        if solution is None or solution.count != 1 or solution.motion_px is not None:
            continue
        window = solution.window
        chi2, along_u, along_v = drawn_out(
            window.image_e, window.state, solution.expected_e, solution.flares_e, window.floor_e2, window.prnu
        )
        if chi2 < SEEMS_CHI2 or math.hypot(along_u, along_v) < LEAST_PX:
            continue
        tried.append((index, solution))
        problems.append(Problem(window, solution.starts, solution.background_e, [(along_u, along_v)]))
    fits = solve(problems, camera)
    return {
        index: fit
        for (index, at_rest), fit in zip(tried, fits, strict=True)
        if fit is not None and fit.cost < at_rest.cost
    }
