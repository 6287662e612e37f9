"""What poses of a robot are held against: its sightings, made independent of each other; compiled loops."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.rig.pose.sights import Carried, Sights

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LOG_TURN = math.log(2.0 * math.pi)


class Problem(NamedTuple):
    """The sightings of one robot, and which source each shows: what a pose is held against.

    Attributes
    ----------
    origin_m, axes, log_range
        As of `Sights`, the range as that of the source, shape (n, …).
    arm_m
        The sources from the robot's origin, in its axes, shape (n, 3).
    white
        What makes residuals independent and of variance 1, a lower triangle, shape (3 n, 3 n).
    log_norm
        Logarithm of the density of residuals of 0.
    """

    origin_m: Array
    axes: Array
    log_range: Array
    arm_m: Array
    white: Array
    log_norm: float


@compiled
def problem_of(sights: Sights, rows: Indices, layout: Carried, source: Indices) -> Problem:
    """Return what poses are held against; `source`, shape (n,), says which one each of the rows shows."""
    n = len(rows)
    log_range, arm_m = np.empty(n), np.empty((n, 3))
    total, known = 0.0, 0
    for a in range(n):
        i = rows[a]
        arm_m[a] = layout.place_m[source[a]]
        log_range[a] = sights.log_range[i] + 0.5 * sights.by_flux[i] * layout.log_flux[source[a]]
        if not math.isnan(log_range[a]):
            total += log_range[a]
            known += 1
    for a in range(n):
        # A range that is not known has a σ that makes it count for nothing.
        if math.isnan(log_range[a]):
            log_range[a] = total / known
    white = joint_covariance(sights, rows, layout, source)
    log_norm = -0.5 * 3 * n * LOG_TURN - _whitening(white)
    return Problem(sights.origin_m[rows], sights.axes[rows], log_range, arm_m, white, log_norm)


@compiled
def joint_covariance(sights: Sights, rows: Indices, layout: Carried, source: Indices) -> Array:
    """Return the covariance of all angles and logarithms of ranges of a robot, shape (3 n, 3 n)."""
    n, errors = len(rows), sights.shared.shape[2]
    covariance = np.empty((3 * n, 3 * n))
    for a in range(n):
        i = rows[a]
        for b in range(a + 1):
            j = rows[b]
            for x in range(3):
                for y in range(3):
                    total = sights.own[i, x, y] if a == b else 0.0
                    for e in range(errors):
                        total += sights.shared[i, x, e] * sights.shared[j, y, e]
                    covariance[3 * a + x, 3 * b + y] = total
                    covariance[3 * b + y, 3 * a + x] = total
            if math.isnan(layout.flux_sigma_common):
                ranges = sights.constant[i] * sights.constant[j]
            else:
                ranges = 0.25 * layout.flux_sigma_common**2 * sights.by_flux[i] * sights.by_flux[j]
            if source[a] == source[b]:  # its own flux is the same in each camera that sees it
                ranges += 0.25 * layout.flux_sigma_own**2 * sights.by_flux[i] * sights.by_flux[j]
            covariance[3 * a + 2, 3 * b + 2] += ranges
            if a != b:
                covariance[3 * b + 2, 3 * a + 2] += ranges
    return covariance


@compiled
def _whitening(matrix: Array) -> float:
    """Turn a covariance in place into the inverse of its root, a triangle; returns ln of det of the root."""
    size, log_determinant = len(matrix), 0.0
    for column in range(size):
        for row in range(column, size):
            total = matrix[row, column]
            for k in range(column):
                total -= matrix[row, k] * matrix[column, k]
            if row == column:
                matrix[column, column] = math.sqrt(total)
                log_determinant += math.log(matrix[column, column])
            else:
                matrix[row, column] = total / matrix[column, column]
    for column in range(size):
        matrix[column, column] = 1.0 / matrix[column, column]
        for row in range(column + 1, size):
            total = 0.0
            for k in range(column, row):
                total -= matrix[row, k] * matrix[k, column]
            matrix[row, column] = total / matrix[row, row]
        for row in range(column):
            matrix[row, column] = 0.0
    return log_determinant
