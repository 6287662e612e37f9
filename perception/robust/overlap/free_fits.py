"""Fits that need not believe the calibration, and by them how far what it gets wrong moves a range."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from perception.model.window import Camera
from perception.robust.goodness import MISFIT_PROBABILITY
from perception.robust.overlap.rivals import to_beat
from perception.robust.solve import Solution, solve

_WIDTH_FREE, _FLUX_FREE = 0.3, 8.0  # any at all
_WIDTH_OFF, _FLUX_OFF = 0.1, 0.2  # as calibrations are off; a flux and a size by any of these two
_FARTHEST = 3.0
_FEWER_AT_RANDOM = 6.0  # other pixels may count; fits of another width than this may have been better
MOST_CLAIMED = 4.0  # of σ: what is claimed to be uncertain contradicts nothing up to here


def of_free_width(solutions: Sequence[Solution], camera: Camera) -> list[Solution | None]:
    """Fit flares through a point spread that may be wider or narrower than the calibration says.

    However unlikely: by that it is decided about others.
    """
    return _again(solutions, with_spread(camera, "psf_sigma_px", _WIDTH_FREE))


def of_free_size(solutions: Sequence[Solution], camera: Camera) -> list[Solution | None]:
    """Fit lone flares whose size may be any, whatever their flux says; however unlikely."""
    return _again(solutions, with_spread(camera, "range_constant_dn_m2_per_s", _FLUX_FREE))


def with_model_error(solution: Solution, camera: Camera) -> Solution:
    """Tell of flares how far their range and flux may be off where the calibration leaves something over.

    What no noise explains may be the source's flux, its size (a wrong lens or focal length and a limb that is
    darker look like one), or the point spread. A lone flare is fitted with all three open (`_moved`). What is
    still left over, or all of it where others are fitted, counts as `LeftOver.widens_range` says.
    """
    widens = solution.left_over.widens_range
    if widens == 1.0:
        return solution
    of_noise = 0.5 * solution.flux_noise_e / solution.flux_e
    log_range, log_flux = np.zeros(solution.count), np.zeros(solution.count)
    if solution.count == 1:
        (free,) = _of_any([solution], camera)
        if free is not None and free.left_over.noise_chi2 < solution.left_over.noise_chi2:
            widens = free.left_over.widens_range
            log_range, log_flux = _moved(solution, free, camera), abs(np.log(free.flux_e / solution.flux_e))
    of_rest = math.sqrt(widens**2 - 1.0) * of_noise
    return replace(
        solution,
        log_range_of_model=np.hypot(log_range, of_rest),
        log_flux_of_model=np.hypot(log_flux, 2.0 * of_rest),
    )


def log_range_of_calibration(lone: Sequence[Solution], camera: Camera) -> float:
    """Return how far the range of any flare in a frame may be off because the calibration is.

    It is off for all of them, so that they tell together what none tells alone: each lone flare is fitted
    with flux, size and point spread open. Mirror images are dimmer than sources of their size, so only the
    half that gains the least speaks. If noise gives it so much once in a million frames, the answer is the
    root of the mean square of how far all the ranges move, none more than `_FARTHEST` medians; else 0.
    """
    gains, moved = [], []
    for one, any_ in zip(lone, _of_any(lone, camera), strict=True):
        if any_ is not None and (gain := _gained(one, any_, camera)) > -_FEWER_AT_RANDOM:
            gains.append(max(gain, 0.0))
            moved.append(float(_moved(one, any_, camera)[0]))
    half = (len(gains) + 1) // 2
    if chance_of_least(sum(sorted(gains)[:half]), half, len(gains)) > MISFIT_PROBABILITY:
        return 0.0
    most = _FARTHEST * sorted(moved)[half - 1]
    return float(np.sqrt(np.mean(np.minimum(moved, most) ** 2)))


def _gained(told: Solution, free: Solution, camera: Camera) -> float:
    """Return by how much better a lone flare is explained, as χ² of two degrees of freedom.

    What is claimed to be uncertain of flux and size is the same for all flares, and no chance of each: so far
    as it explains that they tell two ranges, up to `MOST_CLAIMED` of its σ, that counts for nothing.
    """
    before, after = told.left_over, free.left_over
    gained = (before.noise_chi2 - before.pixels) - (after.noise_chi2 - after.pixels)
    if camera.tie_spread == 0.0:
        return gained
    by_flux = 0.5 * max(_FLUX_OFF, camera.flux_spread)
    lean = by_flux**2 / (by_flux**2 + camera.radius_spread**2)  # of flux, as `Camera.log_range` has it
    apart = abs(float(free.log_photometric_range[0] - free.log_range[0])) / lean
    sigma = math.hypot(float(free.log_range_sigma[0]), 0.5 * float(free.flux_noise_e[0] / free.flux_e[0]))
    return max(gained, (max(apart - MOST_CLAIMED * camera.tie_spread, 0.0) / sigma) ** 2)


def chance_of_least(total: float, least: int, count: int) -> float:
    """Return how often the least of `count` χ² of two degrees of freedom add up to more; 1 of none.

    Such χ² are exponential, of mean 2, and so are the steps from one to the next larger, of mean
    2 / (how many are left): the sum is one of exponentials of different means (Rényi, Acta Math. Acad. Sci.
    Hung. 4, 191, 1953).
    """
    if least == 0:
        return 1.0
    before = np.arange(least)
    means = 2.0 * (least - before) / (count - before)
    apart = np.where(np.eye(least), means[:, None], means[:, None] - means)
    return float(np.sum(np.prod(means[:, None] / apart, axis=1) * np.exp(-total / means)))


def _moved(told: Solution, free: Solution, camera: Camera) -> NDArray[np.float64]:
    """Return how far lone flares' range moves if it is that by flux alone, or by size alone, and not both.

    The larger of the two, each as far as it is farther away than its own σ and what the calibration claims.
    """
    of_flux = 0.5 * np.hypot(free.flux_noise_e / free.flux_e, camera.flux_spread)
    by_flux = (free.log_photometric_range - told.log_range) ** 2 - of_flux**2
    by_size = (free.log_range - told.log_range) ** 2 - free.log_range_sigma**2
    return np.sqrt(np.maximum(np.maximum(by_flux, by_size), 0.0))


def _of_any(solutions: Sequence[Solution], camera: Camera) -> list[Solution | None]:
    """Fit flares as calibrations are off: by 10 % of width and range by flux, or as light insists."""
    of_width = with_spread(camera, "psf_sigma_px", _WIDTH_OFF)
    return _again(solutions, with_spread(of_width, "range_constant_dn_m2_per_s", _FLUX_OFF))


def _again(solutions: Sequence[Solution], camera: Camera) -> list[Solution | None]:
    return solve([to_beat(one, math.inf).again() for one in solutions], camera)


def with_spread(camera: Camera, name: str, spread: float) -> Camera:
    """Return a camera one of whose constants is known to such a relative spread at best."""
    calibration = camera.calibration
    claimed = calibration.sigma.get(name, 0.0)
    sigma = {**calibration.sigma, name: max(spread * getattr(calibration, name), claimed)}
    return replace(camera, calibration=replace(calibration, sigma=sigma))
