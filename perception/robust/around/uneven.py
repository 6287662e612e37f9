"""Flares fitted again where what is left over has no shape: uneven ground, charge that was spilled."""

import math
from collections.abc import Container, Sequence
from dataclasses import replace

import numpy as np

from perception.model.layout import UNUSABLE
from perception.model.window import Camera
from perception.robust.search.prepare import PreparedFrame
from perception.robust.search.structure import EDGES, structure_of
from perception.robust.solve import Solution, solve

MOST_LEFT = 0.25
"""What a fit may leave over, relative to the flares' light, of what is still called a source."""


def retry_on_uneven_ground(best: list[Solution | None], uneven_e: Sequence[float], camera: Camera) -> None:
    """Fit again where something lies around the flares: edges, of the strength that plain fits leave over.

    What is too sharp even for them counts as noise of the window.
    """
    for is_noise in (False, True):
        tried, problems = [], []
        for index, solution in enumerate(best):
            if solution is None or uneven_e[index] == 0.0:
                continue
            window, left_e = solution.window, solution.left_over.structure_e if is_noise else 0.0
            if left_e > 0.0:
                window = replace(window, floor_e2=window.floor_e2 + left_e**2)
            elif not is_noise:
                strength_e = math.hypot(uneven_e[index], window.structure_e)
                edges = structure_of(EDGES, window.box.height, strength_e)
                window = replace(window, structure=edges, structure_e=strength_e, on_edges=True)
            else:
                continue
            tried.append(index)
            problems.append(solution.again(window))
        for index, again in zip(tried, solve(problems, camera), strict=True):
            best[index] = again


def retry_without_spill(
    best: list[Solution | None], parted: Container[int], prepared: PreparedFrame, camera: Camera
) -> None:
    """Fit badly fitted clipped flares without the columns of clipped pixels, where charge may spill."""
    alone = [None if index in parted else one for index, one in enumerate(best)]
    for index, again in without_spill(alone, prepared, camera).items():
        if again.left_over.share < MOST_LEFT:
            best[index] = again


def without_spill(
    found: Sequence[Solution | None], prepared: PreparedFrame, camera: Camera
) -> dict[int, Solution]:
    """Return by index what badly fitted solutions are without columns of clipped pixels, where there are."""
    tried, problems = [], []
    for index, solution in enumerate(found):
        if solution is None or solution.left_over.is_good:
            continue
        # Also those of flares that are none of the window's.
        spilled = prepared.clipped_columns(solution.window.box)
        if spilled.any():
            tried.append(index)
            state = np.where(spilled, UNUSABLE, solution.window.state).astype(np.uint8)
            problems.append(solution.again(replace(solution.window, state=state)))
    fits = zip(tried, solve(problems, camera), strict=True)
    return {index: again for index, again in fits if again is not None}
