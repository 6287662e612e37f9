"""Which measurements are mirror images of robots: by planes that explain several of them at once.

Any two points have a mirror plane, so one pair proves nothing. A plane is a hypothesis with a price: how
probable a mirror is, how well it must be placed to explain what is seen, and how often the robots of the set
would stand so by chance. What it gains is the density of the images where it says they are, over the density
of robots there. Robots in a symmetric formation look like a mirror that loses no light: that is a hypothesis
of its own, in which nothing is a ghost.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from perception.rig.fusion import Joined
from perception.rig.mirrors.flares import Flares
from perception.rig.mirrors.model import (
    CONSTANT,
    GATE_CHI2,
    PANE,
    SURFACE,
    fit_all,
    fit_plane,
    matched,
    seeds_of_kind,
)
from perception.rig.mirrors.odds import (
    INDEX_PRIOR,
    INDEX_SIGMA,
    log_chances,
    log_parameter_prior,
    log_seen,
    log_share,
    log_symmetry,
)
from perception.rig.mirrors.planes import KINDS, mirror_plane, prior_of
from perception.rig.mirrors.seeds import best_seeds, seeds_of_constant
from perception.types import Ghost, Measurement, MirrorPlane, bearing_axes

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MIRROR_PROBABILITY = 0.1
"""That a set shows a flat mirror at all, before it is looked at."""

YES, POSSIBLE = 0.98, 0.005
"""Probabilities of a ghost from which a measurement is called one, or possibly one."""

MOST_PLANE_DISTANCE_M = 20.0
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


@dataclass(frozen=True, eq=False)
class _Trial:
    """A plane and its kind to begin from, and what is known beforehand, as for `fit_plane`."""

    start: Array
    kind: int
    prior: Array
    precision: Array


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
    log_chance = log_chances(flares, len(usable))
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


def _best_plane(
    flares: Flares, robots: Indices, images: Indices, log_chance: Array, known: list[MirrorPlane]
) -> _Found | None:
    """Return the plane that explains most, of those that are known first; it is taken from them."""
    for plane in list(known):
        known.remove(plane)
        prior, kind, precision = prior_of(plane)
        for one in _fitted(flares, robots, images, log_chance, [_Trial(prior, kind, prior, precision)]):
            if one is not None and one.log_odds > _LOG_YES:
                return one
    parents, shown = _plausible_pairs(flares, robots, images)
    trials: list[tuple[int, _Trial]] = []
    for kind, seeds in _seeds(flares, parents, shown):
        chosen, explained = best_seeds(flares, robots, images, seeds, kind, _MOST_TRIED)
        trials += [
            (count, _trial_of(seed, kind)) for count, seed in zip(explained.tolist(), chosen, strict=True)
        ]
    best: _Found | None = None
    trials.sort(key=lambda each: -each[0])
    for count, alike in groupby(trials, key=lambda each: each[0]):
        if count < 2 or (best is not None and best.log_odds > _CLEAR and count < len(best.images)):
            break
        for one in _fitted(flares, robots, images, log_chance, [trial for _, trial in alike]):
            if best is not None and best.log_odds > _CLEAR and count < len(best.images):
                break
            if one is not None and (best is None or one.log_odds > best.log_odds):
                best = one
    return best


def _trial_of(seed: Array, kind: int) -> _Trial:
    prior, precision = seed.copy(), np.zeros((4, 4))
    if kind != CONSTANT:
        prior[4] = INDEX_PRIOR
        precision[3, 3] = 1.0 / INDEX_SIGMA**2
    return _Trial(seed, kind, prior, precision)


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
    flares: Flares, robots: Indices, images: Indices, log_chance: Array, trials: Sequence[_Trial]
) -> Iterator[_Found | None]:
    """Fit planes to the pairs that they explain, and weigh each; None where it explains too few."""
    planes = np.array([each.start for each in trials])
    kinds = np.array([each.kind for each in trials])
    priors = np.array([each.prior for each in trials])
    precisions = np.array([each.precision for each in trials])
    pairs, counts, found, covariances = fit_all(flares, robots, images, planes, kinds, priors, precisions)
    for n, (trial, count) in enumerate(zip(trials, counts.tolist(), strict=True)):
        if not count:
            yield None
            continue
        chi2, log_peak = found[n].tolist()
        shown = pairs[n, 0, :count], pairs[n, 1, :count]
        yield _weighed(flares, robots, log_chance, trial, planes[n], *shown, chi2, log_peak, covariances[n])


def _weighed(
    flares: Flares,
    robots: Indices,
    log_chance: Array,
    trial: _Trial,
    plane: Array,
    parents: Indices,
    shown: Indices,
    chi2: float,
    log_peak: float,
    covariance: Array,
) -> _Found | None:
    """Weigh a plane that has been fitted to the pairs that it explains; None where it explains too few."""
    kind, prior, precision = trial.kind, trial.prior, trial.precision
    is_known = bool(precision[0, 0] > 0.0)
    of_all = parents, shown, covariance
    robot = _one_of_each(flares, parents, shown)
    if len(robot) < len(parents):
        parents, shown = parents[robot], shown[robot]
        chi2, log_peak, covariance = fit_plane(flares, parents, shown, plane.copy(), kind, prior, precision)
        if len(parents) < (1 if is_known else 2) or not (np.diagonal(covariance) > 0.0).all():
            return None
    log_gain = log_peak - 0.5 * chi2 - float(log_chance[shown].sum())
    log_gain += log_seen(flares, robots, parents, plane, kind, len(log_chance))
    log_volume = 0.5 * (np.linalg.slogdet(2.0 * math.pi * covariance)[1])
    if is_known:
        log_prior = 0.5 * (np.linalg.slogdet(precision / (2.0 * math.pi))[1])
        return _Found(plane, kind, *of_all, log_gain + log_volume + log_prior)
    log_prior = -math.log(4.0 * math.pi) - math.log(MOST_PLANE_DISTANCE_M)
    log_odds = math.log(MIRROR_PROBABILITY / len(KINDS)) + log_gain + log_volume + log_prior
    log_odds += log_parameter_prior(plane[4], math.sqrt(covariance[3, 3]), kind)
    if log_odds < _LOG_NEVER:
        return _Found(plane, kind, *of_all, log_odds)
    by_symmetry = log_symmetry(flares, parents, shown, plane, log_gain + 0.5 * chi2 - log_peak, log_prior)
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


def _lone_probability(count: int, own: int, has_mirror: bool) -> list[float]:
    """Return of each flare, the nearest first, the probability that it is the lone image of a nearer one.

    Nothing speaks for or against it but that other robots before that mirror have no image.
    """
    share = math.exp(log_share(1, max(count + own - 2, 0)))
    odds = 0.0 if has_mirror else MIRROR_PROBABILITY * share / count
    return [min(odds * (nearer + own), 0.5) for nearer in range(count)]
