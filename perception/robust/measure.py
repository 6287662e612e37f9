"""From clusters to measured flares: the fit, what to do where it is bad, and what is no source at all."""

import math
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace

import numpy as np

from perception.model.fog import may_be_in_fog
from perception.model.ranging import range_from_flux
from perception.model.sensor import gain_dn_per_e
from perception.model.window import Camera
from perception.robust.aperture import aperture_flux, centroid_sigmas, mask_in
from perception.robust.around.uneven import MOST_LEFT
from perception.robust.clusters import LEAST_RANGE_M, Candidate, Cluster, clusters, guess_by_outline
from perception.robust.explain import best
from perception.robust.forward_light import fit_beside_forward_light
from perception.robust.motion import is_long_clutter
from perception.robust.overlap.deblend import RESIDUAL_SIGMAS, of_free_size, of_free_width
from perception.robust.overlap.eclipse import hidden_log_range
from perception.robust.problem import Problem
from perception.robust.search.blobs import Blob, dilated, divide
from perception.robust.search.prepare import PreparedFrame
from perception.robust.solve import Solution, solve
from perception.robust.verdict import (
    is_any_outline,
    is_border,
    is_clipped_elsewhere,
    is_hardly_seen,
    is_no_large_disc,
    is_on_flank,
    is_other_limb,
    is_other_size,
)

CLIPPED_RANGE_SIGMA = 0.125
"""A clipped flare counts as recovered if its fit claims its range to better than this, relatively."""

MOST_LEFT_ON_EDGES = 0.1

_ODD_SIGMAS = 3.0
_IN_VIEW_PX = 1000  # farther than any window reaches

_TIMES_LAID_OUT = 2  # large discs: a pixel elsewhere the lens stretches them otherwise


@dataclass(frozen=True)
class MeasuredFlare:
    """Place, flux and range of a flare; NaN where no claim is made. `background_e` is per pixel.

    `flux_noise_e` is the part of the σ of its flux that its light brings, not that it may be another's.
    `log_range_doubt` is the part of the relative σ of its range that comes of what sources hide, of each
    other and of the background, and of its being two perhaps; `log_range_doubt_common` that of the background
    alone.
    """

    u_px: float
    v_px: float
    u_sigma_px: float
    v_sigma_px: float
    flux_e: float
    flux_sigma_e: float
    flux_noise_e: float
    background_e: float
    range_m: float
    range_sigma_m: float
    range_sigma_common_m: float = math.nan
    range_by_size_m: float = math.nan
    range_by_size_sigma_m: float = math.nan
    log_range_doubt: float = 0.0
    log_range_doubt_common: float = 0.0
    saturated: bool = False
    misfit: bool = False
    is_doubtful: bool = False
    may_be_more: bool = False
    on_texture: bool = False
    on_edges: bool = False

    @property
    def stands_out(self) -> bool:
        """Whether its flux exceeds the background right beside it by 4 σ.

        A clipped one always does, but for one that does not look like a source and whose flux is unknown.
        What only the coarse background made look bright, such as the border of a shadow, does not. On
        texture, which need not be as normal as the fit takes it to be, it must exceed 8 σ; on edges, which
        never are, where something is left beside it, and where it does not look like a source, 10 σ.
        """
        least = 10.0 if self.misfit or self.on_edges else 8.0 if self.on_texture else 4.0
        if self.saturated:
            return not (self.misfit and self.flux_noise_e > self.flux_e)
        return self.flux_e > 0.0 and not self.flux_e < least * self.flux_noise_e


def measure(
    found: Sequence[Cluster],
    prepared: PreparedFrame,
    apart: bool = False,
    before: Sequence[Candidate] = (),
) -> list[tuple[Blob, MeasuredFlare]]:
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
    prepared
        The frame.
    apart
        That blobs side by side have been tried together before.
    before
        What was measured before.

    Returns
    -------
    A blob and its measurement for each flare.
    """
    camera = Camera(prepared.calibration, prepared.frame.exposure_s, prepared.frame.gain)
    fitted = [cluster for cluster in found if not any(member.is_beyond_fit for member in cluster.members)]
    solutions = best(fitted, prepared, camera)
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
    others = [cluster for cluster in found if any(member.is_beyond_fit for member in cluster.members)]
    for cluster, solution in zip(others, _of_large_discs(others, prepared, camera), strict=True):
        fits = solution is not None and _is_whole_discs(solution)
        small = [] if fits or apart else [k for k in cluster.wanted if not cluster.members[k].is_beyond_fit]
        again += [cluster.members[k] for k in small]
        measured += _by_disc(cluster, solution if fits else None, small, prepared)
    if again:
        # What spoils a cluster spoils it for all: each by itself, the others left out.
        measured += measure(clusters(again, prepared, apart=True, measured=done), prepared, True, done)
    if unseen:
        # Of two side by side that spoil nothing each leaves out too much of the other.
        together = [one for one in clusters(unseen, prepared, measured=done) if len(one.members) > 1]
        measured += measure(together, prepared, True, done)
    if on_flank:
        # Of what is bright beside it an edge may be the whole story: all of it in view.
        in_view = clusters(on_flank, prepared, apart=True, measured=done, within_px=_IN_VIEW_PX)
        measured += measure(in_view, prepared, True, done)
    return measured


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
    # An edge is long, too: what is drawn out on edges must leave hardly any of them.
    drawn_out = solution.motion_px is not None and solution.window.on_edges
    doubted = misfit or cluster.is_clipped or drawn_out
    most_left = MOST_LEFT_ON_EDGES if solution.window.on_edges else MOST_LEFT
    # Of what is clipped too much is unseen for that it may be two to excuse it.
    if doubted and left.share > most_left and (cluster.is_clipped or solution.log_range_of_two == 0.0):
        return []
    if float(solution.log_range.min()) < math.log(LEAST_RANGE_M) and bool(solution.ranged.all()):
        return []
    if cluster.is_clipped and is_any_outline(solution, len(cluster.members)):
        return []
    if misfit and is_clipped_elsewhere(solution):
        return []
    is_at_once = prepared.frame.line_time_s == 0.0  # else flares that move are not fitted as such
    if misfit and cluster.is_clipped and is_at_once and is_other_limb(solution, camera):
        return []
    blobs: list[Blob | None] = [member.blob for member in cluster.members]
    wanted: Sequence[int] = cluster.wanted
    if solution.count != len(blobs) or solution.window.features is not None:
        wanted = range(solution.count)
        blobs = divide([member.blob for member in cluster.members], solution.u_px, solution.v_px)
    return [
        (blob, _measurement(solution, k, blob, misfit, prepared))
        for k in wanted
        # What nothing lit belongs to only helps to explain what lies around.
        if (blob := blobs[k]) is not None
        and not is_border(solution, k, prepared.shape)
        and not is_long_clutter(solution, k, camera)
    ]


def _measurement(
    solution: Solution, index: int, blob: Blob, misfit: bool, prepared: PreparedFrame
) -> MeasuredFlare:
    """Turn one flare of a solution into a measurement, its sigmas wider where the fit is bad."""
    left = solution.left_over
    widening = math.sqrt(max(left.chi2 / max(left.pixels, 1), 1.0)) if misfit else 1.0
    u_px, v_px = float(solution.u_px[index]), float(solution.v_px[index])
    flux_e = float(solution.flux_e[index])
    flux_sigma_e = float(solution.flux_sigma_e[index]) * widening
    hidden = hidden_log_range(solution, index)
    doubt = math.hypot(hidden / math.sqrt(3.0), solution.log_range_of_two)
    of_one = math.hypot(float(solution.log_range_sigma[index]) * widening, hidden / math.sqrt(3.0))
    of_background = float(solution.log_range_hidden[index])
    # The flux is unbiased, so noise alone makes d too large on average, as in `range_from_flux`.
    range_m = math.nan
    if solution.ranged[index]:
        relative = min(flux_sigma_e / flux_e, 1.0)
        range_m = math.exp(float(solution.log_range[index])) / (1.0 + 0.375 * relative**2)
    saturated = bool((blob.pixels & prepared.clipped_in(blob.box)).any())
    told_sigma = of_one  # that it may be two does not make a clipped one a bound
    if may_be_in_fog(prepared.calibration):
        # The range that this fit states is loosely tied to the flux, which tells it in fog.
        told_sigma = math.hypot(0.5 * flux_sigma_e / flux_e, hidden / math.sqrt(3.0))
    on_edge = solution.window.features is not None
    bound_only = saturated and not told_sigma < CLIPPED_RANGE_SIGMA
    return MeasuredFlare(
        u_px=u_px,
        v_px=v_px,
        u_sigma_px=math.nan if bound_only else float(solution.u_sigma_px[index]) * widening,
        v_sigma_px=math.nan if bound_only else float(solution.v_sigma_px[index]) * widening,
        flux_e=flux_e,
        flux_sigma_e=flux_sigma_e,
        flux_noise_e=float(solution.flux_noise_e[index]) * widening,
        background_e=solution.background_e,
        range_m=range_m,
        range_sigma_m=math.nan if bound_only else range_m * math.hypot(of_one, solution.log_range_of_two),
        range_sigma_common_m=math.nan if bound_only else range_m * float(solution.log_range_common[index]),
        log_range_doubt=math.hypot(of_background * widening, doubt),
        log_range_doubt_common=of_background,
        saturated=saturated,
        misfit=misfit,
        is_doubtful=solution.is_doubtful or hidden > of_one,
        may_be_more=solution.may_be_more,
        on_texture=solution.window.structure_e > 0.0,
        on_edges=solution.window.on_edges or on_edge or left.peak_sigmas > RESIDUAL_SIGMAS,
    )


def _of_large_discs(
    found: Sequence[Cluster], prepared: PreparedFrame, camera: Camera
) -> list[Solution | None]:
    """Fit whole discs to clusters of large ones; None where there are none, or the fit did not converge."""
    solutions: list[Solution | None] = [None] * len(found)
    tried: list[int] = []
    problems = []
    for index, cluster in enumerate(found):
        starts = guess_by_outline(cluster, prepared)
        if starts is not None and _large_discs(cluster, prepared):
            tried.append(index)
            problems.append(Problem(cluster.window, starts, cluster.background_e))
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


def _large_discs(cluster: Cluster, prepared: PreparedFrame) -> list[int]:
    """Return which wanted members of a cluster are no lamps by their outlines and their brightness."""
    members = ((k, cluster.members[k]) for k in cluster.wanted)
    return [k for k, one in members if not (one.is_too_large and is_no_large_disc(one, prepared))]


def _is_whole_discs(solution: Solution) -> bool:
    """Tell whether whole discs leave so little that they are taken for sources."""
    return solution.left_over.share <= MOST_LEFT and bool(solution.ranged.all())


def _by_disc(
    cluster: Cluster, solution: Solution | None, without: Container[int], prepared: PreparedFrame
) -> list[tuple[Blob, MeasuredFlare]]:
    """Turn a fit of whole large discs into measurements, or sum apertures where there is none that is one.

    Some members, to be measured otherwise, are left out.

    A disc that is not all there, or not alone, leaves light over: about twice as much its flux may lack, or
    have too much, as the fit has taken a part of it up; by such a share of its radius it may be elsewhere.
    """
    wanted = [k for k in _large_discs(cluster, prepared) if k not in without]
    if solution is None:
        return [
            (cluster.members[k].blob, _from_aperture(cluster.members[k], cluster, prepared)) for k in wanted
        ]
    misfit = _is_misfit(solution)
    measured = []
    for k in wanted:
        blob = cluster.members[k].blob
        one = _measurement(solution, k, blob, misfit, prepared)
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


def _from_aperture(member: Candidate, cluster: Cluster, prepared: PreparedFrame) -> MeasuredFlare:
    """Sum what exceeds a ring around the blob, at its centroid.

    Whether it is all of a source's light, and no other's, nothing tells: no σ of range is claimed, and none
    of the place of what is large.
    """
    blob, window = member.blob, cluster.window
    frame, calibration = prepared.frame, prepared.calibration
    reach_px = 0.5 * math.hypot(blob.box.height, blob.box.width) + 2.0
    own = mask_in(window.box.top, window.box.left, window.usable.shape, blob)
    lit = prepared.lit_in(window.box) & ~own
    aperture = aperture_flux(
        window.image_e,
        member.u_px - window.box.left,
        member.v_px - window.box.top,
        reach_px,
        reach_px,
        reach_px + 4.0,
        window.usable & ~dilated(lit, 2),
    )
    gain = gain_dn_per_e(frame, calibration)
    ranged = range_from_flux(
        aperture.flux * gain,
        aperture.flux_sigma * gain,
        member.u_px,
        member.v_px,
        frame.exposure_s,
        frame.gain,
        calibration,
        aperture.background * gain,
    )
    has_place = not (member.is_clipped or member.is_too_large)
    u_sigma_px, v_sigma_px = centroid_sigmas(member, aperture.flux, prepared)
    return MeasuredFlare(
        u_px=member.u_px,
        v_px=member.v_px,
        u_sigma_px=u_sigma_px if has_place else math.nan,
        v_sigma_px=v_sigma_px if has_place else math.nan,
        flux_e=aperture.flux,
        flux_sigma_e=aperture.flux_sigma,
        flux_noise_e=aperture.flux_sigma,
        background_e=aperture.background,
        range_m=ranged.range_m,
        range_sigma_m=math.nan,
        saturated=member.is_clipped,
        misfit=member.is_too_large and not member.is_clipped,
    )
