"""By how much tracks are off those whom they follow: place, range, bearing, velocity, and their claims."""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.truth.poses import PoseTruth
from perception.types import Track

Values = NDArray[np.float64]

_SINGULAR = 1e-12


@dataclass(frozen=True, eq=False)
class Followed:
    """A track at one time, of which robot it follows a source, and where that truly is in body axes, (3,)."""

    track: Track
    robot: str
    position_body_m: Values


class TrueWays:
    """Where robots truly are at any time, and how fast they go, between the lines of `poses.jsonl`."""

    def __init__(self, poses: Iterable[PoseTruth]) -> None:
        of_robot: dict[str, list[PoseTruth]] = defaultdict(list)
        for pose in poses:
            of_robot[pose.robot].append(pose)
        self._of_robot = {robot: sorted(own, key=lambda pose: pose.time_s) for robot, own in of_robot.items()}

    def velocities_body_m_per_s(self, followed: Sequence[Followed]) -> Values:
        """Return how sources move over ground, in body axes of who follows them, shape (n, 3).

        A source goes as its robot does and turns with it: v + ω × r. NaN where one of the two is not known.
        """
        time_s = np.array([one.track.time_s for one in followed])
        there = self._ways([one.robot for one in followed], time_s)
        seen_from = self._ways([one.track.robot for one in followed], time_s)
        place_m = np.array([one.position_body_m for one in followed]).reshape(-1, 3)
        arm_m = np.einsum("nij,nj->ni", seen_from.rotation, place_m) + seen_from.position_m - there.position_m
        velocity = there.velocity_m_per_s + np.cross(there.angular_velocity_rad_per_s, arm_m)
        return np.asarray(np.einsum("nji,nj->ni", seen_from.rotation, velocity))

    def carried_m(
        self, place_m: Values, robots: Sequence[str], observers: Sequence[str], from_s: Values, to_s: Values
    ) -> Values:
        """Return places of robots' sources, in body axes of who sees them, as they are at another time.

        Shape (n, 3); all else has n elements. A place stays as it is where a robot's way is not known.
        """
        there, then = self._ways(robots, from_s), self._ways(robots, to_s)
        seen_from, seen_then = self._ways(observers, from_s), self._ways(observers, to_s)
        world_m = np.einsum("nij,nj->ni", seen_from.rotation, place_m) + seen_from.position_m
        arm_m = np.einsum("nji,nj->ni", there.rotation, world_m - there.position_m)
        world_m = np.einsum("nij,nj->ni", then.rotation, arm_m) + then.position_m
        carried_m = np.einsum("nji,nj->ni", seen_then.rotation, world_m - seen_then.position_m)
        return np.where(np.isfinite(carried_m).all(axis=1, keepdims=True), carried_m, place_m)

    def relative(self, observer: str, robot: str, time_s: float) -> tuple[Values, float] | None:
        """Return a robot's origin (m) and heading (rad) in the observer's body axes; None where not known."""
        seen_from, there = (self._ways([name], np.array([time_s])) for name in (observer, robot))
        place_m = seen_from.rotation[0].T @ (there.position_m[0] - seen_from.position_m[0])
        turn = seen_from.rotation[0].T @ there.rotation[0]
        if not np.isfinite(turn).all():
            return None
        return place_m, math.atan2(turn[1, 0], turn[0, 0])

    def _ways(self, robots: Sequence[str], time_s: Values) -> "_Ways":
        """Return poses and velocities of robots at times, one each; NaN where none is known."""
        n = len(robots)
        ways = _Ways(*(np.full((n, *shape), np.nan) for shape in ((3,), (3, 3), (3,), (3,))))
        names = np.array(robots)
        for robot in dict.fromkeys(robots):
            own = self._of_robot.get(robot, [])
            known_s = np.array([pose.time_s for pose in own])
            where = np.flatnonzero(names == robot)
            if own:
                within = (time_s[where] >= known_s[0]) & (time_s[where] <= known_s[-1])
                where = where[within]
            if own and where.size:
                _fill(ways, where, own, known_s, time_s[where])
        return ways


@dataclass(frozen=True, eq=False)
class _Ways:
    """Poses and velocities in the world, n of them."""

    position_m: Values
    rotation: Values
    velocity_m_per_s: Values
    angular_velocity_rad_per_s: Values


def _fill(
    ways: _Ways, where: NDArray[np.int64], own: Sequence[PoseTruth], known_s: Values, time_s: Values
) -> None:
    """Interpolate what is known of one robot into the rows that are its own."""
    from scipy.spatial.transform import Rotation, Slerp

    for name in ("position_m", "velocity_m_per_s", "angular_velocity_rad_per_s"):
        columns = np.array([getattr(pose, name) for pose in own]).T
        getattr(ways, name)[where] = np.stack(
            [np.interp(time_s, known_s, column) for column in columns], axis=1
        )
    turned = Rotation.from_quat([pose.quaternion_xyzw for pose in own])
    single = len(own) == 1
    ways.rotation[where] = turned.as_matrix() if single else Slerp(known_s, turned)(time_s).as_matrix()


def error_numbers(followed: Sequence[Followed], ways: TrueWays) -> dict[str, float | None]:
    """Return the errors of tracks, over all instants; None where there are none.

    A NEES is the mean of eᵀ P⁻¹ e over its dimensions, of the covariances that can be inverted: 1 where
    they are true (Bar-Shalom, Li and Kirubarajan, Estimation with Applications, 5.4.2).
    """
    said_m = np.array([one.track.position_body_m for one in followed]).reshape(-1, 3)
    there_m = np.array([one.position_body_m for one in followed]).reshape(-1, 3)
    said_m_per_s = np.array([one.track.velocity_body_m_per_s for one in followed]).reshape(-1, 3)
    there_m_per_s = ways.velocities_body_m_per_s(followed)
    covariance = np.array([one.track.covariance for one in followed]).reshape(-1, 6, 6)
    off = np.concatenate([said_m - there_m, said_m_per_s - there_m_per_s], axis=1)
    range_m = np.linalg.norm(said_m, axis=1) - np.linalg.norm(there_m, axis=1)
    across = np.linalg.norm(np.cross(said_m, there_m), axis=1)
    bearing_deg = np.degrees(np.arctan2(across, (said_m * there_m).sum(axis=1)))
    place, velocity = slice(0, 3), slice(3, 6)
    return {
        "track_position_rmse_m": _rms(np.linalg.norm(off[:, place], axis=1)),
        "track_range_rmse_m": _rms(range_m),
        "track_range_bias_m": float(range_m.mean()) if range_m.size else None,
        "track_bearing_rms_deg": _rms(bearing_deg),
        "track_velocity_rmse_m_per_s": _rms(np.linalg.norm(off[:, velocity], axis=1)),
        "track_nees": _nees(off[:, place], covariance[:, place, place]),
        "track_velocity_nees": _nees(off[:, velocity], covariance[:, velocity, velocity]),
        "track_state_nees": _nees(off, covariance),
    }


def _nees(off: Values, covariance: Values) -> float | None:
    known = np.isfinite(off).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    off, covariance = off[known], covariance[known]
    # Metres and metres per second differ in scale: what can be inverted shows in units of each one's own σ.
    sigma = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
    sound = (sigma > 0.0).all(axis=1)
    off, covariance, sigma = off[sound], covariance[sound], sigma[sound]
    if not len(off):
        return None
    values, vectors = np.linalg.eigh(covariance / (sigma[:, :, None] * sigma[:, None, :]))
    sound = values[:, 0] > _SINGULAR
    pulls = np.einsum("nji,nj->ni", vectors, off / sigma)[sound]
    found = (pulls**2 / values[sound]).sum(axis=1) / off.shape[1]
    return float(found.mean()) if found.size else None


def _rms(values: Values) -> float | None:
    finite = values[np.isfinite(values)]
    return math.sqrt(float(np.mean(finite**2))) if finite.size else None
