"""Light that was rendered in blocks of pixels, enlarged to the sensor without smearing it across edges.

Light is interpolated linearly between the centres of blocks, but for the pixels near edges, which an
`Enlargement` lists: each of these is a weighted sum of blocks that show its own surfaces, or was rendered by
itself. All of it is linear in the light. The weights are made where the geometry is known, in
`transport.indirect.enlargement`.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array

from nir_render.light.averages import BlockVariance
from perception.compiled import compiled

Array = NDArray[np.float64]

ALL_ROWS = slice(None)


@dataclass(frozen=True, eq=False)
class Enlargement:
    """How an image of blocks becomes one of pixels.

    Attributes
    ----------
    rows, columns
        Of the sensor.
    pixels
        Numbers of the pixels, row by row, that are not interpolated from the four blocks around, shape (n,).
    first
        Where the weights of each of these begin; one more at the end, shape (n + 1,).
    block, weight
        Numbers of blocks, and what they weigh, shape (m,).
    patch
        Numbers of the pixels that no block tells of well enough, or that the edge of a lamp cuts, or that lie
        in a flare's halo sharper than blocks, or show what is close to a source, shape (p,): they are
        rendered one by one.
    left_out
        How many more of these there are than may be rendered one by one: they are interpolated.
    """

    rows: int
    columns: int
    pixels: NDArray[np.int32]
    first: NDArray[np.int32]
    block: NDArray[np.int32]
    weight: NDArray[np.float32]
    patch: NDArray[np.int32]
    left_out: int = 0

    def matrix(self, blocks: int) -> csr_array:
        """Return the weights as a sparse matrix, shape (n, blocks)."""
        return csr_array((self.weight, self.block, self.first), shape=(len(self.pixels), blocks))


def enlarge(
    values: Array, rows: int, columns: int, enlargement: Enlargement | None = None, patch: Array | None = None
) -> Array:
    """Return an image at the size of the sensor.

    Parameters
    ----------
    values
        Means over blocks, shape (rows / scale, columns / scale).
    enlargement
        Without, values are linear between the centres of blocks everywhere.
    patch
        The values of `enlargement.patch`, shape (p,).
    """
    if values.shape == (rows, columns):
        return values
    image: Array = np.asarray(
        cv2.resize(values, (columns, rows), interpolation=cv2.INTER_LINEAR), dtype=np.float64
    )
    if enlargement is not None:
        image.ravel()[enlargement.pixels] = enlargement.matrix(values.size) @ values.ravel()
        if patch is not None:
            image.ravel()[enlargement.patch] = patch
    return image


def enlarge_variance(
    variance: BlockVariance,
    rows: int,
    columns: int,
    enlargement: Enlargement | None = None,
    patch: Array | None = None,
    chosen: slice = ALL_ROWS,
) -> Array:
    """Return the variance of each pixel of an enlarged image.

    Parameters
    ----------
    variance, patch
        Of the blocks and of the patch's pixels.
    chosen
        Which rows of the image are wanted.
    """
    of_blocks = variance.whole.shape
    if of_blocks == (rows, columns):
        return variance.of_blocks()[chosen]
    row = np.arange(rows)[chosen]
    down = _linear(row, rows, of_blocks[0])
    across = _linear(np.arange(columns), columns, of_blocks[1])
    places = [axis.indices.reshape(-1, 2) for axis in (down, across)]
    shares = [np.asarray(axis.data).reshape(-1, 2) for axis in (down, across)]
    neighbours = variance.of_neighbours()
    if neighbours is None:
        whole = np.ascontiguousarray(variance.whole, dtype=np.float64)
        image = _of_pairs(whole, places[0], shares[0] ** 2, places[1], shares[1] ** 2)
    else:
        image = _of_fours(neighbours, places[0], shares[0], places[1], shares[1])
    if enlargement is not None:
        blocks = of_blocks[0] * of_blocks[1]
        weights, pixels, patched = enlargement.matrix(blocks), enlargement.pixels, enlargement.patch
        if len(row) < rows:
            fitted, pixels = _in_rows(pixels, columns, row, rows)
            rendered, patched = _in_rows(patched, columns, row, rows)
            weights, patch = weights[fitted], None if patch is None else patch[rendered]
        image.ravel()[pixels] = variance.of_sums(weights)
        if patch is not None:
            image.ravel()[patched] = patch
    return image


def _in_rows(
    pixels: NDArray[np.int32], columns: int, chosen: NDArray[np.int64], rows: int
) -> tuple[NDArray[np.bool_], NDArray[np.int32]]:
    """Return which pixels lie in the chosen rows, and their numbers in the image of these rows."""
    place = np.full(rows, -1, dtype=np.int32)
    place[chosen] = np.arange(len(chosen))
    row, column = np.divmod(pixels, columns)
    kept = place[row] >= 0
    return kept, place[row[kept]] * columns + column[kept]


@compiled
def _of_pairs(
    values: Array, row: NDArray[np.int32], row_weight: Array, column: NDArray[np.int32], column_weight: Array
) -> Array:
    """Return for each pixel the weighted sum of two rows and two columns, shape (rows, columns)."""
    image, line = np.empty((len(row), len(column))), np.empty(values.shape[1])
    for at in range(len(row)):
        first, second = values[row[at, 0]], values[row[at, 1]]
        for block in range(len(line)):
            line[block] = row_weight[at, 0] * first[block] + row_weight[at, 1] * second[block]
        for pixel in range(len(column)):
            one, other = line[column[pixel, 0]], line[column[pixel, 1]]
            image[at, pixel] = column_weight[pixel, 0] * one + column_weight[pixel, 1] * other
    return image


@compiled
def _of_fours(
    neighbours: Array,
    row: NDArray[np.int32],
    row_weight: Array,
    column: NDArray[np.int32],
    column_weight: Array,
) -> Array:
    """Return for each pixel the variance of the weighted sum of its four blocks, shape (rows, columns).

    `neighbours` are the blocks' covariances (`BlockVariance.of_neighbours`).
    """
    image = np.empty((len(row), len(column)))
    own, right, below, below_right, below_left = neighbours
    for at in range(len(row)):
        top, bottom = row[at]
        for pixel in range(len(column)):
            left, beside = column[pixel]
            a, b = row_weight[at, 0] * column_weight[pixel, 0], row_weight[at, 0] * column_weight[pixel, 1]
            c, d = row_weight[at, 1] * column_weight[pixel, 0], row_weight[at, 1] * column_weight[pixel, 1]
            total = a * a * own[top, left] + b * b * own[top, beside]
            total += c * c * own[bottom, left] + d * d * own[bottom, beside]
            total += 2.0 * (a * b * right[top, left] + c * d * right[bottom, left])
            total += 2.0 * (a * c * below[top, left] + b * d * below[top, beside])
            total += 2.0 * (a * d * below_right[top, left] + b * c * below_left[top, beside])
            image[at, pixel] = total
    return image


def without_edges(rows: int, columns: int) -> Enlargement:
    """Return the enlargement that is linear between the centres of blocks everywhere."""
    none, whole = np.empty(0, dtype=np.int32), np.zeros(1, dtype=np.int32)
    return Enlargement(rows, columns, none, whole, none, np.empty(0, dtype=np.float32), none)


def part_of(enlargement: Enlargement, pixels: NDArray[np.int64]) -> Enlargement:
    """Return what an enlargement says of some pixels; all others are as if no edge were near."""
    kept = np.isin(enlargement.pixels, pixels)
    count = np.diff(enlargement.first)
    entries = np.repeat(kept, count)
    return replace(
        enlargement,
        pixels=enlargement.pixels[kept],
        first=np.append(0, np.cumsum(count[kept])).astype(np.int32),
        block=enlargement.block[entries],
        weight=enlargement.weight[entries],
        patch=enlargement.patch[np.isin(enlargement.patch, pixels)],
    )


def with_patch(enlargement: Enlargement, pixels: NDArray[np.int64]) -> Enlargement:
    """Return an enlargement in which some more pixels are rendered one by one."""
    patch = np.union1d(enlargement.patch, pixels)
    others = part_of(enlargement, np.setdiff1d(enlargement.pixels, patch))
    return replace(others, patch=patch.astype(np.int32))


def weights_of(pixels: NDArray[np.int64], scale: int, enlargement: Enlargement) -> csr_array:
    """Return what each block weighs in some pixels that no patch holds, shape (pixels, blocks)."""
    blocks = (enlargement.rows // scale, enlargement.columns // scale)
    row, column = np.divmod(pixels, enlargement.columns)
    down, across = _linear(row, enlargement.rows, blocks[0]), _linear(column, enlargement.columns, blocks[1])
    block = down.indices.reshape(-1, 2, 1) * blocks[1] + across.indices.reshape(-1, 1, 2)
    weight = down.data.reshape(-1, 2, 1) * across.data.reshape(-1, 1, 2)
    first = 4 * np.arange(len(pixels) + 1)
    found = csr_array((weight.ravel(), block.ravel(), first), shape=(len(pixels), blocks[0] * blocks[1]))
    if not len(enlargement.pixels):
        return found
    listed = enlargement.pixels
    place = np.minimum(np.searchsorted(listed, pixels), len(listed) - 1)
    fitted = listed[place] == pixels
    take = csr_array((fitted * 1.0, place, np.arange(len(pixels) + 1)), shape=(len(pixels), len(listed)))
    return csr_array(diags_array((~fitted) * 1.0) @ found + take @ enlargement.matrix(found.shape[1]))


def _linear(at: NDArray[np.int64], count: int, blocks: int) -> csr_array:
    """Return what blocks along an axis of so many pixels weigh in some of these, two each, (n, blocks)."""
    place = np.clip((at + 0.5) * (blocks / count) - 0.5, 0.0, blocks - 1.0)
    low = np.minimum(place.astype(np.int64), max(blocks - 2, 0))
    block = np.stack([low, np.minimum(low + 1, blocks - 1)], axis=1)
    weight = np.stack([1.0 - (place - low), place - low], axis=1)
    return csr_array((weight.ravel(), block.ravel(), 2 * np.arange(len(at) + 1)), shape=(len(at), blocks))
