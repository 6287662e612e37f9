"""Where the bearings and ranges of several sightings say that a source is: compiled loops of `fusion`.

A sighting is a ray from a camera's centre: a direction with its angular covariance, and the logarithm of a
range with noise of its own and an error that all sightings of a source share.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

UNKNOWN_RANGE = 10.0
"""Standard deviation of the logarithm of a range that is not known."""

NEAREST_M, FARTHEST_M = 0.2, 50.0
"""Where rays without ranges are taken to meet."""

LEAST_COSINE = 0.5
"""Rays that differ by more than 60 degrees are not of one source."""

STEPS, SCALE_STEPS = 4, 4
LEAST_FACTOR = 0.1
LEAST_M2 = 1e-10


class Rays(NamedTuple):
    """Sightings, n of them.

    Attributes
    ----------
    origin_m
        Camera centres in body axes, shape (n, 3).
    axes
        Left, up and along each bearing, as rows, shape (n, 3, 3).
    angular_rad2
        Covariance of the angles to the left and upwards, shape (n, 2, 2).
    range_m
        NaN where it is not known, shape (n,).
    noise, common
        Standard deviations of the logarithm of the range, shape (n,).
    time_s
        Mid-exposure, shape (n,).
    """

    origin_m: Array
    axes: Array
    angular_rad2: Array
    range_m: Array
    noise: Array
    common: Array
    time_s: Array


@compiled
def ranges_of_pair(rays: Rays, one: int, other: int) -> tuple[float, float]:
    """Return the ranges of two sightings, each unknown one as the other would have it.

    Where neither is known, they are those at which the rays come nearest to each other.
    """
    here, there = rays.range_m[one], rays.range_m[other]
    if not (math.isnan(here) or math.isnan(there)):
        return here, there
    cosine, forward, back, from_here2, from_there2 = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(3):
        apart_m = rays.origin_m[other, k] - rays.origin_m[one, k]
        g, h = rays.axes[one, 2, k], rays.axes[other, 2, k]
        cosine += g * h
        forward += apart_m * g
        back += apart_m * h
        from_here2 += (here * g - apart_m) ** 2
        from_there2 += (there * h + apart_m) ** 2
    if not math.isnan(here):
        return here, math.sqrt(from_here2)
    if not math.isnan(there):
        return math.sqrt(from_there2), there
    # Nearest: r_g − cos r_h = forward, cos r_g − r_h = back.
    sine2 = max(1.0 - cosine**2, 1e-9)
    here = min(max((forward - cosine * back) / sine2, NEAREST_M), FARTHEST_M)
    there = min(max((cosine * forward - back) / sine2, NEAREST_M), FARTHEST_M)
    return here, there


@compiled
def chi2_of_pairs(rays: Rays, one: Indices, other: Indices, speed_m_per_s: float) -> tuple[Array, Array]:
    """Return the χ² of each pair's being of one source, and the same with ranges that are too long alike.

    A mirror that loses light, or fog, makes ranges by flux longer by one factor; where the rays meet they
    say so. Sources may move at some speed between exposures.

    Returns
    -------
    χ² of three degrees of freedom, and of two with that factor free, shape (one, other); infinite where two
    look in quite different directions, and where no factor below 1 would do.
    """
    chi2 = np.full((len(one), len(other)), np.inf)
    scaled = np.full((len(one), len(other)), np.inf)
    for row in range(len(one)):
        for column in range(len(other)):
            i, j = one[row], other[column]
            cosine = 0.0
            for k in range(3):
                cosine += rays.axes[i, 2, k] * rays.axes[j, 2, k]
            if cosine < LEAST_COSINE:
                continue
            chi2[row, column], factor = _chi2_of_pair(rays, i, j, 1.0, speed_m_per_s)
            if not (math.isnan(rays.range_m[i]) or math.isnan(rays.range_m[j])):
                for _ in range(SCALE_STEPS):
                    factor = min(max(factor, LEAST_FACTOR), 1.0)
                    scaled[row, column], factor = _chi2_of_pair(rays, i, j, factor, speed_m_per_s)
    return chi2, scaled


@compiled
def _chi2_of_pair(rays: Rays, i: int, j: int, factor: float, speed_m_per_s: float) -> tuple[float, float]:
    """Return χ² of two sightings' being of one source, and the factor on both ranges that suits best."""
    apart_m, grown_m, covariance = np.empty(3), np.empty(3), np.empty((3, 3))
    range_i, range_j = ranges_of_pair(rays, i, j)
    moved_m = speed_m_per_s * (rays.time_s[i] - rays.time_s[j])
    for k in range(3):
        along_i, along_j = range_i * rays.axes[i, 2, k], range_j * rays.axes[j, 2, k]
        grown_m[k] = along_i - along_j
        apart_m[k] = rays.origin_m[i, k] - rays.origin_m[j, k] + factor * grown_m[k]
        for m in range(3):
            # What both ranges share moves both along their bearings, and parts them as these differ.
            of_i = rays.common[i] * along_i - rays.common[j] * along_j
            of_j = (
                rays.common[i] * range_i * rays.axes[i, 2, m] - rays.common[j] * range_j * rays.axes[j, 2, m]
            )
            covariance[k, m] = factor**2 * of_i * of_j
        covariance[k, k] += moved_m**2 + LEAST_M2
    _add_noise(rays, i, factor * range_i, covariance)
    _add_noise(rays, j, factor * range_j, covariance)
    _invert(covariance)
    chi2, slope, bend = 0.0, 0.0, 0.0
    for k in range(3):
        for m in range(3):
            chi2 += apart_m[k] * covariance[k, m] * apart_m[m]
            slope += grown_m[k] * covariance[k, m] * apart_m[m]
            bend += grown_m[k] * covariance[k, m] * grown_m[m]
    return chi2, factor - slope / max(bend, 1e-300)


@compiled
def _add_noise(rays: Rays, index: int, range_m: float, covariance: Array) -> None:
    """Add the covariance by noise of a sighting's place, at a range."""
    axes, angular = rays.axes[index], rays.angular_rad2[index]
    along_m2 = (range_m * rays.noise[index]) ** 2
    for k in range(3):
        for m in range(3):
            covariance[k, m] += along_m2 * axes[2, k] * axes[2, m]
            for a in range(2):
                for b in range(2):
                    covariance[k, m] += range_m**2 * axes[a, k] * angular[a, b] * axes[b, m]


@compiled
def _invert(matrix: Array) -> None:
    """Invert a small positive definite matrix in place, by elimination."""
    size = len(matrix)
    for pivot in range(size):
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


@compiled
def placed(rays: Rays, rows: Indices, time_s: float, speed_m_per_s: float) -> tuple[Array, Array]:
    """Return the most likely place of a source, shape (3,), and the covariance of it and of the shared error.

    Gauss–Newton over the place and the error that all ranges share; a sighting at another time counts less
    by how far the source may have moved. Two sightings at least; the first starts it. The covariance has the
    shape (4, 4); the shared error, the last, is in units of its σ.
    """
    start_m, _ = ranges_of_pair(rays, rows[0], rows[1])
    place_m = rays.origin_m[rows[0]] + start_m * rays.axes[rows[0], 2]
    shared = 0.0
    information, score, slope, angular = np.empty((4, 4)), np.empty(4), np.empty(4), np.empty((2, 2))
    for _ in range(STEPS):
        information[:] = 0.0
        information[3, 3] = 1.0
        score[:] = 0.0
        score[3] = -shared
        for i in rows:
            from_m = place_m - rays.origin_m[i]
            range_m = math.sqrt(from_m[0] ** 2 + from_m[1] ** 2 + from_m[2] ** 2)
            moved2 = (speed_m_per_s * (rays.time_s[i] - time_s) / range_m) ** 2
            angular[:] = rays.angular_rad2[i]
            angular[0, 0] += moved2
            angular[1, 1] += moved2
            _invert(angular)
            axes = rays.axes[i]
            for a in range(2):
                for b in range(2):
                    off_rad = 0.0
                    for k in range(3):
                        off_rad += axes[b, k] * from_m[k] / range_m
                    for k in range(3):
                        score[k] -= axes[a, k] / range_m * angular[a, b] * off_rad
                        for m in range(3):
                            information[k, m] += axes[a, k] * angular[a, b] * axes[b, m] / range_m**2
            seen_m = start_m if math.isnan(rays.range_m[i]) else rays.range_m[i]
            weight = 1.0 / (rays.noise[i] ** 2 + moved2)
            slope[:3] = from_m / range_m**2
            slope[3] = rays.common[i]
            off = math.log(seen_m / range_m) - rays.common[i] * shared
            for k in range(4):
                score[k] += slope[k] * weight * off
                for m in range(4):
                    information[k, m] += slope[k] * weight * slope[m]
        _invert(information)
        for k in range(4):
            step = 0.0
            for m in range(4):
                step += information[k, m] * score[m]
            if k < 3:
                place_m[k] += step
            else:
                shared += step
    return place_m, information
