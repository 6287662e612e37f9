"""Where a mirror may be, by two pairs that are reflected alike: a compiled loop of the search for mirrors."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.rig.mirrors.flares import Flares
from perception.rig.mirrors.model import NEAREST_MIRROR_M

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

LEAST_ROOT, MOST_ROOT = 0.1, 1.03
"""√R of a mirror worth looking for, and a margin for noise."""

PARALLEL_RAD = 0.08


@compiled
def seeds_of_constant(flares: Flares, parents: Indices, images: Indices, stride: int, most: int) -> Array:
    """Return planes that two pairs agree on, if they are reflected alike, shape (seeds, 5).

    The image of a pair stands at o + s R h, s = √R for both; each is mirrored about the plane halfway, and
    the two planes are one: their normals are parallel, which is quadratic in s, and their distances equal.
    """
    found = np.empty((most, 5))
    count = 0
    one, other, bend = np.empty(3), np.empty(3), np.empty((3, 3))
    total = len(parents)
    seems_m, apart_m = np.empty((total, 3)), np.empty((total, 3))
    for a in range(total):
        i, j = parents[a], images[a]
        for x in range(3):
            seems_m[a, x] = flares.seems_m[j] * flares.axes[j, 2, x]
            apart_m[a, x] = flares.origin_m[j, x] - flares.place_m[i, x]
    for number in range(0, total * (total - 1) // 2, stride):
        # The numbered pair of pairs, a < b.
        b = int((1.0 + math.sqrt(1.0 + 8.0 * number)) / 2.0)
        if b * (b - 1) // 2 > number:
            b -= 1
        a = number - b * (b - 1) // 2
        i, j, k, m = parents[a], images[a], parents[b], images[b]
        if i in (k, m) or j in (k, m):
            continue
        for x in range(3):
            y, z = (x + 1) % 3, (x + 2) % 3
            a_y, a_z, b_y, b_z = seems_m[a, y], seems_m[a, z], apart_m[a, y], apart_m[a, z]
            c_y, c_z, d_y, d_z = seems_m[b, y], seems_m[b, z], apart_m[b, y], apart_m[b, z]
            bend[2, x] = a_y * c_z - a_z * c_y
            bend[1, x] = a_y * d_z - a_z * d_y + b_y * c_z - b_z * c_y
            bend[0, x] = b_y * d_z - b_z * d_y
        x = 0
        for y in range(1, 3):
            if abs(bend[1, y]) > abs(bend[1, x]):
                x = y
        root2 = bend[1, x] ** 2 - 4.0 * bend[2, x] * bend[0, x]
        if root2 < 0.0 or bend[2, x] == 0.0:
            continue
        for sign in (-1.0, 1.0):
            s = (-bend[1, x] + sign * math.sqrt(root2)) / (2.0 * bend[2, x])
            if not LEAST_ROOT < s < MOST_ROOT:
                continue
            length1, length2, dot, c1, c2, near1, far1 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for y in range(3):
                seen1 = s * flares.seems_m[j] * flares.axes[j, 2, y]
                seen2 = s * flares.seems_m[m] * flares.axes[m, 2, y]
                one[y] = seen1 + flares.origin_m[j, y] - flares.place_m[i, y]
                other[y] = seen2 + flares.origin_m[m, y] - flares.place_m[k, y]
                length1 += one[y] ** 2
                length2 += other[y] ** 2
                dot += one[y] * other[y]
                c1 += one[y] * (flares.place_m[i, y] + 0.5 * one[y])
                c2 += other[y] * (flares.place_m[k, y] + 0.5 * other[y])
                near1 += one[y] * flares.origin_m[j, y]
                far1 += one[y] * flares.place_m[i, y]
            length1, length2 = math.sqrt(length1), math.sqrt(length2)
            c1, c2 = c1 / length1, c2 / length2
            aligned = dot / (length1 * length2) > 1.0 - 0.5 * PARALLEL_RAD**2
            agree = abs(c1 - c2) < 0.05 + 0.05 * c1
            before = c1 - near1 / length1 > NEAREST_MIRROR_M and far1 / length1 < c1
            if aligned and agree and before and count < most:
                for y in range(3):
                    found[count, y] = one[y] / length1
                found[count, 3] = c1
                found[count, 4] = -math.log(min(s, 1.0))
                count += 1
    return found[:count]
