"""Sums of products over pixels, and inverses of what they make: what a step of a fit mostly takes."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled

Array = NDArray[np.float64]

LEAST_PIVOT = 1e-10


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
