"""Whether the camera turns while it is exposed: what the flares of a frame tell together.

It draws out the images of all that rests, each along its own line. By one flare alone it may be its own
motion, or two too near to be told apart, and few robots move so fast.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import turn_slopes_px
from perception.model.layout import CLIPPED
from perception.model.likelihood.scoring_step import scoring_step
from perception.model.window import TURN_RAD_PER_S, Camera, Turn, usual_motion_px
from perception.robust.fit import Fit
from perception.robust.motion import Squares, drawn_out_squares
from perception.robust.solve import Solution, solve
from perception.robust.together.free_width import seen_log_width

Array = NDArray[np.float64]

_LEAST_CHI2 = 21.1  # of three degrees of freedom: noise has more once in ten thousand frames
_FEWEST, _MOST, _LEAST_SNR = 3, 32, 10.0
_STRUCTURE = 30.0  # times as bright as texture beneath it is a flare that tells
_MOST_RADIUS_PX = 10.0  # larger ones show whether the lens is as calibrated
_QUICK = 10.0  # times the usual turn: standard deviation of what is looked for
_ROUNDS, _SETTLED = 4, 0.1  # the latter of χ²
_MOST_STEPS, _LEAST_STEP2 = 30, 1e-6
_SIGMAS = 5.0  # of χ²
_BETTER, _MUCH_BETTER = 4.0, 9.0  # of χ²
_LEFT = 0.75  # of what is left over, where more is wrong than that the camera turns
_MUCH_CHI2 = 13.8  # of two degrees of freedom: noise has more once in a thousand flares


def turning(lone: Sequence[Solution], camera: Camera) -> Camera:
    """Return the camera as it turns while it is exposed, as its flares tell together.

    A flare that is swept by m = a + ib is drawn out by m², a and b in pixels. The rotation that explains
    these best must explain more than noise gives once in ten thousand frames without the quarter that speaks
    for it most, as what is two, or moves itself, may be drawn out as far; nor may one of the others speak
    alone. What it leaves must be noise, but for robots' own motions at ordinary speeds: glossy floors that
    draw flares out all in one direction draw near ones out farther. And flares must not be so much narrower
    across, as where a point spread is not round. Those that are no better explained as swept do not speak:
    they may be two.

    Parameters
    ----------
    lone
        Fits of a flare each.
    camera
        Their camera, taken to be at rest.
    """
    tells = [one for one in lone if _tells(one)]
    tells = sorted(tells, key=lambda one: -float(one.flux_e[0] / one.flux_noise_e[0]))[:_MOST]
    fits, before = [(one, one) for one in tells], np.zeros(3)
    for _ in range(_ROUNDS):
        turn = _turn([swept for _, swept in fits], camera)
        if turn is None:
            return camera
        change, before = turn.rotation_rad - before, turn.rotation_rad
        if float(change @ np.linalg.solve(turn.covariance_rad2, change)) < _SETTLED:
            break
        # Of images far from round a residual tells to first order only.
        again = solve([swept.again() for _, swept in fits], replace(camera, turn=turn))
        pairs = zip(fits, again, strict=True)
        fits = [(rest, one) for (rest, _), one in pairs if one is not None and _tells(one)]
    swept = [one for at_rest, one in fits if _is_explained(one, at_rest)]
    turn = _turn(swept, camera)
    if turn is None:
        return camera
    turned = replace(camera, turn=turn)
    return camera if _is_spread(swept, turned) else turned


def with_turn(solution: Solution, camera: Camera) -> Solution:
    """Tell of flares at rest how far they may be off as their motions beside the camera's turn are not known.

    That turn itself is known so well, and robots move at ordinary speeds.
    """
    turn, sources = camera.turn, solution.sources
    if turn is None or sources is None or solution.motion_px is not None:
        return solution
    fit = Fit(solution.again(), camera.moving)
    layout, count = fit.layout, solution.count
    _, covariance = scoring_step(
        solution.window.view, sources, fit.structure, fit.known, fit.prior, fit.values
    )
    if not np.isfinite(covariance).all():
        return solution
    slopes_px = turn_slopes_px(np.column_stack([solution.u_px, solution.v_px]), camera.calibration)
    own_px = usual_motion_px(solution.log_range, camera, 0.0)
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


def _tells(one: Solution) -> bool:
    return (
        one.count == 1
        and one.motion_px is None
        and one.sources is not None
        and one.window.features is None
        and _STRUCTURE * one.window.structure_e <= float(one.flares_e.max())
        and float(one.image_radius_px[0]) <= _MOST_RADIUS_PX
        and float(one.flux_e[0]) > _LEAST_SNR * float(one.flux_noise_e[0])
        and not (one.window.state == CLIPPED).any()
        and one.drawn_out[0] > 0.0
    )


@dataclass(frozen=True, eq=False)
class _Drawn:
    """How far flares are drawn out, and how far a turn draws them out.

    Attributes
    ----------
    square, precision
        As `drawn_out_squares` has them, the turn that their fits know of counted in, shape (flares,).
    by_turn
        How far each is swept, a + ib, per radian about each axis, shape (flares, 3).
    own_px
        How far each may move itself, the standard deviation of each part, shape (flares,).
    range_m
        Shape (flares,).
    """

    square: Squares
    precision: Array
    by_turn: Squares
    own_px: Array
    range_m: Array

    def of(self, kept: NDArray[np.intp]) -> "_Drawn":
        """Return some of them."""
        return _Drawn(*(getattr(self, each.name)[kept] for each in fields(self)))

    def gains(self, rotation_rad: Array) -> Array:
        """Return by how much χ² of each is less with a turn than without, shape (flares,)."""
        left = self.square - (self.by_turn @ rotation_rad) ** 2
        return np.asarray(self.precision * (np.abs(self.square) ** 2 - np.abs(left) ** 2))

    def weight(self, swept: Squares) -> Array:
        """Return the precision of squares, own motions allowed for: by δ beside m changes m² by 2 m δ."""
        return np.asarray(1.0 / (1.0 / self.precision + (2.0 * np.abs(swept) * self.own_px) ** 2))


def _is_explained(swept: Solution, at_rest: Solution) -> bool:
    """Tell whether what a flare at rest leaves over is explained as it is swept: if not, it may be two."""
    left, before = swept.left_over, at_rest.left_over
    return left.is_good or left.noise_chi2 - left.pixels < _LEFT * (before.noise_chi2 - before.pixels)


def _is_spread(lone: Sequence[Solution], turned: Camera) -> bool:
    """Tell whether flares that are fitted as swept are narrower by what that widens them, half or more of it.

    Of a motion m, σ² of an image grows by m²/24 on the mean of all directions.
    """
    swept2_px2 = np.median(
        [abs(complex(one.sources.swept[0])) ** 2 for one in lone if one.sources is not None]
    )
    widened = float(swept2_px2) / (48.0 * turned.calibration.psf_sigma_px**2)
    off, sigma = seen_log_width(lone, turned)
    return abs(off + widened) < 0.5 * widened and off**2 - (off + widened) ** 2 > _BETTER * sigma**2


def _turn(lone: Sequence[Solution], camera: Camera) -> Turn | None:
    """Return the turn that flares tell together, None where they tell of none."""
    if len(lone) < _FEWEST:
        return None
    more, precision = drawn_out_squares(lone)
    swept = np.array([one.sources.swept[0] for one in lone if one.sources is not None])
    square = more + swept**2
    if float(np.sum(precision * np.abs(square) ** 2)) < _LEAST_CHI2:
        return None
    u_px, v_px, log_range = np.array([(one.u_px[0], one.v_px[0], one.log_range[0]) for one in lone]).T
    slopes = turn_slopes_px(np.column_stack([u_px, v_px]), camera.calibration)
    own_px = usual_motion_px(log_range, camera, 0.0)
    drawn = _Drawn(square, precision, slopes[:, 0] + 1j * slopes[:, 1], own_px, np.exp(log_range))
    sigma_rad = _QUICK * TURN_RAD_PER_S * camera.exposure_s
    gain, rotation_rad = _first_guess(drawn, sigma_rad)
    if gain < _LEAST_CHI2:
        return None
    rotation_rad, _ = _likeliest(rotation_rad, drawn, sigma_rad)
    by_gain = np.argsort(drawn.gains(rotation_rad), kind="stable")
    kept = drawn.of(by_gain[: len(lone) - max(len(lone) // 4, 1)])
    rotation_rad, _ = _likeliest(rotation_rad, kept, sigma_rad)
    swept = kept.by_turn @ rotation_rad
    weight, free = kept.weight(swept), 2 * len(swept) - 3
    chi2 = float(np.sum(weight * np.abs(kept.square - swept**2) ** 2))
    gains = kept.gains(rotation_rad)
    if float(gains.sum()) < _LEAST_CHI2 or float(gains.sum() - gains.max()) < _MUCH_CHI2:
        return None
    if chi2 > free + _SIGMAS * math.sqrt(2.0 * free):
        return None
    # As 1/d² does what moves past, or stands on a mirror.
    nearness = kept.range_m**-2.0
    past = np.sum(weight * nearness * kept.square) / np.sum(weight * nearness**2)
    if float(np.sum(weight * np.abs(kept.square - past * nearness) ** 2)) < chi2 - _MUCH_BETTER:
        return None
    # Those that were left out have their say where they agree: they are not all above the mean by chance.
    swept = drawn.by_turn @ rotation_rad
    agree = drawn.weight(swept) * np.abs(drawn.square - swept**2) ** 2 < _MUCH_CHI2
    rotation_rad, covariance_rad2 = _likeliest(rotation_rad, drawn.of(np.flatnonzero(agree)), sigma_rad)
    return Turn(rotation_rad, max(chi2 / free, 1.0) * covariance_rad2)


def _first_guess(drawn: _Drawn, sigma_rad: float) -> tuple[float, Array]:
    """Return about the most of χ² that any rotation may gain, and a first guess of the one that gains most.

    Squares are linear in the products of the rotation's parts: the best matrix of these gains more than one
    that is of rank one, as products are; the first guess is its largest part.
    """
    first, second = np.triu_indices(3)
    products = drawn.by_turn[:, first] * drawn.by_turn[:, second] * np.where(first == second, 1.0, 2.0)
    root = np.sqrt(drawn.precision)
    design, seen = root[:, None] * products, root * drawn.square
    pull = (design.conj().T @ seen).real
    best = np.linalg.solve((design.conj().T @ design).real + np.eye(6) / sigma_rad**4, pull)
    matrix = np.empty((3, 3))
    matrix[first, second] = matrix[second, first] = best
    values, vectors = np.linalg.eigh(matrix)
    return float(pull @ best), math.sqrt(max(float(values[-1]), 0.0)) * vectors[:, -1]


def _likeliest(rotation_rad: Array, drawn: _Drawn, sigma_rad: float) -> tuple[Array, Array]:
    """Return the likeliest rotation and its covariance, by Gauss and Newton's steps, damped."""
    prior, damping = np.eye(3) / sigma_rad**2, 1e-3
    swept = drawn.by_turn @ rotation_rad
    for _ in range(_MOST_STEPS):
        weight, left = drawn.weight(swept), drawn.square - swept**2
        slope = 2.0 * swept[:, None] * drawn.by_turn
        information = (slope.conj().T @ (weight[:, None] * slope)).real + prior
        pull = (slope.conj().T @ (weight * left)).real - prior @ rotation_rad
        shift = np.linalg.solve(information + damping * np.diag(np.diagonal(information)), pull)
        trial_rad = rotation_rad + shift
        trial = drawn.by_turn @ trial_rad
        gained = np.sum(weight * (np.abs(left) ** 2 - np.abs(drawn.square - trial**2) ** 2))
        if gained + rotation_rad @ prior @ rotation_rad < trial_rad @ prior @ trial_rad:
            damping *= 10.0
            continue
        rotation_rad, swept, damping = trial_rad, trial, 0.1 * damping
        if float(shift @ information @ shift) < _LEAST_STEP2:
            break
    return rotation_rad, np.asarray(np.linalg.inv(information))
