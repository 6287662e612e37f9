"""What lies beneath: a smooth background, and how much a frame scatters about it beside noise, in cells."""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.sensor import gain_dn_per_e, noise_floor_e2, saturation_dn
from perception.types import Calibration, RawFrame

CELL_PX = 64
CLIP_SIGMA = 3.0
CLIP_ROUNDS = 3
STEPS_PER_NOISE, MOST_NOISES = 64, 8

LEAST_RATIO = 1.06
"""Parts of a frame whose scatter exceeds noise by less count as even: so exactly it is measured."""

LEAST_RATIO_AROUND = 1.05
"""As much the mean over 5 × 5 parts must have: chance gives it to one even frame in a hundred or so."""

_SAMPLES_PER_AXIS = 24
_LEAST_FREE, _LEAST_FREE_OF_SCATTER = 0.125, 0.5  # of a cell, that is not clipped
_SCATTER_SAMPLES_PER_AXIS = 16


def background_mesh_e(frame: RawFrame, calibration: Calibration) -> NDArray[np.float32]:
    """Background in electrons per pixel on a mesh of cells of about 64 px.

    In each cell the mean of what lies within 3 σ of the median, σ from the noise model at that median; the
    median of what is kept decides the next round. Clipped pixels are no background: a cell that they fill is
    as those around it. Then a median over 3 × 3 cells removes cells that a large flare fills. A cell is
    sampled at 24 × 24 of its pixels: the error is σ/24, of which a detection notices nothing.

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
    import cv2

    gain, clipped_dn = gain_dn_per_e(frame, calibration), saturation_dn(calibration, frame.gain)
    rows, columns = (_sample_places(length, _SAMPLES_PER_AXIS) for length in frame.data_dn.shape)
    mean_dn = cell_means(
        frame.data_dn,
        rows,
        columns,
        float(frame.black_level_dn),
        gain,
        noise_floor_e2(calibration, frame.gain),
        clipped_dn,
    )
    mesh = ((_filled(mean_dn, clipped_dn) - frame.black_level_dn) / gain).astype(np.float32)
    return np.asarray(cv2.medianBlur(mesh, 3), dtype=np.float32).reshape(mesh.shape)


def _filled(mesh: NDArray[np.float64], if_none: float) -> NDArray[np.float64]:
    """Give cells without a value the mean of those beside them, from the border of the rest inwards."""
    if np.isnan(mesh).all():
        return np.full_like(mesh, if_none)
    filled = mesh
    while np.isnan(filled).any():
        around = np.pad(filled, 1, constant_values=np.nan)
        beside = np.stack([around[:-2, 1:-1], around[2:, 1:-1], around[1:-1, :-2], around[1:-1, 2:]])
        known = np.isfinite(beside)
        mean = np.where(known, beside, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
        filled = np.where(np.isnan(filled) & known.any(axis=0), mean, filled)
    return filled


def spread_mesh(mesh: NDArray[np.float32], calibration: Calibration) -> NDArray[np.float32]:
    """Interpolate a mesh to every pixel of the frame, bilinearly between the cells' middles."""
    return resized(mesh, calibration.width_px, calibration.height_px)


def as_wide(mesh: NDArray[np.float32], calibration: Calibration) -> NDArray[np.float32]:
    """Interpolate a mesh along its rows alone: shape (cells down, columns of the frame)."""
    return resized(mesh, calibration.width_px, len(mesh))


def resized(mesh: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Interpolate between the cells' middles."""
    import cv2

    full = cv2.resize(mesh, (width, height), interpolation=cv2.INTER_LINEAR)
    return np.asarray(full, dtype=np.float32).reshape(height, width)


@lru_cache(maxsize=64)
def _sample_places(length: int, per_axis: int) -> NDArray[np.int64]:
    """Divide an axis into cells: the pixels sampled, evenly in each, shape (cells, samples)."""
    cells = max(1, round(length / CELL_PX))
    per_cell = min(per_axis, math.floor(length / cells))
    place = (np.arange(cells * per_cell) + 0.5) * (length / (cells * per_cell))
    return place.astype(np.int64).reshape(cells, per_cell)


def scatter_places(shape: tuple[int, ...]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the rows and columns of each cell where scatter is sampled, shape (cells, samples) each."""
    rows, columns = (_sample_places(length, _SCATTER_SAMPLES_PER_AXIS) for length in shape)
    return rows, columns


def scatter_ratio(
    samples: NDArray[np.float32], noise_mesh_e: NDArray[np.float32], clipped_mesh_e: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Scatter of a filtered image in each cell relative to that of noise; 1 where it is no larger.

    `samples` are those of all cells' rows and columns, one after another's, shape (rows, columns). What is
    clipped, above `clipped_mesh_e`, is no part of a background.
    """
    import cv2

    ratio = cell_scatter(samples, noise_mesh_e, clipped_mesh_e)
    smooth = np.asarray(cv2.medianBlur(ratio, 3), dtype=np.float32).reshape(ratio.shape)
    # A cell's ratio is known to 6 % only: those around must have some structure too.
    around = np.asarray(cv2.blur(ratio, (5, 5)), dtype=np.float32).reshape(ratio.shape)
    structured = (smooth > LEAST_RATIO) & (around > LEAST_RATIO_AROUND)
    return np.where(structured, smooth, np.float32(1.0))


@compiled
def cell_means(
    data_dn: NDArray[np.uint16], rows: NDArray[np.int64], columns: NDArray[np.int64],
    black_dn: float, gain_dn_per_e: float, floor_e2: float, clipped_dn: int,
) -> NDArray[np.float64]:  # fmt: skip
    """Return the mean count of each cell within 3 σ of the median, σ from the noise model at that median.

    By a histogram of counts: counts that many pixels share are looked at once. `rows` and `columns` say
    which pixels of each cell are looked at, shape (cells, samples). NaN where nearly all are clipped.
    """
    means = np.empty((len(rows), len(columns)))
    count_of = np.zeros((len(columns), 1 << 16), dtype=np.uint16)
    lowest, highest = np.empty(len(columns), dtype=np.int64), np.empty(len(columns), dtype=np.int64)
    for down in range(len(rows)):
        lowest[:], highest[:] = 1 << 16, 0
        # Along whole rows of the frame, as they lie in memory.
        for row in rows[down]:
            for across in range(len(columns)):
                own, least, most = count_of[across], lowest[across], highest[across]
                for column in columns[across]:
                    count = int(data_dn[row, column])
                    own[count] += 1
                    least, most = min(least, count), max(most, count)
                lowest[across], highest[across] = least, most
        for across in range(len(columns)):
            seen, free = rows.shape[1] * columns.shape[1], min(highest[across], clipped_dn - 1)
            kept = seen
            for count in range(free + 1, highest[across] + 1):
                kept -= int(count_of[across, count])
            means[down, across] = math.nan
            if kept > _LEAST_FREE * seen:
                means[down, across] = _clipped_mean(
                    count_of[across], lowest[across], free, kept, black_dn, gain_dn_per_e, floor_e2
                )
            count_of[across, lowest[across] : highest[across] + 1] = 0
    return means


@compiled
def _clipped_mean(
    count_of: NDArray[np.uint16], lowest: int, highest: int, kept: int,
    black_dn: float, gain_dn_per_e: float, floor_e2: float,
) -> float:  # fmt: skip
    """Return the mean of counts of which there are so many of each, `kept` in all, from lowest to highest."""
    low, high = lowest, highest
    for clipping in range(CLIP_ROUNDS + 1):
        # The lower median is itself a sample, so at least it is always kept.
        median, before = low, int(count_of[low])
        while before < (kept - 1) // 2 + 1:
            median += 1
            before += int(count_of[median])
        if clipping == CLIP_ROUNDS:
            break
        sigma = gain_dn_per_e * math.sqrt(max((median - black_dn) / gain_dn_per_e, 0.0) + floor_e2)
        low = max(lowest, math.ceil(max(median - CLIP_SIGMA * sigma, 0.0)))
        high = min(highest, math.floor(min(median + CLIP_SIGMA * sigma, 65535.0)))
        kept = 0
        for count in range(low, high + 1):
            kept += int(count_of[count])
    total = 0
    for count in range(low, high + 1):
        total += count * int(count_of[count])
    return total / kept


@compiled
def cell_scatter(
    samples: NDArray[np.float32], noise_mesh: NDArray[np.float32], most_mesh: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return an image's scatter in each cell over its noise, blind to its outer thirds, where flares are.

    Of samples below `most_mesh` alone; 0 where these are less than half, beside something bright. By a
    histogram, to less than a hundredth of the noise; where it scatters too far for that, by sorting.
    `samples` has as many rows and columns for each cell, one cell's after another's.
    """
    scatter = np.empty(noise_mesh.shape, dtype=np.float32)
    tall, wide = samples.shape[0] // len(noise_mesh), samples.shape[1] // noise_mesh.shape[1]
    last = 2 * STEPS_PER_NOISE * MOST_NOISES + 1
    count_of = np.empty(last + 1, dtype=np.int32)
    for down in range(len(noise_mesh)):
        for across in range(noise_mesh.shape[1]):
            cell = samples[down * tall : (down + 1) * tall, across * wide : (across + 1) * wide]
            count_of[:] = 0
            per_unit, kept = np.float32(STEPS_PER_NOISE) / noise_mesh[down, across], 0
            for row in range(tall):
                for column in range(wide):
                    if cell[row, column] >= most_mesh[down, across]:
                        continue
                    kept += 1
                    place = cell[row, column] * per_unit + np.float32(0.5 * last)
                    count_of[int(min(max(np.float32(0.0), place), np.float32(last)))] += 1
            if not kept > _LEAST_FREE_OF_SCATTER * tall * wide:
                scatter[down, across] = 0.0
                continue
            low, high = round(0.1587 * (kept - 1)), round(0.8413 * (kept - 1))
            step, up_to = 0, count_of[0]
            while up_to <= low:
                step += 1
                up_to += count_of[step]
            first = step
            while up_to <= high:
                step += 1
                up_to += count_of[step]
            if first > 0 and step < last:
                scatter[down, across] = 0.5 * (step - first) / STEPS_PER_NOISE
            else:
                ordered = np.sort(cell.copy().ravel())  # what is left out is the end of it
                scatter[down, across] = 0.5 * (ordered[high] - ordered[low]) / noise_mesh[down, across]
    return scatter
