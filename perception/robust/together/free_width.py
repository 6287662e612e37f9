"""Whether the point spread is as wide as calibrated: what all small flares of a frame tell together."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from perception.model.likelihood.scoring_step import scoring_step
from perception.model.window import Camera
from perception.robust.fit import Fit
from perception.robust.goodness import MISFIT_PROBABILITY
from perception.robust.motion import drawn_out_squares
from perception.robust.overlap.free_fits import MOST_CLAIMED, with_spread
from perception.robust.solve import Solution
from perception.types import Calibration

Array = NDArray[np.float64]

_WIDTH_UNIT = 0.1
_FLUX_OFF = 0.05
_FEWEST, _MOST = 3, 8
_SIGMAS_OF_FRAMES, _LEAST_OF_FRAMES = 6.0, 0.0075
_MOST_TURN_CHI2 = 9.2  # noise has more once in a hundred frames


NOTHING_SEEN = (0.0, math.inf)


def seen_log_width(points: Sequence[Solution], camera: Camera) -> tuple[float, float]:
    """Return by how much ln of the point spread's width is off, and σ, by small flares alone in windows.

    Each takes a step from its fit to one of free width. A flux that is not quite what its size says, as
    mirror images have it, makes them seem wider: so much of it is open. Glossy mirrors and walls close behind
    make some wider, too: the quarter that leans farthest one way does not speak. `NOTHING_SEEN` where there
    are too few, or all are drawn out along one line: the camera turns.
    """
    points = sorted(points, key=lambda one: _sigma(one, camera))[:_MOST]
    steps = _width_steps(points, with_spread(camera, "range_constant_dn_m2_per_s", _FLUX_OFF))
    tell = np.flatnonzero(np.isfinite(steps).all(axis=1))
    points, steps = [points[k] for k in tell], steps[tell]
    if len(steps) < _FEWEST:
        return NOTHING_SEEN
    off, precision = steps[:, 0], steps[:, 1] ** -2.0
    leaning = off / steps[:, 1] * np.sign(np.sum(off * precision))
    kept = np.argsort(leaning, kind="stable")[: len(steps) - len(steps) // 4]
    sigma = 1.0 / math.sqrt(float(precision[kept].sum()))
    if _turn_chi2([points[k] for k in kept]) > _MOST_TURN_CHI2:
        return NOTHING_SEEN
    return float(np.sum(off[kept] * precision[kept])) * sigma**2, sigma


def log_width_of_calibration(seen: tuple[float, float], camera: Camera) -> float:
    """Return by how much ln of the width is off for sure, as seen in a frame (`seen_log_width`).

    0 where noise leans so far once in a million frames, or the calibration's claim covers it.
    """
    mean, sigma = seen
    beyond = (abs(mean) - MOST_CLAIMED * camera.width_spread) / sigma
    if math.erfc(max(beyond, 0.0) / math.sqrt(2.0)) > MISFIT_PROBABILITY:
        return 0.0
    return math.copysign(math.sqrt(mean**2 - sigma**2), mean)


def log_width_of_frames(seen: Sequence[tuple[float, float]], calibration: Calibration) -> float:
    """Return by how much ln of a camera's width is off as its frames see it together (`seen_log_width`).

    0 where that is noise, too little to matter or for glossy mirrors and walls to be excluded, or claimed.
    """
    off, sigma = np.array(seen).reshape(-1, 2).T
    total = float(np.sum(sigma**-2.0))
    if total == 0.0:
        return 0.0
    mean, claimed = float(np.sum(off * sigma**-2.0)) / total, Camera(calibration, 1.0, 1.0).width_spread
    least = max(_SIGMAS_OF_FRAMES / math.sqrt(total), _LEAST_OF_FRAMES, MOST_CLAIMED * claimed)
    return mean if abs(mean) > least else 0.0


def _turn_chi2(points: Sequence[Solution]) -> float:
    """Return by how much flares are drawn out along one line in common, as χ² of two degrees of freedom."""
    square, precision = drawn_out_squares(points)
    total = float(precision.sum())
    return float(abs(np.sum(precision * square))) ** 2 / total if total > 0.0 else 0.0


def log_range_slopes(lone: Sequence[Solution], camera: Camera) -> Array:
    """Return by how much ln of each range changes with ln of the width taken as known, shape (flares,).

    NaN of those that move, or hide parts of each other.
    """
    _, _, by_flux, slack = _width_steps(lone, camera).T
    return np.asarray(by_flux - camera.lean * slack)


def tells_width(one: Solution) -> bool:
    """Tell whether a fit says what another width would change: that of one flare at rest, laid out whole."""
    return one.count == 1 and one.motion_px is None and one.sources is not None


def _width_steps(lone: Sequence[Solution], camera: Camera) -> Array:
    """Return what each lone flare tells of ln width, shape (flares, 4); NaN where it tells nothing.

    By how much it is off, and σ of that; and by how much ln range by flux, and the slack if there is one,
    change with ln width where that is taken as known.
    """
    camera = with_spread(camera, "psf_sigma_px", _WIDTH_UNIT)
    steps = np.full((len(lone), 4), math.nan)
    for step, one in zip(steps, lone, strict=True):
        if one.sources is None or not tells_width(one):
            continue
        fit = Fit(one.again(), camera)
        width, unit, precision = fit.layout.width, fit.known.width_spread, fit.prior.copy()
        precision[width, width] = 0.0
        shift, covariance = scoring_step(
            one.window.view, one.sources, fit.structure, fit.known, precision, fit.values
        )
        of_width = covariance[width] / (unit * covariance[width, width])
        of_slack = of_width[3] if fit.layout.has_slack else 0.0
        step[:] = unit * shift[width], unit * math.sqrt(covariance[width, width]), of_width[2], of_slack
    return steps


def _sigma(point: Solution, camera: Camera) -> float:
    """Return how well a small flare tells ln of the width: about, by its light and as its size is known."""
    of_spread_px2 = camera.calibration.psf_sigma_px**2 + 1.0 / 12.0
    of_size = 0.25 * float(point.image_radius_px[0]) ** 2 / of_spread_px2
    return math.hypot(float(point.flux_noise_e[0] / point.flux_e[0]), 0.5 * _FLUX_OFF * of_size)
