"""Flares that are drawn out, as they move while they are exposed: rivals of round ones and of pairs."""

import cmath
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import PixelBox
from perception.model.likelihood.maximum import MORE_TO_GAIN, TIMES_TO_GAIN
from perception.model.window import MOST_MOTION_PX, Camera, is_usual_motion, motion_price
from perception.robust.goodness import drawn_out
from perception.robust.overlap.deblend import asks_for_more
from perception.robust.overlap.rivals import NO_RIVAL, weighed
from perception.robust.problem import Motion, Problem
from perception.robust.solve import Solution, solve

Array = NDArray[np.float64]
Squares = NDArray[np.complex128]
"""Of motions a + ib along u and v, in px²: they draw images out by these, which add."""

SEEMS_CHI2 = 6.0
"""Of two degrees of freedom, what a lone flare longer than wide leaves over: noise does it once in 20."""

LEAST_PX = 0.2
"""A flare that seems to move less is taken to rest: it changes its flux by less than a thousandth."""

_LONG = 0.2  # radii by which a disc moves: it is a tenth longer than wide

MOST_TOGETHER = 4
"""More flares in one window are not tried as moving ones."""

_COARSE = 1.2  # differences of neighbours see so much more of a point than is there (`goodness.drawn_out`)

AT_REST = (0.0, 0.0)
"""A fit that begins so stays so where the camera does not turn: to first order a motion changes nothing."""


def moving(solutions: Sequence[Solution | None], camera: Camera) -> dict[int, Solution]:
    """Fit flares that are longer than wide as moving ones, and return by index the likelier of both.

    Lone ones where the residual says so; of several in one window, where it asks for more. The sigmas of what
    is returned know of the other.
    """
    tried: list[tuple[int, Solution]] = []
    problems = []
    for index, solution in enumerate(solutions):
        if solution is None or solution.count > MOST_TOGETHER:
            continue
        if solution.count > 1 and not asks_for_more(solution):
            continue
        motions = asked_motions(solution, camera)
        if any(motion != AT_REST for motion in motions):
            tried.append((index, solution))
            problems.append(Problem(solution.window, solution.starts, solution.background_e, motions))
    fits = solve(problems, camera)
    return {
        index: weighed(fit, at_rest) if fit.cost < at_rest.cost else weighed(at_rest, fit)
        for (index, at_rest), fit in zip(tried, fits, strict=True)
        if fit is not None and moves(fit)
    }


def moves(fit: Solution) -> bool:
    """Tell whether flares that may move do: as far as is seen, and no farther than is believed."""
    if fit.motion_px is None or fit.most_motion_px > MOST_MOTION_PX:
        return False
    swept = 0.0 if fit.sources is None else fit.sources.swept
    whole = fit.motion_px @ (1.0, 1.0j) + swept
    return bool(np.abs(whole**2 - swept**2).max() >= LEAST_PX**2)


def asked_motions(solution: Solution, camera: Camera) -> list[Motion]:
    """Return the motion of each that the residual of flares at rest asks for; `AT_REST` where of none."""
    if solution.count == 1:
        return [_seen(solution, 0, *solution.drawn_out, camera)]
    return [_seen(solution, k, *_drawn_out(solution, k), camera) for k in range(solution.count)]


def drawn_out_squares(lone: Sequence[Solution]) -> tuple[Squares, Array]:
    """Return by how much more flares are drawn out than their fits, and the precision of both its parts.

    (a + ib)², a and b the motion along u and v; of one σ in both parts. Shape (flares,) each. A precision of
    0 tells nothing.
    """
    seen = np.array([one.drawn_out[:3] for one in lone]).reshape(-1, 3)
    square: Squares = (seen[:, 1] + 1j * seen[:, 2]) ** 2 / _COARSE
    length4 = np.abs(square) ** 2
    return square, np.divide(seen[:, 0], length4, out=np.zeros(len(seen)), where=length4 > 0.0)


def share_asked(solution: Solution) -> float:
    """Return how much of the χ² beyond noise that flares at rest leave the motions it asks for explain.

    To first order. χ² of the motions knows of noise alone, the other of the model's errors, too: of bright
    flares it is more than all of it.
    """
    left = solution.left_over
    asked = (
        [solution.drawn_out]
        if solution.count == 1
        else [_drawn_out(solution, k) for k in range(solution.count)]
    )
    return sum(chi2 for chi2, *_ in asked) / max(left.seen_chi2 - left.seen_pixels, 1.0)


def is_long_clutter(solution: Solution, index: int, camera: Camera) -> bool:
    """Tell whether a flare on texture or edges moves as no robot does: leaves, seams and slits are long, too.

    On an even ground something else that is long is as rare as a robot that is so quick. A disc that seems to
    move by less than a fifth of its radius is not long: a lens that is slightly off makes it so.
    """
    if solution.motion_px is None or not (solution.window.on_edges or solution.window.structure_e > 0.0):
        return False
    length_px, log_range = np.hypot(*solution.motion_px.T), solution.log_range
    is_long = length_px[index] > _LONG * solution.radius_at_rest_px[index]
    return bool(is_long) and not is_usual_motion(length_px, log_range, camera)[index]


def _seen(
    solution: Solution,
    flare: int,
    chi2: float,
    along_u: float,
    along_v: float,
    most_gain: float,
    camera: Camera,
) -> Motion:
    """Return the motion of a flare that a residual asks for (`drawn_out`), if it does.

    One that costs more than it may gain, by so much that it would not be weighed in, is none.
    """
    length_px = math.hypot(along_u, along_v)
    if not (chi2 > SEEMS_CHI2 and LEAST_PX < length_px < math.inf):
        return AT_REST
    # To first order a residual may ask for a motion that is too long, and longer ones cost more.
    price = motion_price(np.array([0.5 * length_px]), solution.log_range, camera)
    if solution.count > 1:
        most_gain = min(most_gain, MORE_TO_GAIN + TIMES_TO_GAIN * chi2)
    if most_gain < float(price.min()) - NO_RIVAL:
        return AT_REST
    shorter = min(1.0, 0.5 * MOST_MOTION_PX / length_px)
    asked = complex(shorter * along_u, shorter * along_v)
    if solution.sources is None:
        return asked.real, asked.imag
    swept = complex(solution.sources.swept[flare])
    whole = cmath.sqrt(swept**2 + asked**2)
    beside = whole - swept if (whole * swept.conjugate()).real >= 0.0 else -whole - swept
    return beside.real, beside.imag


def _drawn_out(solution: Solution, flare: int) -> tuple[float, float, float, float]:
    """Return what the residual around one of several flares says of its motion, as `Solution.drawn_out`."""
    window = solution.window
    part = _around(solution, flare).seen_from(window.box).slices
    return drawn_out(
        np.ascontiguousarray(window.image_e[part]),
        np.ascontiguousarray(window.state[part]),
        np.ascontiguousarray(solution.expected_e[part]),
        np.ascontiguousarray(solution.flares_e[part]),
        window.floor_e2,
        window.prnu,
    )


def _around(solution: Solution, flare: int) -> PixelBox:
    """Return the part of a window that one of its flares shines into."""
    swept_px = 0.0 if solution.sources is None else abs(complex(solution.sources.swept[flare]))
    radius_px = float(solution.image_radius_px[flare]) + 0.5 * swept_px
    reach_px = math.ceil(radius_px + 3.0 * solution.psf_sigma_px)
    left, top = round(float(solution.u_px[flare])) - reach_px, round(float(solution.v_px[flare])) - reach_px
    window, side = solution.window.box, 2 * reach_px + 1
    part = PixelBox(top, left, side, side).seen_from(window).inside((window.height, window.width))
    return PixelBox(part.top + window.top, part.left + window.left, part.height, part.width)
