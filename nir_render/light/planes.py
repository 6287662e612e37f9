"""Planes fitted to blocks of pixels: what blocks of one surface around a place weigh in the value there."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled

Array = NDArray[np.float64]

REACH = 2
"""Blocks on each side from which a plane is fitted."""

_KERNEL_BLOCKS = 1.4  # σ of the Gaussian weights of the fit
_RIDGE = 0.03  # σ² in squared blocks that stands against a slope: what few blocks say of it counts less


@compiled
def fit_planes(
    pure: NDArray[np.int32], pixel: NDArray[np.int64], label: NDArray[np.int32], scale: int, columns: int
) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Return blocks around pixels, their weights, shape (pixels, blocks), and which pixels have any.

    The weights give the value at the pixel of the plane a + b x + c y that fits the blocks of its label best,
    each block counted by a Gaussian of its distance; b and c are held towards 0 (ridge regression), so that a
    single block is continued flat.

    Parameters
    ----------
    pure
        Label of each block, −1 for blocks that tell of none, shape (rows, columns).
    pixel, label
        Number of each pixel, row by row, and the label that is asked for there, shape (pixels,).
    scale
        Pixels per block, along each axis.
    columns
        Of pixels.
    """
    side = 2 * REACH + 1
    block = np.zeros((len(pixel), side * side), dtype=np.int64)
    weight, found = np.zeros(block.shape), np.zeros(len(pixel), dtype=np.bool_)
    x, y, kernel = np.empty(side * side), np.empty(side * side), np.empty(side * side)
    for part in range(len(pixel)):
        row, column = (
            (pixel[part] // columns + 0.5) / scale - 0.5,
            (pixel[part] % columns + 0.5) / scale - 0.5,
        )
        top, left = int(np.rint(row)) - REACH, int(np.rint(column)) - REACH
        total, mean_x, mean_y = 0.0, 0.0, 0.0
        for one in range(side * side):
            block_row, block_column = top + one // side, left + one % side
            y[one], x[one], kernel[one] = block_row - row, block_column - column, 0.0
            if not (0 <= block_row < pure.shape[0] and 0 <= block_column < pure.shape[1]):
                continue
            block[part, one] = block_row * pure.shape[1] + block_column
            if pure[block_row, block_column] == label[part]:
                kernel[one] = math.exp(-0.5 * (x[one] ** 2 + y[one] ** 2) / _KERNEL_BLOCKS**2)
                total += kernel[one]
        if total == 0.0:
            continue
        found[part] = True
        for one in range(side * side):
            kernel[one] /= total
            mean_x += kernel[one] * x[one]
            mean_y += kernel[one] * y[one]
        xx, yy, xy = _RIDGE, _RIDGE, 0.0
        for one in range(side * side):
            x[one], y[one] = x[one] - mean_x, y[one] - mean_y
            xx += kernel[one] * x[one] * x[one]
            yy += kernel[one] * y[one] * y[one]
            xy += kernel[one] * x[one] * y[one]
        # The value at the pixel, x = y = 0: the mean of the blocks, and from there along the slopes.
        determinant = xx * yy - xy**2
        along_x = (yy * mean_x - xy * mean_y) / determinant
        along_y = (xx * mean_y - xy * mean_x) / determinant
        for one in range(side * side):
            weight[part, one] = kernel[one] * (1.0 - along_x * x[one] - along_y * y[one])
    return block, weight, found
