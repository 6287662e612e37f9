"""Whether the camera turns while it is exposed: what all small flares of a frame tell together.

It draws out the images of all that rests, each along its own line. By one flare alone it may be its own
motion, or two too near to be told apart, and few robots move so fast.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import turn_slopes_px
from perception.model.layout import CLIPPED
from perception.model.likelihood.scoring_step import scoring_step
from perception.model.window import SPEED_M_PER_S, TURN_RAD_PER_S, Camera, Turn
from perception.robust.solve import Solution, solve

Array = NDArray[np.float64]
Squares = NDArray[np.complex128]

MOST_RADIUS_PX = 3.0
"""Of flares whose image tells of point spread and motion, and not of their own outline."""

_LEAST_CHI2 = 30.7  # of three degrees of freedom: noise has more once in a million frames
_FEWEST, _MOST, _LEAST_SNR = 3, 32, 10.0
_QUICK = 10.0  # times the usual turn: standard deviation of what is looked for
_ROUNDS, _MOST_STEPS, _SETTLED = 4, 30, 0.1
_COARSE = 1.2  # differences of neighbours see so much more than is there (`goodness.drawn_out`), of points
_CONSISTENT = 5.0  # standard deviations of χ²


def turning(lone: Sequence[Solution], camera: Camera) -> Camera:
    """Return the camera as it turns while it is exposed, as all small flares at rest tell together.

    A flare that is swept by m = a + ib is drawn out by m², a and b in pixels. The rotation that explains
    these best must explain more than noise gives once in a million frames without the quarter that speaks
    for it most, as what is two, or moves itself, may be drawn out as far. And what it leaves must be noise,
    but for robots' own motions at ordinary speeds: glossy floors that draw flares out all in one direction
    draw near ones out farther.

    Parameters
    ----------
    lone
        Fits of a flare each.
    camera
        Their camera, taken to be at rest.
    """
    tells = [one for one in lone if _tells(one)]
    tells = sorted(tells, key=lambda one: -float(one.flux_e[0] / one.flux_noise_e[0]))[:_MOST]
    turned, before = camera, np.zeros(3)
    for _ in range(_ROUNDS):
        turn = _turn(tells, camera)
        if turn is None:
            return camera
        turned = replace(camera, turn=turn)
        change = turn.rotation_rad - before
        if float(change @ np.linalg.solve(turn.covariance_rad2, change)) < _SETTLED:
            break
        # Of images far from round a residual tells to first order only.
        before, again = turn.rotation_rad, solve([one.again() for one in tells], turned)
        tells = [one for one in again if one is not None and _tells(one)]
    return turned


def with_turn(solution: Solution, camera: Camera) -> Solution:
    """Tell of flares at rest how far they may be off as their motions beside the camera's turn are not known.

    That turn itself is known so well, and robots move at ordinary speeds.
    """
    turn, sources = camera.turn, solution.sources
    if turn is None or sources is None or solution.motion_px is not None:
        return solution
    moving = camera.moving
    known, beside, count = moving.known(solution.window.clip_e), solution.window.beside, solution.count
    layout = known.layout(count, beside.amplitudes)
    values, precision = np.zeros(layout.size), layout.prior(beside, known.motion_px)
    layout.of_sources(values)[:, :3], values[layout.background] = solution.starts, solution.background_e
    _, covariance = scoring_step(solution.window.view, sources, beside, known, precision, values)
    if not np.isfinite(covariance).all():
        return solution
    slopes_px = turn_slopes_px(np.column_stack([solution.u_px, solution.v_px]), camera.calibration)
    own_px = _own_motion_px(solution.log_range, camera)
    off = np.zeros((2, count))
    for flare in range(count):
        at = flare * layout.per_source
        part = slice(at + layout.motion, at + layout.motion + 2)
        by_motion = np.linalg.solve(covariance[part, part], covariance[part, at + 2 : at + layout.motion])
        lean = [[1.0, -camera.lean], [1.0, 0.0]] if layout.has_slack else [[1.0], [1.0]]
        by_motion = by_motion @ np.transpose(lean)  # of ln range by flux and size, and of it by flux alone
        slope = slopes_px[flare]
        moved_px2 = slope @ turn.covariance_rad2 @ slope.T + own_px[flare] ** 2 * np.eye(2)
        off[:, flare] = np.sqrt(np.einsum("ik,ij,jk->k", by_motion, moved_px2, by_motion))
    return replace(
        solution,
        log_range_of_model=np.hypot(solution.log_range_of_model, off[0]),
        log_flux_of_model=np.hypot(solution.log_flux_of_model, 2.0 * off[1]),
    )


def drawn_out_squares(lone: Sequence[Solution]) -> tuple[Squares, Array]:
    """Return by how much more flares are drawn out than their fits, and the precision of both its parts.

    (a + ib)², a and b the motion along u and v; of one σ in both parts. Shape (flares,) each. A precision of
    0 tells nothing.
    """
    seen = np.array([one.drawn_out[:3] for one in lone]).reshape(-1, 3)
    square: Squares = (seen[:, 1] + 1j * seen[:, 2]) ** 2 / _COARSE
    length4 = np.abs(square) ** 2
    return square, np.divide(seen[:, 0], length4, out=np.zeros(len(seen)), where=length4 > 0.0)


def _tells(one: Solution) -> bool:
    return (
        one.count == 1
        and one.motion_px is None
        and one.sources is not None
        and one.window.is_even
        and float(one.image_radius_px[0]) <= MOST_RADIUS_PX
        and float(one.flux_e[0]) > _LEAST_SNR * float(one.flux_noise_e[0])
        and not (one.window.state == CLIPPED).any()
        and one.drawn_out[0] > 0.0
    )


def _turn(lone: Sequence[Solution], camera: Camera) -> Turn | None:
    """Return the turn that flares tell together, None where they tell of none."""
    if len(lone) < _FEWEST:
        return None
    more, precision = drawn_out_squares(lone)
    swept = np.array([one.sources.swept[0] for one in lone if one.sources is not None])
    square = more + swept**2
    if float(np.sum(precision * np.abs(square) ** 2)) < _LEAST_CHI2:
        return None
    places = np.array([(one.u_px[0], one.v_px[0]) for one in lone])
    slopes = turn_slopes_px(places, camera.calibration)
    by_turn: Squares = slopes[:, 0] + 1j * slopes[:, 1]
    sigma_rad = _QUICK * TURN_RAD_PER_S * camera.exposure_s
    gain, rotation = _first_guess(square, precision, by_turn, sigma_rad)
    if gain < _LEAST_CHI2:
        return None
    own_px = _own_motion_px(np.array([one.log_range[0] for one in lone]), camera)
    rotation, _, _ = _likeliest(rotation, square, precision, by_turn, own_px, sigma_rad)
    gains = _gains(square, precision, by_turn, rotation)
    kept = np.argsort(gains, kind="stable")[: len(lone) - max(len(lone) // 4, 1)]
    square, precision, by_turn, own_px = square[kept], precision[kept], by_turn[kept], own_px[kept]
    rotation, covariance, chi2 = _likeliest(rotation, square, precision, by_turn, own_px, sigma_rad)
    free = 2 * len(kept) - 3
    if chi2 > free + _CONSISTENT * math.sqrt(2.0 * free):
        return None
    if float(_gains(square, precision, by_turn, rotation).sum()) < _LEAST_CHI2:
        return None
    return Turn(rotation, covariance)


def _own_motion_px(log_range: Array, camera: Camera) -> Array:
    """Return how far robots move at ordinary speeds, the standard deviation of each part, shape (flares,)."""
    focal_px = math.sqrt(camera.calibration.fx_px * camera.calibration.fy_px)
    return focal_px * camera.exposure_s * SPEED_M_PER_S * np.exp(-log_range)


def _gains(square: Squares, precision: Array, by_turn: Squares, rotation: Array) -> Array:
    """Return by how much χ² of each flare is less as it is swept."""
    left = square - (by_turn @ rotation) ** 2
    return np.asarray(precision * (np.abs(square) ** 2 - np.abs(left) ** 2))


def _first_guess(
    square: Squares, precision: Array, by_turn: Squares, sigma_rad: float
) -> tuple[float, Array]:
    """Return more than any rotation gains of χ², and a first guess of the one that gains most.

    Squares are linear in the products of the rotation's parts: the best matrix of these gains more than one
    that is of rank one, as products are; the first guess is its largest part.
    """
    first, second = np.triu_indices(3)
    products = by_turn[:, first] * by_turn[:, second] * np.where(first == second, 1.0, 2.0)
    root = np.sqrt(precision)
    design = np.concatenate([(root[:, None] * products).real, (root[:, None] * products).imag])
    seen = np.concatenate([(root * square).real, (root * square).imag])
    pull = design.T @ seen
    best = np.linalg.solve(design.T @ design + np.eye(6) / sigma_rad**4, pull)
    matrix = np.empty((3, 3))
    matrix[first, second] = matrix[second, first] = best
    values, vectors = np.linalg.eigh(matrix)
    return float(pull @ best), math.sqrt(max(float(values[-1]), 0.0)) * vectors[:, -1]


def _likeliest(
    rotation: Array, square: Squares, precision: Array, by_turn: Squares, own_px: Array, sigma_rad: float
) -> tuple[Array, Array, float]:
    """Return the likeliest rotation, its covariance, and χ² of what it leaves, own motions allowed for.

    By Gauss and Newton's steps, damped.
    """

    def left_by(rotation: Array) -> tuple[Squares, Squares]:
        swept = by_turn @ rotation
        return square - swept**2, swept

    left, swept = left_by(rotation)
    damping = 1e-3
    for _ in range(_MOST_STEPS):
        # Of m² a motion δ beside it changes 2 m δ.
        weight = 1.0 / (1.0 / precision + (2.0 * np.abs(swept) * own_px) ** 2)
        slope = 2.0 * swept[:, None] * by_turn
        information = ((weight[:, None] * slope).conj().T @ slope).real + np.eye(3) / sigma_rad**2
        pull = (slope.conj().T @ (weight * left)).real - rotation / sigma_rad**2
        before = float(np.sum(weight * np.abs(left) ** 2)) + float(rotation @ rotation) / sigma_rad**2
        shift = np.linalg.solve(information + damping * np.diag(np.diagonal(information)), pull)
        trial = rotation + shift
        new_left, new_swept = left_by(trial)
        after = float(np.sum(weight * np.abs(new_left) ** 2)) + float(trial @ trial) / sigma_rad**2
        if after > before:
            damping *= 10.0
            continue
        rotation, left, swept, damping = trial, new_left, new_swept, 0.1 * damping
        if float(shift @ information @ shift) < 1e-6:
            break
    return rotation, np.asarray(np.linalg.inv(information)), float(np.sum(weight * np.abs(left) ** 2))
