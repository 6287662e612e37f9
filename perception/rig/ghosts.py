"""Which measurements are mirror images of robots: by planes that explain several of them at once.

Any two points have a mirror plane, so one pair proves nothing. A plane is a hypothesis with a price: how
probable a mirror is, how well it must be placed to explain what is seen, and how often the robots of the set
would stand so by chance. What it gains is the density of the images where it says they are, over the density
of robots there. Robots in a symmetric formation look like a mirror that loses no light: that is a hypothesis
of its own, in which nothing is a ghost.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from perception.rig.joined import Joined
from perception.rig.mirrors.flares import Flares, flares_of
from perception.rig.mirrors.model import GATE_CHI2, match_all
from perception.rig.mirrors.odds import log_chances
from perception.rig.mirrors.planes import mirror_plane, prior_of
from perception.rig.mirrors.search import MIRROR_PROBABILITY, Explanation, best_plane, fit_and_weigh
from perception.types import Ghost, MirrorPlane

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

YES, POSSIBLE = 0.98, 0.005
"""Probabilities of a ghost from which a measurement is called one, or possibly one."""

_LOG_YES = math.log(YES / (1.0 - YES))
_MOST_FLARES, _MOST_PLANES = 40, 4


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
    # Writable and in C's order: for other arrays Numba would compile anew.
    flares = flares_of(joined, usable, np.array(own_sources_body_m, dtype=np.float64, order="C"))
    log_chance = log_chances(flares, len(usable))
    # The search is among the nearest; what it finds tells the others, too.
    searched = min(len(usable), _MOST_FLARES)
    own = np.arange(len(usable), len(flares.place_m))
    robots, images = np.concatenate([np.arange(searched), own]), np.arange(searched)
    found: list[Explanation] = []
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


def _best_plane(
    flares: Flares, robots: Indices, images: Indices, log_chance: Array, known: list[MirrorPlane]
) -> Explanation | None:
    """Return the plane that explains most, of those that are known first; it is taken from them."""
    for plane in list(known):
        known.remove(plane)
        prior, kind, precision = prior_of(plane)
        one = fit_and_weigh(flares, robots, images, log_chance, prior.copy(), kind, prior, precision)
        if one.log_odds > _LOG_YES:
            return one
    best = best_plane(flares, robots, images, log_chance)
    return best if best.log_odds > -math.inf else None


def _without(numbers: Indices, *others: Indices) -> Indices:
    """Return numbers that are none of others, in their order."""
    left = np.ones(max(int(each.max(initial=-1)) for each in (numbers, *others)) + 1, dtype=np.bool_)
    for each in others:
        left[each] = False
    return numbers[left[numbers]]


def _lone_probability(count: int, own: int, has_mirror: bool) -> Array:
    """Return of each flare, the nearest first, the probability that it is the lone image of a nearer one.

    Nothing speaks for or against it but that other robots before that mirror have no image (`log_share`).
    """
    others = max(count + own - 2, 0)
    # In closed form: one of its values is a bound of `called`, and logarithms round to either side of it.
    odds = 0.0 if has_mirror else MIRROR_PROBABILITY / ((others + 1) * (others + 2) * count)
    return np.asarray(np.minimum(odds * (np.arange(count) + own), 0.5))
