"""One robot in several cameras, or in several exposures of one, becomes one measurement."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.rig.frame_sets import robot_of
from perception.rig.joined import Joined
from perception.rig.rays import chi2_of_pairs, joined
from perception.rig.sightings import Sightings
from perception.types import Ghost, Measurement

Array = NDArray[np.float64]

GATE_CHI2 = 28.0
"""Sightings of one source lie within this χ² of three degrees of freedom, but for 4 in a million."""

SPEED_SIGMA_M_PER_S = 0.1
"""Robots are taken to move so fast between the exposures of a set (the paper's limit of speed)."""

SCALE_COST = 10.0
"""What it costs two sightings that their ranges agree with where the rays meet but for one factor."""


@dataclass(frozen=True)
class Group:
    """Sightings of one source: indices, and whether their ranges agree with where their rays meet.

    Ranges by flux do not where a mirror has taken light, or fog.
    """

    members: tuple[int, ...]
    ranges_agree: bool = True

    def best(self, noise: Sequence[float]) -> int:
        """Return the member whose range is the most precise: the group stands where it says."""
        return min(self.members, key=noise.__getitem__)


def associated(sightings: Sightings) -> list[Group]:
    """Tell which sightings are of one source: at most one of each frame, nearest first, within a gate."""
    from scipy.optimize import linear_sum_assignment

    groups: list[Group] = []
    frame, noise = sightings.frame, sightings.rays.noise.tolist()
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


def fused(sightings: Sightings, groups: Sequence[Group]) -> Joined:
    """Return each source from its sightings.

    Maximum likelihood of its place: bearings by their own covariance, logarithms of ranges by their noise and
    one error that all of them share. A sighting at another time than the mean counts less by how far the
    source may have moved. Of several exposures of one camera the most precise counts, and what claims no σ
    only where nothing does. Where ranges do not agree with where the rays meet, the most precise sighting
    alone says where it seems to be.
    """
    names = {name: number for number, name in enumerate(dict.fromkeys(key[0] for key in sightings.keys))}
    return joined(
        sightings.rays,
        sightings.together,
        np.array([names[key[0]] for key in sightings.keys], dtype=np.int64),
        sightings.claimed,
        sightings.saturated,
        sightings.merged,
        sightings.ghost,
        np.array([k for group in groups for k in group.members], dtype=np.int64),
        np.cumsum([len(group.members) for group in groups], dtype=np.int64),
        np.array([group.ranges_agree for group in groups], dtype=np.bool_),
        SPEED_SIGMA_M_PER_S,
    )


def measurements_of(
    found: Joined,
    groups: Sequence[Group],
    sightings: Sightings,
    ghosts: Sequence[Ghost],
    ghost_probability: Array,
) -> tuple[Measurement, ...]:
    """Return sources as measurements, by whether each is a mirror image, and how probably."""
    measurements = []
    for group, *said in zip(
        groups, found.time_s.tolist(), found.origin_m.tolist(), found.bearing.tolist(),
        found.range_m.tolist(), found.covariance, found.common_m.tolist(), found.saturated.tolist(),
        found.merged.tolist(), ghosts, ghost_probability.tolist(), strict=True,
    ):  # fmt: skip
        keys = tuple(sightings.keys[k] for k in group.members)
        time_s, origin_m, bearing, range_m, covariance, common_m, saturated, merged, ghost, probability = said
        measurements.append(
            Measurement(
                robot=robot_of(keys[0][0]),
                time_s=time_s,
                cameras=tuple(dict.fromkeys(camera for camera, _, _ in keys)),
                detections=keys,
                origin_body_m=tuple(origin_m),
                bearing_body=tuple(bearing),
                range_m=range_m,
                covariance=covariance,
                range_sigma_common_m=common_m,
                saturated=saturated,
                merged=merged,
                ghost=ghost,
                ghost_probability=probability,
            )
        )
    return tuple(measurements)
