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
def four_dots(x: Array, p: Array, q: Array, r: Array, s: Array) -> tuple[float, float, float, float]:
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
            totals[at], totals[at + 1], totals[at + 2], totals[at + 3] = four_dots(
                weighted, jacobian[at], jacobian[at + 1], jacobian[at + 2], jacobian[at + 3]
            )
        for at in range(fours, one + 1):
            totals[at] = dot(weighted, jacobian[at])
        into[one, one] += totals[one]
        for other in range(one):
            into[one, other] += totals[other]
            into[other, one] += totals[other]


@compiled
def factorised(matrix: Array, scale: Array, factor: Array) -> float:
    """Write the Cholesky factor U, UᵀU = S A S, of a symmetric matrix A, S what makes its diagonal 1.

    Returns ln of the determinant of A; NaN where it is singular or not finite. `scale` has the diagonal of S;
    `factor` is written on and above its diagonal.
    """
    size, log_det = len(matrix), 0.0
    for one in range(size):
        if not (0.0 < matrix[one, one] < math.inf):
            return math.nan
        scale[one] = 1.0 / math.sqrt(matrix[one, one])
        log_det += math.log(matrix[one, one])
    for one in range(size):
        for other in range(one, size):
            factor[one, other] = matrix[one, other] * scale[one] * scale[other]
    for k in range(size):
        if not factor[k, k] > LEAST_PIVOT:
            return math.nan
        log_det += math.log(factor[k, k])
        root = math.sqrt(factor[k, k])
        for other in range(k, size):
            factor[k, other] /= root
        for one in range(k + 1, size):
            share = factor[k, one]
            for other in range(one, size):
                factor[one, other] -= share * factor[k, other]
    return log_det


@compiled
def solved(scale: Array, factor: Array, right: Array, solution: Array) -> None:
    """Write A⁻¹ times a vector, of a matrix A as `factorised`."""
    size = len(right)
    for one in range(size):
        solution[one] = right[one] * scale[one]
    for one in range(size):
        solution[one] /= factor[one, one]
        for other in range(one + 1, size):
            solution[other] -= solution[one] * factor[one, other]
    for one in range(size - 1, -1, -1):
        total = solution[one]
        for other in range(one + 1, size):
            total -= factor[one, other] * solution[other]
        solution[one] = total / factor[one, one]
    for one in range(size):
        solution[one] *= scale[one]


@compiled
def _row_of_root(scale: Array, factor: Array, one: int, row: Array) -> None:
    """Write a row of R, A⁻¹ = R Rᵀ, of a matrix A as `factorised`: what stands before the diagonal is 0."""
    size = len(row)
    row[one:] = 0.0
    row[one] = scale[one]
    for at in range(one, size):
        row[at] /= factor[at, at]
        for other in range(at + 1, size):
            row[other] -= row[at] * factor[at, other]


@compiled
def variance_of(scale: Array, factor: Array, one: int) -> float:
    """Return an element on the diagonal of A⁻¹, of a matrix A as `factorised`."""
    row = np.empty(len(factor))
    _row_of_root(scale, factor, one, row)
    return dot(row[one:], row[one:])


@compiled
def inverted(matrix: Array, inverse: Array) -> float:
    """Write the inverse of a symmetric matrix, by Cholesky's method at a unit diagonal.

    Returns ln of its determinant; NaN where it is singular or not finite, and then writes nothing.
    """
    size = len(matrix)
    scale, factor, root = np.empty(size), np.empty((size, size)), np.empty((size, size))
    log_det = factorised(matrix, scale, factor)
    if math.isnan(log_det):
        return math.nan
    for one in range(size):
        _row_of_root(scale, factor, one, root[one])
        for other in range(one + 1):
            inverse[one, other] = inverse[other, one] = dot(root[one, one:], root[other, one:])
    return log_det


@compiled
def invert(matrix: Array) -> float:
    """Invert a small positive definite matrix in place, by elimination; return ln of its determinant.

    Where it is not positive definite that is some hundred too low.
    """
    size, log_det = len(matrix), 0.0
    for pivot in range(size):
        log_det += math.log(max(matrix[pivot, pivot], 1e-300))
        scale = 1.0 / matrix[pivot, pivot]
        matrix[pivot, pivot] = 1.0
        for column in range(size):
            matrix[pivot, column] *= scale
        for row in range(size):
            if row != pivot:
                factor = matrix[row, pivot]
                matrix[row, pivot] = 0.0
                for column in range(size):
                    matrix[row, column] -= factor * matrix[pivot, column]
    return log_det
