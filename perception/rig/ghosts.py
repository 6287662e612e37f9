"""Which measurements are mirror images of robots: by planes that explain several of them at once.

Any two points have a mirror plane, so one pair proves nothing. A plane is a hypothesis with a price: how
probable a mirror is, how well it must be placed to explain what is seen, and how often the robots of the set
would stand so by chance. What it gains is the density of the images where it says they are, over the density
of robots there. Robots in a symmetric formation look like a mirror that loses no light: that is a hypothesis
of its own, in which nothing is a ghost.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.rig.joined import Joined
from perception.rig.mirrors.flares import Flares
from perception.rig.mirrors.model import (
    CONSTANT,
    GATE_CHI2,
    PANE,
    SURFACE,
    fit_all,
    fit_plane,
    match_all,
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
    one_of_each,
)
from perception.rig.mirrors.planes import KINDS, mirror_plane, prior_of
from perception.rig.mirrors.seeds import best_seeds, dim_pairs, plausible_pairs, seeds_of_constant
from perception.types import Ghost, MirrorPlane, bearing_axes

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
_OWN_SIGMA_M = 2e-3


@dataclass(frozen=True, eq=False)
class _Found:
    """A plane and its kind, whom each image shows, its covariance, and ln of its odds against none."""

    plane: Array
    kind: int
    parents: Indices
    images: Indices
    covariance: Array
    log_odds: float


class _Trials(NamedTuple):
    """Planes to begin from, n of them, and what is known beforehand, as for `fit_all`."""

    planes: Array
    kinds: Indices
    priors: Array
    precisions: Array

    def taken(self, rows: Indices) -> "_Trials":
        """Return some of them."""
        return _Trials._make(column[rows] for column in self)


def told_ghosts(
    joined: Joined, own_sources_body_m: Array, planes: Sequence[MirrorPlane] = ()
) -> tuple[Array, tuple[MirrorPlane, ...]]:
    """Tell mirror images from robots.

    Parameters
    ----------
    joined
        The sources of one set.
    own_sources_body_m
        Where the observer's own sources sit, shape (n, 3): their images tell most.
    planes
        Mirrors that are known already, in today's body axes; their reflectance stays free within their
        covariance.

    Returns
    -------
    How probable it is that each is an image shape (sources,), and the mirrors.
    """
    probability = joined.ghost.astype(np.float64)
    usable = np.flatnonzero(~joined.ghost & (joined.range_m > 0.0) & (joined.seems_m > 0.0))
    usable = usable[np.argsort(joined.seems_m[usable], kind="stable")]
    if not len(usable) or len(usable) + len(own_sources_body_m) < 2:
        return probability, ()
    flares = _flares_of(joined, usable, own_sources_body_m)
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
        of_images = usable[best.images]
        probability[of_images] = np.maximum(probability[of_images], odds)
        if odds < YES:
            break
        found.append(best)
        robots = _without(robots, best.images)
        images = _without(images, best.images, best.parents)
    if found and searched < len(usable):
        robots = np.concatenate([robots, np.arange(searched, len(usable))])
        for one in found:
            others = np.arange(searched, len(usable))
            pairs, count, _ = match_all(flares, robots, others, one.plane[None], one.kind, GATE_CHI2)
            probability[usable[pairs[0, 1, : count[0]]]] = YES
    lone = _lone_probability(len(usable), len(own_sources_body_m), bool(found))
    probability[usable] = np.maximum(probability[usable], lone)
    return probability, tuple(
        mirror_plane(one.plane, one.kind, one.covariance, len(one.images)) for one in found
    )


def called(probability: float) -> Ghost:
    """Say in the contract's words how probably something is a mirror image."""
    return "yes" if probability >= YES else "possible" if probability >= POSSIBLE else "no"


def _flares_of(joined: Joined, rows: Indices, own_sources_body_m: Array) -> Flares:
    """Return sources as the search reckons with them, and behind them the observer's own."""
    n, own = len(rows), len(own_sources_body_m)
    flares = Flares(
        origin_m=np.zeros((n + own, 3)), place_m=np.empty((n + own, 3)), seems_m=np.ones(n + own),
        axes=np.empty((n + own, 3, 3)), angular_rad2=np.zeros((n + own, 2, 2)), noise=np.zeros(n + own),
        noise_m2=np.empty((n + own, 3, 3)), common=np.zeros(n + own), moved_m=np.zeros((n + own, 3)),
    )  # fmt: skip
    bearing, covariance = joined.bearing[rows], joined.covariance[rows]
    flares.origin_m[:n] = joined.origin_m[rows]
    flares.place_m[:n] = flares.origin_m[:n] + joined.range_m[rows, None] * bearing
    flares.seems_m[:n] = joined.seems_m[rows]
    flares.axes[:n], flares.axes[n:] = bearing_axes(bearing), np.eye(3)
    claimed = np.isfinite(covariance).all(axis=(1, 2), keepdims=True)
    flares.angular_rad2[:n] = np.where(claimed, covariance[:, :2, :2], _UNCLAIMED_RAD**2 * np.eye(2))
    flares.noise[:n], flares.common[:n] = joined.noise[rows], joined.common[rows]
    flares.noise_m2[:n], flares.noise_m2[n:] = joined.noise_m2[rows], _OWN_SIGMA_M**2 * np.eye(3)
    flares.moved_m[:n] = joined.moved_m[rows]
    flares.place_m[n:] = own_sources_body_m
    return flares


def _best_plane(
    flares: Flares, robots: Indices, images: Indices, log_chance: Array, known: list[MirrorPlane]
) -> _Found | None:
    """Return the plane that explains most, of those that are known first; it is taken from them."""
    for plane in list(known):
        known.remove(plane)
        prior, kind, precision = prior_of(plane)
        trial = _Trials(prior[None].copy(), np.array([kind]), prior[None], precision[None])
        for one in _fitted(flares, robots, images, log_chance, trial):
            if one is not None and one.log_odds > _LOG_YES:
                return one
    parents, shown = plausible_pairs(flares, robots, images)
    chosen = [
        (*best_seeds(flares, robots, images, seeds, kind, _MOST_TRIED), kind)
        for kind, seeds in _seeds(flares, parents, shown)
    ]
    if not chosen:
        return None
    seeds = np.concatenate([planes for planes, _, _ in chosen])
    counts = np.concatenate([explained for _, explained, _ in chosen])
    kinds = np.repeat([kind for _, _, kind in chosen], [len(planes) for planes, _, _ in chosen])
    trials = _trials_of(seeds, kinds)
    best: _Found | None = None
    for count in sorted({*counts.tolist()} - {0, 1}, reverse=True):
        if best is not None and best.log_odds > _CLEAR and count < len(best.images):
            break
        alike = trials.taken(np.flatnonzero(counts == count))
        for one in _fitted(flares, robots, images, log_chance, alike):
            if best is not None and best.log_odds > _CLEAR and count < len(best.images):
                break
            if one is not None and (best is None or one.log_odds > best.log_odds):
                best = one
    return best


def _trials_of(seeds: Array, kinds: Indices) -> _Trials:
    """Return guessed planes, shape (n, 5), as trials: only what an index usually is is known of them."""
    priors, precisions = seeds.copy(), np.zeros((len(seeds), 4, 4))
    dielectric = kinds != CONSTANT
    priors[dielectric, 4] = INDEX_PRIOR
    precisions[dielectric, 3, 3] = 1.0 / INDEX_SIGMA**2
    return _Trials(seeds, kinds, priors, precisions)


def _seeds(flares: Flares, parents: Indices, images: Indices) -> list[tuple[int, Array]]:
    """Return guesses of planes, by kind of reflectance."""
    pairs = len(parents)
    stride = max(1, pairs * (pairs - 1) // 2 // _MOST_PAIRS_OF_PAIRS)
    seeds = [(CONSTANT, seeds_of_constant(flares, parents, images, stride, _MOST_SEEDS))]
    parents, images = dim_pairs(flares, parents, images)
    seeds += [(kind, seeds_of_kind(flares, parents, images, kind, _SEED_INDICES)) for kind in (SURFACE, PANE)]
    return [(kind, planes) for kind, planes in seeds if len(planes)]


def _fitted(
    flares: Flares, robots: Indices, images: Indices, log_chance: Array, trials: _Trials
) -> Iterator[_Found | None]:
    """Fit planes to the pairs that they explain, and weigh each; None where it explains too few."""
    planes, kinds, priors, precisions = trials
    pairs, counts, found, covariances = fit_all(flares, robots, images, planes, kinds, priors, precisions)
    for n, (kind, count) in enumerate(zip(kinds.tolist(), counts.tolist(), strict=True)):
        if not count:
            yield None
            continue
        chi2, log_peak = found[n].tolist()
        shown = pairs[n, 0, :count], pairs[n, 1, :count]
        known = priors[n], precisions[n]
        yield _weighed(
            flares, robots, log_chance, planes[n], kind, known, *shown, chi2, log_peak, covariances[n]
        )


def _weighed(
    flares: Flares,
    robots: Indices,
    log_chance: Array,
    plane: Array,
    kind: int,
    known: tuple[Array, Array],
    parents: Indices,
    shown: Indices,
    chi2: float,
    log_peak: float,
    covariance: Array,
) -> _Found | None:
    """Weigh a plane that has been fitted to the pairs that it explains; None where it explains too few."""
    prior, precision = known
    is_known = bool(precision[0, 0] > 0.0)
    of_all = parents, shown, covariance
    robot = one_of_each(flares, parents, shown)
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


def _without(numbers: Indices, *others: Indices) -> Indices:
    """Return numbers that are none of others, in their order."""
    left = np.ones(max(int(each.max(initial=-1)) for each in (numbers, *others)) + 1, dtype=np.bool_)
    for each in others:
        left[each] = False
    return numbers[left[numbers]]


def _lone_probability(count: int, own: int, has_mirror: bool) -> Array:
    """Return of each flare, the nearest first, the probability that it is the lone image of a nearer one.

    Nothing speaks for or against it but that other robots before that mirror have no image.
    """
    share = math.exp(log_share(1, max(count + own - 2, 0)))
    odds = 0.0 if has_mirror else MIRROR_PROBABILITY * share / count
    return np.asarray(np.minimum(odds * (np.arange(count) + own), 0.5))
