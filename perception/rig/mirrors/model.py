"""What a flat mirror shows of a robot: compiled loops of the search for mirrors and of their fit.

A plane n·x = c, n a unit vector away from the observer, shows p at p' = p − 2 (n·p − c) n. The image's
bearing is that of p', and its light comes along |p' − o|, o the camera's centre, times the reflectance R: by
flux alone it seems as far as |p' − o| / √R.
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

NEAREST_MIRROR_M, SAME_PLANE = 0.05, 0.02
GATE_CHI2, SEED_GATE_CHI2 = 25.0, 200.0
SEED_LOG_RANGE, SEED_RAD = 0.3, 0.1
SEED_COSINE2 = 1.0 - 2.0 * SEED_RAD**2
FIT_STEPS, HOPELESS_CHI2, MOST_MATCHES = 8, 25.0, 4
STEP, SETTLED2 = 1e-4, 1e-4


@compiled
def log_root_reflectance(kind: int, parameter: float, cosine: float) -> float:
    """Return ½ ln R at an angle of incidence: of a constant one −parameter; Fresnel for unpolarised light.

    The `parameter` of a constant reflectance is −½ ln R, of the others the refractive index. A sheet reflects
    2 R / (1 + R), all orders summed, without absorption.
    """
    if kind == CONSTANT:
        return -parameter
    index = max(parameter, 1.0001)
    cosine = min(max(cosine, 1e-6), 1.0)
    inside = math.sqrt(1.0 - (1.0 - cosine**2) / index**2)
    across = ((cosine - index * inside) / (cosine + index * inside)) ** 2
    within = ((index * cosine - inside) / (index * cosine + inside)) ** 2
    reflectance = 0.5 * (across + within)
    if kind == PANE:
        reflectance = 2.0 * reflectance / (1.0 + reflectance)
    return 0.5 * math.log(max(reflectance, 1e-12))


@compiled
def residual(flares: Flares, image: int, plane: Array, kind: int, place_m: Array, off: Array) -> None:
    """Write how far an image lies from where a plane shows a place: left, up, and in ln range.

    `plane` holds n (3), c and the parameter of the reflectance.
    """
    beyond_m = plane[3]
    for k in range(3):
        beyond_m -= plane[k] * place_m[k]
    path2, cosine = 0.0, 0.0
    for k in range(3):
        off[k] = place_m[k] + 2.0 * beyond_m * plane[k] - flares.origin_m[image, k]
        path2 += off[k] ** 2
        cosine += off[k] * plane[k]
    path_m = math.sqrt(path2)
    left, up, along = 0.0, 0.0, 0.0
    for k in range(3):
        left += flares.axes[image, 0, k] * off[k]
        up += flares.axes[image, 1, k] * off[k]
        along += flares.axes[image, 2, k] * off[k]
    by_reflectance = log_root_reflectance(kind, plane[4], abs(cosine) / path_m)
    off[0] = -math.atan2(left, along)
    off[1] = -math.atan2(up, along)
    off[2] = math.log(flares.seems_m[image] / path_m) + by_reflectance


@compiled
def pair_covariance(
    flares: Flares, parent: int, image: int, plane: Array, kind: int, off: Array, covariance: Array
) -> None:
    """Write the residual of a pair, and its covariance: the image's, and the parent's by the mirror."""
    place_m = flares.place_m[parent].copy()
    residual(flares, image, plane, kind, place_m, off)
    slope, moved = np.empty((3, 3)), np.empty(3)
    for k in range(3):
        place_m[k] += STEP
        residual(flares, image, plane, kind, place_m, moved)
        place_m[k] -= STEP
        for m in range(3):
            slope[m, k] = (moved[m] - off[m]) / STEP
    shared = np.zeros(3)  # the parent's flux is also the image's
    for m in range(3):
        for k in range(3):
            shared[m] += slope[m, k] * flares.moved_m[parent, k]
    shared[2] += flares.common[image]
    for a in range(3):
        for b in range(3):
            covariance[a, b] = shared[a] * shared[b]
            for k in range(3):
                for m in range(3):
                    covariance[a, b] += slope[a, k] * flares.noise_m2[parent, k, m] * slope[b, m]
    for a in range(2):
        for b in range(2):
            covariance[a, b] += flares.angular_rad2[image, a, b]
    covariance[2, 2] += flares.noise[image] ** 2


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
    flares, parents, images
        Whom each image shows, indices of shape (pairs,).
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
    off, moved, covariance, slope = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 4))
    chi2, log_peak = 0.0, 0.0
    trial, axes, settled = np.empty(5), np.empty((2, 3)), False
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
            pair_covariance(flares, i, j, plane, kind, off, covariance)
            for unknown in range(4):
                trial[:] = plane
                if unknown < 2:
                    for k in range(3):
                        trial[k] += STEP * axes[unknown, k]
                else:
                    trial[unknown + 1] += STEP
                residual(flares, j, trial, kind, flares.place_m[i], moved)
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
    for number in range(len(found)):
        parameter = parameters[number // len(parents)]
        i, j = parents[number % len(parents)], images[number % len(parents)]
        cosine, c, s, near = 0.8, 0.0, 0.0, 0.0
        for _ in range(5):
            s = math.exp(log_root_reflectance(kind, parameter, cosine))
            length, c, along, path2, near = 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(3):
                seen = s * flares.seems_m[j] * flares.axes[j, 2, k]
                normal[k] = seen + flares.origin_m[j, k] - flares.place_m[i, k]
                length += normal[k] ** 2
                along += normal[k] * seen
                path2 += seen**2
                c += normal[k] * (flares.place_m[i, k] + 0.5 * normal[k])
                near += normal[k] * flares.origin_m[j, k]
            length = math.sqrt(length)
            cosine, c, near = along / (length * math.sqrt(path2)), c / length, near / length
        far = 0.0
        for k in range(3):
            far += normal[k] * flares.place_m[i, k] / length
        if c - near > NEAREST_MIRROR_M and far < c and cosine > 0.0:
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
    most = min(len(parents), len(images))
    who, whom = np.empty(most, dtype=np.int64), np.empty(most, dtype=np.int64)
    # Those that lie within the gate are few: each with its row and column, and how badly it agrees.
    found, misfit = 0, np.empty(len(parents) * len(images))
    rows, columns = np.empty(len(misfit), dtype=np.int64), np.empty(len(misfit), dtype=np.int64)
    off, covariance, shown_m = np.empty(3), np.empty((3, 3)), np.empty(3)
    for row in range(len(parents)):
        i = parents[row]
        before_m = plane[3]
        for k in range(3):
            before_m -= plane[k] * flares.place_m[i, k]
        if before_m <= 0.0:
            continue
        for k in range(3):
            shown_m[k] = flares.place_m[i, k] + 2.0 * before_m * plane[k]
        for column in range(len(images)):
            j = images[column]
            # Most images are far from where they would have to be: that is seen without a root or an angle.
            along, length2 = 0.0, 0.0
            for k in range(3):
                out_m = shown_m[k] - flares.origin_m[j, k]
                along += flares.axes[j, 2, k] * out_m
                length2 += out_m**2
            if i == j or along <= 0.0 or along**2 < SEED_COSINE2 * length2:
                continue
            residual(flares, j, plane, kind, flares.place_m[i], off)
            if abs(off[0]) > SEED_RAD or abs(off[1]) > SEED_RAD or abs(off[2]) > SEED_LOG_RANGE:
                continue
            if gate_chi2 == 0.0:
                chi2 = (off[0] ** 2 + off[1] ** 2) / SEED_RAD**2 + (off[2] / SEED_LOG_RANGE) ** 2
            else:
                pair_covariance(flares, i, j, plane, kind, off, covariance)
                invert(covariance)
                chi2 = 0.0
                for a in range(3):
                    for b in range(3):
                        chi2 += off[a] * covariance[a, b] * off[b]
            if gate_chi2 == 0.0 or chi2 < gate_chi2:
                misfit[found], rows[found], columns[found] = chi2, row, column
                found += 1
    count, total = 0, 0.0
    while count < most:
        best, at = np.inf, -1
        for one in range(found):
            if misfit[one] < best:
                best, at = misfit[one], one
        if at < 0:
            break
        who[count], whom[count] = parents[rows[at]], images[columns[at]]
        row, column = rows[at], columns[at]
        for one in range(found):
            if rows[one] == row or columns[one] == column:
                misfit[one] = np.inf
        total += best
        count += 1
    return who[:count], whom[:count], total


@compiled
def fit_matched(
    flares: Flares, robots: Indices, images: Indices, plane: Array, kind: int, prior: Array, precision: Array
) -> tuple[Indices, Indices, float, float, Array]:
    """Fit a plane in place to the pairs that it explains, at first by the coarse gate, until they settle.

    Returns the pairs, none if fewer than two (one of a known plane) or none make a plane; and as `fit_plane`.
    """
    least = 1 if precision[0, 0] > 0.0 else 2
    parents, shown, _ = matched(flares, robots, images, plane, kind, 0.0)
    none = parents[:0]
    chi2, log_peak, covariance = 0.0, 0.0, np.empty((4, 4))
    for _ in range(MOST_MATCHES):
        if len(parents) < least:
            break
        chi2, log_peak, covariance = fit_plane(flares, parents, shown, plane, kind, prior, precision)
        holds = np.diag(covariance).min() > 0.0
        for j in shown:
            before_m = plane[3]
            for k in range(3):
                before_m -= plane[k] * flares.origin_m[j, k]
            holds &= before_m > NEAREST_MIRROR_M
        if not holds:
            break
        again, whom, _ = matched(flares, robots, images, plane, kind, GATE_CHI2)
        same = len(again) == len(parents)
        for one in range(len(again)):
            known = False
            for other in range(len(parents)):
                known |= again[one] == parents[other] and whom[one] == shown[other]
            same &= known
        if same:
            return parents, shown, chi2, log_peak, covariance
        parents, shown = again, whom
    return none, none, chi2, log_peak, covariance


@compiled
def best_seeds(
    flares: Flares, parents: Indices, images: Indices, seeds: Array, kind: int, most: int
) -> tuple[Array, Indices]:
    """Return the planes that explain most images, shape (most, 5) or less, and how many each does.

    A seed has the noise of one or two pairs, and that of a dielectric a guessed index, so gates are wide.
    """
    count, misfit = np.empty(len(seeds), dtype=np.int64), np.empty(len(seeds))
    mark = np.empty(len(seeds), dtype=np.int64)
    for seed in range(len(seeds)):
        gate_chi2 = SEED_GATE_CHI2 if kind == CONSTANT else 0.0
        who, whom, misfit[seed] = matched(flares, parents, images, seeds[seed], kind, gate_chi2)
        count[seed] = len(who)
        mark[seed] = ((who + 1) * (whom + 31) ** 4).sum()  # of which pairs, in whatever order
    taken = np.zeros(len(seeds), dtype=np.bool_)
    chosen = np.empty(min(most, len(seeds)), dtype=np.int64)
    ranks = 0
    while ranks < len(chosen):
        best = -1
        for seed in range(len(seeds)):
            if not taken[seed] and (
                best < 0
                or count[seed] > count[best]
                or (count[seed] == count[best] and misfit[seed] < misfit[best])
            ):
                best = seed
        if best < 0:
            break
        chosen[ranks] = best
        ranks += 1
        # Planes close by would be the same one again, and those of the same pairs are fitted to it.
        for seed in range(len(seeds)):
            apart = abs(seeds[seed, 3] - seeds[best, 3])
            for k in range(3):
                apart += abs(seeds[seed, k] - seeds[best, k])
            same_pairs = count[seed] == count[best] and mark[seed] == mark[best]
            taken[seed] |= apart < SAME_PLANE or same_pairs
    return seeds[chosen[:ranks]], count[chosen[:ranks]]
