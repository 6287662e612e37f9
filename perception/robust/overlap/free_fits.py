"""Fits that need not believe the calibration, and by them how far what it gets wrong moves a range."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from perception.model.window import Camera
from perception.robust.overlap.rivals import to_beat
from perception.robust.solve import Solution, solve

_WIDTH_FREE = 0.3
_FLUX_FREE = 8.0


def of_free_width(solutions: Sequence[Solution], camera: Camera) -> list[Solution | None]:
    """Fit flares through a point spread that may be wider or narrower than the calibration says.

    However unlikely: by that it is decided about others.
    """
    return _again(solutions, _with_free_width(camera))


def of_free_size(solutions: Sequence[Solution], camera: Camera) -> list[Solution | None]:
    """Fit lone flares whose size may be any, whatever their flux says; however unlikely."""
    return _again(solutions, _with_free_size(camera))


def with_model_error(solution: Solution, camera: Camera) -> Solution:
    """Tell of flares how far their range and flux may be off where the calibration leaves something over.

    What no noise explains may be the source's flux, its size (a wrong lens or focal length and a limb that is
    darker look like one), or the point spread. A lone flare is fitted with all three free: its range may
    be that by flux alone or that by size alone, as far as these are farther from what is told than by their
    own σ. What is still left over, or all of it where others are fitted, counts as `LeftOver.widens_range`
    says.
    """
    widens = solution.left_over.widens_range
    if widens == 1.0:
        return solution
    of_noise = 0.5 * solution.flux_noise_e / solution.flux_e
    log_range, log_flux = np.zeros(solution.count), np.zeros(solution.count)
    if solution.count == 1:
        (free,) = _again([solution], _with_free_width(_with_free_size(camera)))
        if free is not None and free.left_over.noise_chi2 < solution.left_over.noise_chi2:
            widens = free.left_over.widens_range
            told, flux_sigma = solution.log_range, free.flux_noise_e / free.flux_e
            by_flux = _beyond(free.log_photometric_range - told, 0.5 * flux_sigma)
            log_range = np.maximum(by_flux, _beyond(free.log_range - told, free.log_range_sigma))
            log_flux = abs(np.log(free.flux_e / solution.flux_e))
    of_rest = math.sqrt(widens**2 - 1.0) * of_noise
    return replace(
        solution,
        log_range_of_model=np.hypot(log_range, of_rest),
        log_flux_of_model=np.hypot(log_flux, 2.0 * of_rest),
    )


def _beyond(difference: NDArray[np.float64], sigma: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how large differences are, but for what their σ explain."""
    return np.sqrt(np.maximum(difference**2 - sigma**2, 0.0))


def _again(solutions: Sequence[Solution], camera: Camera) -> list[Solution | None]:
    return solve([to_beat(one, math.inf).again() for one in solutions], camera)


def _with_free_width(camera: Camera) -> Camera:
    return _with_spread(camera, "psf_sigma_px", _WIDTH_FREE)


def _with_free_size(camera: Camera) -> Camera:
    return _with_spread(camera, "range_constant_dn_m2_per_s", _FLUX_FREE)


def _with_spread(camera: Camera, name: str, spread: float) -> Camera:
    """Return a camera one of whose constants is known to a relative spread only."""
    calibration = camera.calibration
    sigma = {**calibration.sigma, name: spread * getattr(calibration, name)}
    return replace(camera, calibration=replace(calibration, sigma=sigma))
