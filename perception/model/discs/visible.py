"""What is seen of spheres' images where nearer ones, or an edge, hide parts: in rows, from limb to limb.

A row of a disc is a piece of a line from limb to limb, of which discs before it take away theirs, and a
straight edge all beyond it: what is left ends in places that are known exactly. Between the heights at which
other limbs come in, or cross, these ends move smoothly, and few rows (Gauss and Legendre's, in the angle
around the height) integrate what is seen; as discs move, what is seen changes along its ends alone.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.bearing import direction_camera
from perception.model.discs.nodes import smoothing_px
from perception.model.discs.outline import AROUND, HARMONICS, crossing, extreme, outline_of, rims_of, value_at
from perception.model.discs.rows import light_from, parts_of_rows
from perception.model.lens import project
from perception.types import Calibration

Array = NDArray[np.float64]

# Rows per ratio of half a height to smoothing: found by comparison with three times as many, that keep the
# error below 1e-4 of the peak.
_ROWS_BASE, _ROWS_SLOPE = 5.0, 4.0
_MOST_ROWS = 64  # more are of several heights
_LEAST_HEIGHT_PX = 1e-4
_SIMPSON: Array = np.array([1.0, 4.0, 1.0]) / 6.0
_LEAST_COSINE = 1e-4  # of an edge's direction: along a row it would end everywhere at once
NO_LIMB, EDGE = -1, -2
NO_EDGE: Array = np.full(4, np.nan)

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
        Whose limb each end is, `EDGE` for the edge, `NO_LIMB` where it goes on there, and by how many columns
        a limb goes aside from one row to the next, shape (pieces, 2).
    density
        Share of the whole disc's light in a pixel, at both ends and in the middle, shape (pieces, 3): times
        the row's height.
    reach_px
        Radius of each whole image, shape (discs,).
    edge
        The edge, as for `seen_of_discs`.
    """

    disc: NDArray[np.int64]
    v_px: Array
    ends_px: Array
    limb: NDArray[np.int64]
    slope: Array
    density: Array
    reach_px: Array
    edge: Array

    @property
    def shares(self) -> Array:
        """What share of each disc's light is seen, shape (discs,)."""
        light = (self.ends_px[:, 1] - self.ends_px[:, 0]) * (self.density @ _SIMPSON)
        return np.asarray(np.bincount(self.disc, light, minlength=len(self.reach_px)), dtype=np.float64)


def seen_of_discs(
    places_px: Array,
    direction: Array,
    radius_rad: Array,
    hides: NDArray[np.int64],
    calibration: Calibration,
    edge: Array = NO_EDGE,
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
    edge
        A place u, v, a direction from there, in rad from u towards v, and how far that way a straight edge
        lies, at a right angle to it, beyond which nothing is seen of any; by default none.
    """
    smooth_px = smoothing_px(calibration)
    if abs(math.cos(edge[2])) < _LEAST_COSINE:
        cosine, sine = math.copysign(_LEAST_COSINE, math.cos(edge[2])), math.sin(edge[2])
        edge = np.array([edge[0], edge[1], math.atan2(sine, cosine), edge[3]])
    rims, across, down = rims_of(direction, radius_rad)
    with np.errstate(invalid="ignore", divide="ignore"):
        outlines_px = project(rims.reshape(-1, 3), calibration).reshape(-1, AROUND, 2)
    parts = parts_of_rows(direction, radius_rad)
    row_disc, of_rows, row, of_pieces, limb, is_known = _pieces(
        outlines_px, direction, across, down, radius_rad, hides, edge, parts, smooth_px
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
    of_row = row_height_px * lengths_px * (light_of_rows @ _SIMPSON)
    total = np.bincount(row_disc, of_row, minlength=len(places_px))
    disc = row_disc[row]
    density = light_of_pieces * (row_height_px[row] / total[disc])[:, None]
    reach_px = np.hypot(*(outlines_px - places_px[:, None, :]).transpose(2, 0, 1)).max(axis=1)
    return Seen(disc, row_v_px[row], ends_px, limb, slope, density, reach_px, edge)


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
    far: int, nearer: NDArray[np.int64], of_u: Array, of_v: Array, turns: Array, direction: Array,
    across: Array, down: Array, radius_rad: Array, edge: Array,
) -> Array:  # fmt: skip
    """Return the rows between which the ends of what is seen of a disc move smoothly, top to bottom.

    `turns` are at which angles around their rims outlines are highest and lowest, shape (discs, 2).
    """
    top, bottom = value_at(of_v[far], turns[far, 0])[0], value_at(of_v[far], turns[far, 1])[0]
    limbs, at = [far, far], [turns[far, 0], turns[far, 1]]
    for one in range(len(nearer)):
        near = nearer[one]
        on_edge = _on_edge(of_u[near], of_v[near], edge)
        for turn in (turns[near, 0], turns[near, 1], on_edge[0], on_edge[1]):
            if _is_within(direction, across, down, radius_rad, near, turn, far):
                limbs.append(near)
                at.append(turn)
        for other in range(one + 1):
            # What crosses the farther one's limb, and what crosses another before it.
            crossed = far if other == one else nearer[other]
            for turn in _cut_by(direction, across, down, radius_rad, near, crossed):
                if crossed == far or _is_within(direction, across, down, radius_rad, near, turn, far):
                    limbs.append(near)
                    at.append(turn)
    for turn in _on_edge(of_u[far], of_v[far], edge):
        limbs.append(far)
        at.append(turn)
    rows = np.array([value_at(of_v[limbs[event]], at[event])[0] for event in range(len(at))])
    return np.sort(np.minimum(np.maximum(rows[np.isfinite(rows)], top), bottom))


@compiled
def _on_edge(of_u: Array, of_v: Array, edge: Array) -> tuple[float, float]:
    """Return at which angles an outline crosses an edge; NaN if it does not."""
    cosine, sine = math.cos(edge[2]), math.sin(edge[2])
    beyond = cosine * of_u + sine * of_v
    level = cosine * edge[0] + sine * edge[1] + edge[3]
    farthest = extreme(beyond, math.atan2(beyond[1, 1], beyond[1, 0]))
    nearest = extreme(beyond, math.atan2(-beyond[1, 1], -beyond[1, 0]))
    if not value_at(beyond, nearest)[0] < level < value_at(beyond, farthest)[0]:
        return math.nan, math.nan
    one_way = (nearest - farthest) % (2.0 * math.pi)
    first = crossing(beyond, level, farthest, farthest + one_way, farthest + 0.5 * one_way)
    other_way = one_way - 2.0 * math.pi
    return first, crossing(beyond, level, farthest, farthest + other_way, farthest + 0.5 * other_way)


@compiled
def _ends_of(of_u: Array, of_v: Array, turns: Array, v_px: float) -> tuple[float, float, float, float]:
    """Return where a row meets an outline, left and right, and how these places go aside; 0 if nowhere."""
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
def _beyond_edge(edge: Array, v_px: float) -> tuple[float, float, float, float]:
    """Return where what lies beyond an edge begins and ends on a row, and how these places go aside."""
    cosine, sine = math.cos(edge[2]), math.sin(edge[2])
    at_px = edge[0] + (edge[3] - (v_px - edge[1]) * sine) / cosine
    if cosine > 0.0:
        return at_px, math.inf, -sine / cosine, 0.0
    return -math.inf, at_px, 0.0, -sine / cosine


@compiled
def _left_of(
    whole: Piece, v_px: float, nearer: NDArray[np.int64], of_u: Array, of_v: Array, turns: Array, edge: Array
) -> list[Piece]:
    """Return what nearer ones and an edge leave of a row of a disc, from left to right."""
    seen = [whole]
    for at in range(len(nearer) + 1):
        if at < len(nearer):
            near = nearer[at]
            left, right, left_slope, right_slope = _ends_of(of_u[near], of_v[near], turns[near], v_px)
        else:
            near = EDGE
            left, right, left_slope, right_slope = _beyond_edge(edge, v_px)
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
def _length_px(height_px: float, v_px: float, of_u: Array, of_v: Array, turns: Array, edge: Array) -> float:
    """Return how long is what ends in rows of a height about a middle one: an edge, where it runs there."""
    left, right, _, _ = _ends_of(of_u, of_v, turns, v_px)
    begin, end, _, _ = _beyond_edge(edge, v_px)
    runs_there = left < begin < right or left < end < right
    return height_px / abs(math.cos(edge[2])) if runs_there else height_px


@compiled
def _pieces(
    outlines_px: Array, direction: Array, across: Array, down: Array, radius_rad: Array,
    hides: NDArray[np.int64], edge: Array, parts: NDArray[np.int64], smooth_px: float,
) -> tuple[NDArray[np.int64], Array, NDArray[np.int64], Array, NDArray[np.int64], bool]:  # fmt: skip
    """Return rows of whole discs, pieces of them that are seen, and whether all outlines are known.

    Of rows the disc, shape (rows,), and v, height, left and right end, shape (rows, 4); of pieces the row,
    shape (pieces,), ends and slopes, (pieces, 4), and limbs, (pieces, 2).
    """
    discs = len(radius_rad)
    of_u, of_v = np.empty((discs, 1 + HARMONICS, 2)), np.empty((discs, 1 + HARMONICS, 2))
    turns, is_known = np.empty((discs, 2)), True
    for disc in range(discs):
        of_u[disc], of_v[disc], turns[disc, 0], turns[disc, 1] = outline_of(outlines_px[disc])
        is_known &= math.isfinite(turns[disc].sum())
    row_disc, of_rows = [0][:0], [0.0][:0]
    piece_row, of_pieces, limbs = [0][:0], [0.0][:0], [0][:0]
    for disc in range(discs if is_known else 0):
        nearer = hides[hides[:, 1] == disc, 0]
        heights = _heights(disc, nearer, of_u, of_v, turns, direction, across, down, radius_rad, edge)
        for panel in range(len(heights) - 1):
            height_px = heights[panel + 1] - heights[panel]
            if height_px < _LEAST_HEIGHT_PX:
                continue
            middle_px = 0.5 * (heights[panel] + heights[panel + 1])
            length_px = _length_px(height_px, middle_px, of_u[disc], of_v[disc], turns[disc], edge)
            more = _ROWS_SLOPE * 0.5 * length_px / smooth_px
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
                    whole, v_px, nearer, of_u, of_v, turns, edge
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
