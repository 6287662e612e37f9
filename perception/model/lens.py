"""The lens: OpenCV's distortion models in closed form, their inverse, and where they fold.

Light from a direction (X, Y, Z), at the field angle θ from the axis Z, falls on the point (x, y) of the
image, in units of the focal length about the principal point. With a = X/Z, b = Y/Z, r² = a² + b²:

rectilinear    x = a, y = b
brown_conrady  x = a g + 2 p1 a b + p2 (r² + 2 a²), y = b g + p1 (r² + 2 b²) + 2 p2 a b,
               g = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
fisheye        (x, y) = θ_d (a, b)/r, θ_d = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)

(OpenCV, modules calib3d and fisheye; Brown 1966; Kannala and Brandt 2006.) A polynomial may turn back beyond
the field that it was fitted over: from there, the fold, on it means nothing, and would put what lies far
outside the field into the middle of the picture. `project` and `unproject` know nothing beyond the fold;
`Distortion.place`, which whoever renders needs for light from anywhere, lets the image grow in proportion
from there on, so that it stays outside.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from perception.model.brown_conrady import undistorted
from perception.types import Calibration

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
LensModel = Literal["rectilinear", "brown_conrady", "fisheye"]

COEFFICIENTS = {"rectilinear": (0,), "brown_conrady": (4, 5, 8), "fisheye": (4,)}
"""Lens models, and how many numbers of distortion each may have."""

_RIGHT_ANGLE = 0.5 * math.pi
# Newton starts from a table over the field angle, up to where a brown_conrady image is 6 km wide.
_TABLE = 4097
_WIDEST_RAD = _RIGHT_ANGLE - 1e-6
_MOST_STEPS, _LAST_STEP = 40, 1e-9  # a step of 1e-9 leaves an error of its square
_SCAN_ANGLES, _SCAN_AZIMUTHS = 901, 72


def project(direction: Array, calibration: Calibration) -> Array:
    """Return where directions in camera axes, shape (n, 3), fall on the image, (u, v), shape (n, 2).

    They need not be of unit length. NaN for what is behind the lens, z ≤ 0, or beyond its fold.
    """
    lens = distortion_of(calibration)
    point = lens.place(direction)
    if lens.fold_rad < _RIGHT_ANGLE:
        point[~lens.images(direction)] = np.nan
    return point * (calibration.fx_px, calibration.fy_px) + (calibration.cx_px, calibration.cy_px)


def unproject(points_px: Array, calibration: Calibration) -> Array:
    """Return the unit directions in camera axes, shape (n, 3), of image points (u, v), shape (n, 2).

    NaN where no light within 90° of the axis and before the fold falls: beyond a fisheye's image circle,
    beyond a fold.
    """
    point = (points_px - (calibration.cx_px, calibration.cy_px)) / (calibration.fx_px, calibration.fy_px)
    direction = distortion_of(calibration).direction(point)
    return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True))


def unproject_each(points_px: Array, calibrations: Sequence[Calibration], camera: Indices) -> Array:
    """As `unproject`, of points in the pictures of several cameras: those of like lenses at once.

    `camera`, shape (n,), says by number in whose picture each point lies.
    """
    intrinsics = np.array([(each.cx_px, each.cy_px, each.fx_px, each.fy_px) for each in calibrations])
    intrinsics = intrinsics.reshape(-1, 4)[camera]
    point = (points_px - intrinsics[:, :2]) / intrinsics[:, 2:]
    lenses = [distortion_of(each) for each in calibrations]
    direction = np.empty((len(point), 3))
    for lens in dict.fromkeys(lenses):
        own = np.array([each == lens for each in lenses])[camera]
        direction[own] = lens.direction(point[own])
    return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True))


def stretch(direction: Array, calibration: Calibration) -> Array:
    """Return how many pixels the image moves, at most, per radian of unit directions, shape (n, 3) → (n,).

    NaN where there is no direction.
    """
    focal_px = (calibration.fx_px, calibration.fy_px)
    if calibration.lens_model == "rectilinear":
        return np.asarray(max(focal_px) / direction[:, 2] ** 2)  # along the radius; across it by 1 / cos θ
    return _greatest(distortion_of(calibration).derivative(direction) * np.reshape(focal_px, (2, 1)))


def distortion_of(calibration: Calibration) -> "Distortion":
    """Return the lens law of a calibration."""
    return _distortion(cast("LensModel", calibration.lens_model), calibration.distortion)


@dataclass(frozen=True)
class Distortion:
    """A lens model and its coefficients in OpenCV's order.

    brown_conrady has 4, 5 or 8: k1, k2, p1, p2, k3, k4, k5, k6; fisheye 4: k1, k2, k3, k4.

    Examples
    --------
    r - 0.3 r³ turns back at r = 1/√0.9, where the image is 2/3 of that high:

    >>> barrel = Distortion("brown_conrady", (-0.3, 0.0, 0.0, 0.0))
    >>> round(math.degrees(barrel.fold_rad), 1)
    46.5
    >>> barrel.place(np.array([0.5, 0.0, 1.0])).round(4).tolist()
    [0.4625, 0.0]
    >>> barrel.direction(np.array([[0.4625, 0.0], [0.8, 0.0]])).round(4).tolist()
    [[0.5, 0.0, 1.0], [nan, nan, 1.0]]
    """

    model: LensModel = "rectilinear"
    coefficients: tuple[float, ...] = ()

    def place(self, direction: Array) -> Array:
        """Return the points (x, y), shape (..., 2), of directions, shape (..., 3), of any length.

        What is behind the lens (Z ≤ 0) becomes NaN.
        """
        z = np.where(direction[..., 2] > 0.0, direction[..., 2], np.nan)
        across = direction[..., :2]
        if self.model == "rectilinear":
            return np.asarray(across / z[..., None])
        if self.model == "brown_conrady":
            tangent = across / z[..., None]
            beyond = np.maximum(np.hypot(tangent[..., 0], tangent[..., 1]) / math.tan(self._end_rad), 1.0)
            x, y = self._distort(tangent[..., 0] / beyond, tangent[..., 1] / beyond)
            return np.stack([x * beyond, y * beyond], axis=-1)
        sine = np.hypot(across[..., 0], across[..., 1])
        height = self.image_height(np.arctan2(sine, z))
        # On the axis θ_d / sin θ is 1 / Z for a direction of any length.
        scale = np.where(sine > 0.0, height / np.where(sine > 0.0, sine, 1.0), 1.0 / z)
        return np.asarray(across * scale[..., None])

    def images(self, direction: Array) -> NDArray[np.bool_]:
        """Tell which directions, shape (..., 3), lie before the fold and not behind the lens, shape (...)."""
        sine = np.hypot(direction[..., 0], direction[..., 1])
        return np.asarray(np.arctan2(sine, direction[..., 2]) <= self._end_rad)

    def direction(self, point: Array) -> Array:
        """Return the directions, shape (..., 3), of points, shape (..., 2).

        Those of a fisheye are of unit length, the others of depth 1. NaN where no light within 90° of the
        axis and before the fold falls.
        """
        if self.model == "fisheye":
            return self._fisheye_direction(point)
        tangent = point if self.model == "rectilinear" else self._undistort(point)
        return np.concatenate([tangent, np.ones((*tangent.shape[:-1], 1))], axis=-1)

    def image_height(self, angle_rad: Array) -> Array:
        """Return the distance from the principal point at field angles, without tangential distortion."""
        if self.model == "rectilinear":
            return np.tan(angle_rad)
        if self.model == "fisheye":
            gain, _ = self._equidistant
            return np.asarray(angle_rad * _polyval(np.minimum(angle_rad, self._end_rad) ** 2, gain.coef))
        tangent = np.tan(angle_rad)
        radial, _ = self._radial(np.minimum(tangent, math.tan(self._end_rad)) ** 2)
        return np.asarray(tangent * radial)

    def solid_angle_sr(self, direction: Array) -> Array:
        """Return the solid angle per unit of the image's area at directions before the fold, shape (...)."""
        cosine, sine, angle = _field_angle(direction)
        if self.model == "rectilinear":
            return np.asarray(cosine**3)
        if self.model == "fisheye":
            # dΩ = sin θ dθ dφ falls on θ_d dθ_d dφ.
            height, slope = self.image_height(angle), self._fisheye_slope(angle)
            small = angle < 1e-9
            return np.where(small, 1.0, sine / np.where(small, 1.0, height * slope))
        xx, xy, yy = self._jacobian(
            direction[..., 0] / direction[..., 2], direction[..., 1] / direction[..., 2]
        )
        return np.asarray(cosine**3 / (xx * yy - xy**2))

    def stretch(self, direction: Array) -> Array:
        """Return how far the image moves, at most, per radian of directions before the fold, shape (...)."""
        if self.model == "rectilinear":
            return np.asarray(1.0 / _field_angle(direction)[0] ** 2)
        return _greatest(self.derivative(direction))

    def derivative(self, direction: Array) -> Array:
        """Differentiate (x, y) by the direction, in radians outwards and around the axis, shape (..., 2, 2).

        At unit directions before the fold, shape (..., 3), of a lens with distortion.
        """
        cosine, sine, angle = _field_angle(direction)
        aside = np.where(sine > 1e-9, sine, 1.0)
        out_x = np.where(sine > 1e-9, direction[..., 0] / aside, 1.0)
        out_y = np.where(sine > 1e-9, direction[..., 1] / aside, 0.0)
        if self.model == "fisheye":
            outwards = self._fisheye_slope(angle)
            around = np.where(sine > 1e-9, self.image_height(angle) / aside, 1.0)
            xx, xy, yx, yy = out_x * outwards, -out_y * around, out_y * outwards, out_x * around
        else:
            aa, ab, bb = self._jacobian(
                direction[..., 0] / direction[..., 2], direction[..., 1] / direction[..., 2]
            )
            xx, yx = (aa * out_x + ab * out_y) / cosine**2, (ab * out_x + bb * out_y) / cosine**2
            xy, yy = (ab * out_x - aa * out_y) / cosine, (bb * out_x - ab * out_y) / cosine
        return np.stack([np.stack([xx, xy], axis=-1), np.stack([yx, yy], axis=-1)], axis=-2)

    @cached_property
    def fold_rad(self) -> float:
        """The field angle at which the image folds, 90° where it does not.

        That is where the image height turns back, or, with tangential distortion, the determinant of the
        Jacobian first falls to 0 for some azimuth.
        """
        if self.model == "rectilinear":
            return _RIGHT_ANGLE
        if self.model == "fisheye":
            return min(math.sqrt(_first_root(self._equidistant[1])), _RIGHT_ANGLE)
        over, under = self._ratio
        square = np.polynomial.Polynomial([0.0, 1.0])
        # d(r g)/dr of g = P(r²)/Q(r²) has the numerator P Q + 2 r² (P' Q − P Q').
        slope = over * under + 2.0 * square * (over.deriv() * under - over * under.deriv())
        radial_rad = math.atan(math.sqrt(min(_first_root(slope), _first_root(under))))
        return radial_rad if not any(self.coefficients[2:4]) else self._tangential_fold(radial_rad)

    @cached_property
    def _end_rad(self) -> float:
        """The field angle up to which the model is followed: right before a fold or a pole of g."""
        return min(self.fold_rad - 1e-9, _WIDEST_RAD)

    def _tangential_fold(self, radial_rad: float) -> float:
        angle_rad = np.linspace(0.0, min(radial_rad, _WIDEST_RAD), _SCAN_ANGLES)[:, None]
        azimuth_rad = 2.0 * np.pi * np.arange(_SCAN_AZIMUTHS) / _SCAN_AZIMUTHS
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # the scan may end at a pole of g
            xx, xy, yy = self._jacobian(
                np.tan(angle_rad) * np.cos(azimuth_rad), np.tan(angle_rad) * np.sin(azimuth_rad)
            )
            area = xx * yy - xy**2
        # Both of its eigenvalues are above 0 as long as the image has not folded; they begin at 1.
        folded = np.any((area <= 0.0) | (xx + yy <= 0.0), axis=1)
        folded[-1:] &= radial_rad >= _RIGHT_ANGLE
        return float(angle_rad[np.argmax(folded) - 1, 0]) if folded.any() else radial_rad

    @cached_property
    def _equidistant(self) -> "tuple[np.polynomial.Polynomial, np.polynomial.Polynomial]":
        """θ_d/θ and dθ_d/dθ of a fisheye, as polynomials of θ²."""
        powers = (1.0, *self.coefficients)
        return np.polynomial.Polynomial(powers), np.polynomial.Polynomial(
            [(2 * n + 1) * value for n, value in enumerate(powers)]
        )

    @cached_property
    def _ratio(self) -> "tuple[np.polynomial.Polynomial, np.polynomial.Polynomial]":
        """Numerator and denominator of g, as polynomials of r²."""
        k1, k2, _, _, k3, k4, k5, k6 = (*self.coefficients, *[0.0] * (8 - len(self.coefficients)))
        return np.polynomial.Polynomial([1.0, k1, k2, k3]), np.polynomial.Polynomial([1.0, k4, k5, k6])

    @cached_property
    def _of_ratio(self) -> tuple[Array, Array, Array, Array]:
        """Coefficients of numerator and denominator of g, and of their derivatives by r²."""
        over, under = self._ratio
        of_these = (each.coef for each in (over, under, over.deriv(), under.deriv()))
        first, second, third, fourth = (
            np.asarray(coefficients, dtype=np.float64) for coefficients in of_these
        )
        return first, second, third, fourth

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Field angles up to the end, and image heights there."""
        angle_rad = np.linspace(0.0, self._end_rad, _TABLE)
        return angle_rad, self.image_height(angle_rad)

    @cached_property
    def _tangents(self) -> tuple[Array, Array]:
        """Image heights up to the end, and tangents of the field angles there."""
        angle_rad, heights = self._table
        return heights, np.tan(angle_rad)

    def _radial(self, square: Array) -> tuple[Array, Array]:
        """Return g and dg/d(r²) at r²."""
        over, under, over_slope, under_slope = self._of_ratio
        below = _polyval(square, under)
        gain = _polyval(square, over) / below
        slope = _polyval(square, over_slope) - gain * _polyval(square, under_slope)
        return gain, slope / below

    def _distort(self, a: Array, b: Array) -> tuple[Array, Array]:
        """Return the point (x, y) of brown_conrady at (a, b)."""
        _, _, p1, p2 = self.coefficients[:4]
        square = a**2 + b**2
        gain, _ = self._radial(square)
        x = a * gain + 2.0 * p1 * a * b + p2 * (square + 2.0 * a**2)
        return x, b * gain + p1 * (square + 2.0 * b**2) + 2.0 * p2 * a * b

    def _jacobian(self, a: Array, b: Array) -> tuple[Array, Array, Array]:
        """Return ∂x/∂a, ∂x/∂b = ∂y/∂a and ∂y/∂b of brown_conrady."""
        _, _, p1, p2 = self.coefficients[:4]
        gain, slope = self._radial(a**2 + b**2)
        xx = gain + 2.0 * a**2 * slope + 2.0 * p1 * b + 6.0 * p2 * a
        xy = 2.0 * a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
        return xx, xy, gain + 2.0 * b**2 * slope + 6.0 * p1 * b + 2.0 * p2 * a

    def _undistort(self, point: Array) -> Array:
        """Return (a, b) of brown_conrady, shape (..., 2), by Newton's method."""
        heights, tangents = self._tangents
        height = np.hypot(point[..., 0], point[..., 1]).ravel()
        start = np.interp(height, heights, tangents) / np.where(height > 0.0, height, 1.0)
        found = undistorted(
            np.ascontiguousarray(point.reshape(-1, 2)), start, *self._of_ratio,
            float(self.coefficients[2]), float(self.coefficients[3]), math.tan(self._end_rad),
        )  # fmt: skip
        return found.reshape(point.shape)

    def _fisheye_direction(self, point: Array) -> Array:
        angle_rad, heights = self._table
        height = np.hypot(point[..., 0], point[..., 1])
        inside = height < heights[-1]
        angle = np.interp(height, heights, angle_rad)
        for _ in range(_MOST_STEPS):
            slope = self._fisheye_slope(angle)
            step = (self.image_height(angle) - height) / np.where(slope > 0.0, slope, np.nan)
            angle = np.clip(angle - step, 0.0, self._end_rad)
            if not (np.abs(step[inside]) > _LAST_STEP).any():
                break
        angle = np.where(inside, angle, np.nan)
        scale = np.sin(angle) / np.where(height > 0.0, height, 1.0)
        return np.stack([point[..., 0] * scale, point[..., 1] * scale, np.cos(angle)], axis=-1)

    def _fisheye_slope(self, angle_rad: Array) -> Array:
        """Return dθ_d/dθ before the fold."""
        return np.asarray(_polyval(angle_rad**2, self._equidistant[1].coef))


RECTILINEAR = Distortion()


@lru_cache(maxsize=16)
def _distortion(model: LensModel, coefficients: tuple[float, ...]) -> Distortion:
    """Return a lens law that keeps its tables from call to call."""
    return Distortion(model, coefficients)


def _polyval(at: Array, coefficients: NDArray[Any]) -> Array:
    """Return the polynomial's value, by Horner's rule."""
    value = np.asarray(coefficients[-1] + 0.0 * at)
    for coefficient in coefficients[-2::-1]:
        value = coefficient + value * at
    return value


def _greatest(slopes: Array) -> Array:
    """Return the greatest that matrices stretch anything, shape (..., 2, 2) → (...)."""
    (a, b), (c, d) = np.moveaxis(slopes, (-2, -1), (0, 1))
    return np.asarray(0.5 * (np.hypot(a + d, b - c) + np.hypot(a - d, b + c)))


def _first_root(polynomial: "np.polynomial.Polynomial") -> float:
    """Return the smallest root above 0, infinity where there is none."""
    roots = np.asarray(polynomial.trim().roots(), dtype=complex)
    # A double root, where the curve touches 0, comes out as a pair with small imaginary parts.
    above = roots.real[(np.abs(roots.imag) < 1e-7 * np.abs(roots)) & (roots.real > 0.0)]
    return float(above.min(initial=math.inf))


def _field_angle(direction: Array) -> tuple[Array, Array, Array]:
    """Return cosine, sine and value of the angle between directions and the axis."""
    sine = np.hypot(direction[..., 0], direction[..., 1])
    length = np.hypot(sine, direction[..., 2])
    return direction[..., 2] / length, sine / length, np.arctan2(sine, direction[..., 2])
