"""Flares on hills of light: cut off the hill, where they stand out of all that lies around them."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.flare import PixelBox
from perception.robust.search.blobs import MOST_PEAKS, Blob, dilated, one_piece, trimmed

_BESIDE_PX = 4
_WAYS = 32  # around a place, at equal angles
_PROMINENT_SIGMAS = 8.5  # 6 of the difference of two places
_PROMINENT_SHARE = 0.25  # of how much brighter it is than the darkest around it


def summit(blob: Blob, clips: NDArray[np.bool_], reach_px: int) -> Blob:
    """Cut what stands on a hill off the hill: a flare before a bright horizon, or on a patch of sun.

    The flare is what exceeds half of the maximum, and as far around that as its image reaches. Where twice as
    much of the blob lies beyond, the level is raised to the brightest of what lies right there. A blob whose
    flare is clipped is left as it is.

    Parameters
    ----------
    blob
        What exceeds the detection limit.
    clips
        Which pixels are clipped by light.
    reach_px
        How far a point's image reaches beyond its half maximum.
    """
    # Of a flare at least a quarter of what it reaches lies in its blob, as in a corner of the frame.
    if not blob.peak_e > 0.0 or blob.area_px <= 2 * (reach_px + 1) ** 2:
        return blob
    top = _part_with_peak(blob, 0.5 * blob.peak_e)
    near = dilated(top, reach_px)
    beyond = blob.pixels & ~near
    if np.count_nonzero(beyond) <= 2 * np.count_nonzero(near & blob.pixels) or (clips & near).any():
        return blob
    beside = beyond & dilated(near, _BESIDE_PX)
    if not beside.any():
        return blob
    level_e = float(blob.filtered_e[beside].max())
    return trimmed(blob, _part_with_peak(blob, level_e)) if level_e < blob.peak_e else blob


def prominent(
    part: Blob, component: Blob, noise: NDArray[np.float32], reach_px: int, shape: tuple[int, int]
) -> list[Blob]:
    """Cut flares off the bright rim of a wall, which may itself exceed half of their maximum.

    A flare's maximum exceeds all that lies around it beyond its reach: that is the level at which it is cut
    off. Along a rim, and in its corners, there is always something as bright. Most of the part must lie
    beyond that reach, or it is the flare itself, as the disc of a near source.

    Parameters
    ----------
    part, component
        What is looked at, of all that exceeds the detection limit in one piece with it.
    noise
        Standard deviation of the component's filtered image, shape (box.height, box.width).
    reach_px
        How far a point's image reaches beyond its half maximum.
    shape
        Of the frame: what is nearer to its edge than that is not looked at.

    Returns
    -------
    The brightest first, at most `MOST_PEAKS`; no pixel is in two of them.
    """
    box, mask = component.box, np.zeros_like(component.pixels)
    mask[part.box.seen_from(box).slices] = part.pixels
    inner = PixelBox(reach_px, reach_px, shape[0] - 2 * reach_px, shape[1] - 2 * reach_px)
    inside, looked_at = inner.overlap(part.box).seen_from(box).slices, np.zeros_like(mask)
    looked_at[inside] = mask[inside]
    found = _prominent(looked_at, component.filtered_e, noise, reach_px)
    found.sort(key=lambda each: -float(component.filtered_e[each[0], each[1]]))
    cut: list[Blob] = []
    taken = np.zeros_like(mask)
    for row, column, level_e in found[:MOST_PEAKS]:
        first_row, first = max(row - reach_px, 0), max(column - reach_px, 0)
        near = np.s_[first_row : row + reach_px + 1, first : column + reach_px + 1]
        above = mask[near] & ~taken[near] & (component.filtered_e[near] > level_e)
        if not above[row - first_row, column - first]:
            continue
        piece = one_piece(above, row - first_row, column - first)
        around = dilated(np.pad(piece, reach_px), reach_px)
        if part.area_px > 3 * np.count_nonzero(around):
            taken[near] |= piece
            corner = PixelBox(box.top + first_row, box.left + first, *piece.shape)
            cut.append(trimmed(Blob(corner, piece, component.filtered_e[near]), piece))
    return cut


@compiled
def _prominent(
    mask: NDArray[np.bool_], brightness: NDArray[np.float32], noise: NDArray[np.float32], reach_px: int
) -> list[tuple[int, int, float]]:
    """Return row and column of maxima that exceed all around them, and the brightest of that."""
    height, width = mask.shape
    found = [(0, 0, 0.0) for _ in range(0)]
    for row in range(height):
        for column in range(width):
            here, least = brightness[row, column], _PROMINENT_SIGMAS * noise[row, column]
            if not mask[row, column] or not here > least:
                continue
            if brightness[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].max() > here:
                continue
            level, darkest = 0.0, here
            for way in range(_WAYS):
                angle = 2.0 * math.pi * way / _WAYS
                there = _between(
                    brightness, row + reach_px * math.sin(angle), column + reach_px * math.cos(angle)
                )
                level, darkest = max(level, there), min(darkest, there)
            if here - level > max(least, _PROMINENT_SHARE * (here - darkest)):
                found.append((row, column, level))
    return found


@compiled
def _between(image: NDArray[np.float32], row: float, column: float) -> float:
    """Return the value of an image between its pixels, by four of them; 0 beyond."""
    first_row, first = math.floor(row), math.floor(column)
    value = 0.0
    for at_row in (first_row, first_row + 1):
        for at in (first, first + 1):
            if 0 <= at_row < image.shape[0] and 0 <= at < image.shape[1]:
                value += (1.0 - abs(row - at_row)) * (1.0 - abs(column - at)) * image[at_row, at]
    return value


def _part_with_peak(blob: Blob, level_e: float) -> NDArray[np.bool_]:
    """Mark what exceeds a level, which the maximum does, in one piece with it, in the blob's box."""
    above = blob.pixels & (blob.filtered_e > level_e)
    row, column = divmod(int(np.argmax(np.where(above, blob.filtered_e, -np.inf))), blob.box.width)
    return one_piece(above, row, column)
