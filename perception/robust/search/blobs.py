"""From a mask to blobs: connected components, and where one of them holds several flares."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.flare import PixelBox

MAX_IMAGE_RADIUS_PX = 28.0
"""Sources that look larger are fitted as they are, or not at all: looking for what may hide them is dear."""

MOST_PEAKS = 16
"""Of one blob so many maxima are told apart at most."""


@dataclass(frozen=True, eq=False)
class Blob:
    """One flare's pixels: a box, and which pixels of it belong, shape (box.height, box.width).

    `filtered_e`, of the same shape, is the filtered image there, 0 elsewhere; empty if only a mask is known.
    """

    box: PixelBox
    pixels: NDArray[np.bool_]
    filtered_e: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 0), dtype=np.float32))

    @cached_property
    def peak_e(self) -> float:
        """Maximum of the filtered image in the blob."""
        return float(self.filtered_e[self.pixels].max())

    @property
    def bright_half(self) -> NDArray[np.bool_]:
        """Which of its pixels are brighter than half of its maximum, in its box."""
        return np.asarray(self.filtered_e > 0.5 * self.peak_e)

    @cached_property
    def area_px(self) -> int:
        """Number of pixels."""
        return int(np.count_nonzero(self.pixels))

    def places(self, width: int) -> NDArray[np.int64]:
        """Return its pixels as indices in a frame of so many columns, in order."""
        return _places(self.pixels, self.box.top, self.box.left, width)


def half_axes_px(mask: NDArray[np.bool_]) -> tuple[float, float]:
    """Return half of the shorter and of the longer axis of an ellipse that fills a mask.

    Along each an ellipse scatters by the square of half of that axis, over four.
    """
    across, down, both = _scatter(mask)
    mean, half = 0.5 * (across + down), math.hypot(0.5 * (across - down), both)
    return 2.0 * math.sqrt(max(mean - half, 0.0)), 2.0 * math.sqrt(mean + half)


@compiled
def _scatter(mask: NDArray[np.bool_]) -> tuple[float, float, float]:
    """Return the variances of the columns and of the rows of a mask's pixels, and their covariance."""
    count, u, v, uu, vv, uv = 0, 0, 0, 0, 0, 0
    for row in range(mask.shape[0]):
        for column in range(mask.shape[1]):
            if mask[row, column]:
                count, u, v = count + 1, u + column, v + row
                uu, vv, uv = uu + column * column, vv + row * row, uv + column * row
    # Whole numbers: nothing is lost in the differences.
    scale = max(count * (count - 1), 1)
    return (count * uu - u * u) / scale, (count * vv - v * v) / scale, (count * uv - u * v) / scale


@compiled
def _places(mask: NDArray[np.bool_], top: int, left: int, width: int) -> NDArray[np.int64]:
    """Return the pixels of a mask, which begins in such a row and column, as indices in a frame, in order."""
    places, count = np.empty(mask.size, dtype=np.int64), 0
    for row in range(mask.shape[0]):
        for column in range(mask.shape[1]):
            if mask[row, column]:
                places[count] = (top + row) * width + left + column
                count += 1
    return places[:count].copy()


def is_large(blob: Blob) -> bool:
    """Tell whether a blob is longer than what is fitted: three radii."""
    return max(blob.box.height, blob.box.width) > 3.0 * MAX_IMAGE_RADIUS_PX


def components(mask: NDArray[np.bool_], min_area_px: int = 1) -> list[Blob]:
    """Find connected components (8 neighbours) of at least a given area, by their first row."""
    places = np.flatnonzero(mask)
    found = blobs_at(places, np.ones(len(places), dtype=np.float32), mask.shape[1])
    return [blob for blob in found if blob.area_px >= min_area_px]


def blobs_at(places: NDArray[np.int64], filtered_e: NDArray[np.float32], width: int) -> list[Blob]:
    """Find connected components (8 neighbours) of pixels, given as their indices in a frame, in order.

    `filtered_e` is the filtered image at these places, `width` the frame's. Only what is marked is looked at:
    in most frames that is next to nothing.
    """
    labels, boxes = _labelled(places, width)
    first, pixels, image_e = _in_boxes(places, filtered_e, width, labels, boxes)
    return [
        Blob(
            PixelBox(top, left, bottom - top, right - left),
            pixels[begin:end].reshape(bottom - top, right - left),
            image_e[begin:end].reshape(bottom - top, right - left),
        )
        for (top, left, bottom, right), begin, end in zip(
            boxes.tolist(), first[:-1].tolist(), first[1:].tolist(), strict=True
        )
    ]


@compiled
def _in_boxes(
    places: NDArray[np.int64], values: NDArray[np.float32], width: int, labels: NDArray[np.int64],
    boxes: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.float32]]:  # fmt: skip
    """Return where each component begins in what follows: its mask and its values, in its box, row by row."""
    first = np.zeros(len(boxes) + 1, dtype=np.int64)
    for label in range(len(boxes)):
        top, left, bottom, right = boxes[label]
        first[label + 1] = first[label] + (bottom - top) * (right - left)
    pixels, image = np.zeros(first[-1], dtype=np.bool_), np.zeros(first[-1], dtype=np.float32)
    for at in range(len(places)):
        top, left, _, right = boxes[labels[at]]
        row = places[at] // width
        here = first[labels[at]] + (row - top) * (right - left) + places[at] - row * width - left
        pixels[here], image[here] = True, values[at]
    return first, pixels, image


@compiled
def _labelled(places: NDArray[np.int64], width: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Give numbers to the connected components of pixels, from the first on.

    Returns the number of each pixel, and each component's first and end row and column, as (top, left,
    bottom, right), shape (components, 4).
    """
    leader, rows = np.arange(len(places)), places // width
    above = 0
    for at in range(len(places)):
        place, row = places[at], rows[at]
        if at > 0 and places[at - 1] == place - 1 and rows[at - 1] == row:
            _join(leader, at - 1, at)
        # Those of the row above that touch: from the one to the left to the one to the right.
        first = max(place - width - 1, (row - 1) * width)
        last = min(place - width + 1, row * width - 1)
        while places[above] < first:
            above += 1
        near = above
        while near < at and places[near] <= last:
            _join(leader, near, at)
            near += 1
    labels, count = np.empty(len(places), dtype=np.int64), 0
    for at in range(len(places)):
        first = _leader(leader, at)
        if first == at:
            labels[at] = count
            count += 1
        else:
            labels[at] = labels[first]
    boxes = np.empty((count, 4), dtype=np.int64)
    boxes[:, :2], boxes[:, 2:] = np.iinfo(np.int64).max, 0
    for at in range(len(places)):
        row, column, box = rows[at], places[at] - rows[at] * width, boxes[labels[at]]
        box[0], box[1] = min(box[0], row), min(box[1], column)
        box[2], box[3] = max(box[2], row + 1), max(box[3], column + 1)
    return labels, boxes


@compiled
def _leader(leader: NDArray[np.int64], at: int) -> int:
    """Return the first pixel of the component that a pixel has been joined to."""
    while leader[at] != at:
        leader[at] = leader[leader[at]]
        at = leader[at]
    return at


@compiled
def _join(leader: NDArray[np.int64], one: int, other: int) -> None:
    """Join the components of two pixels; the pixel that comes first leads."""
    one, other = _leader(leader, one), _leader(leader, other)
    leader[max(one, other)] = min(one, other)


def split_at_peaks(
    blob: Blob,
    noise: NDArray[np.float32],
    dip: float = 0.05,
    flat: NDArray[np.bool_] | None = None,
    most_e: float = math.inf,
) -> list[Blob]:
    """Divide a blob among its distinct local maxima.

    Two maxima are distinct if the lowest saddle between them lies below the fainter one by more than 5 σ of
    noise and a fraction `dip` of its brightness: the plateau of a resolved or clipped disc has many maxima
    but no such saddle. Each pixel goes to the nearest maximum, or to what is flat in one piece with it, as
    the maximum may be anywhere on that.

    Parameters
    ----------
    blob
        A connected component.
    noise
        Standard deviation of its filtered image, shape (box.height, box.width).
    dip
        Least relative depth of a saddle.
    flat
        Which of its pixels are clipped, or as bright as each other, if that counts.
    most_e
        What exceeds this counts as high as that.

    Returns
    -------
    The blob itself, or one blob for each maximum, brightest first.
    """
    brightness = blob.filtered_e
    if blob.peak_e > most_e:
        brightness = np.minimum(brightness, np.float32(most_e))
    peaks = _peaks(blob.pixels, brightness, noise, dip)
    if len(peaks) == 1:
        return [blob]
    peaks = peaks[np.argsort(-brightness[peaks[:, 0], peaks[:, 1]], kind="stable")][:MOST_PEAKS]
    rows, columns = np.indices(blob.pixels.shape)
    distance2 = (rows - peaks[:, :1, None]) ** 2 + (columns - peaks[:, 1:, None]) ** 2
    if flat is not None:
        distance2, pieces = distance2.astype(np.float64), _pieces(flat)
        own = pieces[tuple(peaks.T)]
        for index, piece in enumerate(own):
            # Not where charge that spilled joins several.
            if piece >= 0 and np.count_nonzero(own == piece) == 1:
                distance2[index] = _distance_px(pieces == piece) ** 2
    nearest = distance2.argmin(axis=0)
    return [trimmed(blob, blob.pixels & (nearest == peak)) for peak in range(len(peaks))]


def _distance_px(mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return how far each pixel lies from a mask."""
    import cv2

    outside = np.asarray(~mask, dtype=np.uint8)
    return np.asarray(cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), dtype=np.float64)


def one_piece(mask: NDArray[np.bool_], row: int, column: int) -> NDArray[np.bool_]:
    """Return what of a mask is in one piece with a place in it."""
    pieces = _pieces(mask)
    return np.asarray(pieces == pieces[row, column])


def _pieces(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Give numbers to the connected components of a mask; -1 outside."""
    places, width = np.flatnonzero(mask), mask.shape[1]
    pieces = np.full(mask.size, -1, dtype=np.int64)
    pieces[places] = _labelled(places, width)[0]
    return pieces.reshape(mask.shape)


def dilated(mask: NDArray[np.bool_], by_px: int) -> NDArray[np.bool_]:
    """Widen a mask by some pixels in each direction, corners too."""
    import cv2

    if not mask.any():
        return mask
    kernel = np.ones((2 * by_px + 1, 2 * by_px + 1), dtype=np.uint8)
    return np.asarray(cv2.dilate(mask.view(np.uint8), kernel), dtype=bool).reshape(mask.shape)


@compiled
def _peaks(
    mask: NDArray[np.bool_], brightness: NDArray[np.float32], noise: NDArray[np.float32], dip: float
) -> NDArray[np.int64]:
    """Return the distinct maxima of a blob, (row, column) each.

    Pixels are looked at from the brightest down, as if water fell: where two hills meet, the lower one is
    one of its own if it rises high enough above the saddle, and else a part of the higher one.
    """
    height, width = mask.shape
    inside = np.flatnonzero(mask)
    light, spread = brightness.ravel()[inside], noise.ravel()[inside]
    order = np.argsort(-light, kind="mergesort")
    number = np.full(height * width, -1, dtype=np.int64)  # of each pixel, from the brightest on
    leader = np.arange(len(inside))
    peaks = np.empty((len(inside), 2), dtype=np.int64)
    count = 0
    for rank in range(len(inside)):
        place = inside[order[rank]]
        row, column = place // width, place % width
        number[place] = rank
        for near_row in range(max(0, row - 1), min(height, row + 2)):
            for near in range(max(0, column - 1), min(width, column + 2)):
                beside = number[near_row * width + near]
                if beside < 0:
                    continue
                one, other = _leader(leader, beside), _leader(leader, rank)
                high, low = min(one, other), max(one, other)
                if high == low:
                    continue
                top = light[order[low]]
                depth = top - light[order[rank]]
                if low != rank and depth > max(5.0 * spread[order[low]], dip * top):
                    at = inside[order[low]]
                    peaks[count, 0], peaks[count, 1] = at // width, at % width
                    count += 1
                leader[low] = high
    first = inside[order[0]]
    peaks[count, 0], peaks[count, 1] = first // width, first % width
    return peaks[: count + 1]


def near_groups(blobs: Sequence[Blob], within_px: int) -> list[list[int]]:
    """Group blobs whose boxes come as near as that to each other, directly or by others between them.

    Returns
    -------
    Indices of each group's blobs, groups and blobs in the order given.
    """
    if not blobs:
        return []
    boxes = np.array([(each.box.top, each.box.left, each.box.height, each.box.width) for each in blobs])
    groups: dict[int, list[int]] = {}
    for index, leader in enumerate(_grouped(boxes, within_px).tolist()):
        groups.setdefault(leader, []).append(index)
    return list(groups.values())


@compiled
def _grouped(boxes: NDArray[np.int64], within_px: int) -> NDArray[np.int64]:
    """Return the first of the group that each of some boxes (top, left, height, width) belongs to."""
    leader = np.arange(len(boxes))
    for one in range(len(boxes)):
        top, left, height, width = boxes[one]
        for other in range(one):
            down = max(top - boxes[other, 0] - boxes[other, 2], boxes[other, 0] - top - height)
            across = max(left - boxes[other, 1] - boxes[other, 3], boxes[other, 1] - left - width)
            if max(down, across) <= within_px:
                _join(leader, one, other)
    for one in range(len(boxes)):
        leader[one] = _leader(leader, one)
    return leader


def divide(blobs: Sequence[Blob], u_px: NDArray[np.float64], v_px: NDArray[np.float64]) -> list[Blob | None]:
    """Divide the pixels of blobs among places, each to the nearest; None for a place that gets none."""
    places = np.concatenate([np.argwhere(b.pixels) + np.array([b.box.top, b.box.left]) for b in blobs])
    nearest = np.argmin((places[:, :1] - v_px) ** 2 + (places[:, 1:] - u_px) ** 2, axis=1)
    divided: list[Blob | None] = []
    for index in range(len(u_px)):
        mine = places[nearest == index]
        if not len(mine):
            divided.append(None)
            continue
        top, left = mine.min(axis=0).tolist()
        height, width = (mine.max(axis=0) - (top, left) + 1).tolist()
        pixels = np.zeros((height, width), dtype=bool)
        pixels[mine[:, 0] - top, mine[:, 1] - left] = True
        divided.append(Blob(PixelBox(top, left, height, width), pixels))
    return divided


def trimmed(blob: Blob, pixels: NDArray[np.bool_]) -> Blob:
    """Cut out the part of a blob that `pixels` marks, in a box of its own."""
    rows, columns = np.flatnonzero(pixels.any(axis=1)), np.flatnonzero(pixels.any(axis=0))
    top, left = int(rows[0]), int(columns[0])
    height, width = int(rows[-1]) - top + 1, int(columns[-1]) - left + 1
    box = PixelBox(blob.box.top + top, blob.box.left + left, height, width)
    inside = np.s_[top : top + height, left : left + width]
    return Blob(box, pixels[inside], np.where(pixels[inside], blob.filtered_e[inside], np.float32(0.0)))
