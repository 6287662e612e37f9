"""What a flat mirror shows of a robot: compiled loops of the search for mirrors and of their fit.

A plane n·x = c, n a unit vector away from the observer, shows p at p' = p − 2 (n·p − c) n. Its light
comes along |p' − o| to a camera at o, times the reflectance R: by flux it seems as far as |p' − o| / √R.
"""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.rig.mirrors.flares import Flares

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

CONSTANT, SURFACE, PANE = 0, 1, 2
"""Kinds of reflectance: a constant, of one side of a dielectric, of both sides of a sheet of it."""

NEAREST_MIRROR_M, GATE_CHI2, SEED_GATE_CHI2 = 0.05, 25.0, 200.0
SEED_LOG_RANGE, SEED_RAD = 0.3, 0.1
SEED_COSINE2 = 1.0 - 2.0 * SEED_RAD**2
FIT_STEPS, HOPELESS_CHI2, MOST_MATCHES = 8, 25.0, 4
STEP, SETTLED2 = 1e-4, 1e-4
MOST_STEP = (0.2, 0.2, 1.0, 0.3)
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
def pair_covariance(
    flares: Flares, parent: int, image: int, plane: Array, kind: int, slope: Array, covariance: Array
) -> tuple[float, float, float]:
    """Return the residual of a pair, and write its covariance: the image's, and the parent's by the mirror.

    `slope`, shape (3, 3), is written too: what the parent's place does to the residual.
    """
    x, y, z = flares.place_m[parent, 0], flares.place_m[parent, 1], flares.place_m[parent, 2]
    off = residual(flares, image, plane, kind, x, y, z)
    for k in range(3):
        d_x, d_y, d_z = STEP * (k == 0), STEP * (k == 1), STEP * (k == 2)
        moved = residual(flares, image, plane, kind, x + d_x, y + d_y, z + d_z)
        for m in range(3):
            slope[m, k] = (moved[m] - off[m]) / STEP
    for a in range(3):
        for b in range(a + 1):
            total = flares.angular_rad2[image, a, b] if a < 2 else 0.0
            shared_a = flares.common[image] if a == 2 else 0.0  # the parent's flux is also the image's
            shared_b = flares.common[image] if b == 2 else 0.0
            for k in range(3):
                shared_a += slope[a, k] * flares.moved_m[parent, k]
                shared_b += slope[b, k] * flares.moved_m[parent, k]
                for m in range(3):
                    total += slope[a, k] * flares.noise_m2[parent, k, m] * slope[b, m]
            covariance[a, b] = covariance[b, a] = total + shared_a * shared_b
    covariance[2, 2] += flares.noise[image] ** 2
    return off


@compiled
def invert(matrix: Array) -> float:
    """Invert a small positive definite matrix in place; returns the logarithm of its determinant."""
    size, log_determinant = len(matrix), 0.0
    for pivot in range(size):
        log_determinant += math.log(max(matrix[pivot, pivot], 1e-300))
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
    return log_determinant


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
def fit_plane(
    flares: Flares, parents: Indices, images: Indices, plane: Array, kind: int, prior: Array, precision: Array
) -> tuple[float, float, Array]:
    """Fit a plane to pairs in place, by Gauss–Newton.

    Parameters
    ----------
    parents, images
        Whom each image shows, shape (pairs,).
    plane
        n, c and the parameter, of a `kind` of reflectance, to start from; the fitted ones afterwards.
    prior, precision
        What is known beforehand: a plane, shape (5,), and the precision of its two angles (left and up), of
        c and of the parameter, shape (4, 4); 0 where nothing is.

    Returns
    -------
    χ², prior included; ln of the density of the residuals of all pairs at 0; the covariance of the unknowns,
    shape (4, 4), which is NaN where the fit fails.
    """
    # Unknowns, and behind them the residual as one more column: [H | r], and [H | r]ᵀ C⁻¹ [H | r].
    slope, of_prior, normal = np.empty((3, 5)), np.eye(4, 5), np.empty((5, 5))
    covariance, turned, information = np.empty((3, 3)), np.empty((3, 3)), np.empty((4, 4))
    log_peak, settled = 0.0, False
    # How a step of each unknown moves the plane: its angles to the left and upwards, c, the parameter.
    trial, moves = np.empty(5), np.eye(4, 5, 1)
    for step in range(FIT_STEPS):
        across_m = math.hypot(plane[0], plane[1])
        moves[0, 0], moves[0, 1] = 0.0, 1.0
        if across_m > 1e-9:
            moves[0, 0], moves[0, 1] = -plane[1] / across_m, plane[0] / across_m
        moves[1, 0], moves[1, 1] = -plane[2] * moves[0, 1], plane[2] * moves[0, 0]
        moves[1, 2] = plane[0] * moves[0, 1] - plane[1] * moves[0, 0]
        for unknown in range(4):
            of_prior[unknown, 4] = 0.0
            for k in range(5):
                of_prior[unknown, 4] += moves[unknown, k] * (plane[k] - prior[k])
        normal[:] = 0.0
        add_form_into(normal, of_prior, precision)
        log_peak = 0.0
        for pair in range(len(parents)):
            i, j = parents[pair], images[pair]
            x, y, z = flares.place_m[i, 0], flares.place_m[i, 1], flares.place_m[i, 2]
            off = pair_covariance(flares, i, j, plane, kind, turned, covariance)
            for unknown in range(4):
                for k in range(5):
                    trial[k] = plane[k] + STEP * moves[unknown, k]
                moved = residual(flares, j, trial, kind, x, y, z)
                for m in range(3):
                    slope[m, unknown] = (moved[m] - off[m]) / STEP
            slope[0, 4], slope[1, 4], slope[2, 4] = off
            log_peak -= 0.5 * (invert(covariance) + 3.0 * math.log(2.0 * math.pi))
            add_form_into(normal, slope, covariance)
        for k in range(4):
            if not normal[k, k] > 0.0:
                return normal[4, 4], log_peak, np.full((4, 4), np.nan)
        information[:] = normal[:4, :4]
        invert(information)
        # What its own pairs contradict after three steps is not worth polishing.
        if settled or step == FIT_STEPS - 1 or (step > 2 and normal[4, 4] > HOPELESS_CHI2 * len(parents)):
            break
        settled = True
        for k in range(4):
            change = 0.0
            for m in range(4):
                change -= information[k, m] * normal[m, 4]
            settled &= change**2 < SETTLED2 * information[k, k]
            for m in range(5):
                plane[m] += min(max(change, -MOST_STEP[k]), MOST_STEP[k]) * moves[k, m]
        plane[:3] /= math.sqrt(plane[0] ** 2 + plane[1] ** 2 + plane[2] ** 2)
    return normal[4, 4], log_peak, information


@compiled
def seeds_of_kind(
    flares: Flares, parents: Indices, images: Indices, kind: int, parameters: tuple[float, ...]
) -> Array:
    """Return the plane of each pair for each reflectance of some, shape (seeds, 5)."""
    total, count = len(parents), 0
    found = np.empty((total * len(parameters), 5))
    # The normal is s h + e, h the image as seen, e from the parent to the camera: h², e h, e².
    seen_m, apart_m, known = np.empty((total, 3)), np.empty((total, 3)), np.zeros((3, total))
    root, cosine, normal = np.empty(total), np.empty(total), np.empty(3)
    for pair in range(total):
        i, j = parents[pair], images[pair]
        known[0, pair] = flares.seems_m[j] ** 2
        for k in range(3):
            seen_m[pair, k] = flares.seems_m[j] * flares.axes[j, 2, k]
            apart_m[pair, k] = flares.origin_m[j, k] - flares.place_m[i, k]
            known[1, pair] += seen_m[pair, k] * apart_m[pair, k]
            known[2, pair] += apart_m[pair, k] ** 2
    for parameter in parameters:
        cosine[:] = 0.8
        for _ in range(5):
            for pair in range(total):
                s = math.sqrt(of_dielectric(kind, parameter, cosine[pair]))
                length2 = s**2 * known[0, pair] + 2.0 * s * known[1, pair] + known[2, pair]
                root[pair] = s
                cosine[pair] = (s * known[0, pair] + known[1, pair]) / math.sqrt(length2 * known[0, pair])
        for pair in range(total):
            i, j = parents[pair], images[pair]
            length, c, near, far = 0.0, 0.0, 0.0, 0.0
            for k in range(3):
                normal[k] = root[pair] * seen_m[pair, k] + apart_m[pair, k]
                length += normal[k] ** 2
                c += normal[k] * (flares.place_m[i, k] + 0.5 * normal[k])
                near += normal[k] * flares.origin_m[j, k]
                far += normal[k] * flares.place_m[i, k]
            length, c = math.sqrt(length), c / math.sqrt(length)
            if c - near / length > NEAREST_MIRROR_M and far / length < c and cosine[pair] > 0.0:
                for k in range(3):
                    found[count, k] = normal[k] / length
                found[count, 3], found[count, 4] = c, parameter
                count += 1
    return found[:count]


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
    slope, covariance, apart, form = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 1)), np.empty((1, 1))
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
                off = off_in_range(flares, j, plane, kind, path_m, across_m)
                if abs(off) > SEED_LOG_RANGE:
                    continue
                left, up = -math.atan2(left, along), -math.atan2(up, along)
                if abs(left) > SEED_RAD or abs(up) > SEED_RAD:
                    continue
                chi2 = (left**2 + up**2) / SEED_RAD**2 + (off / SEED_LOG_RANGE) ** 2
                if gate_chi2 > 0.0:
                    pair_covariance(flares, i, j, plane, kind, slope, covariance)
                    invert(covariance)
                    apart[0, 0], apart[1, 0], apart[2, 0], form[:] = left, up, off, 0.0
                    add_form_into(form, apart, covariance)
                    chi2 = form[0, 0]
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


@compiled
def fit_all(
    flares: Flares, robots: Indices, images: Indices, planes: Array, kinds: Indices, priors: Array,
    precisions: Array,
) -> tuple[Indices, Indices, Array, Array]:  # fmt: skip
    """Fit planes in place to the pairs that each explains, at first by the coarse gate, until they settle.

    Returns
    -------
    Pairs, shape (planes, 2, most), and how many, (planes,), 0 where fewer than two (one of a known plane) or
    none make a plane; χ² and ln of density, (planes, 2), and covariances, as of `fit_plane`.
    """
    pairs = np.empty((len(planes), 2, min(len(robots), len(images))), dtype=np.int64)
    count, found = np.zeros(len(planes), dtype=np.int64), np.zeros((len(planes), 2))
    covariances = np.empty((len(planes), 4, 4))
    for n in range(len(planes)):
        plane, kind, prior, precision = planes[n], kinds[n], priors[n], precisions[n]
        least = 1 if precision[0, 0] > 0.0 else 2
        shown, many, _ = match_all(flares, robots, images, planes[n : n + 1], kind, 0.0)
        for _ in range(MOST_MATCHES):
            if many[0] < least:
                break
            who, whom = shown[0, 0, : many[0]], shown[0, 1, : many[0]]
            found[n, 0], found[n, 1], covariance = fit_plane(flares, who, whom, plane, kind, prior, precision)
            holds = np.diag(covariance).min() > 0.0
            for j in whom:
                o = flares.origin_m[j]
                holds &= plane[3] - plane[0] * o[0] - plane[1] * o[1] - plane[2] * o[2] > NEAREST_MIRROR_M
            if not holds:
                break
            shown, many, _ = match_all(flares, robots, images, planes[n : n + 1], kind, GATE_CHI2)
            same = many[0] == len(who)
            for one in range(many[0]):
                same &= ((who == shown[0, 0, one]) & (whom == shown[0, 1, one])).any()
            if same:
                count[n] = many[0]
                pairs[n, 0, : count[n]], pairs[n, 1, : count[n]] = who, whom
                covariances[n] = covariance
                break
    return pairs, count, found, covariances
