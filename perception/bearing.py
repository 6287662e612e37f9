"""From a pixel to a direction: through the lens, then from camera axes to body axes."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perception.lens import unproject
from perception.types import Calibration


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
    direction = direction_camera(points_px, calibration)
    return np.arctan2(np.hypot(direction[:, 0], direction[:, 1]), direction[:, 2])


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


def bearing_body_paper(points_px: ArrayLike, calibration: Calibration) -> NDArray[np.float64]:
    """Bearings by the paper's eq. cam_to_car to the letter: a biased estimate, kept to be measured.

    The equation puts [p_cam; 1] through the full pose T_c^b and normalises the first three components.
    p_cam is a *unit* vector, so the camera's offset on the robot is added as if every source were one
    metre away: the bearing leans towards the offset, by up to atan(offset / 1 m), whatever the range.
    (The sound estimate is `bearing_body`.)

    Parameters
    ----------
    points_px
        Image points (u, v), shape (n, 2).
    calibration
        Intrinsics, and the camera's pose on the robot.

    Returns
    -------
    Unit vectors, shape (n, 3).
    """
    return _normalised(bearing_body(points_px, calibration) + calibration.position_body_m)


def _normalised(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
