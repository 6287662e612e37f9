"""How probable what is seen is without a mirror, and mirrors, formations and their images beforehand."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.rig.mirrors.fit import fit_plane
from perception.rig.mirrors.flares import Flares
from perception.rig.mirrors.model import CONSTANT, log_determinant

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

SYMMETRY_PROBABILITY = 0.03
"""That robots stand in a formation that is its own mirror image, …"""

FORMATION_SIGMAS_M = (0.0, 0.005, 0.01, 0.02, 0.04)
"""… to one of these."""

LOSS_PRIOR, LOSS_SIGMA = math.log(0.15), 1.2
"""−½ ln R of a mirror of constant reflectance is log-normal: 0.15 is R = 0.74, 0.05 and 0.5 lie in 1 σ."""

INDEX_PRIOR, INDEX_SIGMA = 1.5, 0.08

ONE_ROBOT_M = 0.25

HEIGHT_SIGMA_M = 0.02
SAME_HEIGHT = 0.8
LOG_RANGE_SPAN = math.log(100.0)


@compiled
def log_chances(flares: Flares, count: int) -> Array:
    """Return ln of the density of robots where each flare is, per rad² and unit of ln range, shape (count,).

    As many as there are flares, in any direction about the vertical and at any range alike; four of five as
    high as the others, as on a floor.
    """
    found, height_m = np.empty(count), flares.place_m[:, 2].copy()
    for k in range(count):
        height_m[k] = flares.origin_m[k, 2] + flares.seems_m[k] * flares.axes[k, 2, 2]
    middle_m = np.median(height_m)
    spread_m = max(HEIGHT_SIGMA_M, 1.5 * np.median(np.abs(height_m - middle_m)))
    for k in range(count):
        range_m, up = flares.seems_m[k], flares.axes[k, 2, 2]
        sigma_rad = math.hypot(spread_m / range_m, math.sqrt(flares.angular_rad2[k, 1, 1]))
        off = (height_m[k] - middle_m) / range_m / sigma_rad
        level = math.exp(-0.5 * off**2) / (math.sqrt(2.0 * math.pi) * sigma_rad)
        cosine = math.sqrt(max(1.0 - up**2, 1e-6))
        elevation = SAME_HEIGHT * level + (1.0 - SAME_HEIGHT) * 0.5 * cosine
        found[k] = math.log(count * elevation / (2.0 * math.pi * cosine) / LOG_RANGE_SPAN)
    return found


@compiled
def log_parameter_prior(parameter: float, sigma: float, kind: int) -> float:
    """Return ln of the density of a mirror's parameter beforehand, no finer than its `sigma` in the fit."""
    if kind != CONSTANT:  # the fit has counted its χ²
        return -math.log(INDEX_SIGMA * math.sqrt(2.0 * math.pi))
    loss = max(parameter, 0.5 * sigma, 1e-3)
    off = (math.log(loss) - LOSS_PRIOR) / LOSS_SIGMA
    return -0.5 * off**2 - math.log(loss * LOSS_SIGMA * math.sqrt(2.0 * math.pi))


@compiled
def log_symmetry(
    flares: Flares, parents: Indices, images: Indices, plane: Array, log_others: float, log_prior: float
) -> float:
    """Return ln of the odds of robots that stand as images would, with all of their light."""
    whole, precision = plane.copy(), np.zeros((4, 4))
    whole[4], precision[3, 3] = 0.0, 1e10
    # Two robots have two fluxes, each with an error of its own.
    apart_m2, noise = flares.noise_m2.copy(), np.hypot(flares.noise, flares.common)
    for parent in parents:
        for k in range(3):
            for m in range(3):
                apart_m2[parent, k, m] += flares.moved_m[parent, k] * flares.moved_m[parent, m]
    log_odds = -np.inf
    for off_m in FORMATION_SIGMAS_M:
        noise_m2 = apart_m2.copy()
        for k in range(3):
            noise_m2[:, k, k] += off_m**2
        loose = Flares(
            flares.origin_m, flares.place_m, flares.seems_m, flares.axes, flares.angular_rad2, noise,
            noise_m2, np.zeros_like(flares.common), np.zeros_like(flares.moved_m),
        )  # fmt: skip
        chi2, log_peak, covariance = fit_plane(
            loose, parents, images, whole.copy(), CONSTANT, whole, precision
        )
        if covariance[0, 0] > 0.0 and covariance[1, 1] > 0.0 and covariance[2, 2] > 0.0:
            log_volume = 0.5 * log_determinant(covariance[:3, :3], 2.0 * math.pi)
            log_odds = _log_sum(log_odds, log_peak - 0.5 * chi2 + log_volume)
    log_each = math.log(SYMMETRY_PROBABILITY / len(FORMATION_SIGMAS_M))
    return log_odds + log_each + log_others + log_prior


@compiled
def _log_sum(one: float, other: float) -> float:
    """Return ln of the sum of what two numbers are ln of; what is none counts 0."""
    if not other > -np.inf:
        return one
    more, less = max(one, other), min(one, other)
    return more + math.log1p(math.exp(less - more))


@compiled
def log_seen(flares: Flares, robots: Indices, parents: Indices, plane: Array, kind: int, count: int) -> float:
    """Return ln of the probability that these have images and the others none that is bright enough.

    What share of robots a mirror shows depends on how large it is: any share is as probable beforehand.
    """
    return log_share(len(parents), _unseen(flares, robots, parents, plane, kind, count))


@compiled
def _unseen(flares: Flares, robots: Indices, parents: Indices, plane: Array, kind: int, count: int) -> int:
    """Return how many robots have no image, though it would be brighter than the dimmest flare."""
    longer = math.exp(plane[4] if kind == CONSTANT else 1.3)
    farthest_m, unseen = flares.seems_m[:count].max(), 0
    for robot in robots:
        place_m = flares.place_m[robot]
        # Whoever has an image lies before the plane.
        beyond_m = plane[3] - (place_m[0] * plane[0] + place_m[1] * plane[1] + place_m[2] * plane[2])
        image2 = 0.0
        for k in range(3):
            image2 += (place_m[k] + 2.0 * beyond_m * plane[k]) ** 2
        if beyond_m > 0.0 and math.sqrt(image2) * longer < farthest_m and not (parents == robot).any():
            unseen += 1
    return unseen


@compiled
def log_share(seen: int, unseen: int) -> float:
    """Return ln of the probability of just these, of a share between 0 and 1: ∫ s^k (1 − s)^(n−k) ds."""
    return math.lgamma(seen + 1.0) + math.lgamma(unseen + 1.0) - math.lgamma(seen + unseen + 2.0)


@compiled
def one_of_each(flares: Flares, parents: Indices, images: Indices) -> Indices:
    """Return which pairs to weigh: one for each robot, as LEDs of one body stand in step with each other.

    That two robots mirror each other is one coincidence, however many LEDs they carry; that a robot's LEDs
    mirror each other is none.
    """
    kept = np.empty(len(parents), dtype=np.int64)
    count = 0
    for k in range(len(parents)):
        known = _of_one_robot(flares, parents[k], images[k])
        for one in kept[:count]:
            known |= _of_one_robot(flares, parents[k], parents[one])
        if not known:
            kept[count] = k
            count += 1
    return kept[:count]


@compiled
def _of_one_robot(flares: Flares, i: int, j: int) -> bool:
    """Tell whether two flares may be LEDs of one robot: they stand within 25 cm.

    How far apart they are along the line of sight is known no better than by their fluxes.
    """
    apart2, along_m, moved2 = 0.0, 0.0, 0.0
    for k in range(3):
        apart_m = flares.place_m[i, k] - flares.place_m[j, k]
        apart2 += apart_m**2
        along_m += apart_m * flares.axes[i, 2, k]
        moved2 += flares.moved_m[i, k] ** 2 + flares.moved_m[j, k] ** 2
    across_m = math.sqrt(max(apart2 - along_m**2, 0.0))
    return across_m < ONE_ROBOT_M and abs(along_m) < ONE_ROBOT_M + 2.0 * math.sqrt(moved2)
