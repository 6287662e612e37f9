"""From a raw frame to what the robust detector looks at: electrons, background, filtered image, mask."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from perception.background import background_mesh_e, spread_mesh
from perception.matched_filter import detection_limit_e, matched_filter, point_kernel
from perception.sensor import electrons, noise_floor_e2
from perception.types import Calibration, RawFrame

_LIMIT_LEVELS = 12


@dataclass(frozen=True, eq=False)
class PreparedFrame:
    """A frame with all that is computed for whole images; each array has the frame's shape.

    Attributes
    ----------
    frame, calibration
        Where it comes from.
    image_e
        Electrons above black level.
    background_e
        Smooth local background.
    filtered_e
        Matched filter of what exceeds the background.
    filtered_noise
        Noise of `filtered_e` relative to that of a pixel, √Σh².
    lit
        Pixels above the detection limit.
    floor_e2
        Variance of a dark pixel.
    """

    frame: RawFrame
    calibration: Calibration
    image_e: NDArray[np.float32]
    background_e: NDArray[np.float32]
    filtered_e: NDArray[np.float32]
    filtered_noise: float
    lit: NDArray[np.bool_]
    floor_e2: float


def prepare(frame: RawFrame, calibration: Calibration) -> PreparedFrame:
    """Filter a frame and mark what is no noise.

    Parameters
    ----------
    frame
        A raw frame that matches its calibration.
    calibration
        Its camera's calibration.

    Returns
    -------
    PreparedFrame
    """
    floor_e2 = noise_floor_e2(calibration, frame.gain)
    kernel = point_kernel(calibration.psf_sigma_px)
    image_e = electrons(frame, calibration)
    mesh_e = background_mesh_e(frame, calibration)
    background_e = spread_mesh(mesh_e, calibration)
    filtered_e = matched_filter(image_e - background_e, kernel)
    limit_e = spread_mesh(_limit_mesh_e(mesh_e, floor_e2, kernel), calibration)
    return PreparedFrame(
        frame=frame,
        calibration=calibration,
        image_e=image_e,
        background_e=background_e,
        filtered_e=filtered_e,
        filtered_noise=float(np.sum(kernel**2)),
        lit=np.asarray(cv2.compare(filtered_e, limit_e, cv2.CMP_GT), dtype=bool).reshape(image_e.shape),
        floor_e2=floor_e2,
    )


def _limit_mesh_e(
    mesh_e: NDArray[np.float32], floor_e2: float, kernel: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Compute the detection limit of each cell.

    It is smooth in √B, so a few levels and straight lines between them will do.
    """
    root = np.sqrt(np.maximum(mesh_e, 0.0, dtype=np.float64))
    levels = np.linspace(float(root.min()), float(root.max()), _LIMIT_LEVELS)
    limits = detection_limit_e(levels**2, floor_e2, kernel)
    return np.interp(root, levels, limits).astype(np.float32)
