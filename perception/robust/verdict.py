"""What is no source: bad pixels by their shape, lamps and sheen by their size."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import CLIPPED, UNUSABLE
from perception.model.window import Camera
from perception.robust.goodness import MODEL_ERROR, noise_e2
from perception.robust.overlap.free_fits import of_free_width
from perception.robust.overlap.oval import Oval, fit_oval
from perception.robust.solve import Solution

Array = NDArray[np.float64]

REACH_PX, REACHED_SHARE = 2, 0.02
_LEAST_PX, _LEAST_SHARE = 1.0, 0.15
_FLANK_PX, _FLANK_SHARE = 3.0, 0.25
_FLANK_PEAKS, _FLANK_PEAKS_ON_EDGES = 0.5, 1.0
_LEAST_SEEN, _MOST_OFF = 2.0 / 3.0, 0.5
_CLIPPED_DIM, _MOST_CLIPPED_DIM = 0.5, 0.1
_MOST_OF_CLIPPED, _MOST_MOVING_OF_CLIPPED = 2, 1  # flares more than blobs
_LIMB_RADIUS_PX, _MOST_LEFT_OF_LIMB = 2.0, 0.1
_MOST_LIMB_ASPECT, _MOST_LIMB_BRIGHTNESS = 1.08, 1.15  # of sources that are not quite round or known
_OF_TIE = 4.0  # σ
_LEAST_GAIN_OF_OVAL = 30.0  # 2 Δ ln L: real sources give it 10 at most, lamps 50 to 325


def is_one_pixel(solution: Solution) -> bool:
    """Tell whether a single pixel that is stuck or hot explains a window better than a lone flare does.

    A flare's light lies on its pixel's neighbours as well. χ² over 5 × 5 pixels is compared: of the even
    background with one pixel free, and of the flare. (Bright ones `bad_pixels` has found before.)
    """
    window = solution.window
    return _is_one_pixel(
        window.image_e, window.state, solution.expected_e, solution.flares_e, window.floor_e2, window.prnu
    )


@compiled
def _is_one_pixel(
    image_e: Array, state: NDArray[np.uint8], expected_e: Array, flares_e: Array, floor_e2: float, prnu: float
) -> bool:
    """Compare a flare's χ² with that of the ground alone but for the brightest pixel."""
    rows, columns = image_e.shape
    brightest, at_row, at = -math.inf, 0, 0
    least = REACHED_SHARE * flares_e.max()
    for row in range(rows):
        for column in range(columns):
            reached = state[row, column] != UNUSABLE and flares_e[row, column] > least
            if reached and image_e[row, column] > brightest:
                brightest, at_row, at = image_e[row, column], row, column
    of_pixel, of_flare = 0.0, 0.0
    for row in range(max(0, at_row - REACH_PX), min(rows, at_row + REACH_PX + 1)):
        for column in range(max(0, at - REACH_PX), min(columns, at + REACH_PX + 1)):
            if state[row, column] == UNUSABLE:
                continue
            expected, flare = expected_e[row, column], flares_e[row, column]
            ground = expected - flare
            if row != at_row or column != at:
                of_pixel += (image_e[row, column] - ground) ** 2 / (max(ground, 0.0) + floor_e2)
            left = image_e[row, column] - expected
            if not (state[row, column] == CLIPPED and left < 0.0):  # clipped, as is expected
                of_flare += left**2 / (noise_e2(expected, floor_e2, prnu) + (MODEL_ERROR * flare) ** 2)
    return of_pixel < of_flare


def is_border(solution: Solution, index: int, shape: tuple[int, int]) -> bool:
    """Tell whether a flare is only the border of something else, seen or not."""
    return is_on_flank(solution, index, shape) or is_hardly_seen(solution, index, shape)


def is_on_flank(solution: Solution, index: int, shape: tuple[int, int]) -> bool:
    """Tell whether a flare stands on the flank of something larger that is not explained, as a lit patch.

    Light falls off around a flare, on all sides. Where a quarter of a ring around it, all flares taken away,
    still exceeds the background by half of the flare's own peak, it is a part of what lies there; by all of
    it, where straight edges explain what lies there: corners, of which they know nothing, look like fainter
    flares. Of a lone one that is its brightest pixel: an edge may hide its middle. `shape` is the frame's:
    what a window shows beyond it does not count.
    """
    window, place = solution.window, (float(solution.u_px[index]), float(solution.v_px[index]))
    inner_px = float(solution.image_radius_px[index]) + 2.0 * solution.psf_sigma_px + 1.0
    share = _share_above(
        window.image_e,
        solution.flares_e,
        solution.background_e,
        (window.box.top, window.box.left),
        shape,
        place,
        (inner_px, inner_px + _FLANK_PX),
        solution.count == 1,
        _FLANK_PEAKS if window.features is None else _FLANK_PEAKS_ON_EDGES,
    )
    return share > _FLANK_SHARE


@compiled
def _share_above(
    image_e: Array, flares_e: Array, background_e: float, corner: tuple[int, int], shape: tuple[int, int],
    place: tuple[float, float], ring_px: tuple[float, float], is_lone: bool, peaks: float,
) -> float:  # fmt: skip
    """Return the share of a ring where what is no flare exceeds so much of a flare's peak.

    Of a window whose first pixel has that row and column of the frame; `place` is (u, v) in the frame.
    """
    top, left = max(-corner[0], 0), max(-corner[1], 0)
    bottom = min(image_e.shape[0], shape[0] - corner[0])
    right = min(image_e.shape[1], shape[1] - corner[1])
    u, v = place[0] - corner[1], place[1] - corner[0]
    if is_lone:
        peak_e = flares_e[top:bottom, left:right].max()
    else:
        peak_e = flares_e[min(max(round(v), top), bottom - 1), min(max(round(u), left), right - 1)]
    most_e, count, above = peaks * peak_e, 0, 0
    least2_px2, most2_px2 = ring_px[0] ** 2, ring_px[1] ** 2
    for row in range(max(top, math.floor(v - ring_px[1])), min(bottom, math.ceil(v + ring_px[1]) + 1)):
        for column in range(max(left, math.floor(u - ring_px[1])), min(right, math.ceil(u + ring_px[1]) + 1)):
            if least2_px2 <= (column - u) ** 2 + (row - v) ** 2 <= most2_px2:
                count += 1
                above += image_e[row, column] - flares_e[row, column] - background_e > most_e
    return above / max(count, 1)


def is_hardly_seen(solution: Solution, index: int, shape: tuple[int, int]) -> bool:
    """Tell whether a flare is seen from one side alone: a third of it falls where its window does not look.

    Beside what is left out of a window, as the rest of a lit patch, anything may seem to be a flare: the
    little that is seen of it is the patch's border. What falls beyond the frame (`shape`) does not count, nor
    what falls on columns that are left out whole, because charge spilled along them.
    """
    window = solution.window
    width_px = math.hypot(solution.psf_sigma_px, 0.5 * float(solution.image_radius_px[index]))
    place = float(solution.u_px[index]), float(solution.v_px[index])
    share, off_px = _seen(window.state, (window.box.left, window.box.top), place, width_px, shape)
    return share < _LEAST_SEEN and off_px > _MOST_OFF * width_px


@compiled
def _seen(
    state: NDArray[np.uint8], corner: tuple[int, int], place: tuple[float, float], width_px: float,
    shape: tuple[int, int],
) -> tuple[float, float]:  # fmt: skip
    """Return how much of a Gaussian falls on usable pixels of a window, and how far off its middle that lies.

    Of what falls on the frame and on no column that is unusable as a whole; the distance is that of the
    centroid of what is seen from that of what could be.
    """
    reach, seen, whole = math.ceil(3.0 * width_px), 0.0, 0.0
    off_u, off_v, whole_u, whole_v = 0.0, 0.0, 0.0, 0.0
    middle_row, middle = round(place[1]), round(place[0])
    left_out = np.ones(state.shape[1], dtype=np.bool_)  # columns, as a whole
    for here in range(state.shape[0]):
        for at in range(state.shape[1]):
            left_out[at] &= state[here, at] == UNUSABLE
    first, end = max(middle - reach, 0), min(middle + reach + 1, shape[1])
    across = np.exp(-0.5 * ((np.arange(first, end) - place[0]) / width_px) ** 2)
    for row in range(max(middle_row - reach, 0), min(middle_row + reach + 1, shape[0])):
        v, here = row - place[1], row - corner[1]
        down = math.exp(-0.5 * (v / width_px) ** 2)
        for column in range(first, end):
            u, light, at = column - place[0], down * across[column - first], column - corner[0]
            inside = 0 <= here < state.shape[0] and 0 <= at < state.shape[1]
            if inside and left_out[at]:
                continue
            whole += light
            whole_u += light * u
            whole_v += light * v
            if inside and state[here, at] != UNUSABLE:
                seen += light
                off_u += light * u
                off_v += light * v
    if seen == 0.0:
        return (0.0, math.inf) if whole > 0.0 else (1.0, 0.0)
    return seen / whole, math.hypot(off_u / seen - whole_u / whole, off_v / seen - whole_v / whole)


def is_clipped_elsewhere(solution: Solution) -> bool:
    """Tell whether pixels are clipped where the flares that explain a window are half as bright at most.

    Long lamps have 12 to 37 % of their clipped pixels there, points none up to fifty times full scale. What
    structure of the background explains, which may be any lamp, counts for nothing.
    """
    window = solution.window
    clipped = window.state == CLIPPED
    bright_e = solution.flares_e + solution.background_e
    dim = clipped & (bright_e < _CLIPPED_DIM * window.image_e)
    return int(dim.sum()) > _MOST_CLIPPED_DIM * int(clipped.sum())


def is_any_outline(solution: Solution, blobs: int) -> bool:
    """Tell whether it takes so many more flares than blobs that they have the outline of any clipped lamp.

    Those that move have two unknowns more each: three are as long and as bent as any lamp is.
    """
    moves = solution.motion_px is not None and bool((solution.window.state == CLIPPED).any())
    return solution.count > blobs + (_MOST_MOVING_OF_CLIPPED if moves else _MOST_OF_CLIPPED)


def is_other_limb(solution: Solution, camera: Camera) -> bool:
    """Tell whether what is seen of the limb of a clipped disc that fits badly is not that of a source.

    How bright it is within nobody sees; but the limb of a lamp that is dimmer or brighter than sources are,
    or not round, lies elsewhere. Where a disc of such a kind explains far more than a source does, also
    through a point spread that is not the calibration's, it is none; nor is what leaves a tenth of the light.
    """
    if solution.count > 1 or float(solution.radius_at_rest_px[0]) < _LIMB_RADIUS_PX:
        return False
    (wider,) = of_free_width([solution], camera)
    if wider is None or wider.left_over.share > _MOST_LEFT_OF_LIMB:
        return solution.left_over.share > _MOST_LEFT_OF_LIMB
    if wider.left_over.is_good:
        return False
    oval = fit_oval(wider, camera)
    return _is_unlike(oval, camera) and oval.chi2_more < -_LEAST_GAIN_OF_OVAL


def is_other_oval(solution: Solution, camera: Camera) -> bool:
    """Tell whether one oval that no source is explains all of a clipped flare, and a source does not.

    The flare is one that explains a part of it, beside the columns that charge spilled along; a source may be
    seen through any point spread.
    """
    if solution.count > 1 or float(solution.radius_at_rest_px[0]) < _LIMB_RADIUS_PX:
        return False
    (wider,) = of_free_width([solution], camera)
    if wider is not None and wider.left_over.is_good:
        return False
    oval = fit_oval(wider or solution, camera)
    return oval.is_good and _is_unlike(oval, camera)


def _is_unlike(oval: Oval, camera: Camera) -> bool:
    """Tell whether an oval is longer or brighter than sources are, or dimmer."""
    log_brightness = abs(math.log(oval.brightness)) - 2.0 * _OF_TIE * camera.tie_spread
    return oval.aspect > _MOST_LIMB_ASPECT or log_brightness > math.log(_MOST_LIMB_BRIGHTNESS)


def is_other_size(solution: Solution, free: Solution | None, tie_spread: float) -> bool:
    """Tell whether a lone flare that fits badly is a disc of a size that no source of its flux has.

    Parameters
    ----------
    solution
        The flare, its size tied to its flux.
    free
        The same with any size; None where that has no fit.
    tie_spread
        By how much sizes may disagree with fluxes (`model.window.Camera`).
    """
    if free is None:
        return False
    tied_px, free_px = float(solution.image_radius_px[0]), float(free.image_radius_px[0])
    return abs(free_px - tied_px) > max(_LEAST_PX, (_LEAST_SHARE + 4.0 * tie_spread) * tied_px)
