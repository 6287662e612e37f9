"""What is no source: bad pixels by their shape, lamps and sheen by their size."""

import math

import numpy as np

from perception.robust.clusters import Candidate
from perception.robust.goodness import MODEL_ERROR
from perception.robust.prepare import PreparedFrame
from perception.robust.solve import Solution

LEAST_RANGE_M = 0.03
"""Nothing is taken for a source that would stand nearer to the lens."""

_REACH_PX = 2
_DISC_FILLS = (0.88, 1.12)
_MOST_ASPECT = 1.5
_MOST_BRIGHTNESS_FACTOR = 2.0
_LEAST_PX, _LEAST_SHARE = 1.0, 0.15


def is_one_pixel(solution: Solution) -> bool:
    """Tell whether a single pixel that is stuck or hot explains a window better than a lone flare does.

    A flare's light lies on its pixel's neighbours as well. χ² over 5 × 5 pixels is compared: of the even
    background with one pixel free, and of the flare. (Bright ones `sensor.bad_pixels` has found before.)
    """
    window = solution.window
    reached = window.usable & (solution.flares_e > 0.02 * solution.flares_e.max())
    row, column = np.unravel_index(int(np.argmax(np.where(reached, window.image_e, -np.inf))), reached.shape)
    near = np.s_[
        max(row - _REACH_PX, 0) : row + _REACH_PX + 1, max(column - _REACH_PX, 0) : column + _REACH_PX + 1
    ]
    others = window.usable.copy()
    others[row, column] = False
    background_e = solution.expected_e - solution.flares_e
    of_pixel = (window.image_e - background_e) ** 2 / (np.maximum(background_e, 0.0) + window.floor_e2)
    of_flare = solution.residual_e**2 / solution.variance_e2(MODEL_ERROR)
    return float(of_pixel[near][others[near]].sum()) < float(of_flare[near][window.usable[near]].sum())


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


def is_no_large_disc(member: Candidate, prepared: PreparedFrame) -> bool:
    """Tell whether a blob too large to be fitted is no source: by its outline, its brightness, its range.

    The image of a sphere is an ellipse, hardly longer than wide, and as bright at any range: its flux at one
    metre over the area of its image there.
    """
    box, calibration = member.blob.box, prepared.calibration
    rows, columns = prepared.lit.shape
    cut = box.top == 0 or box.left == 0 or box.top + box.height == rows or box.left + box.width == columns
    fill = member.blob.area_px / (0.25 * math.pi * box.height * box.width)
    aspect = max(box.height, box.width) / min(box.height, box.width)
    # What the frame's edge cuts off a disc leaves no rectangle.
    if fill > _DISC_FILLS[1] or (not cut and (fill < _DISC_FILLS[0] or aspect > _MOST_ASPECT)):
        return True
    radius_px = 0.5 * math.sqrt(box.height * box.width)
    if calibration.fx_px * calibration.source_radius_m / radius_px < LEAST_RANGE_M:
        return True
    if not member.at_one_metre_e > 0.0:
        return False
    disc_e = member.at_one_metre_e / (math.pi * (calibration.fx_px * calibration.source_radius_m) ** 2)
    pixels_e = (
        prepared.image_e[box.slices][member.blob.pixels]
        - prepared.background_e[box.slices][member.blob.pixels]
    )
    seen_e = float(np.median(pixels_e))
    if disc_e > seen_e:
        return not member.is_clipped and disc_e > _MOST_BRIGHTNESS_FACTOR * seen_e
    return seen_e > _MOST_BRIGHTNESS_FACTOR * disc_e
