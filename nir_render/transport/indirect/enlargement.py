"""How light in blocks of pixels is to be enlarged, made from what the camera sees where.

Where the blocks around a pixel all show its own surface, light is interpolated linearly between their
centres. Beside an edge a plane is fitted (weighted least squares) to the blocks near by that show this
surface alone: blocks that an edge cuts hold averages over several surfaces and are left out. A pixel that an
edge cuts has its share of each surface. All of it is linear in the light, with weights of geometry alone;
`light.enlarge` applies them.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.light.enlarge import Enlargement
from nir_render.light.planes import fit_planes

Array = NDArray[np.float64]

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
    even
        Whether it is a flat matt surface of one reflectance, or nothing at all, by label.
    """

    middle: NDArray[np.int32]
    edge: NDArray[np.int64]
    within: NDArray[np.int32]
    nearness_per_m: NDArray[np.float32]
    shining: NDArray[np.bool_]
    even: NDArray[np.bool_]


def fit_enlargement(labels: Labels, scale: int) -> Enlargement:
    """Return how light in blocks of scale × scale pixels is enlarged, where these pixels have labels."""
    rows, columns = labels.middle.shape
    pure = labels_of_blocks(labels, scale)
    rough = np.flatnonzero(~_between_equals(pure, rows, columns, scale))
    pixel, label, share = _parts(labels, rough)
    block, weight, found = fit_planes(pure, pixel, label, scale, columns)
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


def labels_of_blocks(labels: Labels, scale: int) -> NDArray[np.int32]:
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
    for neighbour in (padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]):
        equal &= corner == neighbour
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
