"""Flares that overlap: fitted together, their number decided by likelihood.

Flares are added where the residual asks for one, as long as the likelihood gains more than noise or a wrong
point spread could give it. (Joint fits of point spreads in crowded fields: Stetson, Publ. Astron. Soc. Pac.
99, 191, 1987.)
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from perception.model.window import Camera
from perception.robust.goodness import MODEL_ERROR
from perception.robust.overlap.free_fits import of_free_size, of_free_width
from perception.robust.problem import Problem, Start
from perception.robust.solve import Solution, solve

MOST_FLARES = 8
"""So many flares one window is divided into at most."""

MOST_WINDOWS = 100
"""In so many windows of a frame more flares are looked for at most, the brightest: it bounds the time."""

LEAST_GAIN = 40.0
"""2 Δ ln L that one more flare must bring: noise gives χ² of three degrees of freedom, 40 once in 10⁸."""

RESIDUAL_SIGMAS = 5.5
"""Where the residual, matched to a point's image, exceeds this, another flare is tried."""

_LEAST_RADIUS_PX = 1.0


def deblend(
    solutions: Sequence[Solution], camera: Camera, halos: Mapping[int, Solution] | None = None
) -> list[Solution]:
    """Explain windows by as many flares as their likelihoods ask for.

    Adds one flare at a time where the residual is brightest (or, close to a flare, along the axis in which it
    is too long), until a further one would bring less than `LEAST_GAIN`. A lone flare must first fail to be
    one whose image is wider or narrower than the point spread says, so that a calibration that is wrong by
    some per cent splits nothing.

    Parameters
    ----------
    solutions, camera
        What explains each window so far, and the frame's camera.
    halos
        By index lone flares with the light that a wall behind them throws back: where that leaves nothing to
        explain no other flare is looked for, and where it explains more than a second flare further ones are
        looked for beside it.

    Returns
    -------
    The windows' solutions, those given where nothing is gained; where the search was cut short they say so.
    """
    found, beside = list(solutions), dict(halos or {})
    asking = [
        index
        for index, each in enumerate(found)
        if asks_for_more(each) and (index not in beside or _leaves_something(beside[index]))
    ]
    if not asking:
        return found
    by_flux = sorted(asking, key=lambda index: -float(found[index].flux_e.max()))
    asking, late = sorted(by_flux[:MOST_WINDOWS]), by_flux[MOST_WINDOWS:]
    null = dict(enumerate(found))
    while asking:
        trials = [(index, starts) for index in asking for starts in with_one_more(found[index])]
        asking = []
        for index, fit in gaining(trials, dict(enumerate(found)), null, camera).items():
            halo = beside.pop(index, None)
            if halo is not None and halo.cost < fit.cost:
                fit = halo
            found[index] = null[index] = fit
            if asks_for_more(fit):
                (asking if fit.count < MOST_FLARES else late).append(index)
    for index in late:
        found[index] = replace(found[index], may_be_more=True)
    return found


def gaining(
    trials: Sequence[tuple[int, Sequence[Start]]],
    found: Mapping[int, Solution],
    null: dict[int, Solution],
    camera: Camera,
) -> dict[int, Solution]:
    """Fit first guesses with more flares, and return by index the likeliest that gains `LEAST_GAIN`.

    Over what is in `null`: a lone flare is replaced there by one of another width or size that is likelier.
    """
    fits = solve([_of_more(found[index], starts) for index, starts in trials], camera)
    best: dict[int, Solution] = {}
    for (index, _), fit in zip(trials, fits, strict=True):
        if fit is not None and (index not in best or fit.deviance < best[index].deviance):
            best[index] = fit
    likelier = {index: fit for index, fit in best.items() if gain(null[index], fit) >= LEAST_GAIN}
    null |= _eased({index: found[index] for index in likelier if found[index].count == 1}, camera)
    return {index: fit for index, fit in likelier.items() if gain(null[index], fit) >= LEAST_GAIN}


def _leaves_something(halo: Solution) -> bool:
    """Tell whether a flare and its halo leave something to another flare, or around them."""
    return not halo.left_over.is_nothing or asks_for_more(halo)


def _eased(lone: Mapping[int, Solution], camera: Camera) -> dict[int, Solution]:
    """Return by index lone flares of any width of the point spread, or any size, where that explains more."""
    eased = dict(lone)
    large = [index for index, one in lone.items() if float(one.image_radius_px[0]) > _LEAST_RADIUS_PX]
    of_any_width = of_free_width(list(lone.values()), camera)
    of_any_size = of_free_size([lone[index] for index in large], camera)
    for index, other in [*zip(lone, of_any_width, strict=True), *zip(large, of_any_size, strict=True)]:
        if other is not None and other.deviance < eased[index].deviance:
            eased[index] = other
    return eased


def asks_for_more(solution: Solution) -> bool:
    """Tell whether a fit leaves over so much that another flare could bring `LEAST_GAIN`.

    Where it lies beside the flares the residual shows it; within them, χ² over the pixels in which they stand
    out exceeds what a good fit leaves, n ± √(2n), by nearly that gain.
    """
    left = solution.left_over
    if left.seen_chi2 > left.seen_pixels + LEAST_GAIN - 4.0 * math.sqrt(2.0 * left.seen_pixels):
        return True
    return left.peak_sigmas > RESIDUAL_SIGMAS


def gain(one: Solution, other: Solution) -> float:
    """Return by how much another fit explains a window better, as 2 Δ ln L with an imperfect model."""
    variance = other.variance_e2(MODEL_ERROR)
    return float(np.sum((one.residual_e**2 - other.residual_e**2) / variance))


def _of_more(current: Solution, starts: Sequence[Start]) -> Problem:
    """Return the problem of fitting more flares; where they move, each begins with the mean motion."""
    motions = None
    if current.motion_px is not None:
        along_u, along_v = current.motion_px.mean(axis=0).tolist()
        motions = [(along_u, along_v)] * len(starts)
    return Problem(current.window, starts, current.background_e, motions)


def with_one_more(current: Solution) -> list[list[Start]]:
    """Return first guesses with one flare more."""
    box, flares = current.window.box, current.starts
    row, column = current.left_over.peak
    guesses = []
    if current.left_over.peak_sigmas > RESIDUAL_SIGMAS:
        near = current.residual_e[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        brought = max(float(near.sum()), 3.0 * math.sqrt(current.window.floor_e2))
        place = (box.left + float(column), box.top + float(row))
        # A flare of that flux is so much farther than one of the flux found.
        log_range = flares[0][2] + 0.5 * math.log(float(current.flux_e[0]) / brought)
        guesses.append([*flares, (*place, log_range)])
    worst = int(np.argmax([_misfit(current, u, v) for u, v, _ in flares]))
    two = halves(current, worst)
    if two is not None:
        guesses.append([*flares[:worst], *two, *flares[worst + 1 :]])
    peaks = _sharp_peaks(current)
    if current.count == 1 and 2 <= len(peaks) <= MOST_FLARES:
        guesses.append(peaks)
    return guesses


def _sharp_peaks(current: Solution) -> list[Start]:
    """Return the maxima of a window once its smooth part is taken off, as flares that share the light."""
    from scipy.ndimage import gaussian_filter, maximum_filter

    window, box = current.window, current.window.box
    excess_e = np.where(window.usable, window.image_e - current.background_e, 0.0)
    sharp_e = excess_e - gaussian_filter(excess_e, 1.5 * current.psf_sigma_px)
    noise_e = np.sqrt(np.maximum(excess_e, 0.0) + window.floor_e2)
    rows, columns = np.nonzero(
        (sharp_e == maximum_filter(sharp_e, 3)) & (sharp_e > RESIDUAL_SIGMAS * noise_e)
    )
    shares = sharp_e[rows, columns] / max(float(sharp_e[rows, columns].sum()), 1e-300)
    farther = 0.5 * np.log(1.0 / shares) + current.starts[0][2]
    places = zip((box.left + columns).tolist(), (box.top + rows).tolist(), farther.tolist(), strict=True)
    return [(float(u), float(v), log_range) for u, v, log_range in places]


def _misfit(current: Solution, u_px: float, v_px: float) -> float:
    """Return χ² over the 3 × 3 pixels around a place."""
    box = current.window.box
    row, column = (
        int(np.clip(round(at - first), 0, length - 1))
        for at, first, length in ((v_px, box.top, box.height), (u_px, box.left, box.width))
    )
    near = np.s_[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    return float(np.sum(current.residual_e[near] ** 2 / current.variance_e2(MODEL_ERROR)[near]))


def halves(current: Solution, index: int, apart_widths: float = 1.4) -> tuple[Start, Start] | None:
    """Return two flares in place of one, along the axis in which the image is longer than the model's.

    None where it is so along no axis. They are so many widths of the image apart.
    """
    u, v, log_range = current.starts[index]
    box = current.window.box
    rows, columns = np.ogrid[: box.height, : box.width]
    x, y = columns + box.left - u, rows + box.top - v
    # Second moments, weighted by about the model's own image: far from it there is nothing but noise.
    width_px = math.hypot(current.psf_sigma_px, 0.3, 0.5 * float(current.image_radius_px[index]))
    weight = np.where(current.window.usable, np.exp(-0.5 * (x**2 + y**2) / width_px**2), 0.0)
    residual = current.residual_e * weight
    longer = np.array([[(residual * a * b).sum() for b in (x, y)] for a in (x, y)])
    values, axes = np.linalg.eigh(longer)
    if not values[1] > 0.0:
        return None
    half_px = 0.5 * apart_widths * width_px
    du, dv = (half_px * axes[:, 1]).tolist()
    farther = log_range + 0.5 * math.log(2.0)
    return (u + du, v + dv, farther), (u - du, v - dv, farther)
