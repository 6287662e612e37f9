"""Poses: where something stands in what carries it, and which way it is turned.

A pose takes local coordinates to outer ones: x_outer = rotation @ x_local + position.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Self

import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.scene.documents.base import Orientation
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.emitters import Source

# Columns: the camera's x (right), y (down) and z (forward) in a mount that looks along x, y left, z up.
_MOUNT_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Pose:
    """A rotation, shape (3, 3), and a position in metres, shape (3,)."""

    rotation: NDArray[np.float64]
    position_m: NDArray[np.float64]

    @classmethod
    def of(
        cls,
        position_m: tuple[float, float, float],
        yaw_rad: float = 0.0,
        pitch_rad: float = 0.0,
        roll_rad: float = 0.0,
    ) -> Self:
        """Return the pose at a position, turned by yaw about z, then pitch about y, then roll about x.

        >>> Pose.of((1.0, 2.0, 0.3), yaw_rad=0.5).position_m
        array([1. , 2. , 0.3])
        """
        position = np.array(position_m, dtype=np.float64)
        if position.shape != (3,):
            raise InputError(f"position_m is {position_m!r}; wanted three numbers, in metres")
        return cls(_rotation(yaw_rad, pitch_rad, roll_rad), position)

    def __matmul__(self, inner: "Pose") -> "Pose":
        """Return the pose of what stands at `inner` within this one."""
        return Pose(self.rotation @ inner.rotation, self.rotation @ inner.position_m + self.position_m)

    def to_local(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return outer points, shape (..., 3), in this pose's coordinates."""
        return (points_m - self.position_m) @ self.rotation


def rotation_of(orientation: Orientation) -> NDArray[np.float64]:
    """Return the rotation matrix of yaw, pitch and roll, shape (3, 3)."""
    return _rotation(orientation.yaw_rad, orientation.pitch_rad, orientation.roll_rad)


def source_mount(source: Source) -> Pose:
    """Return the pose of a source's own axes on its robot."""
    return Pose(rotation_of(source.orientation), np.array(source.position_m))


def camera_mount(camera: Camera) -> Pose:
    """Return the pose of a camera's axes (x right, y down, z forward) on its robot."""
    return Pose(rotation_of(camera.orientation) @ _MOUNT_FROM_CAMERA, np.array(camera.position_m))


@lru_cache(maxsize=4096)  # of mounts: the same for every robot and scene of a campaign
def _rotation(yaw_rad: float, pitch_rad: float, roll_rad: float) -> NDArray[np.float64]:
    from scipy.spatial.transform import Rotation  # takes a while to load; a check may need none

    matrix = np.asarray(Rotation.from_euler("ZYX", [yaw_rad, pitch_rad, roll_rad]).as_matrix())
    matrix.flags.writeable = False
    return matrix
