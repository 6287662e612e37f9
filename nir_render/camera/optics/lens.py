"""The lens: where a direction lands in the image, and how much of the sky a pixel sees.

Pixel (0, 0) is the centre of the top left pixel, u right, v down; camera axes x right, y down, z forward.
Field angles stay below 90°, as in OpenCV's models.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.lens import principal_point_px
from perception.model.lens import RECTILINEAR, Distortion

# A pixel at the rim of a fisheye's image circle has corners beyond it; their rays keep within it.
_RIM_RAD = 1e-6


@dataclass(frozen=True)
class Intrinsics:
    """A projection: u = fx x + cx, v = fy y + cy in pixels, (x, y) the point of `Distortion.place`."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: Distortion = RECTILINEAR

    def project(self, direction: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pixels (u, v), shape (..., 2), of camera directions, shape (..., 3).

        Directions need not be of unit length. What is behind the lens (z ≤ 0) becomes NaN.
        """
        return self.distortion.place(direction) * (self.fx_px, self.fy_px) + (self.cx_px, self.cy_px)

    def unproject(self, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the unit directions, shape (..., 3), of pixels (u, v), shape (..., 2).

        NaN outside a fisheye's image circle, where the field angle would reach 90°.
        """
        direction = self.distortion.direction(self._point(pixel))
        return np.asarray(direction / np.linalg.norm(direction, axis=-1, keepdims=True))

    def contains(self, u_px: float, v_px: float) -> bool:
        """Tell whether a point lies on the sensor; NaN does not."""
        return -0.5 <= u_px <= self.width_px - 0.5 and -0.5 <= v_px <= self.height_px - 0.5

    def image_radius_px(self, direction: NDArray[np.float64], angular_radius_rad: float) -> float:
        """Return the larger half axis of a small disc's image about a unit direction, shape (3,).

        To first order in the angular radius; the stretch beyond 87° is taken as that at 87°.
        """
        if direction[2] < 0.05:
            sine = math.hypot(direction[0], direction[1])
            direction = np.array([*(direction[:2] / sine * math.sqrt(1.0 - 0.05**2)), 0.05])
        stretch = float(self.distortion.stretch(direction))
        return max(self.fx_px, self.fy_px) * math.tan(min(angular_radius_rad, 1.5)) * stretch

    @property
    def corner_angle_rad(self) -> float:
        """Field angle of the farthest image corner; 90° where it lies outside the image circle."""
        return self.corner_angle_rad_beyond(0.0)

    def corner_angle_rad_beyond(self, margin_px: float) -> float:
        """Field angle of the farthest corner of a frame that is larger by a margin on every side."""
        low_px = -0.5 - margin_px
        ends = [(low_px, self.width_px - 1.0 - low_px), (low_px, self.height_px - 1.0 - low_px)]
        corners = np.stack(np.meshgrid(*ends), axis=-1).astype(np.float64)
        direction = self.distortion.direction(self._point(corners))
        angle_rad = np.arctan2(np.hypot(direction[..., 0], direction[..., 1]), direction[..., 2])
        return float(np.where(np.isnan(angle_rad), 0.5 * np.pi, angle_rad).max())

    def _point(self, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return where pixels lie in units of the focal length, shape (..., 2)."""
        return (pixel - (self.cx_px, self.cy_px)) / (self.fx_px, self.fy_px)


@dataclass(frozen=True, eq=False)
class Field:
    """What the lens makes of each pixel.

    Attributes
    ----------
    angle_rad
        Field angle of the pixel's centre, shape (rows, columns).
    weight
        cos θ times the pixel's solid angle, relative to a pixel on the axis, same shape; 0 outside the image
        circle. A rectilinear lens has cos⁴ θ.
    """

    angle_rad: NDArray[np.float64]
    weight: NDArray[np.float64]


def intrinsics_of(camera: Camera) -> Intrinsics:
    """Return the projection of a camera."""
    lens, sensor = camera.lens, camera.sensor
    focal_px = lens.focal_length_m / sensor.pixel_pitch_m
    cx_px, cy_px = principal_point_px(lens, sensor)
    distortion = Distortion(lens.model, lens.distortion)
    return Intrinsics(sensor.columns, sensor.rows, focal_px, focal_px, cx_px, cy_px, distortion)


def aperture_area_m2(camera: Camera) -> float:
    """Return the area of the entrance pupil, π f² / (4 N²)."""
    return math.pi * (camera.lens.focal_length_m / camera.lens.f_number) ** 2 / 4.0


def field_of(lens: Intrinsics) -> Field:
    """Return field angles and weights of all pixels, those of their centres."""
    if lens.distortion.model == "rectilinear":
        x = (np.arange(lens.width_px) - lens.cx_px) / lens.fx_px
        y = (np.arange(lens.height_px) - lens.cy_px) / lens.fy_px
        tan_squared = x**2 + y[:, None] ** 2
        return Field(np.arctan(np.sqrt(tan_squared)), 1.0 / (1.0 + tan_squared) ** 2)
    return _bent_field(lens)


@lru_cache(maxsize=4)
def _bent_field(lens: Intrinsics) -> Field:
    columns, rows = np.meshgrid(np.arange(lens.width_px, dtype=float), np.arange(lens.height_px, dtype=float))
    direction = lens.unproject(np.stack([columns, rows], axis=-1))
    weight = direction[..., 2] * lens.distortion.solid_angle_sr(direction)
    angle_rad = np.arctan2(np.hypot(direction[..., 0], direction[..., 1]), direction[..., 2])
    lit = np.isfinite(angle_rad)
    return Field(np.where(lit, angle_rad, 0.5 * np.pi), np.where(lit, weight, 0.0))


def corner_directions(camera: Camera) -> NDArray[np.float64]:
    """Return directions at the corners of all pixels in camera axes, shape (rows + 1, columns + 1, 3).

    Those of a rectilinear lens have depth 1: between corners they are linear, and interpolation is exact.
    Those of a fisheye are of unit length, so that it is right to 1/(8 f²), f in pixels, at all angles.
    """
    lens = intrinsics_of(camera)
    if lens.distortion.model != "rectilinear":
        return _bent_corners(lens)
    x = (np.arange(lens.width_px + 1) - 0.5 - lens.cx_px) / lens.fx_px
    y = (np.arange(lens.height_px + 1) - 0.5 - lens.cy_px) / lens.fy_px
    return np.stack(np.broadcast_arrays(x, y[:, None], 1.0), axis=-1)


@lru_cache(maxsize=4)
def _bent_corners(lens: Intrinsics) -> NDArray[np.float64]:
    u_px, v_px = np.meshgrid(np.arange(lens.width_px + 1) - 0.5, np.arange(lens.height_px + 1) - 0.5)
    x, y = (u_px - lens.cx_px) / lens.fx_px, (v_px - lens.cy_px) / lens.fy_px
    direction = lens.distortion.direction(np.stack([x, y], axis=-1))
    azimuth_rad, sine = np.arctan2(y, x), math.cos(_RIM_RAD)
    rim = [sine * np.cos(azimuth_rad), sine * np.sin(azimuth_rad), np.full_like(x, math.sin(_RIM_RAD))]
    corners = np.where(np.isnan(direction), np.stack(rim, axis=-1), direction)
    corners.setflags(write=False)
    return corners
