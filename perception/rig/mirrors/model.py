"""What a flat mirror shows of a robot, and which images show which: compiled loops of the search for mirrors.

A plane n·x = c, n a unit vector away from the observer, shows p at p' = p − 2 (n·p − c) n. Its light
comes along |p' − o| to a camera at o, times the reflectance R: by flux it seems as far as |p' − o| / √R.
"""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.likelihood.products import invert
from perception.rig.mirrors.flares import Flares

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

CONSTANT, SURFACE, PANE = 0, 1, 2
"""Kinds of reflectance: a constant, of one side of a dielectric, of both sides of a sheet of it."""

NEAREST_MIRROR_M, GATE_CHI2 = 0.05, 25.0
SEED_LOG_RANGE, SEED_RAD = 0.3, 0.1
SEED_COSINE2 = 1.0 - 2.0 * SEED_RAD**2
SEED_TANGENT = math.tan(SEED_RAD)
COSINE_STEP = 1e-6
ROUNDED = 1.0 - 1e-9


@compiled
def of_dielectric(kind: int, index: float, cosine: float) -> float:
    """Return the reflectance of a dielectric, by Fresnel for unpolarised light.

    A sheet reflects 2 R / (1 + R), all orders summed, without absorption.
    """
    index = max(index, 1.0001)
    cosine = min(max(cosine, 1e-6), 1.0)
    inside = math.sqrt(1.0 - (1.0 - cosine**2) / index**2)
    across = ((cosine - index * inside) / (cosine + index * inside)) ** 2
    within = ((index * cosine - inside) / (index * cosine + inside)) ** 2
    reflectance = 0.5 * (across + within)
    if kind == PANE:
        reflectance = 2.0 * reflectance / (1.0 + reflectance)
    return max(reflectance, 1e-12)


@compiled
def shown_at(
    flares: Flares, image: int, plane: Array, x: float, y: float, z: float
) -> tuple[float, float, float, float, float]:
    """Return where a plane shows a place: left, up and along an image's axes, how far, and ray · normal."""
    n_x, n_y, n_z = plane[0], plane[1], plane[2]
    twice_m = 2.0 * (((plane[3] - n_x * x) - n_y * y) - n_z * z)
    off_x = x + twice_m * n_x - flares.origin_m[image, 0]
    off_y = y + twice_m * n_y - flares.origin_m[image, 1]
    off_z = z + twice_m * n_z - flares.origin_m[image, 2]
    axes = flares.axes[image]
    left = axes[0, 0] * off_x + axes[0, 1] * off_y + axes[0, 2] * off_z
    up = axes[1, 0] * off_x + axes[1, 1] * off_y + axes[1, 2] * off_z
    along = axes[2, 0] * off_x + axes[2, 1] * off_y + axes[2, 2] * off_z
    across_m = off_x * n_x + off_y * n_y + off_z * n_z
    return left, up, along, math.sqrt(off_x**2 + off_y**2 + off_z**2), across_m


@compiled
def off_in_range(
    flares: Flares, image: int, plane: Array, kind: int, path_m: float, across_m: float
) -> float:
    """Return ln of how much farther an image seems than its path, but for the light that the mirror takes."""
    off = math.log(flares.seems_m[image] / path_m)
    if kind == CONSTANT:
        return float(off - plane[4])
    return off + 0.5 * math.log(of_dielectric(kind, plane[4], abs(across_m) / path_m))


@compiled
def residual(
    flares: Flares, image: int, plane: Array, kind: int, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """Return how far an image lies from where a plane shows a place: left, up, and in ln range.

    `plane` holds n (3), c and the parameter of the reflectance: −½ ln R of a constant one, else the index.
    """
    left, up, along, path_m, across_m = shown_at(flares, image, plane, x, y, z)
    off = off_in_range(flares, image, plane, kind, path_m, across_m)
    if along > 0.0:  # which is quicker
        return -math.atan(left / along), -math.atan(up / along), off
    return -math.atan2(left, along), -math.atan2(up, along), off


@compiled
def _slope_into(
    slope: Array, flares: Flares, image: int, plane: Array, kind: int, x: float, y: float, z: float
) -> None:
    """Write what the place of a parent does to the residual, shape (3, 3).

    A step along an axis k is shown as e_k − 2 n_k n.
    """
    axes, normal = flares.axes[image], plane[:3]
    left, up, along, path_m, across_m = shown_at(flares, image, plane, x, y, z)
    by_cosine, cosine = 0.0, abs(across_m) / path_m
    if kind != CONSTANT:
        lower = of_dielectric(kind, plane[4], cosine - COSINE_STEP)
        by_cosine = 0.5 * math.log(of_dielectric(kind, plane[4], cosine) / lower) / COSINE_STEP
    left2, up2 = along**2 + left**2, along**2 + up**2
    n_left = axes[0, 0] * normal[0] + axes[0, 1] * normal[1] + axes[0, 2] * normal[2]
    n_up = axes[1, 0] * normal[0] + axes[1, 1] * normal[1] + axes[1, 2] * normal[2]
    n_along = axes[2, 0] * normal[0] + axes[2, 1] * normal[1] + axes[2, 2] * normal[2]
    for k in range(3):
        d_left = axes[0, k] - 2.0 * normal[k] * n_left
        d_up = axes[1, k] - 2.0 * normal[k] * n_up
        d_along = axes[2, k] - 2.0 * normal[k] * n_along
        slope[0, k] = (left * d_along - along * d_left) / left2
        slope[1, k] = (up * d_along - along * d_up) / up2
        d_path = (left * d_left + up * d_up + along * d_along) / path_m
        d_cosine = -(math.copysign(normal[k], normal[k] * across_m) + cosine * d_path) / path_m
        slope[2, k] = by_cosine * d_cosine - d_path / path_m


@compiled
def pair_covariance(
    flares: Flares, parent: int, image: int, plane: Array, kind: int, slope: Array, covariance: Array
) -> tuple[float, float, float]:
    """Return the residual of a pair, and write its covariance: the image's, and the parent's by the mirror.

    `slope`, shape (3, 3), is written too: what the parent's place does to the residual.
    """
    x, y, z = flares.place_m[parent, 0], flares.place_m[parent, 1], flares.place_m[parent, 2]
    off = residual(flares, image, plane, kind, x, y, z)
    _slope_into(slope, flares, image, plane, kind, x, y, z)
    noise_m2, moved_m = flares.noise_m2[parent], flares.moved_m[parent]
    for a in range(3):
        s_0, s_1, s_2 = slope[a, 0], slope[a, 1], slope[a, 2]
        n_0 = s_0 * noise_m2[0, 0] + s_1 * noise_m2[1, 0] + s_2 * noise_m2[2, 0]
        n_1 = s_0 * noise_m2[0, 1] + s_1 * noise_m2[1, 1] + s_2 * noise_m2[2, 1]
        n_2 = s_0 * noise_m2[0, 2] + s_1 * noise_m2[1, 2] + s_2 * noise_m2[2, 2]
        shared_a = s_0 * moved_m[0] + s_1 * moved_m[1] + s_2 * moved_m[2]
        shared_a += flares.common[image] if a == 2 else 0.0  # the parent's flux is also the image's
        for b in range(a + 1):
            total = flares.angular_rad2[image, a, b] if a < 2 else 0.0
            total += n_0 * slope[b, 0] + n_1 * slope[b, 1] + n_2 * slope[b, 2]
            shared_b = slope[b, 0] * moved_m[0] + slope[b, 1] * moved_m[1] + slope[b, 2] * moved_m[2]
            shared_b += flares.common[image] if b == 2 else 0.0
            covariance[a, b] = covariance[b, a] = total + shared_a * shared_b
    covariance[2, 2] += flares.noise[image] ** 2
    return off


@compiled
def _chi2(covariance: Array, left: float, up: float, off: float) -> float:
    """Return χ² of a residual, by elimination."""
    by_left, by_left_off = covariance[1, 0] / covariance[0, 0], covariance[2, 0] / covariance[0, 0]
    variance_up = covariance[1, 1] - by_left * covariance[1, 0]
    by_up = (covariance[2, 1] - by_left_off * covariance[1, 0]) / variance_up
    up -= by_left * left
    off -= by_left_off * left + by_up * up
    variance_off = covariance[2, 2] - by_left_off * covariance[2, 0] - by_up**2 * variance_up
    return float(left**2 / covariance[0, 0] + up**2 / variance_up + off**2 / variance_off)


@compiled
def log_determinant(matrix: Array, scale: float) -> float:
    """Return ln of the determinant of a small positive definite matrix times a number.

    Where it is not positive definite, as of a fit that has failed, some hundred too low.
    """
    return invert(scale * matrix)


@compiled
def add_form_into(total: Array, slope: Array, matrix: Array) -> None:
    """Add slopeᵀ · matrix · slope."""
    for a in range(slope.shape[0]):
        for m in range(slope.shape[1]):
            weighed = 0.0
            for b in range(slope.shape[0]):
                weighed += matrix[a, b] * slope[b, m]
            for k in range(slope.shape[1]):
                total[k, m] += slope[a, k] * weighed


@compiled
def match_all(
    flares: Flares, parents: Indices, images: Indices, planes: Array, kind: int, gate_chi2: float
) -> tuple[Indices, Indices, Array]:
    """Tell which of some images show which of some parents in each of some planes, one to one, best first.

    Where `gate_chi2` is 0 the gate is a coarse one, for planes that are but guessed.

    Returns
    -------
    Pairs of parents and images, shape (planes, 2, most); how many, and how well they agree in all, the less
    the better, shape (planes,).
    """
    rows, columns = len(parents), len(images)
    pairs = np.empty((len(planes), 2, min(rows, columns)), dtype=np.int64)
    count, total = np.zeros(len(planes), dtype=np.int64), np.zeros(len(planes))
    # Those that lie within the gate are few: each with its row and column, and how badly it agrees.
    misfit = np.empty(rows * columns)
    at_row, at_column = np.empty(len(misfit), dtype=np.int64), np.empty(len(misfit), dtype=np.int64)
    seen, near = np.empty((7, columns)), np.empty(columns, dtype=np.bool_)
    for column in range(columns):
        for k in range(3):
            seen[k, column] = flares.axes[images[column], 2, k]
            seen[3 + k, column] = flares.origin_m[images[column], k]
        seen[6, column] = flares.seems_m[images[column]] ** 2
    slope, covariance = np.empty((3, 3)), np.empty((3, 3))
    for n in range(len(planes)):
        plane, found = planes[n], 0
        # A mirror takes light and gives none: nearer than its path no image seems, but for the gate.
        least2, most2 = ROUNDED * math.exp(-2.0 * SEED_LOG_RANGE), np.inf
        if kind == CONSTANT:
            least2 *= math.exp(2.0 * plane[4])
            most2 = math.exp(2.0 * (plane[4] + SEED_LOG_RANGE)) / ROUNDED
        for row in range(rows):
            i = parents[row]
            x, y, z = flares.place_m[i, 0], flares.place_m[i, 1], flares.place_m[i, 2]
            before_m = plane[3] - plane[0] * x - plane[1] * y - plane[2] * z
            if before_m <= 0.0:
                continue
            # Most images are far from where they would have to be: that is seen without a root or an angle.
            shown_x = x + 2.0 * before_m * plane[0]
            shown_y = y + 2.0 * before_m * plane[1]
            shown_z = z + 2.0 * before_m * plane[2]
            for column in range(columns):
                out_x = shown_x - seen[3, column]
                out_y = shown_y - seen[4, column]
                out_z = shown_z - seen[5, column]
                along = seen[0, column] * out_x + seen[1, column] * out_y + seen[2, column] * out_z
                length2 = out_x**2 + out_y**2 + out_z**2
                aside = (along > 0.0) & (along**2 >= SEED_COSINE2 * length2)
                beyond = (seen[6, column] >= least2 * length2) & (seen[6, column] <= most2 * length2)
                near[column] = aside & beyond
            for column in range(columns):
                j = images[column]
                if not near[column] or j == i:
                    continue
                left, up, along, path_m, across_m = shown_at(flares, j, plane, x, y, z)
                if abs(left) > SEED_TANGENT * along or abs(up) > SEED_TANGENT * along:
                    continue
                off = off_in_range(flares, j, plane, kind, path_m, across_m)
                if abs(off) > SEED_LOG_RANGE:
                    continue
                left, up = -math.atan(left / along), -math.atan(up / along)
                chi2 = (left**2 + up**2) / SEED_RAD**2 + (off / SEED_LOG_RANGE) ** 2
                if gate_chi2 > 0.0:
                    pair_covariance(flares, i, j, plane, kind, slope, covariance)
                    chi2 = _chi2(covariance, left, up, off)
                if gate_chi2 == 0.0 or chi2 < gate_chi2:
                    misfit[found], at_row[found], at_column[found] = chi2, row, column
                    found += 1
        while count[n] < pairs.shape[2]:
            best, at = np.inf, -1
            for one in range(found):
                if misfit[one] < best:
                    best, at = misfit[one], one
            if at < 0:
                break
            row, column = at_row[at], at_column[at]
            pairs[n, 0, count[n]], pairs[n, 1, count[n]] = parents[row], images[column]
            for one in range(found):
                if at_row[one] == row or at_column[one] == column:
                    misfit[one] = np.inf
            total[n] += best
            count[n] += 1
    return pairs, count, total
