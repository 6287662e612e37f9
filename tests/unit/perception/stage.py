"""Frames of points that shine, by brute force: what a camera of the stack's tests sees."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from perception import RawFrame
from tests.unit.perception.simulation import FLUX_PER_S_AT_1_M, calibration, expose, random

Array = NDArray[np.float64]

CAMERA = calibration(
    width_px=240, height_px=120, fx_px=160.0, fy_px=160.0, cx_px=119.5, cy_px=59.5, source_radius_m=1e-4
)
CAMERAS = {CAMERA.camera: CAMERA}
EXPOSURE_S, RATE_HZ = 2e-4, 30.0


def pixel_and_range(place_m: Array) -> tuple[float, float, float]:
    """Return where a point in body axes is seen, and how far."""
    local = CAMERA.rotation_body_camera.T @ (place_m - CAMERA.position_body_m)
    u = CAMERA.cx_px + CAMERA.fx_px * local[0] / local[2]
    v = CAMERA.cy_px + CAMERA.fy_px * local[1] / local[2]
    return float(u), float(v), float(np.linalg.norm(local))


def _shares(at_px: float, count: int) -> Array:
    """Return how much of a point's image each row, or column, of pixels gets."""
    return np.diff(ndtr((np.arange(count + 1) - 0.5 - at_px) / CAMERA.psf_sigma_px))


def frame_of(index: int, lit_m: Iterable[Array]) -> RawFrame:
    """Return a frame in which points at places in body axes, shape (3,) each, are lit."""
    mean_e = np.full((CAMERA.height_px, CAMERA.width_px), 2.0)
    for place_m in lit_m:
        u_px, v_px, range_m = pixel_and_range(place_m)
        slant = np.hypot(np.hypot(u_px - CAMERA.cx_px, v_px - CAMERA.cy_px) / CAMERA.fx_px, 1.0)
        flux_e = FLUX_PER_S_AT_1_M * EXPOSURE_S / slant / range_m**2
        mean_e += flux_e * np.outer(_shares(v_px, CAMERA.height_px), _shares(u_px, CAMERA.width_px))
    frame = expose(mean_e, CAMERA, random(7, index), EXPOSURE_S)
    return replace(frame, index=index, time_s=index / RATE_HZ)
