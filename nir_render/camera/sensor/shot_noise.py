"""Random variates for millions of pixels at once: normal and Poisson, from 32-bit random words.

Normal variates are Box and Muller's. Poisson variates are quantiles: where the mean is large, of a normal
variate by the asymptotic expansion of the Poisson quantile; where it is small, of a uniform one by adding up
probabilities.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Words = NDArray[np.uint32]

# From this mean on the expansion holds: it shifts 1.1e-5 of the probability, and less beyond.
EXPANSION_MEAN = 16.0
_FEW = 0.25
_SOME = 0.2
_RARE = 1.0 - 2.0**-12


def normal(words: Words) -> Floats:
    """Return standard normal variates, float32, from an even number of random words, one each.

    Box and Muller 1958. The largest is 6.7.
    """
    half = len(words) // 2
    radius, angle = _radius(words[:half]), _angle(words[half:])
    drawn = np.empty(2 * half, dtype=np.float32)
    np.cos(angle, out=drawn[:half])
    np.sin(angle, out=drawn[half:])
    drawn[:half] *= radius
    drawn[half:] *= radius
    return drawn


def some_normal(words: Words, places: NDArray[np.int64]) -> Floats:
    """Return the variates of `normal` at some places, which increase, to the bit."""
    half = len(words) // 2
    first = int(np.searchsorted(places, half))
    of_pair = places.copy()
    of_pair[first:] -= half
    radius, angle = _radius(words[of_pair]), _angle(words[half + of_pair])
    drawn = np.empty(len(places), dtype=np.float32)
    np.cos(angle[:first], out=drawn[:first])
    np.sin(angle[first:], out=drawn[first:])
    drawn *= radius
    return drawn


def _radius(words: Words) -> Floats:
    # Words count from 1, so that the logarithm is finite; its float32 keeps the tail's digits.
    radius = words.astype(np.float32)
    radius += np.float32(0.5)
    radius *= np.float32(2.0**-32)
    np.log(radius, out=radius)
    radius *= np.float32(-2.0)
    np.maximum(radius, np.float32(0.0), out=radius)
    return np.sqrt(radius, out=radius)


def _angle(words: Words) -> Floats:
    angle = words.astype(np.float32)
    angle *= np.float32(2.0 * np.pi * 2.0**-32)
    return angle


def large_poisson(mean: Floats, z: Floats) -> Floats:
    """Return Poisson variates of means of at least `EXPANSION_MEAN`, whole numbers in float32.

    The variate is the whole part of x, the quantile of the incomplete gamma function at Φ(z). Its expansion
    in powers of the mean is that of Giles, ACM Trans. Math. Softw. 42 (2016), eq. 13, with one more term.
    """
    inverse: Floats = np.divide(1.0, np.sqrt(mean), dtype=np.float32)
    squared = z * z
    # Horner in 1/√mean; each coefficient is a polynomial in z.
    x = (np.float32(-207.0 / 155520.0) * squared - np.float32(548.0 / 155520.0)) * squared
    x += np.float32(2684.0 / 155520.0)
    x *= z
    x *= inverse
    x += (squared * np.float32(1.0 / 270.0) + np.float32(7.0 / 810.0)) * squared - np.float32(8.0 / 405.0)
    x *= inverse
    x -= (squared * np.float32(1.0 / 72.0) + np.float32(1.0 / 36.0)) * z
    x *= inverse
    x += squared * np.float32(1.0 / 6.0) + np.float32(1.0 / 3.0)
    x += mean * inverse * z
    x += mean
    np.floor(x, out=x)
    return np.maximum(x, np.float32(0.0), out=x)


def small_poisson(mean: Floats, words: Words) -> Floats:
    """Return Poisson variates of means below `EXPANSION_MEAN`, by adding up probabilities from 0 on.

    In float32, which misplaces 1e-6 of the probability; the uppermost 2⁻¹² of the words, where that would
    show, in float64. Nothing rarer than 2⁻³³ happens.
    """
    uniform = words.astype(np.float32)
    uniform *= np.float32(2.0**-32)
    rare = np.flatnonzero(words >= np.uint32(_RARE * 2.0**32))
    drawn = _counted(mean, np.minimum(uniform, np.float32(_RARE), out=uniform))
    drawn[rare] = _counted(mean[rare].astype(np.float64), (words[rare] + 0.5) * 2.0**-32)
    return drawn.astype(np.float32)


def _counted(rate: NDArray[Any], uniform: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the smallest counts whose cumulated probability reaches the uniform variates, shape (n,)."""
    probability = np.exp(-rate)
    total = probability.copy()
    drawn = np.zeros(rate.shape, dtype=np.uint8)
    left: NDArray[np.int64] | None = None  # of the few that are not done; all until then
    count = 0
    while True:
        above = uniform > total
        remaining = int(np.count_nonzero(above))
        if remaining == 0:
            return drawn
        if left is not None or remaining < _FEW * len(uniform):
            keep = np.flatnonzero(above)
            left = keep if left is None else left[keep]
            uniform, rate, probability, total = uniform[keep], rate[keep], probability[keep], total[keep]
        count += 1
        if left is None:
            drawn += above.view(np.uint8)
        else:
            drawn[left] = count
        probability *= rate
        probability *= rate.dtype.type(1.0 / count)
        total += probability


def poisson(mean: Floats, large: Words, small: Words | None) -> Floats:
    """Return Poisson variates, float32, shape (n,).

    Parameters
    ----------
    mean
        Not negative, shape (n,).
    large, small
        Random words, shape (n + n % 2,) and (n,); `small` may be None where no mean is below
        `EXPANSION_MEAN`.
    """
    if small is None:
        return large_poisson(mean, normal(large)[: len(mean)])
    low = mean < EXPANSION_MEAN
    if low.all():
        return small_poisson(mean, small)
    high = np.flatnonzero(~low)
    if len(high) < _SOME * len(mean):  # a frame's flares: the others need no normal variates
        drawn = np.empty(len(mean), dtype=np.float32)
        drawn[low] = small_poisson(mean[low], small[low])
        drawn[high] = large_poisson(mean[high], some_normal(large, high))
        return drawn
    drawn = large_poisson(np.maximum(mean, np.float32(EXPANSION_MEAN)), normal(large)[: len(mean)])
    drawn[low] = small_poisson(mean[low], small[low])
    return drawn
