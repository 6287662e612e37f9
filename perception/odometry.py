"""Where the observer was at any time, from the records of its odometry around it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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


class Poses(NamedTuple):
    """Poses at n times: `position_m` (n, 3), `rotation` (n, 3, 3), and their σ per axis, (n,) each."""

    position_m: Array
    rotation: Array
    position_sigma_m: Array
    rotation_sigma_rad: Array


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
    poses = poses_at(odometry, np.array([time_s]))
    newest = odometry[-1]
    return Pose(
        position_m=poses.position_m[0],
        rotation=poses.rotation[0],
        position_sigma_m=float(poses.position_sigma_m[0]),
        rotation_sigma_rad=float(poses.rotation_sigma_rad[0]),
        position_walk_m_per_sqrt_s=newest.position_walk_m_per_sqrt_s,
        rotation_walk_rad_per_sqrt_s=newest.rotation_walk_rad_per_sqrt_s,
    )


def poses_at(odometry: Sequence[Odometry], times_s: Array) -> Poses:
    """Do the same for many times, shape (n,)."""
    from scipy.spatial.transform import Rotation  # loads slowly

    n = len(times_s)
    if not odometry:
        return Poses(np.zeros((n, 3)), np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros(n), np.zeros(n))
    known_s = np.array([record.time_s for record in odometry])
    if np.any(np.diff(known_s) < 0.0):
        raise ValueError("odometry: records are not in the order of time; sort them by time_s")
    after = np.clip(
        np.searchsorted(known_s, times_s, side="right"), min(1, len(known_s) - 1), len(known_s) - 1
    )
    before = np.maximum(after - 1, 0)
    between_s = known_s[after] - known_s[before]
    apart = between_s > 0.0
    share = np.where(apart, (times_s - known_s[before]) / np.where(apart, between_s, 1.0), 1.0)
    place_m = np.array([record.position_m for record in odometry])
    rotation = np.array([record.rotation for record in odometry])
    sigma = np.array([(record.position_sigma_m, record.rotation_sigma_rad) for record in odometry])
    first = rotation[before]
    turn = Rotation.from_matrix(first.transpose(0, 2, 1) @ rotation[after]).as_rotvec()
    sigma = np.hypot((1.0 - share)[:, None] * sigma[before], share[:, None] * sigma[after])
    return Poses(
        place_m[before] + share[:, None] * (place_m[after] - place_m[before]),
        first @ Rotation.from_rotvec(share[:, None] * turn).as_matrix(),
        sigma[:, 0],
        sigma[:, 1],
    )
