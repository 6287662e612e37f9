"""Near sources whose discs are too large to be looked at for what hides them: fitted whole, or bounded."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import direction_camera
from perception.model.layout import CLIPPED, UNUSABLE
from perception.model.lens import stretch
from perception.model.ranging import brightness_e, covered_px_at_1_m
from perception.model.window import Camera
from perception.robust.around.uneven import MOST_LEFT
from perception.robust.clusters import LEAST_RANGE_M, Candidate, Cluster
from perception.robust.flare import MeasuredFlare, measured_flare
from perception.robust.forward_light import fit_beside_forward_light
from perception.robust.hiding.eclipse import pile_of
from perception.robust.large.aperture import mask_in, measure_by_aperture
from perception.robust.large.outline import Outline, outline_of
from perception.robust.large.whole import MOST_FITTED_RADIUS_PX, explained_by_one
from perception.robust.overlap.deblend import RESIDUAL_SIGMAS
from perception.robust.overlap.free_fits import of_free_width, with_model_error
from perception.robust.problem import Problem, Start, Window
from perception.robust.search.blobs import Blob, divide
from perception.robust.search.prepare import PreparedFrame
from perception.robust.solve import Solution, solve
from perception.robust.starts.guesses import least_flux_e
from perception.robust.verdict import is_border
from perception.types import Calibration

_LEAST_ROUND, _LEAST_ROUND_IF_CLIPPED = 0.3, 0.6
"""Parts of an outline that must lie on a circle: of a square's 0.2 do. The rest may be what lies around, or
missing; of a clipped disc the outline is all that is known."""

_LEAST_LIT = 2.0 / 3.0
"""Of the disc that the frame shows. A stripe's edge lies on a circle that is far larger than the stripe."""

_MOST_BRIGHTNESS_FACTOR = 2.0
_LEAST_OF_BLOB = 0.25  # that the disc of its outline is, where its light is to bound a range
_ODD_SIGMAS = 3.0
_SPILLS_ON_PX = 3
_BEYOND_PX = 0.5  # of the outline of what is clipped, where nothing that clips is a disc's own
_TIMES_LAID_OUT = 2  # a pixel elsewhere the lens stretches them otherwise


def measure_large(
    found: Sequence[Cluster],
    whole: Mapping[Cluster, Solution | None],
    prepared: PreparedFrame,
    camera: Camera,
    apart: bool,
) -> tuple[list[tuple[Blob, MeasuredFlare]], list[Candidate]]:
    """Measure clusters in which a blob is too large to be looked at closely, or has no range.

    Parameters
    ----------
    found, whole
        The clusters, and what one disc makes of those that seem to be one (`as_whole_discs`).
    prepared, camera
        The frame they are of, and its camera.
    apart
        That blobs side by side have been tried together before.

    Returns
    -------
    A blob and its measurement for each flare; and what is small among them, where whole discs do not explain
    a cluster: it is to be measured by itself.
    """
    explained = explained_by_one(whole, camera)
    measured, found = _piles([each for each in found if each not in explained], prepared, camera)
    for cluster, one in explained.items():
        measured += _by_disc(cluster, one, cluster.wanted, prepared, camera)
    again: list[Candidate] = []
    outlines = [_outlines(cluster, prepared) for cluster in found]
    discs = [_discs(cluster, of_it, prepared) for cluster, of_it in zip(found, outlines, strict=True)]
    problems = [
        _guess_by_outline(cluster, of_it, prepared) if any_disc else None
        for cluster, of_it, any_disc in zip(found, outlines, discs, strict=True)
    ]
    rows = zip(found, outlines, discs, _whole_discs(problems, camera), strict=True)
    for cluster, of_it, wanted, solution in rows:
        if solution is not None and _is_whole_discs(solution, cluster):
            measured += _by_disc(cluster, solution, wanted, prepared, camera)
            continue
        small = [] if apart else [k for k in cluster.wanted if not cluster.members[k].is_beyond_fit]
        again += [cluster.members[k] for k in small]
        for k in wanted:
            member = cluster.members[k]
            if k not in small and _is_most_of_blob(member, of_it[k], prepared):
                measured.append((member.blob, measure_by_aperture(member, cluster, prepared)))
    return measured, again


def _piles(
    found: Sequence[Cluster], prepared: PreparedFrame, camera: Camera
) -> tuple[list[tuple[Blob, MeasuredFlare]], list[Cluster]]:
    """Measure what several spheres, some partly behind others, explain; and return the other clusters.

    All of them by their outline.
    """
    measured: list[tuple[Blob, MeasuredFlare]] = []
    others: list[Cluster] = []
    for cluster in found:
        at_once = prepared.frame.line_time_s == 0.0
        pile = pile_of(cluster, camera, most_more=0) if at_once else None
        if pile is None or not pile.left_over.is_nothing or not pile.ranged.all():
            others.append(cluster)
            continue
        blobs = divide([member.blob for member in cluster.members], pile.u_px, pile.v_px)
        told = with_model_error(pile, camera)
        measured += [
            (blob, measured_flare(told, k, blob, False, prepared))
            for k, blob in enumerate(blobs)
            if blob is not None and not is_border(pile, k, prepared.shape)
        ]
    return measured, others


def _outlines(cluster: Cluster, prepared: PreparedFrame) -> list[Outline | None]:
    """Return the outlines of a cluster's members, None of those that are not too large."""
    return [outline_of(one.blob, prepared) if one.is_too_large else None for one in cluster.members]


def _is_most_of_blob(member: Candidate, outline: Outline | None, prepared: PreparedFrame) -> bool:
    """Tell whether a large clipped blob is the disc of its outline, so that its light bounds a range.

    Not the sliver of a disc beyond the frame's border, nor a clipped spot on a lit patch.
    """
    if outline is None or not member.is_clipped:
        return True
    box = member.blob.box
    inside_u = box.left <= outline.u_px < box.left + box.width
    inside_v = box.top <= outline.v_px < box.top + box.height
    calibration = prepared.calibration
    at_1_m_px2 = float(covered_px_at_1_m(np.array([[outline.u_px, outline.v_px]]), calibration)[0])
    disc_px2 = at_1_m_px2 * (outline.angle_rad / calibration.source_radius_m) ** 2
    return inside_u and inside_v and disc_px2 > _LEAST_OF_BLOB * member.blob.area_px


def _whole_discs(guesses: Sequence[Problem | None], camera: Camera) -> list[Solution | None]:
    """Fit whole discs; None where there are no guesses of any, or the fit did not converge."""
    solutions: list[Solution | None] = [None] * len(guesses)
    tried = [index for index, guess in enumerate(guesses) if guess is not None]
    problems = [guess for guess in guesses if guess is not None]
    for _ in range(_TIMES_LAID_OUT):
        for index, solution in zip(tried, solve(problems, camera), strict=True):
            solutions[index] = solution
        tried = [index for index in tried if solutions[index] is not None]
        problems = [one.again() for one in solutions if one is not None]
    fit_beside_forward_light(solutions, camera)
    blurred = [index for index, one in enumerate(solutions) if one is not None and _is_misfit(one)]
    wider = of_free_width([one for k in blurred if (one := solutions[k]) is not None], camera)
    for index, free in zip(blurred, wider, strict=True):
        held = solutions[index]
        if free is not None and held is not None and free.cost < held.cost:
            solutions[index] = free
    return solutions


def _guess_by_outline(
    cluster: Cluster, outlines: Sequence[Outline | None], prepared: PreparedFrame
) -> Problem | None:
    """Return the problem of large discs, from what is seen of their outlines, which the frame may cut.

    What is clipped outside of them is left out: charge spills along columns. None where a member has no
    range, no outline of a sphere, or is larger than images are laid out for.
    """
    from scipy.ndimage import binary_dilation

    calibration = prepared.calibration
    starts: list[Start] = []
    within = np.zeros(cluster.window.state.shape, dtype=np.bool_)
    for member, outline in zip(cluster.members, outlines, strict=True):
        if not (member.at_one_metre_e > 0.0 and calibration.source_radius_m > 0.0):
            return None
        if not member.is_too_large:
            flux_e = max(member.flux_e, least_flux_e(prepared))
            starts.append((member.u_px, member.v_px, member.log_range(flux_e)))
            within |= mask_in(cluster.window.box.top, cluster.window.box.left, within.shape, member.blob)
            continue
        if outline is None:
            return None
        middle_px = (outline.u_px, outline.v_px)
        direction = direction_camera([middle_px], calibration)
        px_per_rad = float(stretch(direction, calibration)[0])
        if not outline.angle_rad * px_per_rad < MOST_FITTED_RADIUS_PX:
            return None
        starts.append((*middle_px, math.log(calibration.source_radius_m / math.sin(outline.angle_rad))))
        within |= _within(
            outline.angle_rad + _BEYOND_PX / px_per_rad, direction[0], cluster.window, calibration
        )
    spilled = (cluster.window.state == CLIPPED) & ~within
    # Charge that ends on a disc's own limb cannot be told from the limb.
    spilled = binary_dilation(spilled, np.ones((2 * _SPILLS_ON_PX + 1, 1), dtype=np.bool_))
    state = np.where(spilled, UNUSABLE, cluster.window.state)
    return Problem(replace(cluster.window, state=state.astype(np.uint8)), starts, cluster.background_e)


def _within(
    angle_rad: float, axis: NDArray[np.float64], window: Window, calibration: Calibration
) -> NDArray[np.bool_]:
    """Mark the pixels of a window within an angle of a direction."""
    box = window.box
    rows, columns = np.mgrid[box.top : box.top + box.height, box.left : box.left + box.width]
    directions = direction_camera(np.column_stack([columns.ravel(), rows.ravel()]), calibration)
    return np.asarray((directions @ axis > math.cos(angle_rad)).reshape(window.state.shape))


def _is_no_large_disc(member: Candidate, outline: Outline | None, prepared: PreparedFrame) -> bool:
    """Tell whether a blob too large to be fitted is no source: by its outline, its brightness, its range.

    The outline of a sphere is a circle in the sky, and it is as bright at any range: its flux at one metre
    over the solid angle that it fills there, times that of a pixel.
    """
    calibration = prepared.calibration
    if outline is None or outline.share < (_LEAST_ROUND_IF_CLIPPED if member.is_clipped else _LEAST_ROUND):
        return True
    if outline.lit < _LEAST_LIT:
        return True
    if calibration.source_radius_m / math.sin(outline.angle_rad) < LEAST_RANGE_M:
        return True
    if not member.at_one_metre_e > 0.0:
        return False
    frame, place = prepared.frame, np.array([[member.u_px, member.v_px]])
    disc_e = float(brightness_e(place, frame.exposure_s, frame.gain, calibration)[0])
    seen_e = float(np.median(prepared.excess_e[member.blob.box.slices][member.blob.pixels]))
    if disc_e > seen_e:
        return not member.is_clipped and disc_e > _MOST_BRIGHTNESS_FACTOR * seen_e
    return seen_e > _MOST_BRIGHTNESS_FACTOR * disc_e


def _discs(cluster: Cluster, outlines: Sequence[Outline | None], prepared: PreparedFrame) -> list[int]:
    """Return which wanted members of a cluster are no lamps by their outlines and their brightness."""
    members = ((k, cluster.members[k]) for k in cluster.wanted)
    return [
        k for k, one in members if not (one.is_too_large and _is_no_large_disc(one, outlines[k], prepared))
    ]


def _is_whole_discs(solution: Solution, cluster: Cluster) -> bool:
    """Tell whether whole discs leave so little that they are taken for sources: of what clips no misfit."""
    if cluster.is_clipped and _is_misfit(solution):
        return False
    return solution.left_over.share <= MOST_LEFT and bool(solution.ranged.all())


def _by_disc(
    cluster: Cluster, solution: Solution, wanted: Sequence[int], prepared: PreparedFrame, camera: Camera
) -> list[tuple[Blob, MeasuredFlare]]:
    """Turn a fit of whole large discs into measurements.

    A disc that is not all there, or not alone, leaves light over: about twice as much its flux may lack, or
    have too much, as the fit has taken a part of it up; by such a share of its radius it may be elsewhere.
    """
    misfit = _is_misfit(solution)
    measured = []
    told = with_model_error(solution, camera)
    for k in wanted:
        blob = cluster.members[k].blob
        one = measured_flare(told, k, blob, misfit, prepared)
        if misfit:
            share = 2.0 * _odd_share(solution)
            away_px = share * float(solution.image_radius_px[k])
            one = replace(
                one,
                u_sigma_px=math.hypot(one.u_sigma_px, away_px),
                v_sigma_px=math.hypot(one.v_sigma_px, away_px),
                flux_sigma_e=math.hypot(one.flux_sigma_e, share * one.flux_e),
                range_sigma_m=math.hypot(one.range_sigma_m, 0.5 * share * one.range_m),
                log_range_doubt=math.hypot(one.log_range_doubt, 0.5 * share),
            )
        measured.append((blob, one))
    return measured


def _is_misfit(solution: Solution) -> bool:
    """Tell whether what whole discs leave over is more than noise."""
    left = solution.left_over
    return not left.is_good or left.peak_sigmas > RESIDUAL_SIGMAS


def _odd_share(solution: Solution) -> float:
    """Return how much light more or less is seen than chance explains, relative to the flares' light."""
    away_e = np.abs(solution.residual_e)
    odd_e = away_e[away_e > _ODD_SIGMAS * np.sqrt(solution.variance_e2(0.0))]
    return float(odd_e.sum() / max(float(solution.flares_e.sum()), 1e-300))
