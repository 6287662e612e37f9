"""From clusters to measured flares: the fit, what to do where it is bad, and what is no source at all."""

import math
from collections.abc import Sequence
from dataclasses import replace

from perception.model.window import MOST_MOTION_PX, Camera
from perception.robust.around.uneven import MOST_LEFT, explains_flanks
from perception.robust.clusters import LEAST_RANGE_M, Candidate, Cluster, clusters
from perception.robust.explain import best
from perception.robust.flare import MeasuredFlare, measured_flare
from perception.robust.large.discs import measure_large
from perception.robust.large.whole import as_whole_discs
from perception.robust.motion import is_long_clutter
from perception.robust.overlap.deblend import RESIDUAL_SIGMAS
from perception.robust.overlap.free_fits import of_free_size, with_model_error
from perception.robust.search.blobs import Blob, divide
from perception.robust.search.prepare import PreparedFrame
from perception.robust.solve import Solution
from perception.robust.starts.at_rest import by_blobs
from perception.robust.together.camera_turn import turning, with_turn
from perception.robust.verdict import (
    is_any_outline,
    is_border,
    is_clipped_elsewhere,
    is_hardly_seen,
    is_on_flank,
    is_other_limb,
    is_other_oval,
    is_other_size,
)

MOST_LEFT_ON_EDGES = 0.1

_IN_VIEW_PX = 1000  # farther than any window reaches
# Flares for each blob: so many fill any patch, and where one of them is the patch's border others are, too.
_MOST_BESIDE_BORDERS = 4


def measure(
    found: Sequence[Cluster],
    prepared: PreparedFrame,
    camera: Camera,
    apart: bool = False,
    before: Sequence[Candidate] = (),
) -> tuple[list[tuple[Blob, MeasuredFlare]], Camera]:
    """Measure clusters, and leave out what is no source.

    Flares of known size and strength are fitted to each window. What a fit leaves over may be more flares
    (`deblend`), or charge that clipped pixels spilled over their columns. Blobs that are too large for that
    are fitted as whole discs, through a point spread of any width where the calibration's is wrong there (a
    near source out of focus); what no such disc explains, what is clipped then, and what has no range is
    measured by aperture, which claims no σ of range. The flux of a clipped one is a lower bound.

    Parameters
    ----------
    found
        The clusters.
    prepared, camera
        The frame, and its camera: where that is at rest, the flares may tell that it turns.
    apart
        That blobs side by side have been tried together before.
    before
        What was measured before.

    Returns
    -------
    A blob and its measurement for each flare, and the camera as it turns.
    """
    fitted = [cluster for cluster in found if not cluster.is_beyond_fit]
    others = [cluster for cluster in found if cluster.is_beyond_fit]
    whole = as_whole_discs(others, prepared)
    alone = [*fitted, *whole.values()]
    plain = by_blobs(alone, prepared, camera)
    if not apart:
        at_rest, camera = camera, as_it_turns(plain[: len(fitted)], prepared, camera)
        plain = plain if camera is at_rest else by_blobs(alone, prepared, camera)
    solutions = best(fitted, plain[: len(fitted)], prepared, camera)
    odd = [index for index, solution in enumerate(solutions) if solution is not None and _is_odd(solution)]
    of_odd = of_free_size([solution for k in odd if (solution := solutions[k]) is not None], camera)
    free = dict(zip(odd, of_odd, strict=True))
    measured: list[tuple[Blob, MeasuredFlare]] = []
    again: list[Candidate] = []
    unseen: list[Candidate] = []
    on_flank: list[Candidate] = []
    done = list(before)
    for index, (cluster, solution) in enumerate(zip(fitted, solutions, strict=True)):
        other_size = (
            index in free and solution is not None and is_other_size(solution, free[index], camera.tie_spread)
        )
        judged = [] if solution is None or other_size else _judged(cluster, solution, prepared, camera)
        measured += judged
        wanted = [cluster.members[k] for k in cluster.wanted]
        if judged:
            done += wanted
        elif len(cluster.members) > 1:
            again += [] if apart else wanted
        elif not apart and solution is not None and _may_be_before_edge(solution, prepared.shape):
            on_flank += wanted
        elif apart and solution is not None and is_hardly_seen(solution, 0, prepared.shape):
            unseen += wanted if solution.left_over.is_nothing else []
    by_one = dict(zip(whole, plain[len(fitted) :], strict=True))
    large, small = measure_large(others, by_one, prepared, camera, apart)
    measured += large
    again += small
    if again:
        # What spoils a cluster spoils it for all: each by itself, the others left out.
        one_by_one = clusters(again, prepared, apart=True, measured=done)
        measured += measure(one_by_one, prepared, camera, True, done)[0]
    if unseen:
        # Of two side by side that spoil nothing each leaves out too much of the other.
        together = [one for one in clusters(unseen, prepared, measured=done) if len(one.members) > 1]
        measured += measure(together, prepared, camera, True, done)[0]
    if on_flank:
        # Of what is bright beside it an edge may be the whole story: all of it in view.
        in_view = clusters(on_flank, prepared, apart=True, measured=done, within_px=_IN_VIEW_PX)
        measured += measure(in_view, prepared, camera, True, done)[0]
    return measured, camera


def as_it_turns(plain: Sequence[Solution | None], prepared: PreparedFrame, camera: Camera) -> Camera:
    """Return a frame's camera as it turns, if it was at rest so far and flares at rest tell that it does.

    Behind a rolling shutter motion is not fitted.
    """
    if camera.turn is not None or prepared.frame.line_time_s > 0.0:
        return camera
    return turning([one for one in plain if one is not None], camera)


def _may_be_before_edge(solution: Solution, shape: tuple[int, int]) -> bool:
    """Tell whether a flare is well explained, but beside something bright that its window leaves out."""
    left_out = solution.window.features is None and not solution.window.usable.all()
    return (
        left_out and solution.count == 1 and solution.left_over.is_nothing and is_on_flank(solution, 0, shape)
    )


def _is_odd(solution: Solution) -> bool:
    """Tell whether a lone flare fits so badly that its size has to be looked at."""
    return solution.count == 1 and not solution.left_over.is_good


def _judged(
    cluster: Cluster, solution: Solution, prepared: PreparedFrame, camera: Camera
) -> list[tuple[Blob, MeasuredFlare]]:
    """Turn a solution into measurements, if it is one of sources."""
    left = solution.left_over
    misfit = not left.is_good or (solution.count == 1 and left.peak_sigmas > RESIDUAL_SIGMAS)
    # Where nothing is seen but what is clipped, nothing is explained.
    misfit |= cluster.is_clipped and left.pixels == 0
    # An edge is long, too: what is drawn out on edges must leave hardly any of them.
    drawn_out = solution.motion_px is not None and solution.window.on_edges
    doubted = misfit or cluster.is_clipped or drawn_out
    most_left = MOST_LEFT_ON_EDGES if solution.window.on_edges else MOST_LEFT
    # Of what is clipped too much is unseen for that it may be two to excuse it.
    if doubted and left.share > most_left and (cluster.is_clipped or solution.log_range_of_two == 0.0):
        return []
    if float(solution.log_range.min()) < math.log(LEAST_RANGE_M) and bool(solution.ranged.all()):
        return []
    blobs_seen = max(len(cluster.members), solution.by_outline)
    # Where any clipped lamp has such an outline, lines side by side fill any patch.
    if (cluster.is_clipped or solution.motion_px is not None) and is_any_outline(solution, blobs_seen):
        return []
    if misfit and is_clipped_elsewhere(solution):
        return []
    if solution.most_motion_px > MOST_MOTION_PX:  # as a halo may draw it out beyond `moves`
        return []
    is_at_once = prepared.frame.line_time_s == 0.0  # else flares that move are not fitted as such
    if (solution.window.state != cluster.window.state).any():  # by the flanks of what is clipped alone
        whole = replace(solution, window=cluster.window)
        if not explains_flanks(solution, cluster.window) or (is_at_once and is_other_oval(whole, camera)):
            return []
    if misfit and cluster.is_clipped and is_at_once and is_other_limb(solution, camera):
        return []
    blobs: list[Blob | None] = [member.blob for member in cluster.members]
    wanted: Sequence[int] = cluster.wanted
    if solution.count != len(blobs) or solution.window.features is not None:
        wanted = range(solution.count)
        blobs = divide([member.blob for member in cluster.members], solution.u_px, solution.v_px)
    of_border = {k: is_border(solution, k, prepared.shape) for k in wanted}
    if solution.count > _MOST_BESIDE_BORDERS * len(cluster.members) and any(of_border.values()):
        return []
    told = with_turn(with_model_error(solution, camera), camera)
    return [
        (blob, measured_flare(told, k, blob, misfit, prepared))
        for k in wanted
        # What nothing lit belongs to only helps to explain what lies around.
        if (blob := blobs[k]) is not None and not of_border[k] and not is_long_clutter(solution, k, camera)
    ]
