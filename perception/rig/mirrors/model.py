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


@compiled
def log_root_reflectance(kind: int, parameter: float, cosine: float) -> float:
    """Return ½ ln R at an angle of incidence; the parameter is −½ ln R of a constant one, else the index."""
    if kind == CONSTANT:
        return -parameter
    return 0.5 * math.log(of_dielectric(kind, parameter, cosine))


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
def residual(
    flares: Flares, image: int, plane: Array, kind: int, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """Return how far an image lies from where a plane shows a place: left, up, and in ln range.

    `plane` holds n (3), c and the parameter of the reflectance.
    """
    n_x, n_y, n_z = plane[0], plane[1], plane[2]
    twice_m = 2.0 * (((plane[3] - n_x * x) - n_y * y) - n_z * z)
    off_x = x + twice_m * n_x - flares.origin_m[image, 0]
    off_y = y + twice_m * n_y - flares.origin_m[image, 1]
    off_z = z + twice_m * n_z - flares.origin_m[image, 2]
    axes = flares.axes[image]
    path_m = math.sqrt(off_x**2 + off_y**2 + off_z**2)
    cosine = off_x * n_x + off_y * n_y + off_z * n_z
    left = axes[0, 0] * off_x + axes[0, 1] * off_y + axes[0, 2] * off_z
    up = axes[1, 0] * off_x + axes[1, 1] * off_y + axes[1, 2] * off_z
    along = axes[2, 0] * off_x + axes[2, 1] * off_y + axes[2, 2] * off_z
    by_reflectance = log_root_reflectance(kind, plane[4], abs(cosine) / path_m)
    off = math.log(flares.seems_m[image] / path_m) + by_reflectance
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
        shared_a = flares.common[image] if a == 2 else 0.0  # the parent's flux is also the image's
        for k in range(3):
            shared_a += slope[a, k] * flares.moved_m[parent, k]
        for b in range(a + 1):
            shared_b = flares.common[image] if b == 2 else 0.0
            for k in range(3):
                shared_b += slope[b, k] * flares.moved_m[parent, k]
            total = shared_a * shared_b
            for k in range(3):
                for m in range(3):
                    total += slope[a, k] * flares.noise_m2[parent, k, m] * slope[b, m]
            if a < 2:
                total += flares.angular_rad2[image, a, b]
            covariance[a, b] = covariance[b, a] = total
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
    information, score = np.empty((4, 4)), np.empty(4)
    covariance, slope, turned = np.empty((3, 3)), np.empty((3, 4)), np.empty((3, 3))
    chi2, log_peak, settled = 0.0, 0.0, False
    trial, axes = np.empty(5), np.empty((2, 3))
    for step in range(FIT_STEPS):
        across_m = math.hypot(plane[0], plane[1])
        axes[0, 0], axes[0, 1], axes[0, 2] = 0.0, 1.0, 0.0
        if across_m > 1e-9:
            axes[0, 0], axes[0, 1] = -plane[1] / across_m, plane[0] / across_m
        axes[1, 0] = plane[1] * axes[0, 2] - plane[2] * axes[0, 1]
        axes[1, 1] = plane[2] * axes[0, 0] - plane[0] * axes[0, 2]
        axes[1, 2] = plane[0] * axes[0, 1] - plane[1] * axes[0, 0]
        from_prior = np.zeros(4)
        for k in range(3):
            from_prior[0] += axes[0, k] * (plane[k] - prior[k])
            from_prior[1] += axes[1, k] * (plane[k] - prior[k])
        from_prior[2], from_prior[3] = plane[3] - prior[3], plane[4] - prior[4]
        information[:] = precision
        chi2, log_peak = 0.0, 0.0
        for a in range(4):
            score[a] = 0.0
            for b in range(4):
                score[a] -= precision[a, b] * from_prior[b]
                chi2 += from_prior[a] * precision[a, b] * from_prior[b]
        for pair in range(len(parents)):
            i, j = parents[pair], images[pair]
            x, y, z = flares.place_m[i, 0], flares.place_m[i, 1], flares.place_m[i, 2]
            off = pair_covariance(flares, i, j, plane, kind, turned, covariance)
            for unknown in range(4):
                trial[:] = plane
                if unknown < 2:
                    for k in range(3):
                        trial[k] += STEP * axes[unknown, k]
                else:
                    trial[unknown + 1] += STEP
                moved = residual(flares, j, trial, kind, x, y, z)
                for m in range(3):
                    slope[m, unknown] = (moved[m] - off[m]) / STEP
            log_peak -= 0.5 * (invert(covariance) + 3.0 * math.log(2.0 * math.pi))
            for a in range(3):
                for b in range(3):
                    chi2 += off[a] * covariance[a, b] * off[b]
                    for k in range(4):
                        score[k] -= slope[a, k] * covariance[a, b] * off[b]
                        for m in range(4):
                            information[k, m] += slope[a, k] * covariance[a, b] * slope[b, m]
        for k in range(4):
            if not information[k, k] > 0.0:
                return chi2, log_peak, np.full((4, 4), np.nan)
        invert(information)
        # What its own pairs contradict after three steps is not worth polishing.
        if settled or step == FIT_STEPS - 1 or (step > 2 and chi2 > HOPELESS_CHI2 * len(parents)):
            break
        length, settled = 0.0, True
        for k in range(4):
            change = 0.0
            for m in range(4):
                change += information[k, m] * score[m]
            settled &= change**2 < SETTLED2 * information[k, k]
            if k < 2:
                for m in range(3):
                    plane[m] += min(max(change, -0.2), 0.2) * axes[k, m]
            elif k == 2:
                plane[3] += min(max(change, -1.0), 1.0)
            else:
                plane[4] += min(max(change, -0.3), 0.3)
        for k in range(3):
            length += plane[k] ** 2
        for k in range(3):
            plane[k] /= math.sqrt(length)
    return chi2, log_peak, information


@compiled
def seeds_of_kind(
    flares: Flares, parents: Indices, images: Indices, kind: int, parameters: tuple[float, ...]
) -> Array:
    """Return the plane of each pair for each reflectance of some, shape (seeds, 5)."""
    found = np.empty((len(parents) * len(parameters), 5))
    count = 0
    normal = np.empty(3)
    for parameter in parameters:
        for pair in range(len(parents)):
            i, j = parents[pair], images[pair]
            # The normal is s h + e, h the image as seen, e from the parent to the camera: h², e h, e².
            seems2, mixed, apart2 = flares.seems_m[j] ** 2, 0.0, 0.0
            for k in range(3):
                apart_m = flares.origin_m[j, k] - flares.place_m[i, k]
                mixed += flares.seems_m[j] * flares.axes[j, 2, k] * apart_m
                apart2 += apart_m**2
            cosine, s = 0.8, 0.0
            for _ in range(5):
                s = math.sqrt(of_dielectric(kind, parameter, cosine))
                length2 = s**2 * seems2 + 2.0 * s * mixed + apart2
                cosine = (s * seems2 + mixed) / math.sqrt(length2 * seems2)
            length, c, near, far = 0.0, 0.0, 0.0, 0.0
            for k in range(3):
                seen = s * flares.seems_m[j] * flares.axes[j, 2, k]
                normal[k] = seen + flares.origin_m[j, k] - flares.place_m[i, k]
                length += normal[k] ** 2
                c += normal[k] * (flares.place_m[i, k] + 0.5 * normal[k])
                near += normal[k] * flares.origin_m[j, k]
                far += normal[k] * flares.place_m[i, k]
            length = math.sqrt(length)
            c = c / length
            if c - near / length > NEAREST_MIRROR_M and far / length < c and cosine > 0.0:
                for k in range(3):
                    found[count, k] = normal[k] / length
                found[count, 3], found[count, 4] = c, parameter
                count += 1
    return found[:count]


@compiled
def matched(
    flares: Flares, parents: Indices, images: Indices, plane: Array, kind: int, gate_chi2: float
) -> tuple[Indices, Indices, float]:
    """Tell which of some images show which of some parents in a plane, one to one, best first.

    Where `gate_chi2` is 0 the gate is a coarse one, for planes that are but guessed.

    Returns
    -------
    Pairs of parents and images, same shape, and how well they agree in all, the less the better.
    """
    columns = len(images)
    most = min(len(parents), columns)
    who, whom = np.empty(most, dtype=np.int64), np.empty(most, dtype=np.int64)
    # Those that lie within the gate are few: each with its row and column, and how badly it agrees.
    found, misfit = 0, np.empty(len(parents) * columns)
    at_row, at_column = np.empty(len(misfit), dtype=np.int64), np.empty(len(misfit), dtype=np.int64)
    seen, near = np.empty((6, columns)), np.empty(columns, dtype=np.bool_)
    for column in range(columns):
        for k in range(3):
            seen[k, column] = flares.axes[images[column], 2, k]
            seen[3 + k, column] = flares.origin_m[images[column], k]
    slope, covariance = np.empty((3, 3)), np.empty((3, 3))
    for row in range(len(parents)):
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
            near[column] = (along > 0.0) & (along**2 >= SEED_COSINE2 * length2)
        for column in range(columns):
            if not near[column] or images[column] == i:
                continue
            j = images[column]
            off = residual(flares, j, plane, kind, x, y, z)
            if abs(off[0]) > SEED_RAD or abs(off[1]) > SEED_RAD or abs(off[2]) > SEED_LOG_RANGE:
                continue
            if gate_chi2 == 0.0:
                chi2 = (off[0] ** 2 + off[1] ** 2) / SEED_RAD**2 + (off[2] / SEED_LOG_RANGE) ** 2
            else:
                pair_covariance(flares, i, j, plane, kind, slope, covariance)
                invert(covariance)
                chi2 = 0.0
                for a in range(3):
                    for b in range(3):
                        chi2 += off[a] * covariance[a, b] * off[b]
            if gate_chi2 == 0.0 or chi2 < gate_chi2:
                misfit[found], at_row[found], at_column[found] = chi2, row, column
                found += 1
    count, total = 0, 0.0
    while count < most:
        best, at = np.inf, -1
        for one in range(found):
            if misfit[one] < best:
                best, at = misfit[one], one
        if at < 0:
            break
        row, column = at_row[at], at_column[at]
        who[count], whom[count] = parents[row], images[column]
        for one in range(found):
            if at_row[one] == row or at_column[one] == column:
                misfit[one] = np.inf
        total += best
        count += 1
    return who[:count], whom[:count], total


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
        parents, shown, _ = matched(flares, robots, images, plane, kind, 0.0)
        for _ in range(MOST_MATCHES):
            if len(parents) < least:
                break
            fitted = fit_plane(flares, parents, shown, plane, kind, prior, precision)
            found[n, 0], found[n, 1], covariance = fitted
            holds = np.diag(covariance).min() > 0.0
            for j in shown:
                o = flares.origin_m[j]
                holds &= plane[3] - plane[0] * o[0] - plane[1] * o[1] - plane[2] * o[2] > NEAREST_MIRROR_M
            if not holds:
                break
            again, whom, _ = matched(flares, robots, images, plane, kind, GATE_CHI2)
            same = len(again) == len(parents)
            for one in range(len(again)):
                same &= ((parents == again[one]) & (shown == whom[one])).any()
            if same:
                count[n] = len(parents)
                pairs[n, 0, : count[n]], pairs[n, 1, : count[n]] = parents, shown
                covariances[n] = covariance
                break
            parents, shown = again, whom
    return pairs, count, found, covariances


@compiled
def explained_by(
    flares: Flares, parents: Indices, images: Indices, seeds: Array, kind: int
) -> tuple[Indices, Array, Indices]:
    """Return how many images each plane explains, how badly, and a mark of which pairs; shapes (seeds,).

    A seed has the noise of one or two pairs, and that of a dielectric a guessed index, so gates are wide.
    """
    count, misfit = np.empty(len(seeds), dtype=np.int64), np.empty(len(seeds))
    mark = np.empty(len(seeds), dtype=np.int64)
    for seed in range(len(seeds)):
        gate_chi2 = SEED_GATE_CHI2 if kind == CONSTANT else 0.0
        who, whom, misfit[seed] = matched(flares, parents, images, seeds[seed], kind, gate_chi2)
        count[seed] = len(who)
        mark[seed] = ((who + 1) * (whom + 31) ** 4).sum()  # of which pairs, in whatever order
    return count, misfit, mark
