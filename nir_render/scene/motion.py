"""Poses: where robots, and what they carry, are at a time.

A pose takes local coordinates to outer ones: x_outer = rotation @ x_local + position.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from nir_render.scene.devices import Camera
from nir_render.scene.document import Robot
from nir_render.scene.fields import Orientation

# Columns: the camera's x (right), y (down) and z (forward) in a mount that looks along x, y left, z up.
_MOUNT_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Pose:
    """A rotation, shape (3, 3), and a position in metres, shape (3,)."""

    rotation: NDArray[np.float64]
    position_m: NDArray[np.float64]

    def __matmul__(self, inner: Self) -> "Pose":
        """Return the pose of what stands at `inner` within this one."""
        return Pose(self.rotation @ inner.rotation, self.rotation @ inner.position_m + self.position_m)

    def to_local(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return outer points, shape (..., 3), in this pose's coordinates."""
        return (points_m - self.position_m) @ self.rotation


def rotation_of(orientation: Orientation) -> NDArray[np.float64]:
    """Return the rotation matrix of yaw, pitch and roll, shape (3, 3)."""
    angles_rad = [orientation.yaw_rad, orientation.pitch_rad, orientation.roll_rad]
    return np.asarray(Rotation.from_euler("ZYX", angles_rad).as_matrix())


def robot_pose(robot: Robot, time_s: float) -> Pose:
    """Return the robot's pose in the world; before its first and after its last waypoint it stands still."""
    if not robot.motion:
        return Pose(rotation_of(robot.orientation), np.array(robot.position_m))
    # A waypoint is two knots, its arrival and the end of its hold; np.interp and Slerp want them to increase.
    stops = [(way.time_s, way) for way in robot.motion]
    stops += [(way.time_s + way.hold_s, way) for way in robot.motion if way.hold_s > 0.0]
    stops.sort(key=lambda stop: stop[0])
    times_s = np.array([time for time, _ in stops])
    now_s = float(np.clip(time_s, times_s[0], times_s[-1]))
    positions_m = np.array([way.position_m for _, way in stops])
    position_m = np.array([np.interp(now_s, times_s, positions_m[:, axis]) for axis in range(3)])
    rotations = [rotation_of(way.orientation) for _, way in stops]
    if len(rotations) == 1:
        return Pose(rotations[0], position_m)
    return Pose(Slerp(times_s, Rotation.from_matrix(np.array(rotations)))(now_s).as_matrix(), position_m)


def camera_pose_on_robot(camera: Camera) -> Pose:
    """Return the pose of the camera's axes (x right, y down, z forward) on its robot."""
    return Pose(rotation_of(camera.orientation) @ _MOUNT_FROM_CAMERA, np.array(camera.position_m))


def camera_pose(robot: Robot, camera: Camera, time_s: float) -> Pose:
    """Return the pose of the camera's axes in the world at a time."""
    return robot_pose(robot, time_s) @ camera_pose_on_robot(camera)
