"""What is looked at of a blob: its light, and the window that is cut out of the frame."""

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import CLIPPED, SEEN, UNUSABLE
from perception.robust.search.frame import Pixels, ground_at

Float32 = NDArray[np.float32]
Array = NDArray[np.float64]
Places = NDArray[np.int64]

OWN, OTHERS, STRAY = 1, 2, 3
"""Whose the light of a lit pixel is: that of a window's flares, of others, or of what is no flare."""


@compiled
def grounds_at(pixels: Pixels, rows: Places, columns: Places) -> Array:
    """Return the background of some pixels."""
    ground = np.empty(len(rows))
    for index in range(len(rows)):
        ground[index] = ground_at(pixels, rows[index], columns[index])
    return ground


@compiled
def light_of(
    excess_e: Array,
    counts_dn: NDArray[np.uint16],
    places: Places,
    bad_at: Places,
    columns: int,
    full_dn: int,
) -> tuple[float, float, float, int]:
    """Look at a blob's pixels: centroid (u, v), flux in electrons, and how many are clipped.

    `places` are their indices in a frame of so many columns; of each the light above the background and the
    count are given. The centroid is weighted by that light, where some clips by what bends smoothly towards
    it: on pixels the kink would move it. Those that are bad count nowhere.
    """
    u, v, weight, flux, clipped, even_u, even_v = 0.0, 0.0, 0.0, 0.0, 0, 0.0, 0.0
    bend = 0.0
    if counts_dn.max() >= full_dn:
        bend = 1.0 / max(excess_e.max(), 1.0)
    for index, place in enumerate(places):
        row, column = place // columns, place % columns
        even_u += column / len(places)
        even_v += row / len(places)
        at = np.searchsorted(bad_at, place)
        if at < len(bad_at) and bad_at[at] == place:
            continue
        light = excess_e[index]
        clipped += counts_dn[index] >= full_dn
        flux += light
        bent = max(light, 0.0) * (2.0 - bend * light)
        u += bent * column
        v += bent * row
        weight += bent
    if not weight > 0.0:
        return even_u, even_v, flux, clipped
    return u / weight, v / weight, flux, clipped


@compiled
def cut(
    data_dn: NDArray[np.uint16], black_level_dn: float, e_per_dn: float, lit_at: Places, owner: Places,
    bad_at: Places, box: tuple[int, int, int, int], own: Places, full_dn: int, touching_px: int, kept_px: int,
) -> tuple[Array, NDArray[np.uint8]]:  # fmt: skip
    """Cut a window out of a frame: its electrons, and what each of its pixels is.

    Parameters
    ----------
    data_dn, black_level_dn, e_per_dn
        The frame's counts, and how they become electrons.
    lit_at, owner
        Its lit pixels, as indices in order, and the number of the flare that each belongs to; -1 for light
        that is no flare's.
    bad_at
        Its bad pixels, in order.
    box
        Top, left, height and width; it may reach beyond the frame.
    own
        Numbers of the window's flares.
    full_dn
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
    rows, columns = data_dn.shape
    image, state = np.zeros((height, width)), np.full((height, width), SEEN, dtype=np.uint8)
    whose = np.zeros((height, width), dtype=np.int8)
    stray = False
    for row in range(height):
        at_row = min(max(top + row, 0), rows - 1)
        for column in range(width):
            at = min(max(left + column, 0), columns - 1)
            image[row, column] = (float(data_dn[at_row, at]) - black_level_dn) * e_per_dn
            if at_row != top + row or at != left + column:
                state[row, column] = UNUSABLE
            elif data_dn[at_row, at] >= full_dn:
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
