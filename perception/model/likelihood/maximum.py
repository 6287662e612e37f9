"""Where what a window shows is likeliest: Fisher scoring, with Levenberg's damping."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import CLIPPED, SEEN, Known, Sources, Structure, View
from perception.model.likelihood.pixels import (
    expectation,
    is_inside,
    log_variances,
    objective,
    slopes,
    take_last_step,
)
from perception.model.likelihood.products import dot, factorised, inverted, solved, variance_of

Array = NDArray[np.float64]

# A climb is settled where a step is so short, or the next one is if steps go on to shorten as they did; a
# first one below the latter is taken for the last, as from where images were laid out anew.
SETTLED_SIGMAS, LAST_SIGMAS = 0.01, 0.1
LAST_SHARE = 0.1  # of the farthest step: so short it must be for that slopes say what it changes
LEAST_DAMPING, FIRST_DAMPING, MOST_DAMPING = 1e-6, 1e-3, 1e7
MOST_STEPS = 50
# Whether a climb is hopeless is judged after so many steps: ahead is, in -2 ln L, at most so much more than
# so many times what is to be had to first order.
JUDGED_AFTER, MORE_TO_GAIN, TIMES_TO_GAIN = 4, 10.0, 3.0


@compiled
def _add_bend(
    view: View, expected: Array, jacobian: Array, variance: Array, motion: int, into: Array
) -> None:
    """Add to a lone flare's information how ln L bends with its motion beside it, where that is downwards.

    A motion m adds ∂ᵢ∂ⱼ(F S) mᵢ mⱼ / 24 to a flare's light: of that first order in m's square Fisher's
    information knows nothing across a short m, and steps by it alone go to and fro. For the steps alone:
    second derivatives are differences of first ones. `motion` is the index of the first of both unknowns.
    """
    columns, uu, uv, vv = view.image_e.shape[1], 0.0, 0.0, 0.0
    image, state = view.image_e.ravel(), view.state.ravel()
    for pixel in range(columns + 1, len(expected) - columns - 1):
        if state[pixel] != SEEN:
            continue
        pull = (image[pixel] - expected[pixel]) / (24.0 * variance[pixel])
        uu += pull * (jacobian[0, pixel + 1] - jacobian[0, pixel - 1])
        vv += pull * (jacobian[1, pixel + columns] - jacobian[1, pixel - columns])
        uv += pull * (jacobian[0, pixel + columns] - jacobian[0, pixel - columns])
    # Of the two bends along the axes of a symmetric matrix those that are positive.
    mean, half = 0.5 * (uu + vv), math.hypot(0.5 * (uu - vv), uv)
    larger, smaller = max(mean + half, 0.0), max(mean - half, 0.0)
    cosine, sine = (0.5 * (uu - vv) / half, uv / half) if half > 0.0 else (1.0, 0.0)
    even, odd = 0.5 * (larger + smaller), 0.5 * (larger - smaller)
    into[motion, motion] += even + odd * cosine
    into[motion + 1, motion + 1] += even - odd * cosine
    into[motion, motion + 1] += odd * sine
    into[motion + 1, motion] += odd * sine


@compiled
def maximise(
    view: View, sources: Sources, structure: Structure, known: Known, precision: Array, most_step: Array,
    to_beat: float, values: Array, covariance: Array, expected: Array,
) -> tuple[float, float]:  # fmt: skip
    """Find the unknowns that make what a window shows likeliest, by Fisher scoring with Levenberg's damping.

    Parameters
    ----------
    view, sources, structure, known
        The window, and what is in it.
    precision, most_step
        Of the unknowns: a priori, shape (unknowns, unknowns), and how far they may move at once, shape
        (unknowns,) (`layout.Layout`).
    to_beat
        -2 ln L: where all that is ahead is sure to be less likely, the climb is given up.
    values
        First values, shape (unknowns,); the estimates are written there.
    covariance, expected
        Shape (unknowns, unknowns) and (pixels,): the inverse of information and priors, and λ, are written.

    Returns
    -------
    −2 ln L, priors included, but for a constant of the data, and ln of the determinant of information and
    priors; both infinite where no step below a hundredth of a standard deviation was ahead, or none tried.
    """
    size, pixels, count = len(values), len(expected), len(sources.log_range_at)
    step = 3 + (known.tie_spread > 0.0) + 2 * (known.motion_px > 0.0)
    first_wave = count * step + (known.width_spread > 0.0) + 1
    rows = size - len(structure.order)
    jacobian, new_jacobian = np.empty((rows, pixels)), np.empty((rows, pixels))
    new_expected, variance, new_variance = np.empty(pixels), np.empty(pixels), np.empty(pixels)
    gradient, trial, shift, clip_e = np.empty(size), np.empty(size), np.empty(size), known.clip_e
    fisher, damped, factor = np.empty((size, size)), np.empty((size, size)), np.empty((size, size))
    scale = np.empty(size)
    damping, is_new, to_gain, before, taken, sigmas = FIRST_DAMPING, True, 0.0, 0.0, 0, math.inf
    was_rejected = False
    expectation(values, view, sources, structure, known, expected, jacobian, variance)
    for _ in range(MOST_STEPS):
        if is_new:
            slopes(
                view, structure, first_wave, values, expected, jacobian, variance, precision, clip_e, False,
                gradient, fisher,
            )  # fmt: skip
            if math.isnan(factorised(fisher, scale, factor)):
                return math.inf, math.inf
            solved(scale, factor, gradient, shift)
            to_gain = dot(shift, gradient)
            before_sigmas, sigmas = sigmas, 0.0
            for one in range(count * step):
                sigmas = max(sigmas, abs(shift[one]) / math.sqrt(variance_of(scale, factor, one)))
            left_sigmas = sigmas * min(sigmas / before_sigmas, 1.0)
            is_short = bool((np.abs(shift) <= LAST_SHARE * most_step).all())
            if is_short and sigmas <= LAST_SIGMAS and left_sigmas <= SETTLED_SIGMAS:
                take_last_step(
                    view, structure, known, first_wave, shift, values, jacobian, expected, variance
                )
                break
            if sigmas <= SETTLED_SIGMAS:
                break
            before = objective(view, values, expected, variance, precision, clip_e)
            if taken >= JUDGED_AFTER and math.isfinite(to_beat):
                ahead = MORE_TO_GAIN + TIMES_TO_GAIN * to_gain
                if before + log_variances(view, variance) - ahead > to_beat:
                    return math.inf, math.inf
        for one in range(size):
            damped[one] = fisher[one]
            damped[one, one] *= 1.0 + damping
        if known.motion_px > 0.0 and count == 1:
            _add_bend(view, expected, jacobian, variance, step - 2, damped)
        if math.isnan(factorised(damped, scale, factor)):
            return math.inf, math.inf
        solved(scale, factor, gradient, shift)
        for one in range(size):
            trial[one] = values[one] + min(max(shift[one], -most_step[one]), most_step[one])
        is_new = False
        if is_inside(trial, view, count, step):
            expectation(trial, view, sources, structure, known, new_expected, new_jacobian, new_variance)
            after = objective(view, trial, new_expected, variance, precision, clip_e)
            is_new = after <= before + 1e-9 * abs(before) + 1e-9
        if is_new:
            values[:], expected[:] = trial, new_expected
            jacobian, new_jacobian = new_jacobian, jacobian
            variance, new_variance = new_variance, variance
            damping, taken = max(damping if was_rejected else 0.1 * damping, LEAST_DAMPING), taken + 1
            was_rejected = False
        else:
            damping, was_rejected = 10.0 * damping, True
            if not damping < MOST_DAMPING:
                return math.inf, math.inf
    else:
        return math.inf, math.inf
    if (view.state == CLIPPED).any():
        slopes(
            view, structure, first_wave, values, expected, jacobian, variance, precision, clip_e, True,
            gradient, fisher,
        )  # fmt: skip
    log_det = inverted(fisher, covariance)
    if math.isnan(log_det):
        return math.inf, math.inf
    chi2 = objective(view, values, expected, variance, precision, clip_e)
    return chi2 + log_variances(view, variance), log_det
