"""The upper tail of the normal distribution: what a clipped pixel tells."""

import math

from perception.compiled import compiled

SURE_SIGMAS = 9.0
"""Beyond these Φ or Q is 10⁻¹⁹."""

_SQRT_HALF, _LOG_SQRT_2_PI = math.sqrt(0.5), 0.5 * math.log(2.0 * math.pi)


@compiled
def log_upper_tail(z: float) -> float:
    """Return ln Q(z) of the normal distribution: to 10⁻⁸ beyond z = 36, where Q itself is too small."""
    if z < -SURE_SIGMAS:
        return 0.0
    if z < 0.0:
        return math.log1p(-0.5 * math.erfc(-z * _SQRT_HALF))
    if z < 36.0:
        return math.log(0.5 * math.erfc(z * _SQRT_HALF))
    z2 = z * z
    return -0.5 * z2 - _LOG_SQRT_2_PI - math.log(z) + math.log1p(-(1.0 - 3.0 / z2) / z2)


@compiled
def of_clipped(z: float) -> tuple[float, float]:
    """Return φ/Q, and how ln Q bends."""
    if z < -SURE_SIGMAS:
        return 0.0, 0.0
    z = min(z, 1e4)
    mills = math.exp(-0.5 * z * z - _LOG_SQRT_2_PI - log_upper_tail(z))
    return mills, min(max(mills * (mills - z), 0.0), 1.0)


@compiled
def kept_of_clipping(z: float) -> float:
    """Return the share of its information that a pixel keeps that clips z σ above what it expects.

    On average over what it shows: Φ - z φ + φ²/Q.
    """
    if abs(z) > SURE_SIGMAS:
        return 1.0 if z > 0.0 else 0.0
    tail, density = math.exp(log_upper_tail(z)), math.exp(-0.5 * z * z - _LOG_SQRT_2_PI)
    return min(max(1.0 - tail - z * density + density * density / tail, 0.0), 1.0)
