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


@dataclass(frozen=True, eq=False)
class Followed:
    """A track at one time, and whom it follows: true place and velocity over ground, in body axes.

    `velocity_body_m_per_s`, shape (3,), is NaN where it is not known.
    """

    track: Track
    position_body_m: Values
    velocity_body_m_per_s: Values


class TrueWays:
    """Where robots truly are at any time, and how fast they go, between the lines of `poses.jsonl`."""

    def __init__(self, poses: Iterable[PoseTruth]) -> None:
        of_robot: dict[str, list[PoseTruth]] = defaultdict(list)
        for pose in poses:
            of_robot[pose.robot].append(pose)
        self._of_robot = {robot: sorted(own, key=lambda pose: pose.time_s) for robot, own in of_robot.items()}
        self._times_s = {
            robot: np.array([pose.time_s for pose in own]) for robot, own in self._of_robot.items()
        }

    def source_velocity_body_m_per_s(
        self, observer: str, robot: str, position_body_m: Values, time_s: float
    ) -> Values:
        """Return how a robot's source moves over ground, in the observer's body axes, shape (3,).

        It goes as its robot does and turns with it: v + ω × r. NaN where one of the two is not known then.
        """
        there, seen_from = self._at(robot, time_s), self._at(observer, time_s)
        if there is None or seen_from is None:
            return np.full(3, np.nan)
        arm_m = seen_from.rotation @ position_body_m + seen_from.position_m - there.position_m
        turning = np.cross(there.angular_velocity_rad_per_s, arm_m)
        return np.asarray(seen_from.rotation.T @ (there.velocity_m_per_s + turning))

    def _at(self, robot: str, time_s: float) -> "_Way | None":
        from scipy.spatial.transform import Rotation, Slerp

        own = self._of_robot.get(robot, [])
        if not own or not own[0].time_s <= time_s <= own[-1].time_s:
            return None
        times_s = self._times_s[robot]
        k = min(int(np.searchsorted(times_s, time_s, side="right")), len(own) - 1)
        pair = own[max(k - 1, 0)], own[k]
        between_s = pair[1].time_s - pair[0].time_s
        part = (time_s - pair[0].time_s) / between_s if between_s > 0.0 else 0.0
        turned = Rotation.from_quat([pose.quaternion_xyzw for pose in pair])
        rotation = Slerp([0.0, 1.0], turned)(part).as_matrix()
        position_m, velocity, angular = (
            (1.0 - part) * np.array(getattr(pair[0], name)) + part * np.array(getattr(pair[1], name))
            for name in ("position_m", "velocity_m_per_s", "angular_velocity_rad_per_s")
        )
        return _Way(position_m, rotation, velocity, angular)


@dataclass(frozen=True, eq=False)
class _Way:
    position_m: Values
    rotation: Values
    velocity_m_per_s: Values
    angular_velocity_rad_per_s: Values


def error_numbers(followed: Sequence[Followed]) -> dict[str, float | None]:
    """Return the errors of tracks, over all instants; None where there are none.

    A NEES is the mean of eᵀ P⁻¹ e over its dimensions, of the covariances that can be inverted: 1 where
    they are true (Bar-Shalom, Li and Kirubarajan, Estimation with Applications, 5.4.2).
    """
    said_m = np.array([one.track.position_body_m for one in followed]).reshape(-1, 3)
    there_m = np.array([one.position_body_m for one in followed]).reshape(-1, 3)
    said_m_per_s = np.array([one.track.velocity_body_m_per_s for one in followed]).reshape(-1, 3)
    there_m_per_s = np.array([one.velocity_body_m_per_s for one in followed]).reshape(-1, 3)
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


_SINGULAR = 1e-12


def _rms(values: Values) -> float | None:
    finite = values[np.isfinite(values)]
    return math.sqrt(float(np.mean(finite**2))) if finite.size else None
