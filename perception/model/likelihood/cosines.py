"""Sums over pixels with products of cosines, such as the background's structure is made of.

A product of a cosine along rows and one along columns takes row after row, then what the rows came to. And
of two such products the product is a sum of others: cos a cos b = ½ cos(a + b) + ½ cos(a - b). So all that a
fit's information holds of structure beside structure follows from the weights' own sums with few cosines,
a twentieth of the work of summing products over pixels.
"""

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.likelihood.products import four_dots

Array = NDArray[np.float64]


@compiled
def add_waves(cosines: Array, order: NDArray[np.int64], amplitudes: Array, into: Array) -> None:
    """Add Σ c φ to pixels, shape (rows, columns): of products of cosines (`layout.Structure`)."""
    side, most = into.shape[0], order.max() + 1
    along = np.zeros((most, side))
    for wave in range(len(order)):
        down, across = order[wave]
        for column in range(side):
            along[down, column] += amplitudes[wave] * cosines[across, column]
    for row in range(side):
        for down in range(most):
            share = cosines[down, row]
            for column in range(side):
                into[row, column] += share * along[down, column]


@compiled
def cosine_sums(image: Array, cosines: Array, most: int) -> Array:
    """Return Σ x(r, c) cos_j(r) cos_k(c) over an image, shape (side, side), for j and k below `most`.

    Four cosines at a time: up to three more k than asked for.
    """
    side, fours = len(image), (most + 3) // 4 * 4
    by_column, sums = np.zeros((most, side)), np.empty((most, fours))
    for down in range(most):
        into = by_column[down]
        for row in range(0, side - 3, 4):
            wave = cosines[down]
            a, b, c, d = wave[row], wave[row + 1], wave[row + 2], wave[row + 3]
            p, q, r, s = image[row], image[row + 1], image[row + 2], image[row + 3]
            for column in range(side):
                into[column] += (a * p[column] + b * q[column]) + (c * r[column] + d * s[column])
        for row in range(side - side % 4, side):
            a, p = cosines[down, row], image[row]
            for column in range(side):
                into[column] += a * p[column]
        for at in range(0, fours, 4):
            sums[down, at], sums[down, at + 1], sums[down, at + 2], sums[down, at + 3] = four_dots(
                into, cosines[at], cosines[at + 1], cosines[at + 2], cosines[at + 3]
            )
    return sums


@compiled
def add_wave_information(
    cosines: Array, order: NDArray[np.int64], jacobian: Array, weight: Array, first: int, into: Array
) -> None:  # fmt: skip
    """Add Φ W Φᵀ, and J W Φᵀ and its mirror image, to an information: all that waves φ have a part in.

    Parameters
    ----------
    cosines, order
        As `layout.Structure`.
    jacobian, weight
        Derivatives by all else, shape (unknowns - waves, pixels); and W, shape (pixels,).
    first
        Which unknown is the first amplitude of a wave; the derivatives by unknowns after the last stand right
        after those by unknowns before the first.
    into
        The information, shape (unknowns, unknowns).
    """
    side, waves, most = cosines.shape[1], len(order), order.max() + 1
    sums = cosine_sums(weight.reshape(side, side), cosines, 2 * most - 1)
    for one in range(waves):
        n, m = order[one]
        for other in range(one + 1):
            j, k = order[other]
            down, across = abs(n - j), abs(m - k)
            total = sums[n + j, m + k] + sums[n + j, across] + sums[down, m + k] + sums[down, across]
            into[first + one, first + other] += 0.25 * total
            if other < one:
                into[first + other, first + one] += 0.25 * total
    weighted = np.empty((side, side))
    flat = weighted.ravel()
    for row in range(len(jacobian)):
        for pixel in range(len(weight)):
            flat[pixel] = jacobian[row, pixel] * weight[pixel]
        sums = cosine_sums(weighted, cosines, most)
        unknown = row if row < first else row + waves
        for wave in range(waves):
            total = sums[order[wave, 0], order[wave, 1]]
            into[unknown, first + wave] += total
            into[first + wave, unknown] += total
