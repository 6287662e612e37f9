"""Whether a lone disc's limb leaves room for another shape: what is costly to look for is looked for there.

Sources are as bright at any range. So a disc that something hides in part, or behind which another stands
out, differs from the whole disc in where its limb lies: to first order by light along the limb, in proportion
to how far it is displaced. What a few harmonics of any displacement would explain of a fit's residual says,
at the price of one step of a fit, how much any such shape could.
"""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.bearing import pixel_turn
from perception.model.layout import SEEN
from perception.model.likelihood.products import add_information, inverted
from perception.model.spread.edges import blur_of, whole_lanes
from perception.model.spread.shares import shares
from perception.model.window import Camera
from perception.robust.goodness import MODEL_ERROR
from perception.robust.overlap.deblend import LEAST_GAIN, asks_for_more
from perception.robust.solve import Solution

Array = NDArray[np.float64]

_SEEN_OF_GAIN = 0.9
"""Part of another shape's gain that the harmonics gain at least: what they miss noise makes up for.

Noise alone gives as much as there are harmonics, up to 18 ± 6.
"""

_MOST_HARMONICS, _PER_RADIUS_PX = 10, 2.6  # the point spread lets no finer ones through
_STEP_PX, _FEWEST_STEPS = 0.5, 16


def may_be_other_shape(one: Solution, camera: Camera) -> bool:
    """Tell whether a flare may gain `LEAST_GAIN` by not being a whole disc: of several in a window always.

    One that glare surrounds fits badly, too; but what is left is round.

    Parameters
    ----------
    one
        The flare, fitted as a whole disc.
    camera
        The camera.
    """
    if not asks_for_more(one):
        return False
    if one.count > 1 or one.motion_px is not None:
        return True
    return not gain_by_limb(one, camera) < _SEEN_OF_GAIN * LEAST_GAIN


def gain_by_limb(one: Solution, camera: Camera) -> float:
    """Return what displacing a lone disc's limb would gain, as 2 Δ ln L with an imperfect model.

    By one step from the fit, beside what size, brightness and background would gain; NaN where it is unknown.
    """
    u_px, v_px, radius_px = float(one.u_px[0]), float(one.v_px[0]), float(one.image_radius_px[0])
    turn = pixel_turn([[u_px, v_px]], camera.calibration)[0]
    values, axes = np.linalg.eigh(turn @ turn.T)
    # From angles about the middle to pixels, but for a factor: the largest half axis is the radius.
    stretched = axes @ np.diag(np.sqrt(values[0] / values)) @ axes.T
    phase = np.arange(0.0, 1.0, 1.0 / max(_FEWEST_STEPS, math.ceil(2.0 * math.pi * radius_px / _STEP_PX)))
    angle = 2.0 * math.pi * phase
    out_u, out_v = radius_px * (stretched @ np.stack([np.cos(angle), np.sin(angle)]))
    orders = np.arange(1, 1 + max(2, min(int(_PER_RADIUS_PX * radius_px), _MOST_HARMONICS)))
    waves = np.outer(orders, angle)
    window = one.window
    weight = np.where(window.state == SEEN, 1.0 / one.variance_e2(MODEL_ERROR), 0.0)
    return _gain(
        one.residual_e, weight, one.flares_e,
        np.stack([u_px - window.box.left + out_u, v_px - window.box.top + out_v]),
        np.concatenate([np.ones((1, len(angle))), np.cos(waves), np.sin(waves)]), one.psf_sigma_px,
    )  # fmt: skip


@compiled
def _gain(
    left_e: Array, weight: Array, flares_e: Array, outline: Array, waves: Array, sigma_px: float
) -> float:
    """Return what a residual loses, in χ², by light along an outline, modulated by waves.

    Beside what the first wave, which is even, the flares' light and the ground would take of it. `outline`
    has the shape (2, points), `waves` (waves, points). NaN where some of it cannot be told from the rest.
    """
    rows, columns = left_e.shape
    count = len(waves) + 2
    images = np.zeros((count, rows, columns))
    across, down = np.empty((3, whole_lanes(columns))), np.empty((3, whole_lanes(rows)))
    blur = blur_of(sigma_px, max(rows, columns))
    for point in range(outline.shape[1]):
        left, right = shares(outline[0, point], columns, blur, across)
        top, bottom = shares(outline[1, point], rows, blur, down)
        for wave in range(len(waves)):
            for row in range(top, bottom):
                light = waves[wave, point] * down[0, row]
                for column in range(left, right):
                    images[wave, row, column] += light * across[0, column]
    images[count - 2], images[count - 1] = flares_e, 1.0
    by, flat_weight, residual = images.reshape(count, -1), weight.ravel(), left_e.ravel()
    information, inverse = np.zeros((count, count)), np.empty((count, count))
    add_information(by, flat_weight, information)
    if math.isnan(inverted(information, inverse)):
        return math.nan
    pull = np.zeros(count)
    for one in range(count):
        for pixel in range(len(residual)):
            pull[one] += by[one, pixel] * flat_weight[pixel] * residual[pixel]
    # What is round, as size, brightness and ground are, is no other shape.
    is_round = np.array([0, count - 2, count - 1])
    by_round, round_inverse = np.empty((3, 3)), np.empty((3, 3))
    for one in range(3):
        for other in range(3):
            by_round[one, other] = information[is_round[one], is_round[other]]
    if math.isnan(inverted(by_round, round_inverse)):
        return math.nan
    gain = 0.0
    for one in range(count):
        for other in range(count):
            gain += pull[one] * inverse[one, other] * pull[other]
    for one in range(3):
        for other in range(3):
            gain -= pull[is_round[one]] * round_inverse[one, other] * pull[is_round[other]]
    return gain
