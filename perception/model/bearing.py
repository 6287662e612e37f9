"""From a pixel to a direction: through the lens, then from camera axes to body axes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perception.model.lens import unproject, unproject_each
from perception.types import Calibration

_HALF_PIXELS = np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]])


def direction_camera(points_px: ArrayLike, calibration: Calibration) -> NDArray[np.float64]:
    """Back-project pixels to unit directions in camera axes (x right, y down, z forward).

    The paper's eq. pixel_to_image, with its R_i2c the identity: image and camera axes agree here.

    Parameters
    ----------
    points_px
        Image points (u, v), shape (n, 2).
    calibration
        The camera's intrinsics.

    Returns
    -------
    Unit vectors, shape (n, 3); NaN beyond a fisheye's image circle.

    Raises
    ------
    ValueError
        If `points_px` is not of shape (n, 2).
    """
    points = np.asarray(points_px, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 2:
        raise ValueError(f"points_px must have shape (n, 2), not {points.shape}")
    return unproject(points, calibration)


def field_angle_rad(points_px: ArrayLike, calibration: Calibration) -> NDArray[np.float64]:
    """Angle between the optical axis and the direction of each pixel, shape (n,)."""
    return angle_from_axis_rad(direction_camera(points_px, calibration))


def angle_from_axis_rad(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angle between the optical axis and directions in camera axes, shape (..., 3) → (...)."""
    return np.arctan2(np.hypot(direction[..., 0], direction[..., 1]), direction[..., 2])


def pixel_turn(points_px: ArrayLike, calibration: Calibration) -> NDArray[np.float64]:
    """By how much the direction turns over a pixel along u, and along v: shape (n, 2, 3), in camera axes.

    Between half a pixel before and half a pixel beyond, of places of shape (n, 2). Lengths are angles in rad.
    """
    around_px = np.asarray(points_px, dtype=np.float64)[:, None, :] + _HALF_PIXELS
    return _turn(direction_camera(around_px.reshape(-1, 2), calibration))


def turn_slopes_px(points_px: ArrayLike, calibration: Calibration) -> NDArray[np.float64]:
    """How far places on the image move per radian that the camera turns about each of its axes.

    Shape (n, 2) → (n, 2, 3): along u and v, about x, y and z. 0 where a place has no direction.
    """
    points = np.asarray(points_px, dtype=np.float64)
    over_pixel = pixel_turn(points, calibration)
    # What rests turns the other way: e × d, by each axis e less.
    turned = -np.cross(np.eye(3), direction_camera(points, calibration)[:, None, :])
    square = over_pixel @ over_pixel.swapaxes(1, 2)
    known = np.isfinite(square).all(axis=(1, 2))
    slopes = np.zeros((len(points), 2, 3))
    slopes[known] = np.linalg.solve(square[known], over_pixel[known] @ turned[known].swapaxes(1, 2))
    return slopes


def pixel_turns(
    points_px: NDArray[np.float64], calibrations: Sequence[Calibration], camera: NDArray[np.int64]
) -> NDArray[np.float64]:
    """As `pixel_turn`, each in the axes of its camera, by its number in `calibrations`, shape (n,)."""
    around_px = (points_px[:, None, :] + _HALF_PIXELS).reshape(-1, 2)
    return _turn(unproject_each(around_px, calibrations, np.repeat(camera, 4)))


def _turn(around: NDArray[np.float64]) -> NDArray[np.float64]:
    """Subtract the directions about each place, of half a pixel before from those of half a pixel beyond."""
    before_and_beyond = around.reshape(-1, 4, 3)
    return np.asarray(before_and_beyond[:, 1::2] - before_and_beyond[:, 0::2])


def bearing_body(points_px: ArrayLike, calibration: Calibration) -> NDArray[np.float64]:
    """Directions of pixels from the camera's centre, in body axes (x forward, y left, z up).

    A direction is rotated and nothing else: where the camera sits on the robot does not turn it.

    Parameters
    ----------
    points_px
        Image points (u, v), shape (n, 2).
    calibration
        Intrinsics, and the rotation from camera to body axes.

    Returns
    -------
    Unit vectors, shape (n, 3).
    """
    return direction_camera(points_px, calibration) @ calibration.rotation_body_camera.T
