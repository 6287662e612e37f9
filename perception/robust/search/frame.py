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
Places = NDArray[np.int64]

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
def filtered(pixels: Pixels, kernel: Float32, bad_at: Places, box: tuple[int, int, int, int]) -> Float32:
    """Correlate what exceeds the background with a kernel along both axes, within a box inside the frame.

    Zero is what lies beyond the frame, which is what is expected there, and so are bad pixels. The box is
    (top, left, height, width); the kernel is symmetric, and of odd length.
    """
    top, left, height, width = box
    half, padded = len(kernel) // 2, np.empty(width + len(kernel) - 1, dtype=np.float32)
    across = np.zeros((len(kernel), width), dtype=np.float32)  # the last rows, filtered along themselves
    into = np.empty((height, width), dtype=np.float32)
    for row in range(top - half, top + height + half):
        _filter_row(pixels, kernel, bad_at, row, left, padded, across[row % len(kernel)])
        if row - half >= top:
            _sum_rows(across, kernel, row - half, into[row - half - top])
    return into


@compiled
def exceeding(
    pixels: Pixels, kernel: Float32, limit_e: Float32, sample_of: Places, sampled: Places
) -> tuple[Places, Float32, Float32]:
    """Filter a whole frame, and keep what exceeds a limit, and samples of the rest.

    Parameters
    ----------
    pixels, kernel
        As for `filtered`.
    limit_e
        The limit, on the mesh's rows as `Pixels.ground_e`.
    sample_of, sampled
        For each row of the frame the row of samples that it gives, or -1; the columns that are sampled.

    Returns
    -------
    The pixels above the limit, as indices in the frame, in order; the filtered image there; and the samples.
    """
    rows, columns = pixels.data_dn.shape
    half, none = len(kernel) // 2, np.empty(0, dtype=np.int64)
    across = np.zeros((len(kernel), columns), dtype=np.float32)
    padded = np.empty(columns + 2 * half, dtype=np.float32)
    result, limit = np.empty(columns, dtype=np.float32), np.empty(columns, dtype=np.float32)
    samples = np.empty((sample_of.max() + 1, len(sampled)), dtype=np.float32)
    places, values, count = np.empty(1024, dtype=np.int64), np.empty(1024, dtype=np.float32), 0
    for ahead in range(-half, rows + half):
        _filter_row(pixels, kernel, none, ahead, 0, padded, across[ahead % len(kernel)])
        row = ahead - half
        if row < 0:
            continue
        _sum_rows(across, kernel, row, result)
        if sample_of[row] >= 0:
            for at in range(len(sampled)):
                samples[sample_of[row], at] = result[sampled[at]]
        one, other, share = between(row, rows, len(limit_e))
        _blend(limit_e[one], limit_e[other], np.float32(share), limit)
        more = _count_above(result, limit)
        if count + more > len(places):
            places = np.append(places, np.empty(2 * (count + more), dtype=np.int64))
            values = np.append(values, np.empty(2 * (count + more), dtype=np.float32))
        for column in range(columns if more else 0):
            if result[column] > limit[column]:
                places[count], values[count] = row * columns + column, result[column]
                count += 1
    return places[:count].copy(), values[:count].copy(), samples


@compiled
def above(places: Places, values: Float32, limit_e: Float32, rows: int) -> NDArray[np.bool_]:
    """Tell which of some pixels exceed a limit, given on the mesh's rows, in a frame of so many rows."""
    columns = limit_e.shape[1]
    kept = np.empty(len(places), dtype=np.bool_)
    for index, place in enumerate(places):
        one, other, share = between(place // columns, rows, len(limit_e))
        rest, part, column = np.float32(1.0 - share), np.float32(share), place % columns
        kept[index] = values[index] > rest * limit_e[one, column] + part * limit_e[other, column]
    return kept


# Each of these runs along a row with nothing else in sight: so the processor does several pixels at once.


@compiled
def _filter_row(
    pixels: Pixels, kernel: Float32, bad_at: Places, row: int, left: int, padded: Float32, into: Float32
) -> None:
    """Write a part of a row, from a column on, filtered along itself; `padded` has room for its ends."""
    rows, columns = pixels.data_dn.shape
    width, half = len(into), len(kernel) // 2
    if not 0 <= row < rows:
        into[:] = 0.0
        return
    one, other, share = between(row, rows, len(pixels.ground_e))
    first, end = max(left - half, 0), min(left + width + half, columns)
    padded[:] = 0.0
    excess, counts = padded[first - left + half :][: end - first], pixels.data_dn[row, first:end]
    _blend(pixels.ground_e[one, first:end], pixels.ground_e[other, first:end], np.float32(share), excess)
    black, scale = np.float32(pixels.black_level_dn), np.float32(pixels.e_per_dn)
    for column in range(len(excess)):
        excess[column] = (np.float32(counts[column]) - black) * scale - excess[column]
    if len(bad_at):
        at = np.searchsorted(bad_at, row * columns + first)
        while at < len(bad_at) and bad_at[at] < row * columns + end:
            excess[bad_at[at] - row * columns - first] = 0.0
            at += 1
    _weigh(padded[half:][:width], kernel[half], into)
    for step in range(1, half + 1):
        _add_both(padded[half - step :][:width], padded[half + step :][:width], kernel[half + step], into)


@compiled
def _sum_rows(across: Float32, kernel: Float32, row: int, into: Float32) -> None:
    """Write a row filtered across rows too; `across` holds the nearest, each where its number leaves it."""
    half = len(kernel) // 2
    _weigh(across[row % len(kernel)], kernel[half], into)
    for step in range(1, half + 1):
        up, down = across[(row - step) % len(kernel)], across[(row + step) % len(kernel)]
        _add_both(up, down, kernel[half + step], into)


@compiled
def _blend(one: Float32, other: Float32, share: np.float32, into: Float32) -> None:
    """Write what lies between two rows."""
    rest = np.float32(1.0) - share
    for column in range(len(into)):
        into[column] = rest * one[column] + share * other[column]


@compiled
def _weigh(row: Float32, factor: np.float32, into: Float32) -> None:
    """Write a row times a factor."""
    for column in range(len(into)):
        into[column] = factor * row[column]


@compiled
def _add_both(one: Float32, other: Float32, factor: np.float32, into: Float32) -> None:
    """Add the sum of two rows times a factor."""
    for column in range(len(into)):
        into[column] += factor * (one[column] + other[column])


@compiled
def _count_above(row: Float32, limit: Float32) -> int:
    """Count how many pixels of a row exceed a limit."""
    count = 0
    for column in range(len(row)):
        count += row[column] > limit[column]
    return count


@compiled
def without(places: Places, values: Float32, pixels: Pixels, kernel: Float32, bad_at: Places) -> None:
    """Take what bad pixels exceed the background by out of a filtered image, known at some places."""
    rows, columns = pixels.data_dn.shape
    half = len(kernel) // 2
    for bad in bad_at:
        row, column = bad // columns, bad % columns
        excess = np.float32(electrons_at(pixels, row, column) - ground_at(pixels, row, column))
        for near_row in range(max(0, row - half), min(rows, row + half + 1)):
            at = np.searchsorted(places, near_row * columns + max(0, column - half))
            while at < len(places) and places[at] <= near_row * columns + min(columns - 1, column + half):
                across = places[at] - near_row * columns - column
                values[at] -= kernel[half + near_row - row] * kernel[half + across] * excess
                at += 1


@compiled
def neighbours(
    pixels: Pixels, places: Places, floor_e2: float, along_rows: bool
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
    pixels: Pixels, kernel: Float32, bad_at: Places, box: tuple[int, int, int, int], gap_px: int, wide_px: int
) -> tuple[float, int]:
    """Return the median of the filtered image over a frame of pixels around a box, and how many there are.

    The box is (top, left, height, width); the frame begins `gap_px` beyond it and is `wide_px` wide.
    """
    rows, columns = pixels.data_dn.shape
    top, left = box[0] - gap_px, box[1] - gap_px
    bottom, right = box[0] + box[2] + gap_px, box[1] + box[3] + gap_px
    first_row, end_row = max(0, top - wide_px), min(rows, bottom + wide_px)
    first, end = max(0, left - wide_px), min(columns, right + wide_px)
    near = filtered(pixels, kernel, bad_at, (first_row, first, end_row - first_row, end - first))
    values, count = np.empty(near.size, dtype=np.float32), 0
    for row in range(first_row, end_row):
        inside = top <= row < bottom
        for column in range(first, end):
            if not (inside and left <= column < right):
                values[count] = near[row - first_row, column - first]
                count += 1
    return (float(np.median(values[:count])) if count else 0.0), count


@compiled
def _is_among(places: Places, place: int) -> bool:
    """Tell whether a place is one of some, which are in order."""
    at = np.searchsorted(places, place)
    return bool(at < len(places) and places[at] == place)


@compiled
def light_of(
    pixels: Pixels, bad_at: Places, places: Places, clipped_dn: int
) -> tuple[float, float, float, int]:
    """Look at a blob's pixels, indices in the frame: centroid (u, v), flux in electrons, clipped pixels.

    The centroid is weighted by what exceeds the background; pixels that are bad count nowhere.
    """
    columns = pixels.data_dn.shape[1]
    u, v, weight, flux, clipped, even_u, even_v = 0.0, 0.0, 0.0, 0.0, 0, 0.0, 0.0
    for place in places:
        row, column = place // columns, place % columns
        even_u += column / len(places)
        even_v += row / len(places)
        if len(bad_at) and _is_among(bad_at, place):
            continue
        light = electrons_at(pixels, row, column) - ground_at(pixels, row, column)
        clipped += pixels.data_dn[row, column] >= clipped_dn
        flux += light
        u += max(light, 0.0) * column
        v += max(light, 0.0) * row
        weight += max(light, 0.0)
    if not weight > 0.0:
        return even_u, even_v, flux, clipped
    return u / weight, v / weight, flux, clipped


@compiled
def cut(
    pixels: Pixels, lit_at: Places, owner: Places, bad_at: Places,
    box: tuple[int, int, int, int], own: Places, clipped_dn: int, touching_px: int, kept_px: int,
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
