"""Flares fitted again where what is left over has no shape: uneven ground, charge that was spilled."""

import math
from collections.abc import Container, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from perception.model.layout import CLIPPED, UNUSABLE
from perception.model.window import Camera
from perception.robust.clusters import Cluster
from perception.robust.problem import Problem, Window
from perception.robust.search.prepare import PreparedFrame
from perception.robust.search.structure import EDGES, structure_of
from perception.robust.solve import Solution, solve

MOST_LEFT = 0.25
"""What a fit may leave over, relative to the flares' light, of what is still called a source."""

_FEWEST_SEEN = 8
"""Pixels of a flare that must be seen beside columns, where what is clipped is no column itself."""

_LEAST_SPILT_PX = 1
_SPILT_ASPECT = 2  # of what is clipped, from which on charge has spilled for sure
_LEAST_ACROSS = 0.8  # of the columns that are clipped
_SPILLS_ASIDE_PX = 2  # at most, and so far a point spread that is not the calibration's reaches

_WIDTHS_OF_DISC = (0.5, 1.0)
"""Of what is clipped, first guesses: a disc is as wide, the image of a point is so by its point spread."""


def retry_on_uneven_ground(best: list[Solution | None], uneven_e: Sequence[float], camera: Camera) -> None:
    """Fit again where something lies around the flares: edges, of the strength that plain fits leave over.

    What is too sharp even for them counts as noise of the window. Nothing is left of what its window says is
    not worth it (`Window.to_beat`).
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
        if (whole := alone[index]) is not None and explains_flanks(again, whole.window):
            best[index] = again


def by_flanks(
    found: Sequence[Cluster], solutions: Sequence[Solution | None], prepared: PreparedFrame, camera: Camera
) -> dict[int, Solution]:
    """Return by index what lone clipped flares that nothing explains are beside columns of clipped pixels.

    Charge that spills along columns hides where a disc ends along them, and makes what is clipped many times
    as long as wide; across them it is as wide as it is, or the point spread makes it. It must be so bright
    that it clips: the end of such a column is no flare.
    """
    tried, problems = [], []
    for index, (cluster, solution) in enumerate(zip(found, solutions, strict=True)):
        if solution is not None or len(cluster.members) > 1 or not cluster.is_clipped:
            continue
        (member,), window = cluster.members, cluster.window
        width_px = int(prepared.clipped_in(member.blob.box).any(axis=0).sum())
        beside = _without(prepared.clipped_columns(window.box), window)
        for part in _WIDTHS_OF_DISC:
            times = (0.5 * part * width_px / max(member.image_radius_px, 1e-9)) ** 2
            start = member.u_px, member.v_px, member.log_range(max(times * member.flux_e, 1.0))
            tried.append(index)
            problems.append(Problem(beside, [start], cluster.background_e))
    likeliest: dict[int, Solution] = {}
    for index, one in zip(tried, solve(problems, camera), strict=True):
        clips = one is not None and float(one.expected_e.max()) > one.window.clip_e
        if one is not None and clips and explains_flanks(one, found[index].window):
            likeliest[index] = min(likeliest.get(index, one), one, key=lambda fit: fit.deviance)
    return likeliest


def explains_flanks(one: Solution, window: Window) -> bool:
    """Tell whether a flare explains what is seen beside columns that are left out.

    Enough of it must be seen; and it must be as wide as what is clipped, but for a stuck pixel, and shorter,
    as charge spills along columns alone.

    Parameters
    ----------
    one
        The flare, in a window that leaves out columns.
    window
        The same with all columns.
    """
    # How far one moves along columns that are left out nothing tells.
    along = one.motion_px is not None and bool((abs(one.motion_px[:, 1]) > abs(one.motion_px[:, 0])).any())
    clips = window.state == CLIPPED
    clipped = clips.any(axis=0)
    wide, tall = int(clipped.sum()), int(clips.any(axis=1).sum())
    least = 1 if tall >= _SPILT_ASPECT * wide else _FEWEST_SEEN
    if along or not one.left_over.share < MOST_LEFT or one.left_over.pixels < least:
        return False
    own_clips = one.expected_e > window.clip_e
    own = own_clips.any(axis=0)
    # No charge has spilled where what clips ends before the flare itself does.
    if tall < int(own_clips.any(axis=1).sum()) + _LEAST_SPILT_PX:
        return False
    beside = np.convolve(own, np.ones(2 * _SPILLS_ASIDE_PX + 1), mode="same") > 0.5
    return int(beside[clipped].sum()) >= _LEAST_ACROSS * wide


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
            problems.append(solution.again(_without(spilled, solution.window)))
    fits = zip(tried, solve(problems, camera), strict=True)
    return {index: again for index, again in fits if again is not None}


def _without(columns: NDArray[np.bool_], window: Window) -> Window:
    """Return a window that does not look at some of its columns."""
    return replace(window, state=np.where(columns, UNUSABLE, window.state).astype(np.uint8))
