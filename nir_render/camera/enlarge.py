"""Light that was rendered in blocks of pixels, enlarged to the sensor without smearing it across edges.

Where the blocks around a pixel all show its own surface, light is interpolated linearly between their
centres. Beside an edge a plane is fitted (weighted least squares) to the blocks near by that show this
surface alone: blocks that an edge cuts hold averages over several surfaces and are left out. A pixel that an
edge cuts has its share of each surface. All of it is linear in the light, with weights of geometry alone.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, diags_array

Array = NDArray[np.float64]

_REACH = 2  # blocks on each side from which a plane is fitted
_KERNEL_BLOCKS = 1.4  # σ of the Gaussian weights of that fit
_RIDGE = 0.03  # σ² in squared blocks that stands against a slope: what few blocks say of it counts less
_MOST_NOISE = 2.0  # variance that a fitted pixel may have, in variances of a block
_FAR_OFF = 0.15  # how much nearer or farther a pixel may be than the blocks that tell of it
_GOLDEN = 0.5 * (5.0**0.5 - 1.0)
_PATCH_SHARE = 0.05  # of all pixels, at most, are rendered one by one


@dataclass(frozen=True, eq=False)
class Labels:
    """Which surface each pixel shows.

    Attributes
    ----------
    middle
        Label in the middle of each pixel, 0 where nothing is, shape (rows, columns).
    edge
        Numbers of the pixels that lie beside a pixel of another label, row by row, shape (n,).
    within
        Labels at places spread evenly over each of these, shape (n, places).
    nearness_per_m
        One over the distance of what is in the middle of each pixel, 0 where nothing is, as `middle`.
    shining
        Whether a lamp is seen there, by label.
    """

    middle: NDArray[np.int32]
    edge: NDArray[np.int64]
    within: NDArray[np.int32]
    nearness_per_m: NDArray[np.float32]
    shining: NDArray[np.bool_]


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
        Numbers of the pixels that no block tells of well enough, or that the edge of a lamp cuts, shape (p,):
        they are rendered one by one.
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
    values: Array, rows: int, columns: int, how: Enlargement | None = None, patch: Array | None = None
) -> Array:
    """Return an image at the size of the sensor.

    Parameters
    ----------
    values
        Means over blocks, shape (rows / scale, columns / scale).
    how
        Without, values are linear between the centres of blocks everywhere.
    patch
        The values of `how.patch`, shape (p,).
    """
    if values.shape == (rows, columns):
        return values
    image: Array = np.asarray(
        cv2.resize(values, (columns, rows), interpolation=cv2.INTER_LINEAR), dtype=np.float64
    )
    if how is not None:
        image.ravel()[how.pixels] = how.matrix(values.size) @ values.ravel()
        if patch is not None:
            image.ravel()[how.patch] = patch
    return image


def enlarge_variance(
    variance: Array, rows: int, columns: int, how: Enlargement | None = None, patch: Array | None = None
) -> Array:
    """Return the variance of each pixel of an enlarged image of independent blocks.

    Parameters
    ----------
    variance, patch
        Of the blocks and of the patch's pixels.
    """
    if variance.shape == (rows, columns):
        return variance
    sides = zip((rows, columns), variance.shape, strict=True)
    down, across = (_linear(np.arange(count), count, blocks) for count, blocks in sides)
    taller = down.multiply(down) @ variance
    image: Array = np.ascontiguousarray((across.multiply(across) @ taller.T).T)
    if how is not None:
        weights = how.matrix(variance.size)
        image.ravel()[how.pixels] = weights.multiply(weights) @ variance.ravel()
        if patch is not None:
            image.ravel()[how.patch] = patch
    return image


def without_edges(rows: int, columns: int) -> Enlargement:
    """Return the enlargement that is linear between the centres of blocks everywhere."""
    none, whole = np.empty(0, dtype=np.int32), np.zeros(1, dtype=np.int32)
    return Enlargement(rows, columns, none, whole, none, np.empty(0, dtype=np.float32), none)


def part_of(how: Enlargement, pixels: NDArray[np.int64]) -> Enlargement:
    """Return what an enlargement says of some pixels; all others are as if no edge were near."""
    kept = np.isin(how.pixels, pixels)
    count = np.diff(how.first)
    entries = np.repeat(kept, count)
    return replace(
        how,
        pixels=how.pixels[kept],
        first=np.append(0, np.cumsum(count[kept])).astype(np.int32),
        block=how.block[entries],
        weight=how.weight[entries],
        patch=how.patch[np.isin(how.patch, pixels)],
    )


def weights_of(pixels: NDArray[np.int64], scale: int, how: Enlargement) -> csr_array:
    """Return what each block weighs in some pixels that no patch holds, shape (pixels, blocks)."""
    blocks = (how.rows // scale, how.columns // scale)
    row, column = np.divmod(pixels, how.columns)
    down, across = _linear(row, how.rows, blocks[0]), _linear(column, how.columns, blocks[1])
    block = down.indices.reshape(-1, 2, 1) * blocks[1] + across.indices.reshape(-1, 1, 2)
    weight = down.data.reshape(-1, 2, 1) * across.data.reshape(-1, 1, 2)
    first = 4 * np.arange(len(pixels) + 1)
    found = csr_array((weight.ravel(), block.ravel(), first), shape=(len(pixels), blocks[0] * blocks[1]))
    if not len(how.pixels):
        return found
    place = np.minimum(np.searchsorted(how.pixels, pixels), len(how.pixels) - 1)
    fitted = how.pixels[place] == pixels
    take = csr_array((fitted * 1.0, place, np.arange(len(pixels) + 1)), shape=(len(pixels), len(how.pixels)))
    return csr_array(diags_array((~fitted) * 1.0) @ found + take @ how.matrix(found.shape[1]))


def _linear(at: NDArray[np.int64], count: int, blocks: int) -> csr_array:
    """Return what blocks along an axis of so many pixels weigh in some of these, two each, (n, blocks)."""
    place = np.clip((at + 0.5) * (blocks / count) - 0.5, 0.0, blocks - 1.0)
    low = np.minimum(place.astype(np.int64), max(blocks - 2, 0))
    block = np.stack([low, np.minimum(low + 1, blocks - 1)], axis=1)
    weight = np.stack([1.0 - (place - low), place - low], axis=1)
    return csr_array((weight.ravel(), block.ravel(), 2 * np.arange(len(at) + 1)), shape=(len(at), blocks))


def enlargement(labels: Labels, scale: int) -> Enlargement:
    """Return how light in blocks of scale × scale pixels is enlarged, where these pixels have labels."""
    rows, columns = labels.middle.shape
    pure = _pure(labels, scale)
    rough = np.flatnonzero(~_between_equals(pure, rows, columns, scale))
    pixel, label, share = _parts(labels, rough)
    block, weight, found = _fit(pure, pixel, label, scale, columns)
    found &= (weight**2).sum(axis=1) < _MOST_NOISE
    found &= ~_foreshortened(labels, scale, block, weight)
    cut, lone = _chosen(pixel, labels.shining[label], ~found, rows * columns)
    patch = np.concatenate(_rendered(cut, lone, int(_PATCH_SHARE * rows * columns)))
    kept = ~np.isin(pixel, np.concatenate([patch, lone]))
    part, place = np.nonzero((weight != 0.0) & kept[:, None])
    pixels, first = np.unique(pixel[part], return_index=True)
    return Enlargement(
        rows=rows,
        columns=columns,
        pixels=pixels.astype(np.int32),
        first=np.append(first, len(part)).astype(np.int32),
        block=block[part, place].astype(np.int32),
        weight=(weight[part, place] * share[part]).astype(np.float32),
        patch=np.sort(patch).astype(np.int32),
        left_out=len(cut) + len(lone) - len(patch),
    )


def _rendered(
    cut: NDArray[np.int64], lone: NDArray[np.int64], most: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return which of the pixels that lamps' edges cut, first, and of the others are rendered one by one.

    Where not all can be they are taken evenly from the list, and so from all parts of the frame.
    """
    cut = _evenly(cut, most)
    return cut, _evenly(lone, most - len(cut))


def _evenly(pixels: NDArray[np.int64], most: int) -> NDArray[np.int64]:
    """Return at most so many of a list; multiples of the golden section are even and fit no pattern."""
    order = np.argsort(np.arange(len(pixels)) * _GOLDEN % 1.0, kind="stable")
    return pixels[np.sort(order[:most])]


def _pure(labels: Labels, scale: int) -> NDArray[np.int32]:
    """Return the label of each block that shows one surface alone, −1 for others."""
    rows, columns = labels.middle.shape
    in_blocks = labels.middle.reshape(rows // scale, scale, columns // scale, scale)
    label = in_blocks[:, 0, :, 0].copy()
    mixed = (in_blocks != label[:, None, :, None]).any(axis=(1, 3))
    row, column = np.divmod(labels.edge, columns)
    row, column = row // scale, column // scale
    cut = (labels.within != label[row, column][:, None]).any(axis=1)
    mixed[row[cut], column[cut]] = True
    label[mixed] = -1
    return label


def _between_equals(pure: NDArray[np.int32], rows: int, columns: int, scale: int) -> NDArray[np.bool_]:
    """Tell which pixels have four pure blocks of one label around them, shape (rows, columns)."""
    padded = np.pad(pure, 1, mode="edge")
    corner = padded[:-1, :-1]
    equal = corner >= 0
    for other in (padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]):
        equal &= corner == other
    row, column = ((np.arange(count) + 0.5 + 0.5 * scale) // scale for count in (rows, columns))
    return np.asarray(equal[np.ix_(row.astype(np.int64), column.astype(np.int64))])


def _parts(
    labels: Labels, pixels: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float64]]:
    """Return the surfaces in pixels: pixel, rising, label, and share of the pixel, shape (parts,)."""
    edge = np.isin(labels.edge, pixels, assume_unique=True)
    whole = np.setdiff1d(pixels, labels.edge, assume_unique=True)
    within = np.sort(labels.within[edge], axis=1)
    places = within.shape[1]
    begins = np.ones(within.shape, dtype=bool)
    begins[:, 1:] = within[:, 1:] != within[:, :-1]
    row, place = np.nonzero(begins)
    ends = np.append(np.flatnonzero(begins.ravel())[1:], within.size)
    share = (ends - (row * places + place)) / places
    pixel = np.concatenate([whole, labels.edge[edge][row]])
    label = np.concatenate([labels.middle.ravel()[whole], within[row, place]])
    order = np.argsort(pixel, kind="stable")
    return pixel[order], label[order], np.concatenate([np.ones(len(whole)), share])[order]


def _fit(
    pure: NDArray[np.int32], pixel: NDArray[np.int64], label: NDArray[np.int32], scale: int, columns: int
) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Return blocks around parts of pixels, their weights, shape (parts, blocks), and which parts have any.

    The weights give the value at the pixel of the plane a + b x + c y that fits the blocks of the part's
    label best, each block counted by a Gaussian of its distance; b and c are held towards 0 (ridge
    regression), so that a single block is continued flat.
    """
    row, column = ((at + 0.5) / scale - 0.5 for at in np.divmod(pixel, columns))
    steps = np.arange(-_REACH, _REACH + 1)
    down, across = (steps.repeat(len(steps)), np.tile(steps, len(steps)))
    block_row = np.rint(row).astype(np.int64)[:, None] + down
    block_column = np.rint(column).astype(np.int64)[:, None] + across
    inside = (block_row >= 0) & (block_row < pure.shape[0])
    inside &= (block_column >= 0) & (block_column < pure.shape[1])
    y, x = block_row - row[:, None], block_column - column[:, None]
    block = np.where(inside, block_row * pure.shape[1] + block_column, 0)
    own = inside & (pure.ravel()[block] == label[:, None])
    kernel = np.where(own, np.exp(-0.5 * (x**2 + y**2) / _KERNEL_BLOCKS**2), 0.0)
    found = own.any(axis=1)
    kernel[found] /= kernel[found].sum(axis=1, keepdims=True)
    mean_x, mean_y = (kernel * x).sum(axis=1), (kernel * y).sum(axis=1)
    x, y = x - mean_x[:, None], y - mean_y[:, None]
    xx = (kernel * x * x).sum(axis=1) + _RIDGE
    yy = (kernel * y * y).sum(axis=1) + _RIDGE
    xy = (kernel * x * y).sum(axis=1)
    # The value at the pixel, x = y = 0: the mean of the blocks, and from there along the slopes.
    determinant = xx * yy - xy**2
    along_x, along_y = (yy * mean_x - xy * mean_y) / determinant, (xx * mean_y - xy * mean_x) / determinant
    return block, kernel * (1.0 - along_x[:, None] * x - along_y[:, None] * y), found


def _foreshortened(labels: Labels, scale: int, block: NDArray[np.int64], weight: Array) -> NDArray[np.bool_]:
    """Tell which parts are too far off their blocks, for all that these are close in the image.

    One over the distance of a flat surface is linear in the image, so a fitted plane is right for it. Where
    it differs much from that of the blocks, light on the surface may change much between them.
    """
    nearness = labels.nearness_per_m
    near = nearness.reshape(nearness.shape[0] // scale, scale, -1, scale).mean(axis=(1, 3)).ravel()[block]
    share = np.abs(weight)
    mean = (share * near).sum(axis=1) / np.maximum(share.sum(axis=1), 1e-30)
    return np.asarray(np.abs((weight * near).sum(axis=1) - mean) > _FAR_OFF * mean)


def _chosen(
    pixel: NDArray[np.int64], shining: NDArray[np.bool_], lost: NDArray[np.bool_], count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the pixels that the edge of a lamp cuts, and others of which no block tells something."""
    marks = np.zeros((3, count), dtype=bool)
    for mark, parts in zip(marks, (shining, ~shining, lost), strict=True):
        mark[pixel[parts]] = True
    cut = marks[0] & marks[1]
    return np.flatnonzero(cut), np.flatnonzero(marks[2] & ~cut)
