"""Calibrations as OpenCV writes them, a YAML file for each camera."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.export.aside import export_folder
from nir_render.run.folder import write_file
from perception import Calibration, RecordingError, read_calibrations


def export_opencv(folder: Path, target: Path, overwrite: bool = False) -> dict[str, int]:
    """Write the intrinsics of each camera of a run, and how it stands on its robot.

    `model` is `pinhole`, with `distortion_coefficients` for `cv2.projectPoints` and `cv2.undistort`, or
    `fisheye`, for those of `cv2.fisheye`. `rotation_body_camera` and `position_body_m` take camera axes to
    the robot's.

    Returns
    -------
    How many coefficients of distortion each file holds.

    Raises
    ------
    InputError
        The folder has no calibration, or a broken one; as `aside.export_folder`.
    """
    try:
        known = read_calibrations(folder)
    except RecordingError as error:
        raise InputError(*error.problems) from None
    if not known:
        raise InputError(f"{folder}: its calibration.json names no camera; give the folder of a run")
    with export_folder(target, overwrite) as aside:
        for name, calibration in known.items():
            write_file(aside / f"{name}.yaml", _text(calibration).encode())
    return {f"{name}.yaml": _coefficients(calibration).size for name, calibration in known.items()}


def _coefficients(calibration: Calibration) -> NDArray[np.float64]:
    """Return the coefficients in OpenCV's order; a lens without any has four of 0."""
    return np.array(calibration.distortion or (0.0,) * 4)


def _text(calibration: Calibration) -> str:
    storage = cv2.FileStorage(".yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("camera_name", calibration.camera)
    storage.write("image_width", calibration.width_px)
    storage.write("image_height", calibration.height_px)
    storage.write("model", "fisheye" if calibration.lens_model == "fisheye" else "pinhole")
    fx, fy, cx, cy = calibration.fx_px, calibration.fy_px, calibration.cx_px, calibration.cy_px
    matrix = [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]
    storage.write("camera_matrix", np.array(matrix))
    storage.write("distortion_coefficients", _coefficients(calibration).reshape(1, -1))
    storage.write("rotation_body_camera", np.asarray(calibration.rotation_body_camera, dtype=np.float64))
    storage.write("position_body_m", np.asarray(calibration.position_body_m, dtype=np.float64).reshape(3, 1))
    return str(storage.releaseAndGetString())
