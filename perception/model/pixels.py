"""What the pixels of a window expect of its sources, how likely is what they show, and where it is likeliest.

Each pixel counts as x + σ² ~ Poisson(λ + σ²), σ² the variance of a dark pixel (Snyder et al., J. Opt. Soc.
Am. A 12, 272, 1995), widened by the spread of the pixels' responses; its score is (x - λ) / variance. A
clipped pixel says only that x is c or more: its score is φ(z) / (σ Q(z)), z = (c - λ) / σ. Variances come
from the model, not from the data: weights from the data would favour pixels that came out low. All that is
here is compiled, one window at a time; `model.window` says what the unknowns are.
"""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.layout import CLIPPED, SEEN, UNUSABLE, Known, Sources, Structure, View, part_of
from perception.model.normal import log_upper_tail, of_clipped
from perception.model.spread import spread_nodes

Array = NDArray[np.float64]

SETTLED_SIGMAS = 0.01
LEAST_DAMPING, FIRST_DAMPING, MOST_DAMPING = 1e-6, 1e-3, 1e7
MOST_STEPS, LEAST_PIVOT = 50, 1e-10
# Whether a climb is hopeless is judged after so many steps: ahead is, in -2 ln L, at most so much more than
# so many times what is to be had to first order.
JUDGED_AFTER, MORE_TO_GAIN, TIMES_TO_GAIN = 4, 10.0, 3.0
LOG_RANGE_BOUND, MOTION_BOUND_PX = 12.0, 30.0


@compiled
def expectation(
    values: Array, view: View, sources: Sources, structure: Structure, known: Known, expected: Array,
    jacobian: Array, variance: Array,
) -> None:  # fmt: skip
    """Compute λ, its derivatives, and the variance of pixels.

    Parameters
    ----------
    values
        Unknowns, in the order of `layout.Layout`.
    view, sources, structure, known
        The window, of which all but what it shows counts, and what is in it.
    expected, jacobian, variance
        Shape (pixels,), (unknowns, pixels) and (pixels,): written; the last as `sensor.pixel_variance_e2`.
    """
    count, has_slack, moves = len(sources.log_range_at), known.tie_spread > 0.0, known.motion_px > 0.0
    step = 3 + has_slack + 2 * moves
    width = count * step
    background = width + (1 if known.width_spread > 0.0 else 0)
    sigma_px = known.psf_sigma_px
    if known.width_spread > 0.0:
        sigma_px *= math.exp(known.width_spread * values[width])
        jacobian[width] = 0.0
    expected[:], jacobian[background] = values[background], 1.0
    expected += view.known_e.ravel()
    for wave in range(len(structure.columns)):
        expected += values[background + 1 + wave] * structure.columns[wave]
        jacobian[background + 1 + wave] = structure.columns[wave]
    image = np.empty((7 if moves else 5, *view.image_e.shape))
    flat = image.reshape(len(image), -1)
    motion = (0.0, 0.0)
    for source in range(count):
        at = source * step
        by_size = values[at + 2]
        if has_slack:
            by_size -= known.tie_spread * values[at + 3]
        if moves:
            motion = (values[at + step - 2], values[at + step - 1])
        image[:] = 0.0
        place = (values[at] - view.left, values[at + 1] - view.top)
        growth = math.exp(sources.log_range_at[source] - by_size)
        spread_nodes(sources, source, place, growth, motion, sigma_px, image)
        flux = math.exp(sources.log_flux_at_1_m[source] - 2.0 * values[at + 2])
        for pixel in range(len(expected)):
            expected[pixel] += flux * flat[0, pixel]
            jacobian[at, pixel] = flux * flat[1, pixel]
            jacobian[at + 1, pixel] = flux * flat[2, pixel]
            jacobian[at + 2, pixel] = -flux * (2.0 * flat[0, pixel] + flat[3, pixel])
        if has_slack:
            jacobian[at + 3] = known.tie_spread * flux * flat[3]
        if moves:
            jacobian[at + step - 2], jacobian[at + step - 1] = flux * flat[5], flux * flat[6]
        if known.width_spread > 0.0:
            jacobian[width] += known.width_spread * flux * flat[4]
    for pixel in range(len(expected)):
        lit_e = max(expected[pixel], 0.0)
        variance[pixel] = lit_e + (known.prnu * lit_e) ** 2 + view.floor_e2


@compiled
def dot(one: Array, other: Array) -> float:
    """Return Σ xᵢ yᵢ: four sums side by side, which the processor adds at once, always in the same order."""
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    whole = len(one) - len(one) % 4
    for at in range(0, whole, 4):
        a += one[at] * other[at]
        b += one[at + 1] * other[at + 1]
        c += one[at + 2] * other[at + 2]
        d += one[at + 3] * other[at + 3]
    for at in range(whole, len(one)):
        a += one[at] * other[at]
    return (a + b) + (c + d)


@compiled
def _four_dots(x: Array, p: Array, q: Array, r: Array, s: Array) -> tuple[float, float, float, float]:
    """Return `dot` of an array and four others each, to the bit: their sums do not wait for one another."""
    p0 = p1 = p2 = p3 = q0 = q1 = q2 = q3 = r0 = r1 = r2 = r3 = s0 = s1 = s2 = s3 = 0.0
    whole = len(x) - len(x) % 4
    for at in range(0, whole, 4):
        a, b, c, d = x[at], x[at + 1], x[at + 2], x[at + 3]
        p0, p1, p2, p3 = p0 + a * p[at], p1 + b * p[at + 1], p2 + c * p[at + 2], p3 + d * p[at + 3]
        q0, q1, q2, q3 = q0 + a * q[at], q1 + b * q[at + 1], q2 + c * q[at + 2], q3 + d * q[at + 3]
        r0, r1, r2, r3 = r0 + a * r[at], r1 + b * r[at + 1], r2 + c * r[at + 2], r3 + d * r[at + 3]
        s0, s1, s2, s3 = s0 + a * s[at], s1 + b * s[at + 1], s2 + c * s[at + 2], s3 + d * s[at + 3]
    for at in range(whole, len(x)):
        p0, q0, r0, s0 = p0 + x[at] * p[at], q0 + x[at] * q[at], r0 + x[at] * r[at], s0 + x[at] * s[at]
    return (p0 + p1) + (p2 + p3), (q0 + q1) + (q2 + q3), (r0 + r1) + (r2 + r3), (s0 + s1) + (s2 + s3)


@compiled
def add_information(jacobian: Array, weight: Array, into: Array) -> None:
    """Add J W Jᵀ."""
    size, pixels = jacobian.shape
    weighted, totals = np.empty(pixels), np.empty(size)
    for one in range(size):
        for pixel in range(pixels):
            weighted[pixel] = jacobian[one, pixel] * weight[pixel]
        fours = (one + 1) // 4 * 4
        for at in range(0, fours, 4):
            totals[at], totals[at + 1], totals[at + 2], totals[at + 3] = _four_dots(
                weighted, jacobian[at], jacobian[at + 1], jacobian[at + 2], jacobian[at + 3]
            )
        for at in range(fours, one + 1):
            totals[at] = dot(weighted, jacobian[at])
        into[one, one] += totals[one]
        for other in range(one):
            into[one, other] += totals[other]
            into[other, one] += totals[other]


@compiled
def slopes(
    view: View, values: Array, expected: Array, jacobian: Array, variance: Array,
    precision: Array, clip_e: float, of_average: bool, gradient: Array, information: Array,
) -> None:  # fmt: skip
    """Write the gradient of ln L and the information, priors included.

    The information is what these very pixels give, or, `of_average`, what such pixels give on average.
    """
    image, state = view.image_e.ravel(), view.state.ravel()
    pull, weight = np.zeros(len(expected)), np.zeros(len(expected))
    for pixel in range(len(expected)):
        if state[pixel] == UNUSABLE:
            continue
        weight[pixel] = 1.0 / variance[pixel]
        if state[pixel] == SEEN and not of_average:
            pull[pixel] = (image[pixel] - expected[pixel]) / variance[pixel]
        elif math.isfinite(clip_e):
            sigma = math.sqrt(variance[pixel])
            mills, curvature, kept = of_clipped((clip_e - expected[pixel]) / sigma)
            pull[pixel] = mills / sigma
            weight[pixel] *= kept if of_average else curvature
    information[:] = precision
    add_information(jacobian, weight, information)
    for one in range(len(values)):
        total = dot(jacobian[one], pull)
        for other in range(len(values)):
            total -= precision[one, other] * values[other]
        gradient[one] = total


@compiled
def objective(
    view: View, values: Array, expected: Array, variance: Array, precision: Array, clip_e: float
) -> float:
    """Return −2 ln L of an expectation with given variances, priors included, without Σ ln variance."""
    image, state = view.image_e.ravel(), view.state.ravel()
    total = 0.0
    for pixel in range(len(expected)):
        if state[pixel] == SEEN:
            total += (image[pixel] - expected[pixel]) ** 2 / variance[pixel]
        elif state[pixel] == CLIPPED:
            z = (clip_e - expected[pixel]) / math.sqrt(variance[pixel])
            total -= 2.0 * log_upper_tail(min(max(z, -38.0), 1e4))
    for one in range(len(values)):
        for other in range(len(values)):
            total += values[one] * precision[one, other] * values[other]
    return total


@compiled
def log_variances(view: View, variance: Array) -> float:
    """Return Σ ln variance of the pixels that are seen."""
    state, total = view.state.ravel(), 0.0
    for pixel in range(len(variance)):
        if state[pixel] == SEEN:
            total += math.log(variance[pixel])
    return total


@compiled
def unlikeliness(
    view: View, sources: Sources, structure: Structure, known: Known, precision: Array, guesses: Array
) -> Array:
    """Return −2 ln L of guesses of the unknowns, as `maximise` of the likeliest; infinite where none can be.

    The arguments are as for that; `guesses` has the shape (guesses, unknowns), `sources` are those of all.
    """
    pixels, unknowns = view.image_e.size, guesses.shape[1]
    count = len(sources.log_range_at) // len(guesses)
    step = 3 + (known.tie_spread > 0.0) + 2 * (known.motion_px > 0.0)
    expected, variance, jacobian = np.empty(pixels), np.empty(pixels), np.empty((unknowns, pixels))
    totals = np.full(len(guesses), math.inf)
    for guess in range(len(guesses)):
        if is_inside(guesses[guess], view, count, step):
            own = part_of(sources, guess * count, (guess + 1) * count)
            expectation(guesses[guess], view, own, structure, known, expected, jacobian, variance)
            totals[guess] = objective(view, guesses[guess], expected, variance, precision, known.clip_e)
            totals[guess] += log_variances(view, variance)
    return totals


@compiled
def inverted(matrix: Array, inverse: Array) -> float:
    """Write the inverse of a symmetric matrix, by Cholesky's method at a unit diagonal.

    Returns ln of its determinant; NaN where it is singular or not finite, and then writes nothing.
    """
    size = len(matrix)
    scale, lower, log_det = np.empty(size), np.zeros((size, size)), 0.0
    for one in range(size):
        if not (0.0 < matrix[one, one] < math.inf):
            return math.nan
        scale[one] = 1.0 / math.sqrt(matrix[one, one])
        log_det += math.log(matrix[one, one])
    for one in range(size):
        for other in range(one + 1):
            total = matrix[one, other] * scale[one] * scale[other]
            for k in range(other):
                total -= lower[one, k] * lower[other, k]
            if one != other:
                lower[one, other] = total / lower[other, other]
                continue
            if not total > LEAST_PIVOT:
                return math.nan
            lower[one, one] = math.sqrt(total)
            log_det += math.log(total)
    # L⁻¹, in place, and its product with itself.
    for one in range(size):
        lower[one, one] = 1.0 / lower[one, one]
        for other in range(one):
            total = 0.0
            for k in range(other, one):
                total -= lower[one, k] * lower[k, other]
            lower[one, other] = total * lower[one, one]
    for one in range(size):
        for other in range(one + 1):
            total = 0.0
            for k in range(one, size):
                total += lower[k, one] * lower[k, other]
            inverse[one, other] = inverse[other, one] = total * scale[one] * scale[other]
    return log_det


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
def is_inside(values: Array, view: View, count: int, step: int) -> bool:
    """Tell whether all sources are on the window's pixels, at ranges and motions that can be."""
    rows, columns = view.image_e.shape
    for at in range(0, count * step, step):
        column, row = values[at] - view.left, values[at + 1] - view.top
        on_pixels = -0.5 < column < columns - 0.5 and -0.5 < row < rows - 0.5
        near = step < 5 or math.hypot(values[at + step - 2], values[at + step - 1]) < MOTION_BOUND_PX
        if not (on_pixels and near and abs(values[at + 2]) < LOG_RANGE_BOUND):
            return False
    return bool(np.isfinite(values).all())


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
    priors; both infinite where no step below a hundredth of a standard deviation was reached, or none tried.
    """
    size, pixels, count = len(values), len(expected), len(sources.log_range_at)
    step = 3 + (known.tie_spread > 0.0) + 2 * (known.motion_px > 0.0)
    jacobian, new_jacobian = np.empty((size, pixels)), np.empty((size, pixels))
    new_expected, variance, new_variance = np.empty(pixels), np.empty(pixels), np.empty(pixels)
    gradient, trial, clip_e = np.empty(size), np.empty(size), known.clip_e
    fisher, inverse, damped = np.empty((size, size)), np.empty((size, size)), np.empty((size, size))
    damping, is_new, log_det, before, taken = FIRST_DAMPING, True, 0.0, 0.0, 0
    expectation(values, view, sources, structure, known, expected, jacobian, variance)
    for _ in range(MOST_STEPS):
        if is_new:
            slopes(view, values, expected, jacobian, variance, precision, clip_e, False, gradient, fisher)
            log_det = inverted(fisher, inverse)
            if math.isnan(log_det):
                return math.inf, math.inf
            settled, to_gain = True, 0.0
            for one in range(size):
                free_step = 0.0
                for other in range(size):
                    free_step += inverse[one, other] * gradient[other]
                if one < count * step:
                    settled &= abs(free_step) <= SETTLED_SIGMAS * math.sqrt(inverse[one, one])
                to_gain += free_step * gradient[one]
            if settled:
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
        if math.isnan(inverted(damped, damped)):
            return math.inf, math.inf
        for one in range(size):
            shift = 0.0
            for other in range(size):
                shift += damped[one, other] * gradient[other]
            trial[one] = values[one] + min(max(shift, -most_step[one]), most_step[one])
        is_new = False
        if is_inside(trial, view, count, step):
            expectation(trial, view, sources, structure, known, new_expected, new_jacobian, new_variance)
            after = objective(view, trial, new_expected, variance, precision, clip_e)
            is_new = after <= before + 1e-9 * abs(before) + 1e-9
        if is_new:
            values[:], expected[:] = trial, new_expected
            jacobian, new_jacobian = new_jacobian, jacobian
            variance, new_variance = new_variance, variance
            damping, taken = max(0.1 * damping, LEAST_DAMPING), taken + 1
        else:
            damping *= 10.0
            if not damping < MOST_DAMPING:
                return math.inf, math.inf
    else:
        return math.inf, math.inf
    if (view.state == CLIPPED).any():
        slopes(view, values, expected, jacobian, variance, precision, clip_e, True, gradient, fisher)
        log_det = inverted(fisher, inverse)
        if math.isnan(log_det):
            return math.inf, math.inf
    covariance[:] = inverse
    chi2 = objective(view, values, expected, variance, precision, clip_e)
    return chi2 + log_variances(view, variance), log_det
