"""From a mask to blobs: connected components, and where one of them holds several flares."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import PixelBox

_MAX_PEAKS = 16


@dataclass(frozen=True, eq=False)
class Blob:
    """One flare's pixels: a box, and which pixels of it belong, shape (box.height, box.width)."""

    box: PixelBox
    pixels: NDArray[np.bool_]

    @property
    def area_px(self) -> int:
        """Number of pixels."""
        return int(self.pixels.sum())


def components(mask: NDArray[np.bool_], min_area_px: int = 1) -> list[Blob]:
    """Find connected components (8 neighbours) of at least a given area, by their first row.

    Only what is marked is looked at: in most frames that is next to nothing.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    places = np.flatnonzero(mask)
    if not len(places):
        return []
    width = mask.shape[1]
    rows, columns = np.divmod(places, width)
    pairs = []
    for step, across in ((1, 1), (width - 1, -1), (width, 0), (width + 1, 1)):
        beside = (columns + across >= 0) & (columns + across < width)
        one = np.flatnonzero(beside)
        other = np.searchsorted(places, places[one] + step)
        met = other < len(places)
        one, other = one[met], other[met]
        met = places[other] == places[one] + step
        pairs.append(np.stack([one[met], other[met]]))
    one, other = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(one), dtype=np.int8), (one, other)), shape=(len(places), len(places)))
    count, labels = connected_components(graph, directed=False)
    order = np.argsort(labels, kind="stable")
    ends = np.cumsum(np.bincount(labels, minlength=count))[:-1]
    blobs = []
    for members in np.split(order, ends):
        if len(members) < min_area_px:
            continue
        down, across_px = rows[members], columns[members]
        top, left = int(down.min()), int(across_px.min())
        pixels = np.zeros((int(down.max()) - top + 1, int(across_px.max()) - left + 1), dtype=bool)
        pixels[down - top, across_px - left] = True
        blobs.append(Blob(PixelBox(top, left, *pixels.shape), pixels))
    return blobs


def split_at_peaks(
    blob: Blob, brightness: NDArray[np.floating], noise: NDArray[np.floating], dip: float = 0.05
) -> list[Blob]:
    """Divide a blob among its distinct local maxima.

    Two maxima are distinct if the lowest saddle between them lies below the fainter one by more than 5 σ of
    noise and a fraction `dip` of its brightness: the plateau of a resolved or clipped disc has many maxima
    but no such saddle. Each pixel goes to the nearest maximum.

    Parameters
    ----------
    blob
        A connected component.
    brightness
        The filtered image within the blob's box, shape (box.height, box.width).
    noise
        Standard deviation of `brightness`, same shape.
    dip
        Least relative depth of a saddle.

    Returns
    -------
    The blob itself, or one blob for each maximum, brightest first.
    """
    import cv2

    inside = np.where(blob.pixels, brightness, -np.inf)
    widened = cv2.dilate(inside.astype(np.float32), np.ones((3, 3), dtype=np.uint8))
    maxima = (inside.astype(np.float32) >= widened) & blob.pixels
    # A plateau is one maximum: of each connected group, the brightest pixel stands for it.
    count, groups = cv2.connectedComponents(maxima.view(np.uint8), connectivity=8)
    if count <= 2:
        return [blob]
    places = [_brightest(inside, groups == group) for group in range(1, count)]
    places = sorted(places, key=lambda at: float(inside[at]), reverse=True)[:_MAX_PEAKS]
    peaks = places[:1]
    for place in places[1:]:
        height = float(inside[place])
        level = height - max(5.0 * float(noise[place]), dip * height)
        _, above = cv2.connectedComponents((inside > level).view(np.uint8), connectivity=8)
        if all(above[place] != above[peak] for peak in peaks):
            peaks.append(place)
    if len(peaks) == 1:
        return [blob]
    rows, columns = np.indices(blob.pixels.shape)
    distance2 = np.stack([(rows - row) ** 2 + (columns - column) ** 2 for row, column in peaks])
    nearest = distance2.argmin(axis=0)
    return [_trimmed(blob, blob.pixels & (nearest == peak)) for peak in range(len(peaks))]


def near_groups(blobs: Sequence[Blob], within_px: int) -> list[list[int]]:
    """Group blobs whose boxes come as near as that to each other, directly or by others between them.

    Returns
    -------
    Indices of each group's blobs, groups and blobs in the order given.
    """
    if not blobs:
        return []
    edges = np.array(
        [(b.box.top, b.box.left, b.box.top + b.box.height, b.box.left + b.box.width) for b in blobs]
    )
    low, high = edges[:, :2], edges[:, 2:]
    gap_px = np.maximum(low[:, None] - high[None], low[None] - high[:, None]).max(axis=-1)
    leader = np.arange(len(blobs))
    for first, second in np.argwhere(np.triu(gap_px <= within_px, 1)).tolist():
        one, other = sorted((int(leader[first]), int(leader[second])))
        leader[leader == other] = one
    return [np.flatnonzero(leader == each).tolist() for each in np.unique(leader)]


def divide(blobs: Sequence[Blob], u_px: NDArray[np.float64], v_px: NDArray[np.float64]) -> list[Blob]:
    """Divide the pixels of blobs among places, each to the nearest; a place that gets none has its own."""
    places = np.concatenate([np.argwhere(b.pixels) + np.array([b.box.top, b.box.left]) for b in blobs])
    nearest = np.argmin((places[:, :1] - v_px) ** 2 + (places[:, 1:] - u_px) ** 2, axis=1)
    divided = []
    for index in range(len(u_px)):
        mine = places[nearest == index]
        if not len(mine):
            mine = np.array([[round(float(v_px[index])), round(float(u_px[index]))]])
        top, left = mine.min(axis=0).tolist()
        height, width = (mine.max(axis=0) - (top, left) + 1).tolist()
        pixels = np.zeros((height, width), dtype=bool)
        pixels[mine[:, 0] - top, mine[:, 1] - left] = True
        divided.append(Blob(PixelBox(top, left, height, width), pixels))
    return divided


def _brightest(brightness: NDArray[np.floating], mask: NDArray[np.bool_]) -> tuple[int, int]:
    row, column = np.unravel_index(int(np.argmax(np.where(mask, brightness, -np.inf))), mask.shape)
    return int(row), int(column)


def _trimmed(blob: Blob, pixels: NDArray[np.bool_]) -> Blob:
    """Cut out the part of a blob that `pixels` marks, in a box of its own."""
    rows, columns = np.flatnonzero(pixels.any(axis=1)), np.flatnonzero(pixels.any(axis=0))
    top, left = int(rows[0]), int(columns[0])
    height, width = int(rows[-1]) - top + 1, int(columns[-1]) - left + 1
    box = PixelBox(blob.box.top + top, blob.box.left + left, height, width)
    return Blob(box, pixels[top : top + height, left : left + width])
