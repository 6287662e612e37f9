"""The plane that explains most of what a set shows, and the odds that it is a mirror: compiled loops."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.rig.mirrors.fit import fit_matched, fit_plane
from perception.rig.mirrors.flares import Flares
from perception.rig.mirrors.model import CONSTANT, PANE, SURFACE, log_determinant
from perception.rig.mirrors.odds import (
    INDEX_PRIOR,
    INDEX_SIGMA,
    log_parameter_prior,
    log_seen,
    log_symmetry,
    one_of_each,
)
from perception.rig.mirrors.planes import KINDS
from perception.rig.mirrors.seeds import (
    best_seeds,
    dim_pairs,
    plausible_pairs,
    seeds_of_constant,
    seeds_of_kind,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MIRROR_PROBABILITY = 0.1
"""That a set shows a flat mirror at all, before it is looked at."""

LOG_OF_KIND = math.log(MIRROR_PROBABILITY / len(KINDS))
"""ln of the probability of a mirror of one kind of reflectance."""

MOST_PLANE_DISTANCE_M = 20.0
LOG_PLACE_PRIOR = -math.log(4.0 * math.pi) - math.log(MOST_PLANE_DISTANCE_M)
"""ln of the density of planes: any direction, and any distance up to that."""

MOST_SEEDS, MOST_TRIED, MOST_PAIRS_OF_PAIRS = 4000, 12, 40_000
SEED_INDICES = (1.4, 1.45, 1.5, 1.55, 1.6)

CLEAR = 10.0
"""ln of odds at which planes that explain fewer images are no longer tried."""

LOG_NEVER = math.log(1e-4)
"""ln of odds below which it is no mirror, whatever else would explain what is seen."""


class Explanation(NamedTuple):
    """What a plane explains.

    Attributes
    ----------
    log_odds
        ln of its odds against there being no mirror; −∞ where it explains too few.
    plane, kind
        n, c and the parameter of a kind of reflectance, shape (5,).
    parents, images
        Whom each image shows, shape (pairs,).
    covariance
        Of its two angles, of c and of the parameter, shape (4, 4).
    """

    log_odds: float
    plane: Array
    kind: int
    parents: Indices
    images: Indices
    covariance: Array


@compiled
def best_plane(flares: Flares, robots: Indices, images: Indices, log_chance: Array) -> Explanation:
    """Return what the most probable plane explains, none being known; NaN and −∞ where there is none.

    `robots`, `images` and `log_chance` as for `fit_and_weigh`.
    """
    planes, explained, kinds = _seeds(flares, robots, images)
    none = np.empty(0, dtype=np.int64)
    best = Explanation(-np.inf, np.full(5, np.nan), CONSTANT, none, none, np.full((4, 4), np.nan))
    most = explained.max() if len(explained) else 0
    for count in range(most, 1, -1):
        for n in np.flatnonzero(explained == count):
            if best.log_odds > CLEAR and count < len(best.images):
                return best
            kind, plane, prior, precision = kinds[n], planes[n], planes[n].copy(), np.zeros((4, 4))
            if kind != CONSTANT:  # only what an index usually is is known
                prior[4], precision[3, 3] = INDEX_PRIOR, 1.0 / INDEX_SIGMA**2
            one = fit_and_weigh(flares, robots, images, log_chance, plane, kind, prior, precision)
            if one.log_odds > best.log_odds:
                best = one
    return best


@compiled
def _seeds(flares: Flares, robots: Indices, images: Indices) -> tuple[Array, Indices, Indices]:
    """Return guesses of planes, shape (n, 5), how many images each explains, and its kind, shape (n,)."""
    parents, shown = plausible_pairs(flares, robots, images)
    pairs = len(parents)
    stride = max(1, pairs * (pairs - 1) // 2 // MOST_PAIRS_OF_PAIRS)
    guessed = seeds_of_constant(flares, parents, shown, stride, MOST_SEEDS)
    planes, explained = best_seeds(flares, robots, images, guessed, CONSTANT, MOST_TRIED)
    kinds = np.full(len(planes), CONSTANT)
    parents, shown = dim_pairs(flares, parents, shown)
    for kind in (SURFACE, PANE):
        guessed = seeds_of_kind(flares, parents, shown, kind, SEED_INDICES)
        more, explained_more = best_seeds(flares, robots, images, guessed, kind, MOST_TRIED)
        planes, explained = np.concatenate((planes, more)), np.concatenate((explained, explained_more))
        kinds = np.concatenate((kinds, np.full(len(more), kind)))
    return planes, explained, kinds


@compiled
def fit_and_weigh(
    flares: Flares, robots: Indices, images: Indices, log_chance: Array, plane: Array, kind: int,
    prior: Array, precision: Array,
) -> Explanation:  # fmt: skip
    """Fit a plane in place to the pairs that it explains, and weigh it.

    Parameters
    ----------
    robots, images
        Which flares may be shown, and which may be images.
    plane, kind, prior, precision
        As for `fit_plane`.
    log_chance
        ln of the density of robots where each flare is, as of `log_chances`.
    """
    parents, shown, chi2, log_peak, covariance = fit_matched(
        flares, robots, images, plane, kind, prior, precision
    )
    if not len(parents):
        return Explanation(-np.inf, plane, kind, parents, shown, covariance)
    log_odds = _weighed(
        flares, robots, log_chance, plane, kind, prior, precision, parents, shown, chi2, log_peak, covariance
    )
    return Explanation(log_odds, plane, kind, parents, shown, covariance)


@compiled
def _weighed(
    flares: Flares, robots: Indices, log_chance: Array, plane: Array, kind: int, prior: Array,
    precision: Array, parents: Indices, shown: Indices, chi2: float, log_peak: float, covariance: Array,
) -> float:  # fmt: skip
    """Return ln of the odds of a plane that has been fitted to the pairs that it explains."""
    is_known = precision[0, 0] > 0.0
    robot = one_of_each(flares, parents, shown)
    if len(robot) < len(parents):
        parents, shown = parents[robot], shown[robot]
        chi2, log_peak, covariance = fit_plane(flares, parents, shown, plane.copy(), kind, prior, precision)
        if len(parents) < (1 if is_known else 2) or not np.diag(covariance).min() > 0.0:
            return -np.inf
    log_gain = log_peak - 0.5 * chi2 - log_chance[shown].sum()
    log_gain += log_seen(flares, robots, parents, plane, kind, len(log_chance))
    log_volume = 0.5 * log_determinant(covariance, 2.0 * math.pi)
    if is_known:
        log_prior = 0.5 * log_determinant(precision, 0.5 / math.pi)
        return float(log_gain + log_volume + log_prior)
    log_odds = LOG_OF_KIND + log_gain + log_volume + LOG_PLACE_PRIOR
    log_odds += log_parameter_prior(plane[4], math.sqrt(covariance[3, 3]), kind)
    if log_odds < LOG_NEVER:
        return float(log_odds)
    log_others = log_gain + 0.5 * chi2 - log_peak
    by_symmetry = log_symmetry(flares, parents, shown, plane, log_others, LOG_PLACE_PRIOR)
    # Against there being neither a mirror nor a formation.
    return float(log_odds - math.log1p(math.exp(min(by_symmetry, 700.0))))
