"""One robot in several cameras, or in several exposures of one, becomes one measurement."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.rig.frame_sets import robot_of
from perception.rig.rays import chi2_of_pairs, placed
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
            chi2, scaled = chi2_of_pairs(sightings.rays, best, new, SPEED_SIGMA_M_PER_S)
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


def fused(sightings: Sightings, groups: Sequence[Group]) -> list[Measurement]:
    """Return the measurement of each source from its sightings.

    Maximum likelihood of its place: bearings by their own covariance, logarithms of ranges by their noise and
    one error that all of them share. A sighting at another time than the mean counts less by how far the
    source may have moved. Where ranges do not agree with where the rays meet, the most precise sighting alone
    says where it seems to be.
    """
    return [_fused(sightings, group) for group in groups]


def _fused(sightings: Sightings, group: Group) -> Measurement:
    rays, members = sightings.rays, group.members
    if len(members) == 1 or not group.ranges_agree:
        best = group.best(rays.noise)
        time_s = float(rays.time_s[best])
        origin_m, bearing, range_m, covariance, common = _alone(sightings, best)
    else:
        rows = np.array(sorted(members, key=rays.noise.__getitem__))
        weight = 1.0 / np.trace(rays.angular_rad2[rows], axis1=1, axis2=2)
        time_s = float(weight @ rays.time_s[rows] / weight.sum())
        origin_m, bearing, range_m, covariance, common = _together(sightings, rows, time_s)
    flagged = all(sightings.ghost[k] for k in members)
    claimed = all(sightings.claimed[k] for k in members)
    return Measurement(
        robot=robot_of(sightings.keys[members[0]][0]),
        time_s=time_s,
        cameras=tuple(dict.fromkeys(sightings.keys[k][0] for k in members)),
        detections=tuple(sightings.keys[k] for k in members),
        origin_body_m=_vector(origin_m),
        bearing_body=_vector(bearing),
        range_m=range_m,
        covariance=covariance if claimed else np.full((3, 3), math.nan),
        range_sigma_common_m=common * range_m if claimed else math.nan,
        saturated=any(sightings.saturated[k] for k in members),
        merged=any(sightings.merged[k] for k in members),
        ghost="yes" if flagged else "no",
        ghost_probability=float(flagged),
    )


def _alone(sightings: Sightings, index: int) -> tuple[Array, Array, float, Array, float]:
    rays = sightings.rays
    range_m, common = float(rays.range_m[index]), float(rays.common[index])
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = rays.angular_rad2[index]
    covariance[2, 2] = range_m**2 * (rays.noise[index] ** 2 + common**2)
    if math.isnan(range_m):
        covariance[2, :] = covariance[:, 2] = math.nan
    return rays.origin_m[index], rays.axes[index, 2], range_m, covariance, common


def _together(
    sightings: Sightings, rows: NDArray[np.int64], time_s: float
) -> tuple[Array, Array, float, Array, float]:
    """Fuse several; a range that is still open to more than 30 % is none."""
    rays = sightings.rays
    place_m, covariance_m2 = placed(rays, rows, time_s, SPEED_SIGMA_M_PER_S)
    origin_m = rays.origin_m[rows].mean(axis=0)
    range_m = float(np.linalg.norm(place_m - origin_m))
    bearing = (place_m - origin_m) / range_m
    turn = bearing_axes(bearing) / np.array([range_m, range_m, 1.0])[:, None]
    covariance = turn @ covariance_m2 @ turn.T
    if not math.sqrt(covariance[2, 2]) < _KNOWN_RANGE * range_m:
        covariance[2, :] = covariance[:, 2] = range_m = math.nan
        return origin_m, bearing, range_m, covariance, 0.0
    weight = 1.0 / rays.noise[rows] ** 2
    return origin_m, bearing, range_m, covariance, float(weight @ rays.common[rows] / weight.sum())


def _vector(values: Array) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
