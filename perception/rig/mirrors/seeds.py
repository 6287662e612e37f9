"""Where a mirror may be, by pairs of a flare and its image: compiled loops of the search for mirrors."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.rig.mirrors.flares import Flares
from perception.rig.mirrors.model import (
    CONSTANT,
    NEAREST_MIRROR_M,
    ROUNDED,
    match_all,
    of_dielectric,
)

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LEAST_ROOT, MOST_ROOT = 0.1, 1.03
"""√R of a mirror worth looking for, and a margin for noise."""

SEED_GATE_CHI2 = 200.0
DIM_RATIO = 1.5
PARALLEL_RAD = 0.08
PARALLEL_COSINE = 1.0 - 0.5 * PARALLEL_RAD**2
SAME_PLANE = 0.02


@compiled
def plausible_pairs(flares: Flares, robots: Indices, images: Indices) -> tuple[Indices, Indices]:
    """Return whom each flare may show: an image is farther than what it shows, from anywhere before it."""
    most, count = len(robots) * len(images), 0
    parents, shown = np.empty(most, dtype=np.int64), np.empty(most, dtype=np.int64)
    for i in robots:
        for j in images:
            if i != j and flares.seems_m[j] > parted_m(flares, i, j):
                parents[count], shown[count] = i, j
                count += 1
    return parents[:count], shown[:count]


@compiled
def parted_m(flares: Flares, i: int, j: int) -> float:
    """Return how far a flare is from where the bearing of another counts from."""
    apart2 = 0.0
    for k in range(3):
        apart2 += (flares.place_m[i, k] - flares.origin_m[j, k]) ** 2
    return math.sqrt(apart2)


@compiled
def dim_pairs(flares: Flares, parents: Indices, images: Indices) -> tuple[Indices, Indices]:
    """Return the pairs with a dim image: a dielectric takes more than half of the light but when grazed."""
    dim = np.empty(len(parents), dtype=np.bool_)
    for pair in range(len(parents)):
        near_m = parted_m(flares, parents[pair], images[pair])
        dim[pair] = flares.seems_m[images[pair]] > DIM_RATIO * near_m
    return parents[dim], images[dim]


@compiled
def seeds_of_constant(flares: Flares, parents: Indices, images: Indices, stride: int, most: int) -> Array:
    """Return planes that two pairs agree on, if they are reflected alike, shape (seeds, 5).

    The image of a pair stands at o + s R h, s = √R for both; each is mirrored about the plane halfway, and
    the two planes are one: their normals are parallel, which is quadratic in s, and their distances equal.
    """
    found = np.empty((most, 5))
    count = 0
    one, other = np.empty(3), np.empty(3)
    total = len(parents)
    # By axis first: roots are then found for many pairs at a time.
    seems_m, apart_m, roots = np.empty((3, total)), np.empty((3, total)), np.empty((2, total))
    for a in range(total):
        i, j = parents[a], images[a]
        for x in range(3):
            seems_m[x, a] = flares.seems_m[j] * flares.axes[j, 2, x]
            apart_m[x, a] = flares.origin_m[j, x] - flares.place_m[i, x]
    number = 0
    for b in range(1, total):
        # Pairs of pairs are numbered, a < b, and every so many of them looked at.
        begin = (stride - number % stride) % stride
        number += b
        _roots(seems_m, apart_m, b, roots)
        k, m = parents[b], images[b]
        for a in range(begin, b, stride):
            i, j = parents[a], images[a]
            if i in (k, m) or j in (k, m):
                continue
            for way in range(2):
                s = roots[way, a]
                if not LEAST_ROOT < s < MOST_ROOT:
                    continue
                length1, length2, dot = 0.0, 0.0, 0.0
                for y in range(3):
                    one[y] = s * seems_m[y, a] + flares.origin_m[j, y] - flares.place_m[i, y]
                    other[y] = s * seems_m[y, b] + flares.origin_m[m, y] - flares.place_m[k, y]
                    length1 += one[y] ** 2
                    length2 += other[y] ** 2
                    dot += one[y] * other[y]
                # Most are far from parallel: that is seen without a root.
                if dot <= 0.0 or dot**2 < ROUNDED * PARALLEL_COSINE**2 * length1 * length2:
                    continue
                c1, c2, near1, far1 = 0.0, 0.0, 0.0, 0.0
                for y in range(3):
                    c1 += one[y] * (flares.place_m[i, y] + 0.5 * one[y])
                    c2 += other[y] * (flares.place_m[k, y] + 0.5 * other[y])
                    near1 += one[y] * flares.origin_m[j, y]
                    far1 += one[y] * flares.place_m[i, y]
                length1, length2 = math.sqrt(length1), math.sqrt(length2)
                c1, c2 = c1 / length1, c2 / length2
                aligned = dot / (length1 * length2) > PARALLEL_COSINE
                agree = abs(c1 - c2) < 0.05 + 0.05 * c1
                before = c1 - near1 / length1 > NEAREST_MIRROR_M and far1 / length1 < c1
                if aligned and agree and before and count < most:
                    for y in range(3):
                        found[count, y] = one[y] / length1
                    found[count, 3] = c1
                    found[count, 4] = -math.log(min(s, 1.0))
                    count += 1
    return found[:count]


@compiled
def _roots(seems_m: Array, apart_m: Array, b: int, roots: Array) -> None:
    """Write both s at which the normals of a pair and of all before it are parallel, NaN where there is none.

    Of the three components of their cross product the one counts whose middle term is the largest.
    """
    c_x, c_y, c_z = seems_m[0, b], seems_m[1, b], seems_m[2, b]
    d_x, d_y, d_z = apart_m[0, b], apart_m[1, b], apart_m[2, b]
    for a in range(b):
        a_x, a_y, a_z = seems_m[0, a], seems_m[1, a], seems_m[2, a]
        b_x, b_y, b_z = apart_m[0, a], apart_m[1, a], apart_m[2, a]
        middle = a_y * d_z - a_z * d_y + b_y * c_z - b_z * c_y
        bend, last = a_y * c_z - a_z * c_y, b_y * d_z - b_z * d_y
        middle_y = a_z * d_x - a_x * d_z + b_z * c_x - b_x * c_z
        bend_y, last_y = a_z * c_x - a_x * c_z, b_z * d_x - b_x * d_z
        middle_z = a_x * d_y - a_y * d_x + b_x * c_y - b_y * c_x
        bend_z, last_z = a_x * c_y - a_y * c_x, b_x * d_y - b_y * d_x
        larger = abs(middle_y) > abs(middle)
        middle = middle_y if larger else middle
        bend = bend_y if larger else bend
        last = last_y if larger else last
        larger = abs(middle_z) > abs(middle)
        middle = middle_z if larger else middle
        bend = bend_z if larger else bend
        last = last_z if larger else last
        # The root of less than 0 is NaN, and so is 0 over 0: neither is between any bounds.
        root = np.sqrt(middle**2 - 4.0 * bend * last)
        roots[0, a] = (-middle - root) / (2.0 * bend)
        roots[1, a] = (-middle + root) / (2.0 * bend)


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
def best_seeds(
    flares: Flares, parents: Indices, images: Indices, seeds: Array, kind: int, most: int
) -> tuple[Array, Indices]:
    """Return the planes that explain most images, shape (most, 5) or less, and how many each does."""
    # A seed has the noise of one or two pairs, and that of a dielectric a guessed index, so gates are wide.
    gate_chi2 = SEED_GATE_CHI2 if kind == CONSTANT else 0.0
    pairs, count, misfit = match_all(flares, parents, images, seeds, kind, gate_chi2)
    chosen = _chosen(seeds, pairs, count, misfit, most)
    return seeds[chosen], count[chosen]


@compiled
def _chosen(seeds: Array, pairs: Indices, count: Indices, misfit: Array, most: int) -> Indices:
    """Return which planes to try, the best first."""
    mark = np.zeros(len(seeds), dtype=np.int64)  # of which pairs, in whatever order
    for seed in range(len(seeds)):
        for k in range(count[seed]):
            mark[seed] += (pairs[seed, 0, k] + 1) * (pairs[seed, 1, k] + 31) ** 4
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
    return chosen[:ranks]
