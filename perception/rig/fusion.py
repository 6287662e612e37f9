"""One robot in several cameras, or in several exposures of one, becomes one measurement."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.rig.frame_sets import robot_of
from perception.rig.rays import Rays, chi2_of_pairs, placed
from perception.rig.sightings import Sightings
from perception.types import Measurement, bearing_axes

Array = NDArray[np.float64]

GATE_CHI2 = 28.0
"""Sightings of one source lie within this χ² of three degrees of freedom, but for 4 in a million."""

SPEED_SIGMA_M_PER_S = 0.1
"""Robots are taken to move so fast between the exposures of a set (the paper's limit of speed)."""

SCALE_COST = 10.0
"""What it costs two sightings that their ranges agree with where the rays meet but for one factor."""

_KNOWN_RANGE = 0.3


@dataclass(frozen=True)
class Group:
    """Sightings of one source: indices, and whether their ranges agree with where their rays meet.

    Ranges by flux do not where a mirror has taken light, or fog.
    """

    members: tuple[int, ...]
    ranges_agree: bool = True

    def best(self, noise: Array) -> int:
        """Return the member whose range is the most precise: the group stands where it says."""
        return min(self.members, key=noise.__getitem__)


def associated(sightings: Sightings) -> list[Group]:
    """Tell which sightings are of one source: at most one of each frame, nearest first, within a gate."""
    from scipy.optimize import linear_sum_assignment

    groups: list[Group] = []
    frame, noise = sightings.frame, sightings.rays.noise
    for first in np.flatnonzero(np.diff(frame, prepend=-1)):
        new = np.flatnonzero(frame == frame[first])
        left = set(new.tolist())
        if groups:
            best = np.array([group.best(noise) for group in groups])
            chi2, scaled = chi2_of_pairs(sightings.together, best, new, SPEED_SIGMA_M_PER_S)
            cost = np.minimum(chi2, scaled + SCALE_COST)
            if cost.min() < GATE_CHI2:
                rows, columns = linear_sum_assignment(np.minimum(cost, GATE_CHI2))
                for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
                    if cost[row, column] < GATE_CHI2:
                        group, k = groups[row], int(new[column])
                        agree = group.ranges_agree and bool(cost[row, column] == chi2[row, column])
                        groups[row] = Group((*group.members, k), agree)
                        left.remove(k)
        groups += [Group((k,)) for k in sorted(left)]
    return groups


@dataclass(frozen=True, eq=False)
class Joined:
    """A measurement, and what the search for mirrors must know beside it.

    Attributes
    ----------
    measurement
        Of a source.
    seems_m
        How far it seems by flux, from the measurement's origin: of a mirror image that is not where it is.
    noise, common
        Standard deviations of the logarithm of that.
    moved_m
        By how much a flux that is wrong by its σ moves the place, shape (3,).
    noise_m2
        Covariance of the place by all else, shape (3, 3).
    """

    measurement: Measurement
    seems_m: float
    noise: float
    common: float
    moved_m: Array
    noise_m2: Array


def fused(sightings: Sightings, groups: Sequence[Group]) -> list[Joined]:
    """Return the measurement of each source from its sightings.

    Maximum likelihood of its place: bearings by their own covariance, logarithms of ranges by their noise and
    one error that all of them share. A sighting at another time than the mean counts less by how far the
    source may have moved. Of several exposures of one camera the most precise counts, and what claims no σ
    only where nothing does. Where ranges do not agree with where the rays meet, the most precise sighting
    alone says where it seems to be.
    """
    rays = sightings.rays
    known = _Known(
        _alone(rays),
        rays.noise.tolist(),
        rays.common.tolist(),
        rays.time_s.tolist(),
        sightings.claimed.tolist(),
        sightings.saturated.tolist(),
        sightings.merged.tolist(),
        sightings.ghost.tolist(),
    )
    return [_fused(sightings, group, known) for group in groups]


@dataclass(frozen=True, eq=False)
class _Known:
    """What each sighting says by itself, in Python's own numbers: it is asked for one by one."""

    alone: Sequence["_Place"]
    noise: list[float]
    common: list[float]
    time_s: list[float]
    claimed: list[bool]
    saturated: list[bool]
    merged: list[bool]
    ghost: list[bool]


def _fused(sightings: Sightings, group: Group, known: _Known) -> Joined:
    rays, members = sightings.rays, group.members
    used = [k for k in members if known.claimed[k]] or list(members)
    best = min(used, key=known.noise.__getitem__)
    by_camera: dict[str, int] = {}
    for k in sorted(used, key=known.noise.__getitem__):
        by_camera.setdefault(sightings.keys[k][0], k)
    if len(by_camera) == 1 or not group.ranges_agree:
        used = [best]
        place = known.alone[best]
        time_s = known.time_s[best]
        seems_m = known.alone[best].range_m
    else:
        used = list(by_camera.values())
        rows = np.array(used)
        weight = 1.0 / np.trace(sightings.together.angular_rad2[rows], axis1=1, axis2=2)
        time_s = float(weight @ rays.time_s[rows] / weight.sum())
        place = _together(sightings.together, rows, time_s)
        at_origin_m = rays.origin_m[best] + rays.range_m[best] * rays.axes[best, 2] - place.origin_m
        seems_m = math.hypot(*at_origin_m.tolist())
    flagged = all(known.ghost[k] for k in members)
    claimed = known.claimed[best]
    measurement = Measurement(
        robot=robot_of(sightings.keys[members[0]][0]),
        time_s=time_s,
        cameras=tuple(dict.fromkeys(sightings.keys[k][0] for k in members)),
        detections=tuple(sightings.keys[k] for k in members),
        origin_body_m=_vector(place.origin_m),
        bearing_body=_vector(place.bearing),
        range_m=place.range_m,
        covariance=place.covariance if claimed else np.full((3, 3), math.nan),
        range_sigma_common_m=abs(float(place.moved_m @ place.bearing)) if claimed else math.nan,
        saturated=all(known.saturated[k] for k in used),
        merged=any(known.merged[k] for k in used),
        ghost="yes" if flagged else "no",
        ghost_probability=float(flagged),
    )
    return Joined(
        measurement=measurement,
        seems_m=seems_m,
        noise=known.noise[best],
        common=known.common[best],
        moved_m=place.moved_m,
        noise_m2=place.noise_m2,
    )


@dataclass(frozen=True, eq=False)
class _Place:
    """Where a source is, as in `Measurement` and `Joined`."""

    origin_m: Array
    bearing: Array
    range_m: float
    covariance: Array
    moved_m: Array
    noise_m2: Array


def _alone(rays: Rays) -> list[_Place]:
    """Return what each sighting says by itself."""
    covariance = np.zeros((len(rays.range_m), 3, 3))
    covariance[:, :2, :2] = rays.angular_rad2
    noise = covariance.copy()
    noise[:, 2, 2] = rays.noise**2
    covariance[:, 2, 2] = rays.range_m**2 * (rays.noise**2 + rays.common**2)
    unknown = np.isnan(rays.range_m)
    covariance[unknown, 2, :] = covariance[unknown, :, 2] = math.nan
    bearing = rays.axes[:, 2]
    moved_m = (rays.common * rays.range_m)[:, None] * bearing
    noise_m2 = rays.range_m[:, None, None] ** 2 * (np.swapaxes(rays.axes, 1, 2) @ noise @ rays.axes)
    ranges_m = rays.range_m.tolist()
    return [
        _Place(*one)
        for one in zip(rays.origin_m, bearing, ranges_m, covariance, moved_m, noise_m2, strict=True)
    ]


def _together(rays: Rays, rows: NDArray[np.int64], time_s: float) -> _Place:
    """Fuse several; a range that is still open to more than 30 % is none."""
    place_m, of_all = placed(rays, rows, time_s, SPEED_SIGMA_M_PER_S)
    covariance_m2 = of_all[:3, :3]
    # A fit with a prior of variance 1 answers an error a of what it assumed by −C a.
    moved_m = -of_all[:3, 3]
    origin_m = rays.origin_m[rows].mean(axis=0)
    range_m = float(np.linalg.norm(place_m - origin_m))
    bearing = (place_m - origin_m) / range_m
    turn = bearing_axes(bearing) / np.array([range_m, range_m, 1.0])[:, None]
    covariance = turn @ covariance_m2 @ turn.T
    if not math.sqrt(covariance[2, 2]) < _KNOWN_RANGE * range_m:
        covariance[2, :] = covariance[:, 2] = range_m = math.nan
    noise_m2 = covariance_m2 - np.outer(moved_m, moved_m)
    return _Place(origin_m, bearing, range_m, covariance, moved_m, noise_m2)


def _vector(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
