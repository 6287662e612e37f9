"""Random variates for millions of pixels at once: normal and Poisson, from 32-bit random words.

Normal variates are Box and Muller's. Poisson variates are quantiles: where the mean is large, of a normal
variate by the asymptotic expansion of the Poisson quantile; where it is small, of a uniform one by adding up
probabilities.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled

Floats = NDArray[np.float32]
Words = NDArray[np.uint32]

# From this mean on the expansion holds: it shifts 1.1e-5 of the probability, and less beyond.
EXPANSION_MEAN = 16.0
_SOME = 0.2
_TOGETHER = 64  # pixels that are counted side by side, as vectors
_RARE = 1.0 - 2.0**-12
# Short of 1 by far more than float32 rounds off a uniform variate or an exponential function.
_SURE = np.float32(1.0 - 2.0**-20)
_UNIT = np.float32(2.0**-32)


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
    drawn = np.zeros(len(mean), dtype=np.float32)
    unsure = _not_surely_dark(mean, words)
    rate, word = mean[unsure], words[unsure]
    uniform = np.minimum(word.astype(np.float32) * _UNIT, np.float32(_RARE))
    drawn[unsure] = _counted(rate, np.exp(-rate), uniform, np.float32(1.0))
    rare = unsure[word >= np.uint32(_RARE * 2.0**32)]
    rate_of_rare = mean[rare].astype(np.float64)
    drawn[rare] = _counted(
        rate_of_rare, np.exp(-rate_of_rare), (words[rare] + 0.5) * 2.0**-32, np.float64(1.0)
    )
    return drawn


@compiled
def _not_surely_dark(mean: Floats, words: Words) -> NDArray[np.int64]:
    """Return the places whose uniform variate is not below 1 − λ, which is below the chance e^−λ of none."""
    places = np.empty(len(mean), dtype=np.int64)
    found = 0
    for place in range(len(mean)):
        places[found] = place
        found += not np.float32(words[place]) * _UNIT < _SURE - mean[place]
    return places[:found]


@compiled
def _counted(
    rate: NDArray[Any], none: NDArray[Any], uniform: NDArray[Any], one: np.floating[Any]
) -> NDArray[Any]:
    """Return the smallest counts whose cumulated probability reaches the uniform variates, shape (n,).

    `none` is the probability of 0; all are of the type of `one`, and so is what is reckoned with.
    """
    drawn = np.empty_like(rate)
    probability, total = np.empty(_TOGETHER, dtype=rate.dtype), np.empty(_TOGETHER, dtype=rate.dtype)
    counts = np.empty(_TOGETHER, dtype=np.int32)
    for first in range(0, len(rate), _TOGETHER):
        rates, uniforms = rate[first : first + _TOGETHER], uniform[first : first + _TOGETHER]
        size = len(rates)
        for place in range(size):
            probability[place] = total[place] = none[first + place]
            counts[place] = 0
        count, left = one, np.int32(1)
        while left > 0:
            inverse, left = one / count, np.int32(0)
            for place in range(size):
                more = np.int32(uniforms[place] > total[place])
                left += more
                counts[place] += more
                probability[place] = probability[place] * rates[place] * inverse
                total[place] += probability[place]
            count += one
        for place in range(size):
            drawn[first + place] = counts[place]
    return drawn


def poisson(mean: Floats, large: Words | None, small: Words | None) -> Floats:
    """Return Poisson variates, float32, shape (n,).

    Parameters
    ----------
    mean
        Not negative, shape (n,).
    large, small
        Random words, shape (n + n % 2,) and (n,): `large` may be None where all means are below
        `EXPANSION_MEAN`, `small` where none is.
    """
    if small is None:
        assert large is not None
        return large_poisson(mean, normal(large)[: len(mean)])
    if large is None:
        return small_poisson(mean, small)
    low = mean < EXPANSION_MEAN
    high = np.flatnonzero(~low)
    if len(high) < _SOME * len(mean):  # a frame's flares: the others need no normal variates
        drawn = np.empty(len(mean), dtype=np.float32)
        drawn[low] = small_poisson(mean[low], small[low])
        drawn[high] = large_poisson(mean[high], some_normal(large, high))
        return drawn
    drawn = large_poisson(np.maximum(mean, np.float32(EXPANSION_MEAN)), normal(large)[: len(mean)])
    drawn[low] = small_poisson(mean[low], small[low])
    return drawn
