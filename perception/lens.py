"""The lens models of a calibration, OpenCV's: from directions to pixels and back.

In units of the focal length about the principal point, with a = x/z, b = y/z, r² = a² + b² of a direction:
brown_conrady moves (a, b) by radial and tangential polynomials, fisheye images it at θ_d = θ (1 + k1 θ² +
k2 θ⁴ + k3 θ⁶ + k4 θ⁸) from the middle. Coefficients are in OpenCV's order.
"""

import math
from functools import lru_cache

import cv2
import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray

from perception.types import Calibration

COEFFICIENTS = {"rectilinear": (0,), "brown_conrady": (4, 5, 8), "fisheye": (4,)}
"""Lens models, and how many numbers of distortion each may have."""

_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 500, 1e-10)
_STEPS = 30
_MISSED_PX = 0.01
_LARGEST_TANGENT = 100.0
_SMALL_RAD = 1e-4


def project(direction: NDArray[np.float64], calibration: Calibration) -> NDArray[np.float64]:
    """Return where directions in camera axes, shape (n, 3), fall on the image, (u, v), shape (n, 2).

    They must lead forward, z > 0, and need not be of unit length.
    """
    a, b = direction[:, 0] / direction[:, 2], direction[:, 1] / direction[:, 2]
    if calibration.lens_model == "brown_conrady":
        (a, b), _ = _bent(a, b, calibration.distortion)
    elif calibration.lens_model == "fisheye":
        tangent = np.hypot(a, b)
        angle = np.arctan(tangent)
        scale = angle * polyval(angle**2, [1.0, *calibration.distortion])
        scale = np.where(tangent > 0.0, scale / np.where(tangent > 0.0, tangent, 1.0), 1.0)
        a, b = a * scale, b * scale
    return np.stack(
        [calibration.cx_px + calibration.fx_px * a, calibration.cy_px + calibration.fy_px * b], axis=1
    )


def unproject(points_px: NDArray[np.float64], calibration: Calibration) -> NDArray[np.float64]:
    """Return the unit directions in camera axes, shape (n, 3), of image points (u, v), shape (n, 2).

    NaN beyond a fisheye's image circle, where the field angle would reach 90°, and where a brown_conrady lens
    images nothing that could be found: beyond its fold.
    """
    x = (points_px[:, 0] - calibration.cx_px) / calibration.fx_px
    y = (points_px[:, 1] - calibration.cy_px) / calibration.fy_px
    if calibration.lens_model == "fisheye":
        return _fisheye_direction(x, y, calibration.distortion)
    if calibration.lens_model == "brown_conrady" and len(x):
        x, y = _straightened(x, y, calibration)
    direction = np.stack([x, y, np.ones_like(x)], axis=1)
    return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True))


def stretch(direction: NDArray[np.float64], calibration: Calibration) -> float:
    """Return how many pixels the image moves, at most, per radian of a unit direction, shape (3,).

    NaN where there is no direction.
    """
    focal_px = max(calibration.fx_px, calibration.fy_px)
    cosine = float(direction[2])
    if calibration.lens_model == "rectilinear":
        return focal_px / cosine**2  # along the radius; across it by 1 / cos θ
    if math.isnan(cosine):
        return math.nan
    sine = float(np.hypot(direction[0], direction[1]))
    outward = direction[:2] / sine if sine > 0.0 else np.array([1.0, 0.0])
    radial = np.array([*(outward * cosine), -sine])
    around = np.array([-outward[1], outward[0], 0.0])
    steps = _SMALL_RAD * np.array([radial, -radial, around, -around])
    ahead = direction + steps
    ahead[:, 2] = np.maximum(ahead[:, 2], 1e-9)
    places = project(ahead, calibration)
    return float(np.linalg.norm(places[::2] - places[1::2], ord=2)) / (2.0 * _SMALL_RAD)


def _bent(
    a: NDArray[np.float64], b: NDArray[np.float64], coefficients: tuple[float, ...]
) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]], tuple[NDArray[np.float64], ...]]:
    """Return the point (x, y) of brown_conrady at (a, b), and ∂x/∂a, ∂x/∂b = ∂y/∂a, ∂y/∂b there."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, 0.0, 0.0, 0.0, 0.0)[:8]
    square = a**2 + b**2
    over, under = polyval(square, [1.0, k1, k2, k3]), polyval(square, [1.0, k4, k5, k6])
    radial = over / under
    slope = (
        polyval(square, [k1, 2.0 * k2, 3.0 * k3]) - radial * polyval(square, [k4, 2.0 * k5, 3.0 * k6])
    ) / under
    x = a * radial + 2.0 * p1 * a * b + p2 * (square + 2.0 * a**2)
    y = b * radial + p1 * (square + 2.0 * b**2) + 2.0 * p2 * a * b
    xx = radial + 2.0 * a**2 * slope + 2.0 * p1 * b + 6.0 * p2 * a
    xy = 2.0 * a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
    yy = radial + 2.0 * b**2 * slope + 6.0 * p1 * b + 2.0 * p2 * a
    return (x, y), (xx, xy, yy)


def _straightened(
    x: NDArray[np.float64], y: NDArray[np.float64], calibration: Calibration
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (a, b) of points of a brown_conrady lens, by Newton's method.

    It starts from OpenCV's fixed-point iteration, which creeps near a fold, and where that has left the
    field, from the radial terms alone. NaN where it comes no nearer than 0.01 px, or beyond the fold.
    """
    points, coefficients = np.stack([x, y], axis=1)[:, None], calibration.distortion
    straight = cv2.undistortPoints(points, np.eye(3), np.array(coefficients), criteria=_CRITERIA)[:, 0].T
    height = np.hypot(x, y)
    tangents, heights = _rising_images(coefficients)
    scale = np.interp(height, heights, tangents) / np.where(height > 0.0, height, 1.0)
    found_a, found_b = np.full_like(x, np.nan), np.full_like(y, np.nan)
    for a, b in ((straight[0], straight[1]), (x * scale, y * scale)):
        with np.errstate(all="ignore"):  # what runs away is not taken
            for _ in range(_STEPS):
                (u, v), (xx, xy, yy) = _bent(a, b, coefficients)
                area = xx * yy - xy**2
                step_a, step_b = (yy * (u - x) - xy * (v - y)) / area, (xx * (v - y) - xy * (u - x)) / area
                a, b = a - step_a, b - step_b
                if not (np.hypot(step_a, step_b) > 1e-13).any():
                    break
            (u, v), (xx, xy, yy) = _bent(a, b, coefficients)
            missed_px = np.hypot((u - x) * calibration.fx_px, (v - y) * calibration.fy_px)
            # Before the fold both eigenvalues of the Jacobian are above 0.
            good = (missed_px <= _MISSED_PX) & (xx * yy - xy**2 > 0.0) & (xx + yy > 0.0)
            good &= np.hypot(a, b) <= tangents[-1] * (1.0 + 1e-9)
        new = good & np.isnan(found_a)
        found_a, found_b = np.where(new, a, found_a), np.where(new, b, found_b)
    return found_a, found_b


def _fisheye_direction(
    x: NDArray[np.float64], y: NDArray[np.float64], coefficients: tuple[float, ...]
) -> NDArray[np.float64]:
    """Return unit directions of points in units of the focal length, by Newton's method.

    OpenCV's own inverse takes no image height above π/2, which a field angle below 90° may reach.
    """
    powers = [1.0, *coefficients]
    slopes = [(2 * n + 1) * value for n, value in enumerate(powers)]
    angles, heights = _rising_heights(coefficients)
    height = np.hypot(x, y)
    inside = height < heights[-1]
    angle = np.interp(height, heights, angles)
    for _ in range(_STEPS):
        slope = np.maximum(polyval(angle**2, slopes), 1e-6)
        step = (angle * polyval(angle**2, powers) - height) / slope
        angle = np.clip(angle - step, 0.0, angles[-1])
        if np.abs(step).max(initial=0.0, where=inside) < 1e-12:
            break
    angle = np.where(inside, angle, np.nan)
    scale = np.where(height > 0.0, np.sin(angle) / np.where(height > 0.0, height, 1.0), 1.0)
    return np.stack([x * scale, y * scale, np.cos(angle)], axis=1)


@lru_cache(maxsize=16)
def _rising_heights(coefficients: tuple[float, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return field angles from the axis to 90°, or to where the image turns back, and image heights there."""
    angles = np.linspace(0.0, 0.5 * np.pi, 1025)
    heights = angles * polyval(angles**2, [1.0, *coefficients])
    last = int(np.argmin(np.append(np.diff(heights) > 0.0, False)))
    return angles[: last + 1], heights[: last + 1]


@lru_cache(maxsize=16)
def _rising_images(coefficients: tuple[float, ...]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return tan θ up to where a brown_conrady image turns back, or has a pole, and image heights there.

    Those of the radial terms alone.
    """
    tangents = np.tan(np.linspace(0.0, np.arctan(_LARGEST_TANGENT), 4097))
    radial = (*coefficients[:2], 0.0, 0.0, *coefficients[4:])
    with np.errstate(all="ignore"):
        (heights, _), _ = _bent(tangents, np.zeros_like(tangents), radial)
    last = int(np.argmin(np.append(np.diff(heights) > 0.0, False)))
    return tangents[: last + 1], heights[: last + 1]
