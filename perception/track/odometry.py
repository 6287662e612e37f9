"""Where the observer was at any time, from the records of its odometry around it."""

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from perception.types import Odometry

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Pose:
    """An observer's pose in its odometry frame.

    `position_m`, shape (3,), and `rotation`, shape (3, 3), as in `Odometry`; per axis, `position_sigma_m` and
    `rotation_sigma_rad` are its errors by itself, the walks by how much later poses depart from it.
    """

    position_m: Array
    rotation: Array
    position_sigma_m: float = 0.0
    rotation_sigma_rad: float = 0.0
    position_walk_m_per_sqrt_s: float = 0.0
    rotation_walk_rad_per_sqrt_s: float = 0.0


AT_REST = Pose(np.zeros(3), np.eye(3))


def pose_at(odometry: Sequence[Odometry], time_s: float) -> Pose:
    """Interpolate between the two records around a time; beyond them, go on as they moved.

    Positions linearly, rotations along the great arc. The errors of both records weigh in as they do in the
    pose, and grow where it is extrapolated.

    Parameters
    ----------
    odometry
        Records of one robot by time; empty: it stands still at the origin.
    time_s
        When.

    Raises
    ------
    ValueError
        If the records are not in the order of time.
    """
    if not odometry:
        return AT_REST
    times_s = [record.time_s for record in odometry]
    if any(later < earlier for earlier, later in zip(times_s, times_s[1:], strict=False)):
        raise ValueError("odometry: records are not in the order of time; sort them by time_s")
    place = bisect.bisect_right(times_s, time_s)
    place = min(max(place, 1), len(odometry) - 1)
    before, after = odometry[place - 1 if len(odometry) > 1 else 0], odometry[place]
    between_s = after.time_s - before.time_s
    share = (time_s - before.time_s) / between_s if between_s > 0.0 else 1.0
    turn = Rotation.from_matrix(before.rotation.T @ after.rotation).as_rotvec()
    weights = (1.0 - share, share) if between_s > 0.0 else (0.0, 1.0)
    return Pose(
        position_m=before.position_m + share * (after.position_m - before.position_m),
        rotation=before.rotation @ Rotation.from_rotvec(share * turn).as_matrix(),
        position_sigma_m=math.hypot(
            weights[0] * before.position_sigma_m, weights[1] * after.position_sigma_m
        ),
        rotation_sigma_rad=math.hypot(
            weights[0] * before.rotation_sigma_rad, weights[1] * after.rotation_sigma_rad
        ),
        position_walk_m_per_sqrt_s=after.position_walk_m_per_sqrt_s,
        rotation_walk_rad_per_sqrt_s=after.rotation_walk_rad_per_sqrt_s,
    )
