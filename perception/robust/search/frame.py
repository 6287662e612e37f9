"""Loops over the pixels of a raw frame, compiled: what exceeds the background, and what a point filter finds.

Electrons are made of counts where they are wanted, and the smooth background is interpolated there: no image
of the frame's size is made but the filtered one.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled

Float32 = NDArray[np.float32]
Array = NDArray[np.float64]
Places = NDArray[np.int64]

_LOOKED_AT = 256
"""So many pixels of a row are counted at once, before any is looked at by itself."""


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
    (top, left, height, width); the kernel is symmetric, of the sum 1, and has a multiple of three weights on
    either side of its middle (`in_threes`).
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
def levels_around(
    pixels: Pixels, kernel: Float32, bad_at: Places, boxes: Places, gap_px: int, ring_px: int
) -> tuple[Array, Places]:
    """Return the median of the filtered frame in a ring around each of some boxes, and of how many pixels.

    Boxes are rows of (top, left, height, width); the ring, so many pixels wide, begins so many beside them.
    What of it lies beyond the frame does not count; 0 where that is all of it.
    """
    rows, columns = pixels.data_dn.shape
    levels, counts = np.zeros(len(boxes)), np.zeros(len(boxes), dtype=np.int64)
    for index in range(len(boxes)):
        top, left, height, width = boxes[index]
        first_row, first = max(top - gap_px - ring_px, 0), max(left - gap_px - ring_px, 0)
        end_row = min(top + height + gap_px + ring_px, rows)
        end = min(left + width + gap_px + ring_px, columns)
        image = filtered(pixels, kernel, bad_at, (first_row, first, end_row - first_row, end - first))
        values, count = np.empty(image.size, dtype=np.float32), 0
        for row in range(first_row, end_row):
            inside = top - gap_px <= row < top + height + gap_px
            for column in range(first, end):
                if not (inside and left - gap_px <= column < left + width + gap_px):
                    values[count] = image[row - first_row, column - first]
                    count += 1
        counts[index] = count
        if count:
            levels[index] = np.median(values[:count])
    return levels, counts


@compiled
def exceeding(
    pixels: Pixels, kernel: Float32, limit_e: Float32, sample_of: Places, sampled: Places
) -> tuple[Places, Float32, Float32]:
    """Filter a whole frame, and keep what exceeds a limit, and samples of the rest.

    Rows are filtered along themselves first. Their weighted sum exceeds a limit only where one of them does:
    so rows are summed only where that is so, next to nowhere in most frames, and where samples are taken.

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
    taps, half, none = len(kernel), len(kernel) // 2, np.empty(0, dtype=np.int64)
    across = np.zeros((taps, columns), dtype=np.float32)
    padded, result = np.empty(columns + 2 * half, dtype=np.float32), np.empty(columns, dtype=np.float32)
    # The lowest limit that any of the rows may have in whose sum a row is.
    lowest_e = limit_e
    for by in range(1, half * len(limit_e) // rows + 2):
        lowest_e = np.minimum(np.minimum(lowest_e, _shifted(limit_e, by)), _shifted(limit_e, -by))
    lowest_e = np.minimum(lowest_e, _shifted(lowest_e, 1))  # a row lies between two of the mesh's
    bright_pixels = np.zeros(taps, dtype=np.int64)
    lit, row_limit_e = np.empty(columns, dtype=np.int64), np.empty(columns, dtype=np.float32)
    samples = np.empty((sample_of.max() + 1, len(sampled)), dtype=np.float32)
    places, values, count = np.empty(1024, dtype=np.int64), np.empty(1024, dtype=np.float32), 0
    for ahead in range(rows + half):
        now, row = ahead % taps, ahead - half
        _filter_row(pixels, kernel, none, ahead, 0, padded, across[now])
        one, other, _ = between(min(ahead, rows - 1), rows, len(limit_e))
        bright_pixels[now] = _count_above(across[now], lowest_e[one])
        if row < 0:
            continue
        if sample_of[row] >= 0:
            _sum_rows(across, kernel, row, result)
            for at in range(len(sampled)):
                samples[sample_of[row], at] = result[sampled[at]]
        if not bright_pixels.any():
            continue
        if sample_of[row] < 0:
            _sum_rows(across, kernel, row, result)
        one, other, share = between(row, rows, len(limit_e))
        rest, part = np.float32(1.0 - share), np.float32(share)
        for column in range(columns):
            row_limit_e[column] = rest * limit_e[one, column] + part * limit_e[other, column]
        found = _brighter(result, row_limit_e, lit)
        if count + found > len(places):
            places = np.append(places, np.empty(count + found, dtype=np.int64))
            values = np.append(values, np.empty(count + found, dtype=np.float32))
        places[count:][:found], values[count:][:found] = row * columns + lit[:found], result[lit[:found]]
        count += found
    return places[:count].copy(), values[:count].copy(), samples


@compiled
def _shifted(mesh: Float32, by: int) -> Float32:
    """Return a mesh moved by some rows, its first or last one repeated."""
    moved = np.empty_like(mesh)
    for row in range(len(mesh)):
        moved[row] = mesh[min(max(row + by, 0), len(mesh) - 1)]
    return moved


@compiled
def _brighter(row: Float32, limit_e: Float32, into: Places) -> int:
    """Write which pixels of a row exceed a limit, and return how many do."""
    count = 0
    for first in range(0, len(row), _LOOKED_AT):
        part, least_e = row[first : first + _LOOKED_AT], limit_e[first : first + _LOOKED_AT]
        if _count_above(part, least_e) == 0:
            continue
        for column in range(len(part)):
            if part[column] > least_e[column]:
                into[count] = first + column
                count += 1
    return count


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
    """Write what a part of a row, from a column on, exceeds the background by, filtered along itself.

    `padded` has room for its ends. What lies beyond the frame, and bad pixels, are taken to be background.
    """
    rows, columns = pixels.data_dn.shape
    width, half = len(into), len(kernel) // 2
    if not 0 <= row < rows:
        into[:] = 0.0
        return
    first, end = max(left - half, 0), min(left + width + half, columns)
    start = first - left + half
    counts, within = pixels.data_dn[row, first:end], padded[start:][: end - first]
    for column in range(len(within)):
        within[column] = np.float32(counts[column])
    padded[:start] = _ground_dn(pixels, row, first)
    padded[start + end - first :] = _ground_dn(pixels, row, end - 1)
    if len(bad_at):
        at = np.searchsorted(bad_at, row * columns + first)
        while at < len(bad_at) and bad_at[at] < row * columns + end:
            column = bad_at[at] - row * columns
            within[column - first] = _ground_dn(pixels, row, column)
            at += 1
    one, other, share = between(row, rows, len(pixels.ground_e))
    above, below = pixels.ground_e[one, left : left + width], pixels.ground_e[other, left : left + width]
    scale, part, rest = np.float32(pixels.e_per_dn), np.float32(share), np.float32(1.0 - share)
    black_e = np.float32(pixels.black_level_dn * pixels.e_per_dn)
    if half == 3:
        _weigh_seven(padded, kernel[half:], scale, black_e, (rest, part), (above, below), into)
        return
    _weigh(padded[half:][:width], kernel[half], into)
    for step in range(1, half + 1, 3):
        before = (
            padded[half - step :][:width],
            padded[half - step - 1 :][:width],
            padded[half - step - 2 :][:width],
        )
        behind = (
            padded[half + step :][:width],
            padded[half + step + 1 :][:width],
            padded[half + step + 2 :][:width],
        )
        _add_six(before, behind, kernel[half + step : half + step + 3], into)
    for column in range(width):
        into[column] = into[column] * scale - black_e - (rest * above[column] + part * below[column])


@compiled
def _weigh_seven(
    padded: Float32, weights: Float32, scale: np.float32, black_e: np.float32,
    shares: tuple[np.float32, np.float32], ground_e: tuple[Float32, Float32], into: Float32,
) -> None:  # fmt: skip
    """Write a row filtered with seven weights, those of the middle and of one side given, less the ground.

    The kernel of most point spreads is so short; to the bit what the longer way gives, in one go.
    """
    (rest, part), (above, below) = shares, ground_e
    middle, a, b, c = weights[0], weights[1], weights[2], weights[3]
    for column in range(len(into)):
        total = middle * padded[column + 3] + (
            a * (padded[column + 2] + padded[column + 4])
            + b * (padded[column + 1] + padded[column + 5])
            + c * (padded[column] + padded[column + 6])
        )
        into[column] = total * scale - black_e - (rest * above[column] + part * below[column])


@compiled
def _ground_dn(pixels: Pixels, row: int, column: int) -> np.float32:
    """Return the background of a pixel in counts."""
    return np.float32(ground_at(pixels, row, column) / pixels.e_per_dn + pixels.black_level_dn)


@compiled
def _sum_rows(across: Float32, kernel: Float32, row: int, into: Float32) -> None:
    """Write a row filtered across rows too; `across` holds the nearest, each where its number leaves it."""
    half, taps = len(kernel) // 2, len(kernel)
    _weigh(across[row % taps], kernel[half], into)
    for step in range(1, half + 1, 3):
        up = across[(row - step) % taps], across[(row - step - 1) % taps], across[(row - step - 2) % taps]
        down = across[(row + step) % taps], across[(row + step + 1) % taps], across[(row + step + 2) % taps]
        _add_six(up, down, kernel[half + step : half + step + 3], into)


@compiled
def _weigh(row: Float32, factor: np.float32, into: Float32) -> None:
    """Write a row times a factor."""
    for column in range(len(into)):
        into[column] = factor * row[column]


@compiled
def _add_six(
    before: tuple[Float32, Float32, Float32],
    behind: tuple[Float32, Float32, Float32],
    weights: Float32,
    into: Float32,
) -> None:
    """Add three pairs of rows, each times its weight."""
    one, two, three = before
    first, second, third = behind
    a, b, c = weights[0], weights[1], weights[2]
    for column in range(len(into)):
        into[column] += (
            a * (one[column] + first[column])
            + b * (two[column] + second[column])
            + c * (three[column] + third[column])
        )


@compiled
def _count_above(row: Float32, limit_e: Float32) -> int:
    """Count how many pixels of a row exceed a limit."""
    count = np.int32(0)  # as wide as the pixels: that halves the time
    for column in range(len(row)):
        count += np.int32(row[column] > limit_e[column])
    return int(count)


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
def excess_at(pixels: Pixels, places: Places) -> Array:
    """Return by how many electrons pixels, indices in the frame, exceed the background."""
    excess, columns = np.empty(len(places)), pixels.data_dn.shape[1]
    for index, place in enumerate(places):
        row, column = place // columns, place % columns
        excess[index] = electrons_at(pixels, row, column) - ground_at(pixels, row, column)
    return excess


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
    reach, row = 0 if along_rows else 1, -1
    one, other, share = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64), np.empty(3)
    for index, place in enumerate(places):
        if row < 0 or not row * columns <= place < (row + 1) * columns:
            row = place // columns
            for line in range(3):  # the one above, its own, the one below
                near_row = min(max(row + line - 1, 0), rows - 1)
                one[line], other[line], share[line] = between(near_row, rows, len(pixels.ground_e))
        column = place - row * columns
        for line in range(1 - reach, 2 + reach):
            for across in range(-1, 2):
                near_row, near, at = row + line - 1, column + across, line
                if not (0 <= near < columns and 0 <= near_row < rows):
                    near_row, near, at = row, column, 1
                seen = electrons_at(pixels, near_row, near)
                first, second = float(pixels.ground_e[one[at], near]), float(pixels.ground_e[other[at], near])
                excess = seen - ((1.0 - share[at]) * first + share[at] * second)
                if line == 1 and across == 0:
                    own[index] = excess
                    continue
                around[index] += excess
                variance[index] += max(seen, 0.0) + floor_e2
    return own, around, variance
