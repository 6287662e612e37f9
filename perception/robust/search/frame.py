"""Loops over the pixels of a raw frame, compiled: filtered, looked at around a blob, cut into windows.

Electrons are made of counts where they are wanted, and the smooth background is interpolated there: no image
of the frame's size is made but the filtered one.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import CLIPPED, SEEN, UNUSABLE

Float32 = NDArray[np.float32]
Array = NDArray[np.float64]

OWN, OTHERS, STRAY = 1, 2, 3
"""Whose the light of a lit pixel is: that of a window's flares, of others, or of what is no flare."""


class Pixels(NamedTuple):
    """A frame's counts, how they become electrons, and the background beneath.

    Attributes
    ----------
    data_dn
        Raw counts, shape (rows, columns).
    black_level_dn, e_per_dn
        An electron count is (count - black level) · e_per_dn.
    ground_e
        Background, already as wide as the frame, on the mesh's rows: shape (cells down, columns).
    """

    data_dn: NDArray[np.uint16]
    black_level_dn: float
    e_per_dn: float
    ground_e: Float32


@compiled
def between(row: int, rows: int, cells: int) -> tuple[int, int, float]:
    """Return between which two of so many cells a row lies, and the second one's share."""
    place = (row + 0.5) * cells / rows - 0.5
    if place <= 0.0:
        return 0, 0, 0.0
    if place >= cells - 1:
        return cells - 1, cells - 1, 0.0
    first = math.floor(place)
    return first, first + 1, place - first


@compiled
def ground_at(pixels: Pixels, row: int, column: int) -> float:
    """Return the background of a pixel."""
    one, other, share = between(row, len(pixels.data_dn), len(pixels.ground_e))
    first, second = float(pixels.ground_e[one, column]), float(pixels.ground_e[other, column])
    return (1.0 - share) * first + share * second


@compiled
def electrons_at(pixels: Pixels, row: int, column: int) -> float:
    """Return the electrons of a pixel above black level."""
    return (float(pixels.data_dn[row, column]) - pixels.black_level_dn) * pixels.e_per_dn


@compiled
def filtered(pixels: Pixels, kernel: Float32) -> Float32:
    """Correlate what exceeds the background with a kernel along both axes, zero beyond the border.

    Zero is the expected value there, so the border is less noisy than the rest, never more. The kernel is
    symmetric, and of odd length.
    """
    rows, columns = pixels.data_dn.shape
    taps, half = len(kernel), len(kernel) // 2
    into = np.empty((rows, columns), dtype=np.float32)
    padded = np.zeros(columns + 2 * half, dtype=np.float32)
    across = np.zeros((taps, columns), dtype=np.float32)  # the last rows, filtered along themselves
    for row in range(rows + half):
        line = across[row % taps]
        if row < rows:
            one, other, share = between(row, rows, len(pixels.ground_e))
            _excess(pixels, row, one, other, np.float32(share), padded[half : half + columns])
            _times(padded[half : half + columns], kernel[half], line)
            for step in range(1, half + 1):
                before, behind = padded[half - step :][:columns], padded[half + step :][:columns]
                _add_both(before, behind, kernel[half + step], line)
        else:
            line[:] = 0.0
        done = row - half
        if done >= 0:
            result = into[done]
            _times(across[done % taps], kernel[half], result)
            for step in range(1, half + 1):
                up, down = across[(done - step) % taps], across[(done + step) % taps]
                _add_both(up, down, kernel[half + step], result)
    return into


# Each of these runs along a row with nothing else in sight: so the processor does several pixels at once.


@compiled
def _excess(pixels: Pixels, row: int, one: int, other: int, share: np.float32, into: Float32) -> None:
    """Write what a row exceeds the background by, which lies between two rows of the mesh."""
    above, below, counts = pixels.ground_e[one], pixels.ground_e[other], pixels.data_dn[row]
    black, scale, rest = (
        np.float32(pixels.black_level_dn),
        np.float32(pixels.e_per_dn),
        np.float32(1.0) - share,
    )
    for column in range(len(into)):
        ground = rest * above[column] + share * below[column]
        into[column] = (np.float32(counts[column]) - black) * scale - ground


@compiled
def _times(row: Float32, factor: np.float32, into: Float32) -> None:
    """Write a row times a factor."""
    for column in range(len(into)):
        into[column] = factor * row[column]


@compiled
def _add_both(one: Float32, other: Float32, factor: np.float32, into: Float32) -> None:
    """Add the sum of two rows times a factor."""
    for column in range(len(into)):
        into[column] += factor * (one[column] + other[column])


@compiled
def above(filtered_e: Float32, limit_e: Float32) -> NDArray[np.int64]:
    """Return which pixels exceed a limit, given on the mesh's rows, as indices in the frame, in order."""
    rows, columns = filtered_e.shape
    line = np.empty(columns, dtype=np.float32)
    counts = np.zeros(rows, dtype=np.int64)
    for row in range(rows):
        one, other, share = between(row, rows, len(limit_e))
        rest, part = np.float32(1.0 - share), np.float32(share)
        first, second, image = limit_e[one], limit_e[other], filtered_e[row]
        count = 0
        for column in range(columns):
            count += image[column] > rest * first[column] + part * second[column]
        counts[row] = count
    found = np.empty(counts.sum(), dtype=np.int64)
    at = 0
    for row in range(rows):
        if counts[row] == 0:
            continue
        one, other, share = between(row, rows, len(limit_e))
        rest, part = np.float32(1.0 - share), np.float32(share)
        for column in range(columns):
            line[column] = rest * limit_e[one, column] + part * limit_e[other, column]
        for column in range(columns):
            if filtered_e[row, column] > line[column]:
                found[at] = row * columns + column
                at += 1
    return found


@compiled
def without(filtered_e: Float32, pixels: Pixels, kernel: Float32, places: NDArray[np.int64]) -> None:
    """Take what some pixels exceed the background by out of a filtered image."""
    rows, columns = filtered_e.shape
    half = len(kernel) // 2
    for place in places:
        row, column = place // columns, place % columns
        excess = np.float32(electrons_at(pixels, row, column) - ground_at(pixels, row, column))
        for near_row in range(max(0, row - half), min(rows, row + half + 1)):
            for near in range(max(0, column - half), min(columns, column + half + 1)):
                weight = kernel[half + near_row - row] * kernel[half + near - column]
                filtered_e[near_row, near] -= weight * excess


@compiled
def neighbours(
    pixels: Pixels, places: NDArray[np.int64], floor_e2: float, along_rows: bool
) -> tuple[Array, Array, Array]:
    """Return by how much pixels exceed the background, their eight neighbours together, and their variance.

    `along_rows` counts the two neighbours in the same row alone. A neighbour beyond the frame is taken to be
    as bright as the pixel itself.
    """
    rows, columns = pixels.data_dn.shape
    own, around, variance = np.zeros(len(places)), np.zeros(len(places)), np.zeros(len(places))
    reach = 0 if along_rows else 1
    for index, place in enumerate(places):
        row, column = place // columns, place % columns
        own[index] = electrons_at(pixels, row, column) - ground_at(pixels, row, column)
        for down in range(-reach, reach + 1):
            for across in range(-1, 2):
                if down == 0 and across == 0:
                    continue
                near_row, near = row + down, column + across
                if not (0 <= near_row < rows and 0 <= near < columns):
                    near_row, near = row, column
                seen = electrons_at(pixels, near_row, near)
                around[index] += seen - ground_at(pixels, near_row, near)
                variance[index] += max(seen, 0.0) + floor_e2
    return own, around, variance


@compiled
def ring_level(
    filtered_e: Float32, box: tuple[int, int, int, int], gap_px: int, wide_px: int
) -> tuple[float, int]:
    """Return the median of a filtered image over a frame of pixels around a box, and how many there are.

    The box is (top, left, height, width); the frame begins `gap_px` beyond it and is `wide_px` wide.
    """
    rows, columns = filtered_e.shape
    top, left = box[0] - gap_px, box[1] - gap_px
    bottom, right = box[0] + box[2] + gap_px, box[1] + box[3] + gap_px
    first_row, end_row = max(0, top - wide_px), min(rows, bottom + wide_px)
    first, end = max(0, left - wide_px), min(columns, right + wide_px)
    values = np.empty(max(0, end_row - first_row) * max(0, end - first), dtype=np.float32)
    count = 0
    for row in range(first_row, end_row):
        inside = top <= row < bottom
        for column in range(first, end):
            if inside and left <= column < right:
                continue
            values[count] = filtered_e[row, column]
            count += 1
    return (float(np.median(values[:count])) if count else 0.0), count


@compiled
def _is_among(places: NDArray[np.int64], place: int) -> bool:
    """Tell whether a place is one of some, which are in order."""
    at = np.searchsorted(places, place)
    return bool(at < len(places) and places[at] == place)


@compiled
def light_of(
    pixels: Pixels, filtered_e: Float32, bad_at: NDArray[np.int64], mask: NDArray[np.bool_],
    corner: tuple[int, int], clipped_dn: int,
) -> tuple[float, float, float, int, int]:  # fmt: skip
    """Look at a blob: centroid (u, v), flux in electrons, clipped pixels, and its half area.

    The centroid is weighted by what exceeds the background; pixels that are bad count nowhere. The half area
    is how many pixels exceed half of the maximum in the filtered image.
    """
    u, v, weight, flux, clipped, peak, count = 0.0, 0.0, 0.0, 0.0, 0, -math.inf, 0
    even_u, even_v = 0.0, 0.0
    for row in range(corner[0], corner[0] + mask.shape[0]):
        for column in range(corner[1], corner[1] + mask.shape[1]):
            if not mask[row - corner[0], column - corner[1]]:
                continue
            count += 1
            even_u += column
            even_v += row
            peak = max(peak, filtered_e[row, column])
            if len(bad_at) and _is_among(bad_at, row * pixels.data_dn.shape[1] + column):
                continue
            light = electrons_at(pixels, row, column) - ground_at(pixels, row, column)
            clipped += pixels.data_dn[row, column] >= clipped_dn
            flux += light
            u += max(light, 0.0) * column
            v += max(light, 0.0) * row
            weight += max(light, 0.0)
    half_area = 0
    for row in range(mask.shape[0]):
        for column in range(mask.shape[1]):
            if mask[row, column] and filtered_e[corner[0] + row, corner[1] + column] > 0.5 * peak:
                half_area += 1
    if not weight > 0.0:
        return even_u / count, even_v / count, flux, clipped, half_area
    return u / weight, v / weight, flux, clipped, half_area


@compiled
def cut(
    pixels: Pixels, lit_at: NDArray[np.int64], owner: NDArray[np.int64], bad_at: NDArray[np.int64],
    box: tuple[int, int, int, int], own: NDArray[np.int64], clipped_dn: int, touching_px: int, kept_px: int,
) -> tuple[Array, NDArray[np.uint8]]:  # fmt: skip
    """Cut a window out of a frame: its electrons, and what each of its pixels is.

    Parameters
    ----------
    pixels
        The frame.
    lit_at, owner
        Its lit pixels, as indices in order, and the number of the flare that each belongs to; -1 for light
        that is no flare's.
    bad_at
        Its bad pixels, in order.
    box
        Top, left, height and width; it may reach beyond the frame.
    own
        Numbers of the window's flares.
    clipped_dn
        Count from which on a pixel is clipped.
    touching_px
        Light that is no flare's is left out unless it comes so near: then it is what the flares stand on.
    kept_px
        What lies so near to what is left out is left out, too.

    Returns
    -------
    Shape (height, width) both; the second is of `model.layout`'s states.
    """
    top, left, height, width = box
    rows, columns = pixels.data_dn.shape
    image, state = np.zeros((height, width)), np.full((height, width), SEEN, dtype=np.uint8)
    whose = np.zeros((height, width), dtype=np.int8)
    stray = False
    for row in range(height):
        at_row = min(max(top + row, 0), rows - 1)
        for column in range(width):
            at = min(max(left + column, 0), columns - 1)
            image[row, column] = electrons_at(pixels, at_row, at)
            if at_row != top + row or at != left + column:
                state[row, column] = UNUSABLE
            elif pixels.data_dn[at_row, at] >= clipped_dn:
                state[row, column] = CLIPPED
        if at_row != top + row:
            continue
        lit = np.searchsorted(lit_at, at_row * columns + max(left, 0))
        while lit < len(lit_at) and lit_at[lit] < at_row * columns + min(left + width, columns):
            column = lit_at[lit] - at_row * columns - left
            if owner[lit] < 0:
                whose[row, column] = STRAY
                stray = True
            else:
                whose[row, column] = OTHERS
                for one in own:
                    if owner[lit] == one:
                        whose[row, column] = OWN
            lit += 1
    for place in bad_at:
        row, column = place // columns - top, place % columns - left
        if 0 <= row < height and 0 <= column < width:
            state[row, column] = UNUSABLE
    touching = stray and _comes_near(whose, touching_px)
    for row in range(height):
        for column in range(width):
            if whose[row, column] == OTHERS or (whose[row, column] == STRAY and not touching):
                state[
                    max(0, row - kept_px) : row + kept_px + 1, max(0, column - kept_px) : column + kept_px + 1
                ] = UNUSABLE
    return image, state


@compiled
def _comes_near(whose: NDArray[np.int8], within_px: int) -> bool:
    """Tell whether light that is no flare's comes near to the flares of a window, inside it."""
    height, width = whose.shape
    for row in range(height):
        for column in range(width):
            if whose[row, column] != OWN:
                continue
            near = whose[
                max(0, row - within_px) : row + within_px + 1,
                max(0, column - within_px) : column + within_px + 1,
            ]
            if (near == STRAY).any():
                return True
    return False
