"""Where another's light fell in with a source's own, by its levels alone: no word is asked.

A hidden Markov model over the samples: the source alone, dark or lit, or with a light beside it of one of
several amplitudes, which is dark or lit too, for a second or two. What it finds is an erasure: what a decoder
reads from the rest does not depend on whose light that was.
"""

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.messages.samples import usable, usable_samples
from perception.messages.settings import DecoderSettings

Array = NDArray[np.float64]

_AMPLITUDES = np.arange(0.25, 2.6, 0.15)
_SPREAD = 0.05  # of those between two of these, and of one that fades
_BEGINS_PER_S = 0.02
_LASTS_S = 1.5
_LIT, _EDGE = 0.6, 0.02  # shares of samples that are lit, and that an edge of a bit cuts
_GLINT = 1e-4  # share of samples that follow no model
_GLINT_SPAN = 3.0
_SURE, _POSSIBLE = 0.99, 1e-3  # probability that another's light is there, and about it may be


def foreign_light(rows: Array, amplitude: float, settings: DecoderSettings) -> NDArray[np.bool_]:
    """Return which samples another's light may have touched, shape (n,), beside a source of an amplitude.

    The posterior of each, by the forward-backward recursion (Rabiner, 1989) over all of them: stretches where
    that is possible, in which it is sure somewhere.

    Parameters
    ----------
    rows
        Mid-exposures, exposures, levels, and their standard deviations dark and lit, shape (5, n).
    """
    time_s, exposure_s, level, dark, lit = rows
    touched = usable(exposure_s, level, dark, lit, settings)
    if not touched.any():
        return touched
    one = usable_samples(time_s, exposure_s, level, dark, lit, settings)
    emitted = _emitted(one.level, one.dark_variance, one.lit_variance, amplitude, _AMPLITUDES)
    probability = _posterior(one.time_s, emitted)
    if not (probability > _SURE).any():
        return np.zeros(len(touched), dtype=np.bool_)
    possible = probability > _POSSIBLE
    stretch = np.cumsum(np.diff(possible, prepend=False))  # odd where it is possible, and how many there were
    touched[touched] = possible & np.isin(stretch, stretch[probability > _SURE])
    return touched


@compiled
def _gauss(level: float, dark: float, lit: float, at: float, spread: float) -> float:
    variance = max(dark + at * (lit - dark), min(dark, lit)) + spread * spread
    return float(np.exp(-0.5 * (level - at) ** 2 / variance) / np.sqrt(2.0 * np.pi * variance))


@compiled
def _emitted(level: Array, dark: Array, lit: Array, amplitude: float, others: Array) -> Array:
    """Return the density of each sample with no other light, and with each amplitude of one."""
    found = np.empty((level.shape[0], 1 + others.shape[0]))
    for n in range(level.shape[0]):
        # Whatever lies between dark and lit may be an edge that the exposure cuts.
        alone = (1.0 - _LIT) * _gauss(level[n], dark[n], lit[n], 0.0, 0.0)
        alone += _LIT * _gauss(level[n], dark[n], lit[n], amplitude, 0.0)
        alone = (1.0 - _EDGE) * alone
        if 0.0 < level[n] < amplitude:
            alone += _EDGE / amplitude
        found[n, 0] = alone + _GLINT / _GLINT_SPAN
        for k in range(others.shape[0]):
            light = amplitude * others[k]
            beside = (1.0 - _LIT) * _gauss(level[n], dark[n], lit[n], light, _SPREAD)
            beside += _LIT * _gauss(level[n], dark[n], lit[n], amplitude + light, _SPREAD)
            found[n, 1 + k] = _LIT * beside + (1.0 - _LIT) * alone + _GLINT / _GLINT_SPAN
    return found


@compiled
def _posterior(time_s: Array, emitted: Array) -> Array:
    """Return the probability of each sample that another light was there."""
    count, states = emitted.shape
    forward, back = np.zeros((count, states)), np.ones(states)
    share = 1.0 / (states - 1)
    for n in range(count):
        if n == 0:
            forward[0, 0] = 1.0 - _BEGINS_PER_S * _LASTS_S
            forward[0, 1:] = _BEGINS_PER_S * _LASTS_S * share
        else:
            since = time_s[n] - time_s[n - 1]
            begins, ends = 1.0 - np.exp(-_BEGINS_PER_S * since), 1.0 - np.exp(-since / _LASTS_S)
            ended = ends * forward[n - 1, 1:].sum()
            forward[n, 1:] = (1.0 - ends) * forward[n - 1, 1:] + begins * share * forward[n - 1, 0]
            forward[n, 0] = (1.0 - begins) * forward[n - 1, 0] + ended
        forward[n] *= emitted[n]
        forward[n] /= forward[n].sum()
    found = np.empty(count)
    for n in range(count - 1, -1, -1):
        both = forward[n] * back
        found[n] = both[1:].sum() / both.sum()
        if n > 0:
            since = time_s[n] - time_s[n - 1]
            begins, ends = 1.0 - np.exp(-_BEGINS_PER_S * since), 1.0 - np.exp(-since / _LASTS_S)
            after = emitted[n] * back
            back[0] = (1.0 - begins) * after[0] + begins * share * after[1:].sum()
            back[1:] = (1.0 - ends) * after[1:] + ends * after[0]
            back /= back.max()
    return found
