"""The inverse of the brown_conrady lens (`model.lens`): point by point, by Newton's method, compiled."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled

Array = NDArray[np.float64]

_MOST_STEPS, _LAST_STEP = 40, 1e-9  # a step of 1e-9 leaves an error of its square
_RESIDUAL = 1e-12


@compiled
def _value(coefficients: Array, at: float) -> float:
    """Return a polynomial's value, by Horner's rule."""
    value = 0.0
    for power in range(len(coefficients)):
        value = coefficients[len(coefficients) - 1 - power] + value * at
    return value


@compiled
def undistorted(
    points: Array, start: Array, over: Array, under: Array, over_slope: Array, under_slope: Array,
    p1: float, p2: float, most: float,
) -> Array:  # fmt: skip
    """Return (a, b) of points of a brown_conrady lens, shape (n, 2), from `start` times these on.

    g is `over` / `under`, polynomials of r². NaN where no (a, b) of a length up to `most` is found.
    """
    found = np.full(points.shape, np.nan)
    for index in range(len(points)):
        x, y = points[index]
        a, b, step = x * start[index], y * start[index], math.inf
        for _ in range(_MOST_STEPS + 1):
            square = a * a + b * b
            below = _value(under, square)
            gain = _value(over, square) / below
            slope = (_value(over_slope, square) - gain * _value(under_slope, square)) / below
            off_x = a * gain + 2.0 * p1 * a * b + p2 * (square + 2.0 * a * a) - x
            off_y = b * gain + p1 * (square + 2.0 * b * b) + 2.0 * p2 * a * b - y
            if not step > _LAST_STEP * (1.0 + math.sqrt(square)):
                break
            xx = gain + 2.0 * a * a * slope + 2.0 * p1 * b + 6.0 * p2 * a
            xy = 2.0 * a * b * slope + 2.0 * p1 * a + 2.0 * p2 * b
            yy = gain + 2.0 * b * b * slope + 6.0 * p1 * b + 2.0 * p2 * a
            area = xx * yy - xy * xy
            step_a, step_b = (yy * off_x - xy * off_y) / area, (xx * off_y - xy * off_x) / area
            a, b, step = a - step_a, b - step_b, math.hypot(step_a, step_b)
        is_found = math.hypot(off_x, off_y) <= _RESIDUAL * (1.0 + math.hypot(x, y))
        if is_found and math.hypot(a, b) <= most:
            found[index] = a, b
    return found
