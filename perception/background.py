"""The local background of a frame, on a coarse mesh, blind to flares."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from perception.sensor import gain_dn_per_e, noise_floor_e2
from perception.types import Calibration, RawFrame

CELL_PX = 64
_SAMPLES_PER_AXIS = 32
_CLIP_SIGMA = 3.0
_CLIP_ROUNDS = 3


def background_mesh_e(frame: RawFrame, calibration: Calibration) -> NDArray[np.float32]:
    """Background in electrons per pixel on a mesh of cells of about 64 px.

    In each cell the mean of what lies within 3 σ of the median, σ from the noise model at that median; the
    median of what is kept decides the next round. Then a median over 3 × 3 cells removes cells that a large
    flare fills. A cell is sampled at 32 × 32 of its pixels: the error is σ/32, of which a detection notices
    nothing.

    Parameters
    ----------
    frame
        A raw frame that matches its calibration.
    calibration
        Noise model.

    Returns
    -------
    Mesh, float32, shape (cells down, cells across); cells divide the frame evenly.
    """
    gain = gain_dn_per_e(frame, calibration)
    samples = _cell_samples(frame.data_dn)
    samples.sort(axis=-1)
    count = samples.shape[-1]
    # The lower median is itself a sample, so at least it is always kept.
    median = samples[..., (count - 1) // 2].astype(np.float64)
    kept = np.ones(samples.shape, dtype=bool)
    for _ in range(_CLIP_ROUNDS):
        sigma = gain * np.sqrt(
            np.maximum((median - frame.black_level_dn) / gain, 0.0) + noise_floor_e2(calibration, frame.gain)
        )
        kept = np.abs(samples - median[..., None]) <= _CLIP_SIGMA * sigma[..., None]
        first = kept.argmax(axis=-1)
        middle = first + (kept.sum(axis=-1) - 1) // 2
        median = np.take_along_axis(samples, middle[..., None], axis=-1)[..., 0].astype(np.float64)
    mean = np.sum(samples, axis=-1, where=kept, dtype=np.float64) / kept.sum(axis=-1)
    mesh = ((mean - frame.black_level_dn) / gain).astype(np.float32)
    return np.asarray(cv2.medianBlur(mesh, 3), dtype=np.float32).reshape(mesh.shape)


def spread_mesh(mesh: NDArray[np.float32], calibration: Calibration) -> NDArray[np.float32]:
    """Interpolate a mesh to every pixel of the frame, bilinearly between the cells' middles."""
    size = (calibration.width_px, calibration.height_px)
    full = cv2.resize(mesh, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(full, dtype=np.float32).reshape(calibration.height_px, calibration.width_px)


def _cell_samples(data_dn: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Pixels of each cell, shape (cells down, cells across, samples)."""
    down, rows = _sample_places(data_dn.shape[0])
    across, columns = _sample_places(data_dn.shape[1])
    taken = data_dn[np.ix_(rows, columns)]
    blocks = taken.reshape(down, rows.size // down, across, columns.size // across)
    return blocks.transpose(0, 2, 1, 3).reshape(down, across, -1)


def _sample_places(length: int) -> tuple[int, NDArray[np.intp]]:
    """Divide an axis: the number of cells, and the pixels sampled, evenly in each."""
    cells = max(1, round(length / CELL_PX))
    per_cell = min(_SAMPLES_PER_AXIS, math.floor(length / cells))
    place = (np.arange(cells * per_cell) + 0.5) * (length / (cells * per_cell))
    return cells, place.astype(np.intp)
