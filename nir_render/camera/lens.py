"""The lens: where a direction lands in the image. Rectilinear for now.

Pixel (0, 0) is the centre of the top left pixel, u right, v down; camera axes x right, y down, z forward.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.scene.devices import Camera


@dataclass(frozen=True)
class Intrinsics:
    """A rectilinear projection: u = fx x/z + cx, v = fy y/z + cy, in pixels."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float

    def project(self, direction: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pixels (u, v), shape (..., 2), of camera directions, shape (..., 3).

        Directions need not be of unit length. What is behind the lens (z ≤ 0) becomes NaN.
        """
        z = np.where(direction[..., 2] > 0.0, direction[..., 2], np.nan)
        u_px = self.fx_px * direction[..., 0] / z + self.cx_px
        v_px = self.fy_px * direction[..., 1] / z + self.cy_px
        return np.stack([u_px, v_px], axis=-1)

    def unproject(self, pixel: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the unit directions, shape (..., 3), of pixels (u, v), shape (..., 2)."""
        x = (pixel[..., 0] - self.cx_px) / self.fx_px
        y = (pixel[..., 1] - self.cy_px) / self.fy_px
        direction = np.stack([x, y, np.ones_like(x)], axis=-1)
        return np.asarray(direction / np.linalg.norm(direction, axis=-1, keepdims=True))

    def contains(self, u_px: float, v_px: float) -> bool:
        """Tell whether a point lies on the sensor; NaN does not."""
        return -0.5 <= u_px <= self.width_px - 0.5 and -0.5 <= v_px <= self.height_px - 0.5

    @property
    def corner_angle_rad(self) -> float:
        """Field angle of the farthest image corner."""
        across = max(self.cx_px + 0.5, self.width_px - 0.5 - self.cx_px) / self.fx_px
        down = max(self.cy_px + 0.5, self.height_px - 0.5 - self.cy_px) / self.fy_px
        return math.atan(math.hypot(across, down))


def intrinsics_of(camera: Camera) -> Intrinsics:
    """Return the projection of a camera whose optical axis meets the centre of its sensor."""
    sensor = camera.sensor
    focal_px = camera.lens.focal_length_m / sensor.pixel_pitch_m
    cx_px, cy_px = (sensor.columns - 1) / 2, (sensor.rows - 1) / 2
    return Intrinsics(sensor.columns, sensor.rows, focal_px, focal_px, cx_px, cy_px)


def aperture_area_m2(camera: Camera) -> float:
    """Return the area of the entrance pupil, π f² / (4 N²)."""
    return math.pi * (camera.lens.focal_length_m / camera.lens.f_number) ** 2 / 4.0


def corner_directions(camera: Camera) -> NDArray[np.float64]:
    """Return directions at the corners of all pixels in camera axes, shape (rows + 1, columns + 1, 3).

    Their depth is 1, so that between corners of a rectilinear lens they are linear, and interpolation is
    exact.
    """
    lens = intrinsics_of(camera)
    x = (np.arange(lens.width_px + 1) - 0.5 - lens.cx_px) / lens.fx_px
    y = (np.arange(lens.height_px + 1) - 0.5 - lens.cy_px) / lens.fy_px
    return np.stack(np.broadcast_arrays(x, y[:, None], 1.0), axis=-1)
