"""From clusters to measured flares: the fit, what to do where it is bad, and what is no source at all."""

import math
from collections.abc import Container, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.model.layout import UNUSABLE
from perception.model.ranging import range_from_flux
from perception.model.sensor import gain_dn_per_e
from perception.model.window import Camera
from perception.robust.aperture import aperture_flux
from perception.robust.clusters import Candidate, Cluster, clusters, dilated, guesses
from perception.robust.deblend import RESIDUAL_SIGMAS, deblend, of_free_size
from perception.robust.forward_light import fit_beside_forward_light
from perception.robust.goodness import halo_sigmas
from perception.robust.search.blobs import Blob, divide
from perception.robust.search.prepare import PreparedFrame
from perception.robust.solve import Problem, Solution, solve
from perception.robust.structure import EDGES, halo_of, halo_widths_px, joined, structure_of
from perception.robust.verdict import (
    LEAST_RANGE_M,
    is_border,
    is_hardly_seen,
    is_no_large_disc,
    is_one_pixel,
    is_other_size,
)

CLIPPED_RANGE_SIGMA = 0.125
"""A clipped flare counts as recovered if its fit claims its range to better than this, relatively."""

HALO_SEEMS_SIGMAS = 1.5
HALO_GAIN = 10.0
"""2 Δ ln L that a halo must bring: noise gives χ² of three degrees of freedom, 10 twice in a hundred."""

MOST_LEFT = 0.25
"""What a fit may leave over, relative to the flares' light, of what is still called a source."""

MOST_LEFT_ON_EDGES = 0.1


@dataclass(frozen=True)
class MeasuredFlare:
    """Place, flux and range of a flare; NaN where no claim is made. `background_e` is per pixel."""

    u_px: float
    v_px: float
    u_sigma_px: float
    v_sigma_px: float
    flux_e: float
    flux_sigma_e: float
    background_e: float
    range_m: float
    range_sigma_m: float
    range_sigma_common_m: float = math.nan
    range_by_size_m: float = math.nan
    range_by_size_sigma_m: float = math.nan
    saturated: bool = False
    misfit: bool = False
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
            return not (self.misfit and self.flux_sigma_e > self.flux_e)
        return self.flux_e > 0.0 and not self.flux_e < least * self.flux_sigma_e


def measure(
    found: Sequence[Cluster], prepared: PreparedFrame, apart: bool = False
) -> list[tuple[Blob, MeasuredFlare]]:
    """Measure clusters, and leave out what is no source.

    Flares of known size and strength are fitted to each window. What a fit leaves over may be more flares
    (`deblend`), or charge that clipped pixels spilled over their columns. Blobs that are too large to be
    fitted, or have no range, are measured by aperture; the flux of a clipped one is then a lower bound.

    Parameters
    ----------
    found
        The clusters.
    prepared
        The frame.
    apart
        That blobs side by side have been tried together before.

    Returns
    -------
    A blob and its measurement for each flare.
    """
    camera = Camera(prepared.calibration, prepared.frame.exposure_s, prepared.frame.gain)
    fitted = [cluster for cluster in found if not any(member.is_beyond_fit for member in cluster.members)]
    solutions = _best(fitted, prepared, camera)
    odd = [index for index, solution in enumerate(solutions) if solution is not None and _is_odd(solution)]
    of_odd = of_free_size([solution for k in odd if (solution := solutions[k]) is not None], camera)
    free = dict(zip(odd, of_odd, strict=True))
    measured: list[tuple[Blob, MeasuredFlare]] = []
    again: list[Candidate] = []
    for index, (cluster, solution) in enumerate(zip(fitted, solutions, strict=True)):
        other_size = (
            index in free and solution is not None and is_other_size(solution, free[index], camera.tie_spread)
        )
        judged = [] if solution is None or other_size else _judged(cluster, solution, prepared)
        measured += judged
        if not judged and len(cluster.members) > 1 and not apart:
            again += [cluster.members[k] for k in cluster.wanted]
    if again:
        # What spoils a cluster spoils it for all: each by itself, the others left out.
        measured += measure(clusters(again, prepared, apart=True), prepared, apart=True)
    others = [cluster for cluster in found if any(member.is_beyond_fit for member in cluster.members)]
    return measured + [each for cluster in others for each in _by_apertures(cluster, prepared)]


def _best(found: Sequence[Cluster], prepared: PreparedFrame, camera: Camera) -> list[Solution | None]:
    """Solve clusters, and deblend them."""
    problems = [
        (index, Problem(cluster.window, starts, cluster.background_e))
        for index, cluster in enumerate(found)
        for starts in guesses(cluster, prepared)
    ]
    best: list[Solution | None] = [None] * len(found)
    for (index, _), solution in zip(problems, solve([p for _, p in problems], camera), strict=True):
        held = best[index]
        if solution is not None and (held is None or solution.deviance < held.deviance):
            best[index] = solution
    for index, (cluster, solution) in enumerate(zip(found, best, strict=True)):
        if len(cluster.members) == 1 and solution is not None and is_one_pixel(solution):
            best[index] = None
    fit_beside_forward_light(best, camera)
    # Behind a rolling shutter a drive that switches while rows are read leaves a part of one flare, which two
    # flares would explain better.
    parted = {}
    if prepared.frame.line_time_s == 0.0:
        plain = [None if c.is_in_crowd else s for c, s in zip(found, best, strict=True)]
        parted = _parted(plain, prepared.shape, camera)
    _retry_without_spill(best, parted, prepared, camera)
    uneven_e = [0.0 if one is None else one.left_over.structure_e for one in best]
    # Many flares where one blob was seen may be something wide: its whole residual counts.
    spread_e = {
        index: one.excess_e
        for index, more in parted.items()
        if (one := best[index]) is not None and more.count > one.count + 1
    }
    for index in _retry_with_halo(best, camera):
        uneven_e[index] = one.left_over.structure_e if (one := best[index]) else 0.0
    uneven_e = [left_e or spread_e.get(index, 0.0) for index, left_e in enumerate(uneven_e)]
    _retry_on_uneven_ground(best, uneven_e, camera)
    for index, more in parted.items():
        if (one := best[index]) is None or more.cost < one.cost:
            best[index] = more
    return best


def _parted(plain: Sequence[Solution | None], shape: tuple[int, int], camera: Camera) -> dict[int, Solution]:
    """Deblend, and return by index what explains all that is seen: enough flares explain anything by half.

    Flares that would shine where a window does not look explain nothing.
    """
    tried = [(index, one) for index, one in enumerate(plain) if one is not None]
    more = deblend([one for _, one in tried], camera)
    return {
        index: several
        for (index, one), several in zip(tried, more, strict=True)
        if several is not one
        and several.left_over.is_good
        and several.left_over.structure_e == 0.0
        and not any(is_hardly_seen(several, k, shape) for k in range(several.count))
    }


def _retry_with_halo(best: list[Solution | None], camera: Camera) -> list[int]:
    """Fit lone flares again that seem to have a halo: a wall behind a source shines around it, and in it.

    Returns which have one.
    """
    tried: list[tuple[int, Solution]] = []
    problems = []
    for index, solution in enumerate(best):
        if solution is None or solution.count != 1:
            continue
        u_px, v_px, _ = solution.starts[0]
        radius_px, flux_e = float(solution.image_radius_px[0]), float(solution.flux_e[0])
        window = solution.window
        seems = halo_sigmas(
            window.image_e, window.state, solution.expected_e, window.floor_e2, window.prnu,
            (u_px - window.box.left, v_px - window.box.top), halo_widths_px(radius_px),
        )  # fmt: skip
        if seems < HALO_SEEMS_SIGMAS:
            continue
        halo = halo_of(window.box, u_px, v_px, radius_px, flux_e)
        tried.append((index, solution))
        problems.append(solution.again(replace(window, structure=joined(window.structure, halo))))
    having = []
    for (index, without), again in zip(tried, solve(problems, camera), strict=True):
        if again is not None and without.deviance - again.deviance > HALO_GAIN:
            best[index] = again
            having.append(index)
    return having


def _retry_on_uneven_ground(best: list[Solution | None], uneven_e: Sequence[float], camera: Camera) -> None:
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


def _retry_without_spill(
    best: list[Solution | None], parted: Container[int], prepared: PreparedFrame, camera: Camera
) -> None:
    """Fit badly fitted clipped flares without the columns of clipped pixels, where charge may spill."""
    tried, problems = [], []
    for index, solution in enumerate(best):
        if solution is None or index in parted or solution.left_over.is_good:
            continue
        # Also those of flares that are none of the window's.
        spilled = prepared.clipped_columns(solution.window.box)
        if spilled.any():
            tried.append(index)
            state = np.where(spilled, UNUSABLE, solution.window.state).astype(np.uint8)
            problems.append(solution.again(replace(solution.window, state=state)))
    for index, again in zip(tried, solve(problems, camera), strict=True):
        if again is not None and again.left_over.share < MOST_LEFT:
            best[index] = again


def _is_odd(solution: Solution) -> bool:
    """Tell whether a lone flare fits so badly that its size has to be looked at."""
    return solution.count == 1 and not solution.left_over.is_good


def _judged(
    cluster: Cluster, solution: Solution, prepared: PreparedFrame
) -> list[tuple[Blob, MeasuredFlare]]:
    """Turn a solution into measurements, if it is one of sources."""
    left = solution.left_over
    misfit = not left.is_good or (solution.count == 1 and left.peak_sigmas > RESIDUAL_SIGMAS)
    doubted = misfit or cluster.is_clipped
    most_left = MOST_LEFT_ON_EDGES if solution.window.on_edges else MOST_LEFT
    if doubted and left.share > most_left:
        return []
    if float(solution.log_range.min()) < math.log(LEAST_RANGE_M) and bool(solution.ranged.all()):
        return []
    blobs: list[Blob | None] = [member.blob for member in cluster.members]
    wanted: Sequence[int] = cluster.wanted
    if solution.count != len(blobs):
        wanted = range(solution.count)
        blobs = divide([member.blob for member in cluster.members], solution.u_px, solution.v_px)
    return [
        (blob, _measurement(solution, k, blob, misfit, prepared))
        for k in wanted
        # What nothing lit belongs to only helps to explain what lies around.
        if (blob := blobs[k]) is not None and not is_border(solution, k, prepared.shape)
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
    log_sigma = float(solution.log_range_sigma[index]) * widening
    # The flux is unbiased, so noise alone makes d too large on average, as in `range_from_flux`.
    range_m = math.nan
    if solution.ranged[index]:
        relative = min(flux_sigma_e / flux_e, 1.0)
        range_m = math.exp(float(solution.log_range[index])) / (1.0 + 0.375 * relative**2)
    frame = prepared.frame
    clips = blob.pixels & (frame.data_dn[blob.box.slices] >= prepared.clipped_dn)
    if clips.any() and len(prepared.bad_at):
        clips &= ~prepared.bad[blob.box.slices]
    saturated = bool(clips.any())
    bound_only = saturated and not log_sigma < CLIPPED_RANGE_SIGMA
    return MeasuredFlare(
        u_px=u_px,
        v_px=v_px,
        u_sigma_px=math.nan if bound_only else float(solution.u_sigma_px[index]) * widening,
        v_sigma_px=math.nan if bound_only else float(solution.v_sigma_px[index]) * widening,
        flux_e=flux_e,
        flux_sigma_e=flux_sigma_e,
        background_e=solution.background_e,
        range_m=range_m,
        range_sigma_m=math.nan if bound_only else range_m * log_sigma,
        range_sigma_common_m=math.nan if bound_only else range_m * float(solution.log_range_common[index]),
        saturated=saturated,
        misfit=misfit,
        on_texture=solution.window.structure_e > 0.0,
        on_edges=solution.window.on_edges or left.peak_sigmas > RESIDUAL_SIGMAS,
    )


def _by_apertures(cluster: Cluster, prepared: PreparedFrame) -> list[tuple[Blob, MeasuredFlare]]:
    return [
        (member.blob, _from_aperture(member, cluster, prepared))
        for member in (cluster.members[k] for k in cluster.wanted)
        if not (member.is_too_large and is_no_large_disc(member, prepared))
    ]


def _from_aperture(member: Candidate, cluster: Cluster, prepared: PreparedFrame) -> MeasuredFlare:
    """Sum what exceeds a ring around the blob, at its centroid."""
    blob, window = member.blob, cluster.window
    frame, calibration = prepared.frame, prepared.calibration
    reach_px = 0.5 * math.hypot(blob.box.height, blob.box.width) + 2.0
    own = _mask_in(window.box.top, window.box.left, window.usable.shape, blob)
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
    camera = Camera(calibration, frame.exposure_s, frame.gain)
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
    u_sigma_px, v_sigma_px = _centroid_sigmas(member, aperture.flux, prepared)
    return MeasuredFlare(
        u_px=member.u_px,
        v_px=member.v_px,
        u_sigma_px=math.nan if member.is_clipped else u_sigma_px,
        v_sigma_px=math.nan if member.is_clipped else v_sigma_px,
        flux_e=aperture.flux,
        flux_sigma_e=aperture.flux_sigma,
        background_e=aperture.background,
        range_m=ranged.range_m,
        range_sigma_m=math.nan if member.is_clipped else ranged.range_sigma_m,
        range_sigma_common_m=math.nan if member.is_clipped else 0.5 * ranged.range_m * camera.flux_spread,
        saturated=member.is_clipped,
        misfit=not member.is_clipped and not member.is_beyond_fit,
    )


def _mask_in(top: int, left: int, shape: tuple[int, ...], blob: Blob) -> NDArray[np.bool_]:
    """Mark the blob's pixels in a mask over a window that holds it."""
    mask = np.zeros(shape, dtype=bool)
    row, column = blob.box.top - top, blob.box.left - left
    mask[row : row + blob.box.height, column : column + blob.box.width] = blob.pixels
    return mask


def _centroid_sigmas(member: Candidate, flux_e: float, prepared: PreparedFrame) -> tuple[float, float]:
    """Compute the centroid's standard deviations: √(Σ (x - x̄)² variance) / flux along each axis."""
    if not flux_e > 0.0:
        return math.nan, math.nan
    blob = member.blob
    light_e = prepared.excess_e[blob.box.slices][blob.pixels] + prepared.background_e(
        member.u_px, member.v_px
    )
    variance = np.maximum(light_e, 0.0) + prepared.floor_e2
    rows, columns = np.nonzero(blob.pixels)
    return (
        math.sqrt(float(np.sum((blob.box.left + columns - member.u_px) ** 2 * variance))) / flux_e,
        math.sqrt(float(np.sum((blob.box.top + rows - member.v_px) ** 2 * variance))) / flux_e,
    )
