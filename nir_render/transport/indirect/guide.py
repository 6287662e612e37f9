"""Which light to ask next: the chance of each emitter, by the place of the surface that is lit.

The scene's box is cut into cells. In each cell an emitter's chance goes with what it would bring to the
cell's middle if nothing stood in between: its power over the distance squared. A share is spread evenly over
the groups, and in each over its emitters: so the light of a group stands alone, whatever shines beside it.
Drawing one costs the same for four emitters and for thousands.

In fog that is not enough: there lights also say where paths turn and whereto, and a group that is picked
seldom at each of several vertices hardly ever gets the paths that it needs. Groups whose light differs much
are therefore dealt out to *tiers*: each path serves one tier, as if the others were off (`kernel.begin`).
"""

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.by_spectrum import spectrum_key
from nir_render.camera.optics.response import response
from nir_render.scene.documents.camera import Camera
from nir_render.scene.emission import emission_units
from nir_render.scene.snapshot import Snapshot
from nir_render.transport.world.emitters import RECTANGLE, SKY, SPHERE, SUN, Emitters
from nir_render.transport.world.facets import Facets, reflectance

Array = NDArray[np.float64]

_CELLS = 4096
_ENTRIES = 2**22  # cells × emitters
_EVEN_SHARE = 0.05
_STEP, _STEPS = 4, 6  # of the groups' power
_GROUP_SHARE = 0.06  # of the picks, spread evenly over groups
# Groups are of another tier from so many times weaker on, and tiers are so many at most. In clear air asking
# each costs half as much again, which is less than it spares beside the sun, and more than beside lamps.
_TIERS_IN_FOG, _TIERS_IN_CLEAR_AIR = (16.0, 3), (1024.0, 2)


@dataclass(frozen=True, eq=False)
class Guide:
    """Chances of emitters on a grid of cells.

    Attributes
    ----------
    low_m, step_m, counts
        The grid's corner, the extent of a cell, and the number of cells, along x, y and z, shape (3,).
    cumulative
        Cumulated chances, shape (tiers · cells, emitters), of one tier after the other, x runs fastest; the
        last is 1.
    chance
        Each emitter's chance, the exact differences of `cumulative`, float32, same shape; 0 in other tiers.
    tier
        The tier of each emitter, the strongest is 0, shape (emitters,).
    tier_share
        Share of each tier in what is brought to a cell, shape (tiers, cells).
    """

    low_m: Array
    step_m: Array
    counts: NDArray[np.int64]
    cumulative: NDArray[np.float32]
    chance: NDArray[np.float32]
    tier: NDArray[np.int64]
    tier_share: Array


def guide(
    emitters: Emitters,
    facets: Facets,
    power: Array,
    low_m: Array,
    high_m: Array,
    extinction_per_m: float = 0.0,
) -> Guide:
    """Return the chances of all emitters in a box.

    Parameters
    ----------
    power
        What one unit of each light group's emission counts, shape (groups,).
    low_m, high_m
        Corners of the box that holds the scene's bodies, shape (3,).
    extinction_per_m
        Of fog, which dims what is far.
    """
    extent_m = np.maximum(high_m - low_m, 1e-3 * max(float(np.max(high_m - low_m)), 1e-3))
    cells = int(np.clip(_ENTRIES // len(emitters.kind), 1, _CELLS))
    edge_m = float(np.cbrt(np.prod(extent_m) / cells))
    counts = np.maximum(np.floor(extent_m / edge_m), 1).astype(np.int64)
    step_m = extent_m / counts
    axes_m = [low_m[k] + step_m[k] * (np.arange(counts[k]) + 0.5) for k in range(3)]
    weight = _unshadowed(emitters, facets, axes_m, step_m, extinction_per_m)
    weight *= power[emitters.group][:, None]
    steps = _TIERS_IN_FOG if extinction_per_m > 0.0 else _TIERS_IN_CLEAR_AIR
    tier = _tiers(weight.mean(axis=1), emitters, *steps)
    numbers = range(int(tier.max(initial=0)) + 1)
    tables = [_chances(weight, emitters.group, tier == number) for number in numbers]
    cumulative, chance = (np.concatenate(parts) for parts in zip(*tables, strict=True))
    brought = np.stack([weight[tier == number].sum(axis=0) for number in numbers])
    share = brought / np.maximum(brought.sum(axis=0), 1e-300)
    return Guide(low_m, step_m, counts, cumulative, chance, tier, share)


def _chances(
    weight: Array, group: NDArray[np.int64], chosen: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return cumulated chances of the chosen emitters, and chances, by their weights in each cell.

    `weight` has shape (emitters, cells), what is returned (cells, emitters); the chance of others is 0.
    """
    places = np.flatnonzero(chosen)
    places = places[np.argsort(group[places], kind="stable")]
    first = np.flatnonzero(np.diff(group[places], prepend=-1))
    count = np.diff(first, append=places.size)
    own_weight = weight if np.array_equal(places, np.arange(len(group))) else weight[places]
    if first.size == places.size:  # each group has one emitter
        brought, within = own_weight, np.ones((1, 1))
    else:
        brought = np.add.reduceat(own_weight, first, axis=0)
        of_group, even = np.repeat(brought, count, axis=0), np.repeat(1.0 / count, count)[:, None]
        within = np.where(of_group > 0.0, own_weight / np.where(of_group > 0.0, of_group, 1.0), even)
        within = (1.0 - _EVEN_SHARE) * within + _EVEN_SHARE * even
    if first.size > 1:
        total = brought.sum(axis=0)
        share = np.where(total > 0.0, brought / np.where(total > 0.0, total, 1.0), 1.0 / first.size)
        share = (1.0 - _GROUP_SHARE) * share + _GROUP_SHARE / first.size
        within = within * (share if first.size == places.size else np.repeat(share, count, axis=0))
    chance = np.zeros(weight.shape)
    chance[places] = within
    cumulative = np.cumsum(chance, axis=0)
    last = len(chosen) - 1 - np.argmax(chance[::-1] > 0.0, axis=0)
    cumulative = (cumulative / cumulative[-1]).astype(np.float32)
    cumulative[np.arange(len(chosen))[:, None] >= last] = 1.0
    chance32 = np.diff(cumulative, axis=0, prepend=np.float32(0.0))
    return np.ascontiguousarray(cumulative.T), np.ascontiguousarray(chance32.T)


def _tiers(brought: Array, emitters: Emitters, step: float, most: int) -> NDArray[np.int64]:
    """Return the tier of each emitter, by what its group brings to the scene on the mean over it.

    That is an irradiance for all kinds of light, and can be compared. The sky goes with the strongest: paths
    come to it by themselves, wherever they are led.
    """
    of_group = np.bincount(emitters.group, np.where(emitters.facet < 0, brought, 0.0))
    ratio = of_group.max(initial=0.0) / np.maximum(of_group, 1e-300)
    level = np.minimum(np.floor(np.log(ratio) / np.log(step)), most - 1)
    level[emitters.group[emitters.kind == SKY]] = 0
    return np.unique(level[emitters.group], return_inverse=True)[1].astype(np.int64)


def _unshadowed(
    emitters: Emitters, facets: Facets, axes_m: list[Array], step_m: Array, extinction_per_m: float
) -> Array:
    """Return what one unit of each emitter brings to cells if nothing hides it, shape (emitters, cells).

    Spheres seen straight, of which there may be thousands, are reckoned together.
    """
    plain = (emitters.kind == SPHERE) & (emitters.facet < 0)
    irradiance = np.empty((len(emitters.kind), *(axis.size for axis in axes_m[::-1])))
    x2, y2, z2 = ((emitters.center_m[plain, k, None] - axes_m[k]) ** 2 for k in range(3))
    distance2_m2 = (x2[:, None, None, :] + y2[:, None, :, None]) + z2[:, :, None, None]
    irradiance[plain] = _of_sphere(distance2_m2, step_m, extinction_per_m)
    z, y, x = np.meshgrid(*axes_m[::-1], indexing="ij")
    places_m = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    irradiance = irradiance.reshape(len(emitters.kind), -1)
    for row in np.flatnonzero(~plain):
        irradiance[row] = _unshadowed_irradiance(
            emitters, facets, int(row), places_m, step_m, extinction_per_m
        )
    return irradiance


def _of_sphere(distance2_m2: Array, step_m: Array, extinction_per_m: float) -> Array:
    """Return what a sphere brings to cells whose middles are so far."""
    spread2_m2 = float(step_m @ step_m) / 12.0  # mean square distance within a cell from its middle
    area_m2 = 4.0 * np.pi * (distance2_m2 + spread2_m2)
    return np.exp(-extinction_per_m * np.sqrt(distance2_m2)) / area_m2 if extinction_per_m else 1.0 / area_m2


def _unshadowed_irradiance(
    emitters: Emitters, facets: Facets, row: int, places_m: Array, step_m: Array, extinction_per_m: float
) -> Array:
    """Return what one unit of an emitter brings to places if nothing hides it, roughly, shape (places,)."""
    spread2_m2 = float(step_m @ step_m) / 12.0
    facet = int(emitters.facet[row])
    kind = int(emitters.kind[row])
    if kind == SKY:
        to_m = np.broadcast_to([0.0, 0.0, 1.0], places_m.shape)
        irradiance = np.ones(len(places_m))
        direction = to_m
    elif kind == SUN:
        to_m = np.broadcast_to(emitters.normal[row], places_m.shape)
        irradiance = np.ones(len(places_m))
        direction = to_m
    else:
        to_m = emitters.center_m[row] - places_m
        distance2_m2 = (to_m**2).sum(axis=1)
        direction = to_m / np.sqrt(np.maximum(distance2_m2, 1e-12))[:, None]
        irradiance = _of_sphere(distance2_m2, step_m, extinction_per_m)
        if kind == RECTANGLE:
            height_m = -(to_m @ emitters.normal[row])
            slack_m = 0.5 * float(np.abs(emitters.normal[row]) @ step_m)
            cosine = (height_m + slack_m) / np.sqrt(distance2_m2 + spread2_m2)
            irradiance *= 4.0 * np.clip(cosine, 0.0, 1.0)
    assert kind in (SPHERE, RECTANGLE, SUN, SKY)
    return irradiance if facet < 0 else irradiance * _facet_share(facets, facet, places_m, direction, step_m)


def _facet_share(facets: Facets, facet: int, places_m: Array, direction: Array, step_m: Array) -> Array:
    """Return the share of an image's light that a facet throws to places, 1 % where it misses them."""
    normal = facets.normal[facet]
    slope = direction @ normal
    height_m = (places_m - facets.center_m[facet]) @ normal
    slack_m = 0.5 * float(np.abs(normal) @ step_m)
    towards = (height_m * slope < 0.0) | (np.abs(height_m) < slack_m)
    along_m = np.where(np.abs(slope) > 1e-9, -height_m / np.where(np.abs(slope) > 1e-9, slope, 1.0), np.inf)
    hits_m = places_m + np.where(np.isfinite(along_m), along_m, 0.0)[:, None] * direction
    reach_m = 0.5 * float(np.linalg.norm(step_m))
    inside = towards
    for half_m in (facets.half_u_m[facet], facets.half_v_m[facet]):
        length_m = float(np.linalg.norm(half_m))
        inside = inside & (np.abs((hits_m - facets.center_m[facet]) @ half_m) / length_m < length_m + reach_m)
    return np.where(inside, 1.0, 0.01) * np.asarray(reflectance(facets, facet, np.abs(slope)))


def group_power(snapshot: Snapshot, camera: Camera) -> NDArray[np.float64]:
    """Return what each group counts when lights are chosen: the electrons that it brings, roughly.

    In steps of 4 below the strongest: so a light is rendered anew seldom when a source's power, the spectrum
    or the filter change, which otherwise matter only afterwards. It moves nothing but noise.
    """
    known = snapshot.emitters.values()
    answers: dict[Hashable, float] = {}
    for one in known:
        key = spectrum_key(one)
        if key not in answers:
            answers[key] = float(response(camera, one)(0.0))
    brought = np.array([emission_units(one) * answers[spectrum_key(one)] for one in known])
    strongest = brought.max() if brought.size else 1.0
    steps = np.round(np.log(np.maximum(brought, 1e-30) / max(strongest, 1e-30)) / np.log(_STEP))
    return np.asarray(float(_STEP) ** np.maximum(steps, -_STEPS))
