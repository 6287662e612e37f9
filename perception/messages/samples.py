"""What each sample of a signal says: its log-likelihood at a level, robustly; what it says of an edge."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.messages.settings import DecoderSettings

Array = NDArray[np.float64]

ENDED, BEGUN, DARK, RISE, FALL, GARBAGE, FOREIGN, SEEN = range(8)
ROWS = 8
# Where an edge may lie about its step, in steps, and how probably: the lattice rounds start, rate and edge.
_JITTER = np.array([-0.9, -0.35, 0.0, 0.35, 0.9])
_JITTER_SHARE = np.array([0.1, 0.25, 0.3, 0.25, 0.1])
_GARBAGE = np.array([0.0, 0.25, 0.5, 0.75, 1.0])  # levels of what is no packet; any other beside them,
_GARBAGE_SHARE = np.array([0.35, 0.05, 0.05, 0.05, 0.35, 0.15])  # and how often it turns to each,
_GARBAGE_STAYS_S = 0.1  # after so long

_OUTLIERS = 1e-3  # share of samples that follow no model (a merger unnoticed, a glint)
_OUTLIER_SPAN = 3.0  # the levels over which they spread evenly


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples that carry something: mid-exposure, exposure, level, variances, shape (n,) each."""

    time_s: Array
    exposure_s: Array
    level: Array
    dark_variance: Array
    lit_variance: Array

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.time_s)


def usable(
    exposure_s: Array, level: Array, sigma_dark: Array, sigma_lit: Array, settings: DecoderSettings
) -> NDArray[np.bool_]:
    """Return which samples are no erasures; what is exposed for longer than half a bit tells no bit."""
    finite = np.isfinite(level) & np.isfinite(sigma_dark) & np.isfinite(sigma_lit)
    return np.asarray(finite & (exposure_s <= 0.5 / settings.rate_hz))


def usable_samples(
    time_s: Array,
    exposure_s: Array,
    level: Array,
    sigma_dark: Array,
    sigma_lit: Array,
    settings: DecoderSettings,
) -> Samples:
    """Return the samples without erasures, the floors added to their variances."""
    keep = usable(exposure_s, level, sigma_dark, sigma_lit, settings)
    dark = sigma_dark[keep] ** 2 + settings.dark_floor**2
    lit = sigma_lit[keep] ** 2 + settings.lit_floor**2
    return Samples(time_s[keep], np.maximum(exposure_s[keep], 1e-9), level[keep], dark, lit)


def log_likelihood(samples: Samples, level: Array) -> Array:
    """Return the log-likelihood of samples at levels, shape (..., n); variances grow with the light."""
    one = samples
    shape = (*level.shape[:-1], len(one))
    flat = np.ascontiguousarray(np.broadcast_to(level, shape).reshape(-1, len(one)), dtype=np.float64)
    return _log_likelihood(one.level, one.dark_variance, one.lit_variance, flat).reshape(shape)


class AnyLevels:
    """What light may do that is no packet: it turns from one level to any other at any time.

    A Markov chain of levels; each sample is scored by what those before it led to expect. So what blinks at
    a rate that is not known, or in no rhythm, is explained at the price of its edges.
    """

    def __init__(self) -> None:
        self.weights = _GARBAGE_SHARE.copy()
        self._last_s = -np.inf

    def stays(self, time_s: Array) -> Array:
        """Return how probably the level stayed since the sample before, shape (n,); times go on."""
        since_s = time_s - np.concatenate([[self._last_s], time_s[:-1]])
        self._last_s = float(time_s[-1])
        return np.asarray(np.exp(-since_s / _GARBAGE_STAYS_S))


def add_samples(
    table: Array,
    samples: Samples,
    amplitude: float,
    others: Array,
    origin_s: float,
    step_s: float,
    any_levels: AnyLevels | None = None,
) -> None:
    """Add samples to a table of shape (8, steps), whose step 0 is at `origin_s`.

    A source has the level `amplitude` where it is lit; on it lies the light of others, each row of `others`,
    shape (m, n), with the same probability. The table's rows hold, for an edge at each step: the scores for
    dark of the samples that end before it and after the step before; of those that begin; and of the samples
    that it may cut, their scores with dark on both sides, dark before and lit after, lit before and dark
    after; the score for what is no packet, which `any_levels` has followed up to here; for being any level at
    all, as another's light makes it; and how many.
    """
    one = samples
    chain = AnyLevels() if any_levels is None else any_levels
    stays = chain.stays(one.time_s)
    middle = (one.time_s - origin_s) / step_s
    half = 0.5 * one.exposure_s / step_s
    _add(
        table, one.level, one.dark_variance, one.lit_variance, middle, half, amplitude, others,
        chain.weights, stays,
    )  # fmt: skip


@compiled
def _density(level: float, dark: float, lit: float, at: float) -> float:
    """Return the density of a sample at a level; a few samples follow no model."""
    variance = max(dark + max(at, 0.0) * (lit - dark), min(dark, lit))
    off = level - at
    density = math.exp(-0.5 * off * off / variance) / math.sqrt(2.0 * math.pi * variance)
    return (1.0 - _OUTLIERS) * density + _OUTLIERS / _OUTLIER_SPAN


@compiled
def _log_likelihood(level: Array, dark: Array, lit: Array, at: Array) -> Array:
    found = np.empty_like(at)
    for row in range(at.shape[0]):
        for n in range(at.shape[1]):
            found[row, n] = math.log(_density(level[n], dark[n], lit[n], at[row, n]))
    return found


@compiled
def _mean_density(
    level: float, dark: float, lit: float, amplitude: float, others: Array, n: int, share: float
) -> float:
    """Return a sample's density where the source is lit for a share of it, over what others may add."""
    total = 0.0
    for way in range(others.shape[0]):
        total += _density(level, dark, lit, amplitude * share + others[way, n])
    return float(total / others.shape[0])


@compiled
def _add(
    table: Array, level: Array, dark: Array, lit: Array, middle: Array, half: Array, amplitude: float,
    others: Array, weights: Array, stays: Array,
) -> None:  # fmt: skip
    steps = table.shape[1]
    for n in range(level.shape[0]):
        of_lit = _mean_density(level[n], dark[n], lit[n], amplitude, others, n, 1.0)
        of_dark = _mean_density(level[n], dark[n], lit[n], amplitude, others, n, 0.0)
        anything = 0.0
        for k in range(weights.shape[0]):
            density = 1.0 / _OUTLIER_SPAN
            if k < _GARBAGE.shape[0]:
                density = _mean_density(level[n], dark[n], lit[n], amplitude, others, n, _GARBAGE[k])
            weights[k] = (stays[n] * weights[k] + (1.0 - stays[n]) * _GARBAGE_SHARE[k]) * density
            anything += weights[k]
        for k in range(weights.shape[0]):
            weights[k] /= anything
        score = math.log(of_dark / of_lit)
        begun = math.floor(middle[n] - half[n] - 1.0) + 1  # the first edge that may cut it
        ended = math.ceil(middle[n] + half[n] + 1.0)  # the first one after it
        if begun < 0 or ended >= steps:
            continue
        table[ENDED, ended] += score
        table[BEGUN, begun] += score
        table[GARBAGE, ended] += math.log(anything / of_lit)
        table[FOREIGN, ended] -= math.log(of_lit * _OUTLIER_SPAN)
        table[SEEN, int(middle[n])] += 1.0
        for edge in range(begun, ended):
            fall = rise = 0.0
            for k in range(_JITTER.shape[0]):
                before = (_JITTER[k] + edge - middle[n] + half[n]) / (2.0 * half[n])
                if before <= 0.0:
                    fall += _JITTER_SHARE[k] * of_dark
                    rise += _JITTER_SHARE[k] * of_lit
                elif before >= 1.0:
                    fall += _JITTER_SHARE[k] * of_lit
                    rise += _JITTER_SHARE[k] * of_dark
                else:
                    fall += _JITTER_SHARE[k] * _mean_density(
                        level[n], dark[n], lit[n], amplitude, others, n, before
                    )
                    rise += _JITTER_SHARE[k] * _mean_density(
                        level[n], dark[n], lit[n], amplitude, others, n, 1.0 - before
                    )
            table[DARK, edge] += score
            table[RISE, edge] += math.log(rise / of_lit)
            table[FALL, edge] += math.log(fall / of_lit)


class LevelScale:
    """The factor on a signal's levels, learnt from the samples that are probably lit.

    What is old counts less: the factor may change slowly.
    """

    _KEEP = 0.97  # of the weight, for each block of five bits: 17 seconds

    def __init__(self, sigma: float) -> None:
        self._prior = 1.0 / max(sigma, 1e-6) ** 2
        self._weight = self._sum = 0.0

    @property
    def value(self) -> float:
        """The factor by all that was seen so far."""
        return (self._sum + self._prior) / (self._weight + self._prior)

    def learn(self, samples: Samples) -> float:
        """Add samples (an EM step of the mixture of dark and lit), and return the factor."""
        one = samples
        weight, moment = _weight_of_lit(one.level, one.dark_variance, one.lit_variance, self.value)
        self._weight = self._KEEP * self._weight + weight
        self._sum = self._KEEP * self._sum + moment
        return self.value


@compiled
def _weight_of_lit(level: Array, dark: Array, lit: Array, value: float) -> tuple[float, float]:
    """Return the weight of the samples that are probably lit and not far off, and their weighted sum."""
    total = moment = 0.0
    for n in range(level.shape[0]):
        if (level[n] - value) ** 2 < 9.0 * lit[n] + 0.25:
            of_lit = _density(level[n], dark[n], lit[n], value)
            of_dark = _density(level[n], dark[n], lit[n], 0.0)
            weight = of_lit / (of_lit + of_dark) / lit[n]
            total += weight
            moment += weight * level[n]
    return total, moment
