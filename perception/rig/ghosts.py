"""Which measurements are mirror images of robots: by planes that explain several of them at once.

Any two points have a mirror plane, so one pair proves nothing. A plane is a hypothesis with a price: how
probable a mirror is, how well it must be placed to explain what is seen, and how often the robots of the set
would stand so by chance. What it gains is the density of the images where it says they are, over the density
of robots there. Robots in a symmetric formation look like a mirror that loses no light: that is a hypothesis
of its own, in which nothing is a ghost.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.rig.fusion import Joined
from perception.rig.mirrors.flares import Flares
from perception.rig.mirrors.model import (
    CONSTANT,
    GATE_CHI2,
    PANE,
    SURFACE,
    best_seeds,
    fit_matched,
    fit_plane,
    matched,
    seeds_of_kind,
)
from perception.rig.mirrors.planes import KINDS, mirror_plane, prior_of
from perception.rig.mirrors.seeds import seeds_of_constant
from perception.types import Ghost, Measurement, MirrorPlane, bearing_axes

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MIRROR_PROBABILITY = 0.1
"""That a set shows a flat mirror at all, before it is looked at."""

SYMMETRY_PROBABILITY = 0.03
"""That robots stand in a formation that is its own mirror image, …"""

FORMATION_SIGMAS_M = (0.0, 0.005, 0.01, 0.02, 0.04)
"""… to one of these."""

YES, POSSIBLE = 0.98, 0.005
"""Probabilities of a ghost from which a measurement is called one, or possibly one."""

MOST_PLANE_DISTANCE_M = 20.0
LOSS_PRIOR, LOSS_SIGMA = math.log(0.15), 1.2
"""−½ ln R of a mirror of constant reflectance is log-normal: 0.15 is R = 0.74, 0.05 and 0.5 lie in 1 σ."""

INDEX_PRIOR, INDEX_SIGMA = 1.5, 0.08

_MOST_FLARES = 40
_MOST_SEEDS, _MOST_TRIED = 4000, 12
_CLEAR = 10.0
_LOG_NEVER = math.log(1e-4)
"""Odds below are of no mirror, whatever else would explain what is seen."""

_LOG_YES = math.log(YES / (1.0 - YES))
_UNCLAIMED_RAD = 1e-3
_MOST_PAIRS_OF_PAIRS = 40_000
_MOST_PLANES = 4
_SEED_INDICES = (1.4, 1.45, 1.5, 1.55, 1.6)
_DIM_RATIO = 1.5
_HEIGHT_SIGMA_M = 0.02
_SAME_HEIGHT = 0.8
_LOG_RANGE_SPAN = math.log(100.0)
_OWN_SIGMA_M = 2e-3
_ONE_ROBOT_M = 0.25


@dataclass(frozen=True, eq=False)
class _Found:
    """A plane and its kind, whom each image shows, its covariance, and ln of its odds against none."""

    plane: Array
    kind: int
    parents: Indices
    images: Indices
    covariance: Array
    log_odds: float


def told_ghosts(
    joined: Sequence[Joined], own_sources_body_m: Array, planes: Sequence[MirrorPlane] = ()
) -> tuple[tuple[Measurement, ...], tuple[MirrorPlane, ...]]:
    """Tell mirror images from robots.

    Parameters
    ----------
    joined
        The measurements of one set.
    own_sources_body_m
        Where the observer's own sources sit, shape (n, 3): their images tell most.
    planes
        Mirrors that are known already, in today's body axes; their reflectance stays free within their
        covariance.

    Returns
    -------
    The measurements with `ghost` and its probability, and the mirrors.
    """
    measurements = [each.measurement for each in joined]
    usable = [k for k, each in enumerate(measurements) if each.ghost == "no" and each.range_m > 0.0]
    usable = [k for k in usable if joined[k].seems_m > 0.0]
    usable = sorted(usable, key=lambda k: joined[k].seems_m)
    probability = np.zeros(len(measurements))
    if not usable or len(usable) + len(own_sources_body_m) < 2:
        return tuple(measurements), ()
    flares = _flares_of([joined[k] for k in usable], own_sources_body_m)
    log_chance = _log_chance(flares, len(usable))
    # The search is among the nearest; what it finds tells the others, too.
    searched = min(len(usable), _MOST_FLARES)
    own = np.arange(len(usable), len(flares.place_m))
    robots, images = np.concatenate([np.arange(searched), own]), np.arange(searched)
    found: list[_Found] = []
    known = list(planes)
    while len(found) < _MOST_PLANES and len(images):
        best = _best_plane(flares, robots, images, log_chance, known)
        if best is None:
            break
        odds = 1.0 / (1.0 + math.exp(-min(best.log_odds, 700.0)))
        of_images = [usable[j] for j in best.images]
        probability[of_images] = np.maximum(probability[of_images], odds)
        if odds < YES:
            break
        found.append(best)
        robots = np.setdiff1d(robots, best.images)
        images = np.setdiff1d(images, np.union1d(best.images, best.parents))
    if found and searched < len(usable):
        robots = np.concatenate([robots, np.arange(searched, len(usable))])
        for one in found:
            _, shown, _ = matched(
                flares, robots, np.arange(searched, len(usable)), one.plane, one.kind, GATE_CHI2
            )
            probability[[usable[j] for j in shown]] = YES
    lone = _lone_probability(len(usable), len(own_sources_body_m), bool(found))
    for place, k in enumerate(usable):
        probability[k] = max(probability[k], lone[place])
    told = tuple(
        each if each.ghost != "no" else replace(each, ghost=_called(p), ghost_probability=p)
        for each, p in zip(measurements, probability.tolist(), strict=True)
    )
    return told, tuple(mirror_plane(one.plane, one.kind, one.covariance, len(one.images)) for one in found)


def _called(probability: float) -> Ghost:
    return "yes" if probability >= YES else "possible" if probability >= POSSIBLE else "no"


def _flares_of(joined: Sequence[Joined], own_sources_body_m: Array) -> Flares:
    own = len(own_sources_body_m)
    measurements = [each.measurement for each in joined]
    bearing = np.array([each.bearing_body for each in measurements])
    origin_m = np.array([each.origin_body_m for each in measurements])
    range_m = np.array([each.range_m for each in measurements])
    axes = bearing_axes(bearing)
    claimed = np.array([np.isfinite(each.covariance).all() for each in measurements])
    angular_rad2 = np.array([each.covariance[:2, :2] for each in measurements])
    angular_rad2[~claimed] = _UNCLAIMED_RAD**2 * np.eye(2)
    noise_m2 = np.array([each.noise_m2 for each in joined])
    mount_m2 = np.tile(_OWN_SIGMA_M**2 * np.eye(3), (own, 1, 1))
    common = np.array([each.common for each in joined])
    return Flares(
        origin_m=np.concatenate([origin_m, np.zeros((own, 3))]),
        place_m=np.concatenate([origin_m + range_m[:, None] * bearing, own_sources_body_m]),
        seems_m=np.array([each.seems_m for each in joined] + [1.0] * own),
        axes=np.concatenate([axes, np.tile(np.eye(3), (own, 1, 1))]),
        angular_rad2=np.concatenate([angular_rad2, np.zeros((own, 2, 2))]),
        noise=np.concatenate([[each.noise for each in joined], np.zeros(own)]),
        noise_m2=np.concatenate([noise_m2, mount_m2]),
        common=np.concatenate([common, np.zeros(own)]),
        moved_m=np.concatenate([[each.moved_m for each in joined], np.zeros((own, 3))]),
    )


def _log_chance(flares: Flares, count: int) -> Array:
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


def _best_plane(
    flares: Flares, robots: Indices, images: Indices, log_chance: Array, known: list[MirrorPlane]
) -> _Found | None:
    """Return the plane that explains most, of those that are known first; it is taken from them."""
    for plane in list(known):
        known.remove(plane)
        prior, kind, precision = prior_of(plane)
        one = _fitted(flares, robots, images, log_chance, prior, kind, prior, precision)
        if one is not None and one.log_odds > _LOG_YES:
            return one
    parents, shown = _plausible_pairs(flares, robots, images)
    trials = []
    for kind, seeds in _seeds(flares, parents, shown):
        chosen, explained = best_seeds(flares, robots, images, seeds, kind, _MOST_TRIED)
        trials += [(count, kind, seed) for count, seed in zip(explained.tolist(), chosen, strict=True)]
    best: _Found | None = None
    for count, kind, seed in sorted(trials, key=lambda each: -each[0]):
        if count < 2 or (best is not None and best.log_odds > _CLEAR and count < len(best.images)):
            break
        prior, precision = seed.copy(), np.zeros((4, 4))
        prior[4] = INDEX_PRIOR if kind != CONSTANT else seed[4]
        precision[3, 3] = 1.0 / INDEX_SIGMA**2 if kind != CONSTANT else 0.0
        one = _fitted(flares, robots, images, log_chance, seed, kind, prior, precision)
        if one is not None and (best is None or one.log_odds > best.log_odds):
            best = one
    return best


def _plausible_pairs(flares: Flares, robots: Indices, images: Indices) -> tuple[Indices, Indices]:
    """Return whom each flare may show: an image is farther than what it shows, from anywhere before it."""
    i, j = (grid.ravel() for grid in np.meshgrid(robots, images, indexing="ij"))
    near_m = np.linalg.norm(flares.place_m[i] - flares.origin_m[j], axis=1)
    usable = (i != j) & (flares.seems_m[j] > near_m)
    return i[usable], j[usable]


def _seeds(flares: Flares, parents: Indices, images: Indices) -> list[tuple[int, Array]]:
    """Return guesses of planes, by kind of reflectance."""
    pairs = len(parents)
    stride = max(1, pairs * (pairs - 1) // 2 // _MOST_PAIRS_OF_PAIRS)
    seeds = [(CONSTANT, seeds_of_constant(flares, parents, images, stride, _MOST_SEEDS))]
    # A dielectric takes more than half of the light but at grazing angles.
    near_m = np.linalg.norm(flares.place_m[parents] - flares.origin_m[images], axis=1)
    dim = flares.seems_m[images] > _DIM_RATIO * near_m
    parents, images = parents[dim], images[dim]
    seeds += [(kind, seeds_of_kind(flares, parents, images, kind, _SEED_INDICES)) for kind in (SURFACE, PANE)]
    return [(kind, planes) for kind, planes in seeds if len(planes)]


def _fitted(
    flares: Flares,
    robots: Indices,
    images: Indices,
    log_chance: Array,
    start: Array,
    kind: int,
    prior: Array,
    precision: Array,
) -> _Found | None:
    """Fit a plane to the pairs that it explains, and weigh it; None where it explains too few."""
    plane = start.copy()
    is_known = bool(precision[0, 0] > 0.0)
    parents, shown, chi2, log_peak, covariance = fit_matched(
        flares, robots, images, plane, kind, prior, precision
    )
    if not len(parents):
        return None
    of_all = parents, shown, covariance
    robot = _one_of_each(flares, parents, shown)
    if len(robot) < len(parents):
        parents, shown = parents[robot], shown[robot]
        chi2, log_peak, covariance = fit_plane(flares, parents, shown, plane.copy(), kind, prior, precision)
        if len(parents) < (1 if is_known else 2) or not (np.diagonal(covariance) > 0.0).all():
            return None
    log_gain = log_peak - 0.5 * chi2 - float(log_chance[shown].sum())
    log_gain += _log_seen(flares, robots, parents, plane, kind, len(log_chance))
    log_volume = 0.5 * (np.linalg.slogdet(2.0 * math.pi * covariance)[1])
    if is_known:
        log_prior = 0.5 * (np.linalg.slogdet(precision / (2.0 * math.pi))[1])
        return _Found(plane, kind, *of_all, log_gain + log_volume + log_prior)
    log_prior = -math.log(4.0 * math.pi) - math.log(MOST_PLANE_DISTANCE_M)
    log_odds = math.log(MIRROR_PROBABILITY / len(KINDS)) + log_gain + log_volume + log_prior
    log_odds += _log_parameter_prior(plane[4], math.sqrt(covariance[3, 3]), kind)
    if log_odds < _LOG_NEVER:
        return _Found(plane, kind, *of_all, log_odds)
    by_symmetry = _log_symmetry(flares, parents, shown, plane, log_gain + 0.5 * chi2 - log_peak, log_prior)
    # Against there being neither a mirror nor a formation.
    against = math.log1p(math.exp(min(by_symmetry, 700.0)))
    return _Found(plane, kind, *of_all, log_odds - against)


def _one_of_each(flares: Flares, parents: Indices, images: Indices) -> list[int]:
    """Return which pairs to weigh: one for each robot, as LEDs of one body stand in step with each other.

    That two robots mirror each other is one coincidence, however many LEDs they carry; that a robot's LEDs
    mirror each other is none.
    """
    kept: list[int] = []
    for k, (i, j) in enumerate(zip(parents.tolist(), images.tolist(), strict=True)):
        if not (_of_one_robot(flares, i, j) or any(_of_one_robot(flares, i, parents[one]) for one in kept)):
            kept.append(k)
    return kept


def _of_one_robot(flares: Flares, i: int, j: int) -> bool:
    """Tell whether two flares may be LEDs of one robot: they stand within 25 cm.

    How far apart they are along the line of sight is known no better than by their fluxes.
    """
    apart_m = flares.place_m[i] - flares.place_m[j]
    along_m = abs(float(apart_m @ flares.axes[i, 2]))
    across_m = math.sqrt(max(float(apart_m @ apart_m) - along_m**2, 0.0))
    unsure_m = 2.0 * math.hypot(*flares.moved_m[i].tolist(), *flares.moved_m[j].tolist())
    return across_m < _ONE_ROBOT_M and along_m < _ONE_ROBOT_M + unsure_m


def _log_parameter_prior(parameter: float, sigma: float, kind: int) -> float:
    if kind != CONSTANT:  # the fit has counted its χ²
        return -math.log(INDEX_SIGMA * math.sqrt(2.0 * math.pi))
    loss = max(parameter, 0.5 * sigma, 1e-3)
    off = (math.log(loss) - LOSS_PRIOR) / LOSS_SIGMA
    return -0.5 * off**2 - math.log(loss * LOSS_SIGMA * math.sqrt(2.0 * math.pi))


def _log_symmetry(
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


def _log_seen(
    flares: Flares, robots: Indices, parents: Indices, plane: Array, kind: int, count: int
) -> float:
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
    return _log_share(len(parents), unseen)


def _log_share(seen: int, unseen: int) -> float:
    """Return ln of the probability of just these, of a share between 0 and 1: ∫ s^k (1 − s)^(n−k) ds."""
    return math.lgamma(seen + 1.0) + math.lgamma(unseen + 1.0) - math.lgamma(seen + unseen + 2.0)


def _lone_probability(count: int, own: int, has_mirror: bool) -> list[float]:
    """Return of each flare, the nearest first, the probability that it is the lone image of a nearer one.

    Nothing speaks for or against it but that other robots before that mirror have no image.
    """
    share = math.exp(_log_share(1, max(count + own - 2, 0)))
    odds = 0.0 if has_mirror else MIRROR_PROBABILITY * share / count
    return [min(odds * (nearer + own), 0.5) for nearer in range(count)]
