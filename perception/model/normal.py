"""The normal distribution: over a row of pixels, in cubics as exact as an image needs, and its upper tail."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled

Array = NDArray[np.float64]

REACH_SIGMAS = 6.0
"""Beyond this nothing of a point's light counts: 10⁻⁹ on either side."""

STEP = 1.0 / 32.0

_SURE = -9.0  # of what exceeds it so surely nothing is lost: 1 - Q is 10⁻¹⁹
_SQRT_HALF, _LOG_SQRT_2_PI = math.sqrt(0.5), 0.5 * math.log(2.0 * math.pi)


def _table() -> NDArray[np.float64]:
    """Return cubics for Φ and φ between steps, from two steps before `REACH_SIGMAS` on, shape (steps, 8).

    Four coefficients each, of the part of a step. They meet both functions and their slopes at each step, and
    miss them by 3·10⁻⁹ at most between. What lies beyond the reach is made up for, so that no light is lost.
    """
    x = np.arange(-REACH_SIGMAS - 2.0 * STEP, REACH_SIGMAS + 2.0 * STEP, STEP)
    density = np.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)
    below = np.array([0.5 * math.erfc(-at * math.sqrt(0.5)) for at in x.tolist()])
    beyond = 0.5 * math.erfc(REACH_SIGMAS * math.sqrt(0.5))
    share = (below - beyond) / (1.0 - 2.0 * beyond)
    cubics = []
    for value, slope in ((share, density), (density, -x * density)):
        rise, first, last = np.diff(value), STEP * slope[:-1], STEP * slope[1:]
        cubics += [value[:-1], first, 3.0 * rise - 2.0 * first - last, first + last - 2.0 * rise]
    return np.ascontiguousarray(np.stack(cubics, axis=1))


NORMAL = _table()
# At the reach: the shares below either end, and the density.
_NONE, _ALL = float(NORMAL[2, 0]), float(NORMAL[-1, 0])
_LAST = float(NORMAL[2, 4])


@compiled
def shares(at_px: float, count: int, sigma_px: float, into: Array) -> tuple[int, int]:
    """Spread a point along a row of pixels.

    Writes each pixel's share of a Gaussian, its derivative by place and that by ln σ, into rows 0, 1 and 2 of
    `into`, shape (3, count), and returns the first pixel reached and the one after the last.
    """
    reach_px = REACH_SIGMAS * sigma_px
    if not (-reach_px - 0.5 < at_px < count - 0.5 + reach_px):
        return 0, 0
    first = max(0, math.ceil(at_px - reach_px - 0.5))
    end = min(count, math.floor(at_px + reach_px + 0.5) + 1)
    below, density, moment = 0.0, 0.0, 0.0
    for edge in range(first, end + 1):
        away = min(max((edge - 0.5 - at_px) / sigma_px, -REACH_SIGMAS), REACH_SIGMAS)
        place = (away + (REACH_SIGMAS + 2.0 * STEP)) / STEP
        step = int(place)
        cubic, t = NORMAL[step], place - step
        next_below = cubic[0] + t * (cubic[1] + t * (cubic[2] + t * cubic[3]))
        next_density = (cubic[4] + t * (cubic[5] + t * (cubic[6] + t * cubic[7]))) / sigma_px
        next_moment = sigma_px * away * next_density
        if edge > first:
            into[0, edge - 1] = next_below - below
            into[1, edge - 1] = density - next_density
            into[2, edge - 1] = moment - next_moment
        below, density, moment = next_below, next_density, next_moment
    return first, end


@compiled
def _below(away_px: float, sigma_px: float) -> tuple[float, float]:
    """Return the share of a Gaussian below a place, and σ² times its density there."""
    if away_px >= REACH_SIGMAS * sigma_px:
        return _ALL, sigma_px * _LAST
    if away_px <= -REACH_SIGMAS * sigma_px:
        return _NONE, sigma_px * _LAST
    place = (away_px / sigma_px + (REACH_SIGMAS + 2.0 * STEP)) / STEP
    step = int(place)
    cubic, t = NORMAL[step], place - step
    below = cubic[0] + t * (cubic[1] + t * (cubic[2] + t * cubic[3]))
    return below, sigma_px * (cubic[4] + t * (cubic[5] + t * (cubic[6] + t * cubic[7])))


@compiled
def strip_shares(
    at_px: float, half_px: float, shading: tuple[float, float], off_px: float, count: int, sigma_px: float,
    into: Array,
) -> tuple[int, int]:  # fmt: skip
    """Spread a strip along a row of pixels, as `shares` does a point.

    Its light is 1 + a t + b (t² - 1/3) with `shading` (a, b), t from -1 at its left end to 1 at its right.
    Rows 0 to 2 of `into`, shape (4, count), become as there, row 3 the derivative by ln size as the strip and
    `off_px`, how far its middle lies from the point that it grows about, grow in proportion.
    """
    reach_px = REACH_SIGMAS * sigma_px + half_px
    if not (-reach_px - 0.5 < at_px < count - 0.5 + reach_px):
        return 0, 0
    first = max(0, math.ceil(at_px - reach_px - 0.5))
    end = min(count, math.floor(at_px + reach_px + 0.5) + 1)
    h, s, variance, is_shaded = half_px, sigma_px, sigma_px**2, shading[0] != 0.0 or shading[1] != 0.0
    even, tilt, bend = 0.5 * (1.0 - shading[1] / 3.0) / h, 0.5 * shading[0] / h**2, 0.5 * shading[1] / h**3
    below, density, moment, growing = 0.0, 0.0, 0.0, 0.0
    for edge in range(first, end + 1):
        # From the strip's middle; u runs along it from -h to h.
        x = edge - 0.5 - at_px
        below_a, slope_a = _below(x + h, s)
        below_b, slope_b = _below(x - h, s)
        # ∫ N(x - u) du and ∫ u N du, by parts; ∫ Φ du; σ² times the slope of the first.
        zeroth = below_a - below_b
        first_moment = x * zeroth + slope_a - slope_b
        next_below = even * (h * (below_a + below_b) + first_moment)
        next_density, next_growing = even * zeroth, even * first_moment
        next_moment = even * (slope_a - slope_b)
        if is_shaded:
            # ∫ uⁿ⁺¹ N du = x ∫ uⁿ N du + σ² times the slope of that; ∫ uⁿ Φ du by parts.
            slope_1 = variance * zeroth - h * (slope_a + slope_b)
            second_moment = x * first_moment + slope_1
            slope_2 = 2.0 * variance * first_moment + h * h * (slope_a - slope_b)
            third_moment = x * second_moment + slope_2
            next_below += tilt * 0.5 * (second_moment - h * h * zeroth)
            next_below += bend * (h**3 * (below_a + below_b) + third_moment) / 3.0
            next_density += tilt * first_moment + bend * second_moment
            next_growing += tilt * second_moment + bend * third_moment
            next_moment += tilt * slope_1 + bend * slope_2
        next_growing += off_px * next_density
        if edge > first:
            into[0, edge - 1] = next_below - below
            into[1, edge - 1] = density - next_density
            into[2, edge - 1] = next_moment - moment
            into[3, edge - 1] = growing - next_growing
        below, density, moment, growing = next_below, next_density, next_moment, next_growing
    return first, end


@compiled
def log_upper_tail(z: float) -> float:
    """Return ln Q(z) of the normal distribution: to 10⁻⁸ beyond z = 36, where Q itself is too small."""
    if z < _SURE:
        return 0.0
    if z < 0.0:
        return math.log1p(-0.5 * math.erfc(-z * _SQRT_HALF))
    if z < 36.0:
        return math.log(0.5 * math.erfc(z * _SQRT_HALF))
    z2 = z * z
    return -0.5 * z2 - _LOG_SQRT_2_PI - math.log(z) + math.log1p(-(1.0 - 3.0 / z2) / z2)


@compiled
def of_clipped(z: float) -> tuple[float, float, float]:
    """Return φ/Q, the curvature of ln Q, and the share of its information that such a pixel keeps."""
    if z < _SURE:
        return 0.0, 0.0, 0.0
    z = min(z, 1e4)
    log_tail = log_upper_tail(z)
    mills = math.exp(-0.5 * z * z - _LOG_SQRT_2_PI - log_tail)
    curvature = min(max(mills * (mills - z), 0.0), 1.0)
    density = math.exp(-0.5 * z * z - _LOG_SQRT_2_PI)
    kept = 1.0 - math.exp(log_tail) - z * density + density * mills
    return mills, curvature, min(max(kept, 0.0), 1.0)
