"""How probable what is seen is without a mirror, and mirrors, formations and their images beforehand."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.rig.mirrors.flares import Flares
from perception.rig.mirrors.model import CONSTANT, fit_plane

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SYMMETRY_PROBABILITY = 0.03
"""That robots stand in a formation that is its own mirror image, …"""

FORMATION_SIGMAS_M = (0.0, 0.005, 0.01, 0.02, 0.04)
"""… to one of these."""

LOSS_PRIOR, LOSS_SIGMA = math.log(0.15), 1.2
"""−½ ln R of a mirror of constant reflectance is log-normal: 0.15 is R = 0.74, 0.05 and 0.5 lie in 1 σ."""

INDEX_PRIOR, INDEX_SIGMA = 1.5, 0.08

_HEIGHT_SIGMA_M = 0.02
_SAME_HEIGHT = 0.8
_LOG_RANGE_SPAN = math.log(100.0)


def log_chances(flares: Flares, count: int) -> Array:
    """Return ln of the density of robots where each flare is, per rad² and unit of ln range, shape (count,).

    As many as there are flares, in any direction about the vertical and at any range alike; four of five as
    high as the others, as on a floor.
    """
    range_m = flares.seems_m[:count]
    apart_m = range_m[:, None] * flares.axes[:count, 2]
    height_m = flares.origin_m[:count, 2] + apart_m[:, 2]
    of_all_m = np.concatenate([height_m, flares.place_m[count:, 2]])
    middle_m = float(np.median(of_all_m))
    spread_m = max(_HEIGHT_SIGMA_M, 1.5 * float(np.median(abs(of_all_m - middle_m))))
    sigma_rad = np.hypot(spread_m / range_m, np.sqrt(flares.angular_rad2[:count, 1, 1]))
    off = (height_m - middle_m) / range_m / sigma_rad
    level = np.exp(-0.5 * off**2) / (math.sqrt(2.0 * math.pi) * sigma_rad)
    cosine = np.sqrt(np.maximum(1.0 - (apart_m[:, 2] / range_m) ** 2, 1e-6))
    elevation = _SAME_HEIGHT * level + (1.0 - _SAME_HEIGHT) * 0.5 * cosine
    return np.asarray(np.log(count * elevation / (2.0 * math.pi * cosine) / _LOG_RANGE_SPAN))


def log_parameter_prior(parameter: float, sigma: float, kind: int) -> float:
    """Return ln of the density of a mirror's parameter beforehand, no finer than its `sigma` in the fit."""
    if kind != CONSTANT:  # the fit has counted its χ²
        return -math.log(INDEX_SIGMA * math.sqrt(2.0 * math.pi))
    loss = max(parameter, 0.5 * sigma, 1e-3)
    off = (math.log(loss) - LOSS_PRIOR) / LOSS_SIGMA
    return -0.5 * off**2 - math.log(loss * LOSS_SIGMA * math.sqrt(2.0 * math.pi))


def log_symmetry(
    flares: Flares, parents: Indices, images: Indices, plane: Array, log_others: float, log_prior: float
) -> float:
    """Return ln of the odds of robots that stand as images would, with all of their light."""
    precision = np.zeros((4, 4))
    precision[3, 3] = 1e10
    log_odds = -math.inf
    # Two robots have two fluxes, each with an error of its own.
    each_own = flares.moved_m[:, :, None] * flares.moved_m[:, None, :]
    apart = flares._replace(
        noise=np.hypot(flares.noise, flares.common),
        common=np.zeros_like(flares.common),
        moved_m=np.zeros_like(flares.moved_m),
    )
    for off_m in FORMATION_SIGMAS_M:
        whole = plane.copy()
        whole[4] = 0.0
        loose = apart._replace(noise_m2=flares.noise_m2 + each_own + off_m**2 * np.eye(3))
        chi2, log_peak, covariance = fit_plane(
            loose, parents, images, whole, CONSTANT, whole.copy(), precision
        )
        if (np.diagonal(covariance)[:3] > 0.0).all():
            log_volume = 0.5 * float(np.linalg.slogdet(2.0 * math.pi * covariance[:3, :3])[1])
            log_odds = np.logaddexp(log_odds, log_peak - 0.5 * chi2 + log_volume)
    log_share = math.log(SYMMETRY_PROBABILITY / len(FORMATION_SIGMAS_M))
    return float(log_odds) + log_share + log_others + log_prior


def log_seen(flares: Flares, robots: Indices, parents: Indices, plane: Array, kind: int, count: int) -> float:
    """Return ln of the probability that these have images and the others none that is bright enough.

    What share of robots a mirror shows depends on how large it is: any share is as probable beforehand.
    """
    farthest_m = float(flares.seems_m[:count].max())
    # Whoever has an image lies before the plane.
    beyond_m = plane[3] - flares.place_m[robots] @ plane[:3]
    image_m = flares.place_m[robots] + 2.0 * beyond_m[:, None] * plane[:3]
    seems_m = np.sqrt((image_m**2).sum(axis=1)) * math.exp(plane[4] if kind == CONSTANT else 1.3)
    shown = (beyond_m > 0.0) & (seems_m < farthest_m)
    seen = set(parents.tolist())
    unseen = sum(robot not in seen for robot in robots[shown].tolist())
    return log_share(len(parents), unseen)


def log_share(seen: int, unseen: int) -> float:
    """Return ln of the probability of just these, of a share between 0 and 1: ∫ s^k (1 − s)^(n−k) ds."""
    return math.lgamma(seen + 1.0) + math.lgamma(unseen + 1.0) - math.lgamma(seen + unseen + 2.0)
