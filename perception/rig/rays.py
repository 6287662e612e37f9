"""Where the bearings and ranges of several sightings say that a source is: compiled loops of `fusion`.

A sighting is a ray from a camera's centre: a direction with its angular covariance, and the logarithm of a
range with noise of its own and an error that all sightings of a source share.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.likelihood.products import invert
from perception.rig.joined import Joined

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

UNKNOWN_RANGE = 10.0
"""Standard deviation of the logarithm of a range that is not known."""

NEAREST_M, FARTHEST_M = 0.2, 50.0
"""Where rays without ranges are taken to meet."""

LEAST_COSINE = 0.5
"""Rays that differ by more than 60 degrees are not of one source."""

KNOWN_RANGE = 0.3
"""A fused range that is open to more than this, relatively, is none."""

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
    room = np.empty((5, 3))
    for row in range(len(one)):
        for column in range(len(other)):
            i, j = one[row], other[column]
            cosine = 0.0
            for k in range(3):
                cosine += rays.axes[i, 2, k] * rays.axes[j, 2, k]
            if cosine < LEAST_COSINE:
                continue
            chi2[row, column], factor = _chi2_of_pair(rays, i, j, 1.0, speed_m_per_s, room)
            if not (math.isnan(rays.range_m[i]) or math.isnan(rays.range_m[j])):
                for _ in range(SCALE_STEPS):
                    factor = min(max(factor, LEAST_FACTOR), 1.0)
                    found = _chi2_of_pair(rays, i, j, factor, speed_m_per_s, room)
                    scaled[row, column], factor = found
    return chi2, scaled


@compiled
def _chi2_of_pair(
    rays: Rays, i: int, j: int, factor: float, speed_m_per_s: float, room: Array
) -> tuple[float, float]:
    """Return χ² of two sightings' being of one source, and the factor on both ranges that suits best.

    `room`, shape (5, 3), is what it works in.
    """
    apart_m, grown_m, covariance = room[0], room[1], room[2:]
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
    invert(covariance)
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
            invert(angular)
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
        invert(information)
        for k in range(4):
            step = 0.0
            for m in range(4):
                step += information[k, m] * score[m]
            if k < 3:
                place_m[k] += step
            else:
                shared += step
    return place_m, information


@compiled
def joined(
    rays: Rays, together: Rays, camera: Indices, claimed: Flags, saturated: Flags, merged: Flags,
    ghost: Flags, members: Indices, ends: Indices, agree: Flags, speed_m_per_s: float,
) -> Joined:  # fmt: skip
    """Return sources from their sightings.

    Parameters
    ----------
    rays, together
        Sightings, and the same where several are compared, n of them.
    camera
        The number of the camera of each, shape (n,).
    claimed, saturated, merged, ghost
        As of `Sightings`, shape (n,).
    members, ends
        The sightings of the first source, then those of the second, ..., shape (n,); where each one's end.
    agree
        Whether ranges agree with where the rays meet, for each source.
    """
    n, begin = len(ends), 0
    found = Joined(
        np.empty(n), np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty((n, 3, 3)), np.empty(n),
        np.empty(n), np.empty(n), np.empty(n), np.empty((n, 3)), np.empty((n, 3, 3)),
        np.ones(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_), np.ones(n, dtype=np.bool_),
    )  # fmt: skip
    used = np.empty(len(members), dtype=np.int64)
    for source in range(n):
        own, begin = members[begin : ends[source]], ends[source]
        for k in own:
            found.merged[source] |= merged[k]
            found.ghost[source] &= ghost[k]
        count = _counting(own, camera, claimed, rays.noise, used)
        best = used[0]
        if count == 1 or not agree[source]:
            count = 1
            _alone_into(found, source, rays, best)
        else:
            _together_into(found, source, rays, together, used[:count], speed_m_per_s)
        for k in used[:count]:
            found.saturated[source] &= saturated[k]
        found.noise[source], found.common[source] = rays.noise[best], rays.common[best]
        common_m = 0.0
        for k in range(3):
            common_m += found.moved_m[source, k] * found.bearing[source, k]
        found.common_m[source] = abs(common_m)
        if not claimed[best]:
            found.covariance[source] = np.nan
            found.common_m[source] = np.nan
    return found


@compiled
def _counting(members: Indices, camera: Indices, claimed: Flags, noise: Array, used: Indices) -> int:
    """Write which of a source's sightings count: the least noisy of each camera, by noise; tell how many."""
    any_claimed, count, kept = False, 0, 0
    for k in members:
        any_claimed |= claimed[k]
    for k in members:
        if any_claimed and not claimed[k]:
            continue
        place = count
        while place > 0 and noise[used[place - 1]] > noise[k]:
            used[place] = used[place - 1]
            place -= 1
        used[place] = k
        count += 1
    for one in range(count):
        known = False
        for other in range(kept):
            known |= camera[used[other]] == camera[used[one]]
        if not known:
            used[kept] = used[one]
            kept += 1
    return kept


@compiled
def _alone_into(found: Joined, source: int, rays: Rays, k: int) -> None:
    """Write what a sighting says by itself."""
    range_m, noise2 = rays.range_m[k], rays.noise[k] ** 2
    found.time_s[source] = rays.time_s[k]
    found.range_m[source] = found.seems_m[source] = range_m
    covariance, axes = found.covariance[source], rays.axes[k]
    covariance[:] = 0.0
    covariance[:2, :2] = rays.angular_rad2[k]
    covariance[2, 2] = range_m**2 * (noise2 + rays.common[k] ** 2)
    if math.isnan(range_m):
        covariance[2, :] = covariance[:, 2] = np.nan
    for x in range(3):
        found.origin_m[source, x] = rays.origin_m[k, x]
        found.bearing[source, x] = axes[2, x]
        found.moved_m[source, x] = rays.common[k] * range_m * axes[2, x]
        for y in range(3):
            total = noise2 * axes[2, x] * axes[2, y]
            for a in range(2):
                for b in range(2):
                    total += axes[a, x] * rays.angular_rad2[k, a, b] * axes[b, y]
            found.noise_m2[source, x, y] = range_m**2 * total


@compiled
def _together_into(
    found: Joined, source: int, rays: Rays, together: Rays, rows: Indices, speed_m_per_s: float
) -> None:
    """Write what several say together; a range that is still open to more than 30 % is none."""
    best, weights, time_s = rows[0], 0.0, 0.0
    origin_m, bearing = found.origin_m[source], found.bearing[source]
    origin_m[:] = 0.0
    for k in rows:
        weight = 1.0 / (together.angular_rad2[k, 0, 0] + together.angular_rad2[k, 1, 1])
        weights += weight
        time_s += weight * rays.time_s[k]
        origin_m += together.origin_m[k]
    time_s /= weights
    origin_m /= len(rows)
    place_m, of_all = placed(together, rows, time_s, speed_m_per_s)
    range2, seems2 = 0.0, 0.0
    for x in range(3):
        range2 += (place_m[x] - origin_m[x]) ** 2
        seen_m = rays.origin_m[best, x] + rays.range_m[best] * rays.axes[best, 2, x]
        seems2 += (seen_m - origin_m[x]) ** 2
    range_m = math.sqrt(range2)
    for x in range(3):
        bearing[x] = (place_m[x] - origin_m[x]) / range_m
        # A fit with a prior of variance 1 answers an error a of what it assumed by −C a.
        found.moved_m[source, x] = -of_all[x, 3]
    turn, covariance = np.empty((3, 3)), found.covariance[source]
    axes_into(turn, bearing)
    turn[:2] /= range_m
    for a in range(3):
        for b in range(3):
            covariance[a, b] = 0.0
            found.noise_m2[source, a, b] = of_all[a, b] - of_all[a, 3] * of_all[b, 3]
            for x in range(3):
                for y in range(3):
                    covariance[a, b] += turn[a, x] * of_all[x, y] * turn[b, y]
    if not math.sqrt(covariance[2, 2]) < KNOWN_RANGE * range_m:
        covariance[2, :] = covariance[:, 2] = range_m = np.nan
    found.time_s[source], found.range_m[source], found.seems_m[source] = time_s, range_m, math.sqrt(seems2)


@compiled
def axes_into(axes: Array, bearing: Array) -> None:
    """Write unit vectors to the left, upwards and along a bearing (`bearing_axes`)."""
    x, y, z = bearing
    level = math.hypot(x, y)
    left_x, left_y = 0.0, 1.0
    if level > 1e-12:
        left_x, left_y = -y / level, x / level
    axes[0, 0], axes[0, 1], axes[0, 2] = left_x, left_y, 0.0
    axes[1, 0], axes[1, 1], axes[1, 2] = -z * left_y, z * left_x, x * left_y - y * left_x
    axes[2, 0], axes[2, 1], axes[2, 2] = x, y, z
