"""What is seen of spheres' images where nearer ones hide parts of farther ones: in rows, from limb to limb.

A row of a disc is a piece of a line from limb to limb, of which discs before it take away theirs: what is left
ends on limbs whose places are known exactly. Between the heights at which other limbs come in, or cross, ends
move smoothly, and few rows (Gauss and Legendre's, in the angle around the height) integrate what is seen; as the
discs move, what is seen changes along its ends alone.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.bearing import direction_camera
from perception.model.discs.outline import AROUND, HARMONICS, crossing, extreme, rims_of, series_of, value_at
from perception.model.discs.rows import LEFT_OUT, SMOOTH_RAD, light_from
from perception.model.lens import project
from perception.types import Calibration

Array = NDArray[np.float64]

# Rows per ratio of half a height to smoothing: found by comparison with three times as many, that keep the
# error below 1e-4 of the peak.
_ROWS_BASE, _ROWS_SLOPE = 5.0, 4.0
_MOST_ROWS = 64  # more are of several heights
_LEAST_HEIGHT_PX = 1e-4
_MOST_PARTS = 8
NO_LIMB = -1

Piece = tuple[float, float, int, int, float, float]
"""Both ends of a piece of a row, whose limbs these are, and how they go aside."""


def _rules() -> Array:
    """Return places of rows, as shares of a height, and their shares of it, (rule, rows, 2)."""
    rules = np.zeros((_MOST_ROWS + 1, _MOST_ROWS, 2))
    for rows in range(1, _MOST_ROWS + 1):
        node, weight = np.polynomial.legendre.leggauss(rows)
        angle = 0.5 * math.pi * (1.0 + node)
        rules[rows, :rows, 0] = 0.5 * (1.0 - np.cos(angle))
        rules[rows, :rows, 1] = 0.25 * math.pi * weight * np.sin(angle)
    return rules


_RULES = _rules()


class Seen(NamedTuple):
    """Pieces of rows of discs that are seen.

    Attributes
    ----------
    disc
        Which disc's each is, shape (pieces,).
    v_px, ends_px
        Its row, and the columns where it begins and ends, shape (pieces,) and (pieces, 2).
    limb, slope
        Whose limb each end is, `NO_LIMB` where it goes on there, and by how many columns a limb goes aside
        from one row to the next, shape (pieces, 2).
    density
        Share of the whole disc's light in a pixel, at both ends and in the middle, shape (pieces, 3): times
        the row's height.
    reach_px
        Radius of each whole image, shape (discs,).
    """

    disc: NDArray[np.int64]
    v_px: Array
    ends_px: Array
    limb: NDArray[np.int64]
    slope: Array
    density: Array
    reach_px: Array


def seen_of_discs(
    places_px: Array, direction: Array, radius_rad: Array, hides: NDArray[np.int64], calibration: Calibration
) -> Seen | None:
    """Lay out what is seen of discs, some partly behind others; None where an image is not known so.

    Parameters
    ----------
    places_px, direction, radius_rad
        Where discs are, shapes (discs, 2), (discs, 3) and (discs,).
    hides
        Which nearer one hides a part of which farther one, shape (pairs, 2).
    calibration
        Intrinsics, point spread and response.
    """
    smooth_px = math.sqrt(calibration.psf_sigma_px**2 + 1.0 / 12.0)
    rims, across, down = rims_of(direction, radius_rad)
    with np.errstate(invalid="ignore", divide="ignore"):
        outlines_px = project(rims.reshape(-1, 3), calibration).reshape(-1, AROUND, 2)
    # cos⁴ θ, as light falls off, bends so much more away from the axis.
    bend = np.sqrt(np.maximum(3.0 / direction[:, 2] ** 2 - 2.0, 0.0))
    parts = np.clip(np.ceil(radius_rad * bend / SMOOTH_RAD), 1.0, _MOST_PARTS).astype(np.int64)
    row_disc, of_rows, row, of_pieces, limb, is_known = _pieces(
        outlines_px, direction, across, down, radius_rad, hides, parts, smooth_px
    )
    if not is_known:
        return None
    row_v_px, row_height_px, row_ends_px = of_rows[:, 0], of_rows[:, 1], of_rows[:, 2:]
    ends_px, slope = np.ascontiguousarray(of_pieces[:, :2]), np.ascontiguousarray(of_pieces[:, 2:])
    along = np.array([0.0, 0.5, 1.0])
    both_ends_px = np.concatenate([row_ends_px, ends_px])
    both_v_px = np.concatenate([row_v_px, row_v_px[row]])
    u_px = both_ends_px[:, :1] * (1.0 - along) + both_ends_px[:, 1:] * along
    at_px = np.stack([u_px.ravel(), np.repeat(both_v_px, 3)], axis=1)
    light = light_from(direction_camera(at_px, calibration), calibration).reshape(-1, 3)
    light_of_rows, light_of_pieces = light[: len(row_disc)], light[len(row_disc) :]
    lengths_px = row_ends_px[:, 1] - row_ends_px[:, 0]
    of_row = row_height_px * lengths_px * (light_of_rows @ (1.0 / 6.0, 4.0 / 6.0, 1.0 / 6.0))  # Simpson's
    total = np.bincount(row_disc, of_row, minlength=len(places_px))
    disc = row_disc[row]
    density = light_of_pieces * (row_height_px[row] / total[disc])[:, None]
    reach_px = np.hypot(*(outlines_px - places_px[:, None, :]).transpose(2, 0, 1)).max(axis=1)
    return Seen(disc, row_v_px[row], ends_px, limb, slope, density, reach_px)


@compiled
def _cut_by(
    direction: Array, across: Array, down: Array, radius_rad: Array, one: int, other: int
) -> tuple[float, float]:
    """Return at which angles around its rim one cap's crosses another's; NaN if it does not."""
    ahead = (direction[one] * direction[other]).sum()
    aside = math.sin(radius_rad[one]) * (across[one] * direction[other]).sum()
    below = math.sin(radius_rad[one]) * (down[one] * direction[other]).sum()
    most = math.hypot(aside, below)
    level = math.cos(radius_rad[other]) - math.cos(radius_rad[one]) * ahead
    if not abs(level) < most:
        return math.nan, math.nan
    middle, away = math.atan2(below, aside), math.acos(level / most)
    return middle - away, middle + away


@compiled
def _is_within(
    direction: Array, across: Array, down: Array, radius_rad: Array, one: int, turn: float, other: int
) -> bool:
    """Tell whether a place on one cap's rim lies within another cap."""
    cosine = 0.0
    for axis in range(3):
        aside = math.cos(turn) * across[one, axis] + math.sin(turn) * down[one, axis]
        at = math.cos(radius_rad[one]) * direction[one, axis] + math.sin(radius_rad[one]) * aside
        cosine += at * direction[other, axis]
    return cosine > math.cos(radius_rad[other])


@compiled
def _heights(
    far: int, nearer: NDArray[np.int64], of_v: Array, turns: Array, direction: Array, across: Array,
    down: Array, radius_rad: Array,
) -> Array:  # fmt: skip
    """Return the rows between which the ends of what is seen of a disc move smoothly, top to bottom.

    `turns` are at which angles around their rims outlines are highest and lowest, shape (discs, 2).
    """
    top, bottom = value_at(of_v[far], turns[far, 0])[0], value_at(of_v[far], turns[far, 1])[0]
    events = [top, bottom]
    for at in range(len(nearer)):
        near = nearer[at]
        for end in range(2):
            if _is_within(direction, across, down, radius_rad, near, turns[near, end], far):
                events.append(value_at(of_v[near], turns[near, end])[0])
        for turn in _cut_by(direction, across, down, radius_rad, far, near):
            if math.isfinite(turn):
                events.append(value_at(of_v[far], turn)[0])
        for before in range(at):
            other = nearer[before]
            for turn in _cut_by(direction, across, down, radius_rad, near, other):
                if math.isfinite(turn) and _is_within(direction, across, down, radius_rad, near, turn, far):
                    events.append(value_at(of_v[near], turn)[0])
    inside = [min(max(one, top), bottom) for one in events]
    return np.sort(np.array(inside))


@compiled
def _ends_of(of_u: Array, of_v: Array, turns: Array, v_px: float) -> tuple[float, float, float, float]:
    """Return where a row meets an outline, left and right, and how these places go aside; all 0 if nowhere."""
    highest, lowest = turns[0], turns[1]
    top, bottom = value_at(of_v, highest)[0], value_at(of_v, lowest)[0]
    if not top < v_px < bottom:
        return 0.0, 0.0, 0.0, 0.0
    one_way = (highest - lowest) % (2.0 * math.pi)
    way = math.acos((2.0 * v_px - top - bottom) / (bottom - top)) / math.pi
    first = crossing(of_v, v_px, lowest, lowest + one_way, lowest + way * one_way)
    other_way = one_way - 2.0 * math.pi
    second = crossing(of_v, v_px, lowest, lowest + other_way, lowest + way * other_way)
    u_1, along_1, _ = value_at(of_u, first)
    u_2, along_2, _ = value_at(of_u, second)
    slope_1, slope_2 = along_1 / value_at(of_v, first)[1], along_2 / value_at(of_v, second)[1]
    if not math.isfinite(u_1 + u_2):  # at a limb's very top or bottom
        return 0.0, 0.0, 0.0, 0.0
    if u_1 <= u_2:
        return u_1, u_2, slope_1, slope_2
    return u_2, u_1, slope_2, slope_1


@compiled
def _left_of(
    whole: Piece, disc: int, v_px: float, nearer: NDArray[np.int64], of_u: Array, of_v: Array, turns: Array
) -> list[Piece]:
    """Return what nearer ones leave of a row of a disc, from left to right."""
    seen = [whole]
    for near in nearer:
        left, right, left_slope, right_slope = _ends_of(of_u[near], of_v[near], turns[near], v_px)
        if not left < right:
            continue
        rest = seen[:0]
        for begin, end, limb, end_limb, slope, end_slope in seen:
            if right <= begin or end <= left:
                rest.append((begin, end, limb, end_limb, slope, end_slope))
                continue
            if begin < left:
                rest.append((begin, left, limb, near, slope, left_slope))
            if right < end:
                rest.append((right, end, near, end_limb, right_slope, end_slope))
        seen = rest
    return seen


@compiled
def _pieces(
    outlines_px: Array, direction: Array, across: Array, down: Array, radius_rad: Array,
    hides: NDArray[np.int64], parts: NDArray[np.int64], smooth_px: float,
) -> tuple[NDArray[np.int64], Array, NDArray[np.int64], Array, NDArray[np.int64], bool]:  # fmt: skip
    """Return rows of whole discs, pieces of them that are seen, and whether all outlines are known.

    Of rows the disc, shape (rows,), and v, height, left and right end, shape (rows, 4); of pieces the row,
    shape (pieces,), ends and slopes, (pieces, 4), and limbs, (pieces, 2).
    """
    discs = len(radius_rad)
    of_u, of_v = np.empty((discs, 1 + HARMONICS, 2)), np.empty((discs, 1 + HARMONICS, 2))
    turns, is_known = np.empty((discs, 2)), True
    for disc in range(discs):
        of_u[disc], of_v[disc] = series_of(outlines_px[disc, :, 0]), series_of(outlines_px[disc, :, 1])
        last = np.abs(of_u[disc, HARMONICS]).max() + np.abs(of_v[disc, HARMONICS]).max()
        is_known &= last <= LEFT_OUT * np.abs(of_v[disc, 1]).max()  # not if it is not a number
        turn = math.atan2(of_v[disc, 1, 1], of_v[disc, 1, 0])
        turns[disc] = extreme(of_v[disc], turn + math.pi), extreme(of_v[disc], turn)
        is_known &= math.isfinite(turns[disc].sum())
    row_disc, of_rows = [0][:0], [0.0][:0]
    piece_row, of_pieces, limbs = [0][:0], [0.0][:0], [0][:0]
    for disc in range(discs if is_known else 0):
        nearer = hides[hides[:, 1] == disc, 0]
        heights = _heights(disc, nearer, of_v, turns, direction, across, down, radius_rad)
        for panel in range(len(heights) - 1):
            height_px = heights[panel + 1] - heights[panel]
            if height_px < _LEAST_HEIGHT_PX:
                continue
            more = _ROWS_SLOPE * 0.5 * height_px / smooth_px
            times = math.ceil(more / (_MOST_ROWS - _ROWS_BASE))
            rows = math.ceil(_ROWS_BASE + more / times)
            for at in range(times * rows):
                place, share = _RULES[rows, at % rows]
                v_px = heights[panel] + height_px * (at // rows + place) / times
                left, right, left_slope, right_slope = _ends_of(of_u[disc], of_v[disc], turns[disc], v_px)
                if not left < right:
                    continue
                row_disc.append(disc)
                of_rows.extend((v_px, height_px * share / times, left, right))
                whole = (left, right, disc, disc, left_slope, right_slope)
                for begin, end, limb, end_limb, slope, end_slope in _left_of(
                    whole, disc, v_px, nearer, of_u, of_v, turns
                ):
                    part_px = (end - begin) / parts[disc]
                    for part in range(parts[disc]):
                        piece_row.append(len(row_disc) - 1)
                        of_pieces.extend(
                            (begin + part * part_px, begin + (part + 1) * part_px, slope, end_slope)
                        )
                        limbs.append(limb if part == 0 else NO_LIMB)
                        limbs.append(end_limb if part == parts[disc] - 1 else NO_LIMB)
    return (
        np.array(row_disc), np.array(of_rows).reshape(-1, 4), np.array(piece_row),
        np.array(of_pieces).reshape(-1, 4), np.array(limbs).reshape(-1, 2), is_known,
    )  # fmt: skip
