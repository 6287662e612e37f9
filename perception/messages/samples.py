"""What each sample of a signal says: its log-likelihood at a level between dark and lit, robustly."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.messages.settings import DecoderSettings

Array = NDArray[np.float64]
LevelLikelihood = Callable[[Array], Array]
"""Log-likelihood of the samples, shape (n,), where their source is lit for a share of the exposure, shape
(..., n)."""

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


def usable_samples(
    time_s: Array,
    exposure_s: Array,
    level: Array,
    sigma_dark: Array,
    sigma_lit: Array,
    settings: DecoderSettings,
) -> Samples:
    """Return the samples without erasures, the floors added to their variances.

    An exposure longer than half a bit tells no bit from the next and is an erasure too.
    """
    keep = np.isfinite(level) & np.isfinite(sigma_dark) & np.isfinite(sigma_lit)
    keep &= exposure_s <= 0.5 / settings.rate_hz
    dark = sigma_dark[keep] ** 2 + settings.dark_floor**2
    lit = sigma_lit[keep] ** 2 + settings.lit_floor**2
    return Samples(time_s[keep], np.maximum(exposure_s[keep], 1e-9), level[keep], dark, lit)


def likelihood_of_levels(samples: Samples, scale: float) -> LevelLikelihood:
    """Return the log-likelihood where a lit source has the level `scale`; variances grow with the light."""

    def log_likelihood(share: Array) -> Array:
        variance = samples.dark_variance + share * (samples.lit_variance - samples.dark_variance)
        return log_density(samples.level - scale * share, variance)

    return log_likelihood


def log_density(off: Array, variance: Array) -> Array:
    """Return the log-density of errors, a few of which follow no model."""
    density = np.exp(-0.5 * off * off / variance) / np.sqrt(2.0 * np.pi * variance)
    return np.asarray(np.log((1.0 - _OUTLIERS) * density + _OUTLIERS / _OUTLIER_SPAN))


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
        score = likelihood_of_levels(samples, self.value)
        lit = 1.0 / (1.0 + np.exp(score(np.zeros(1)) - score(np.ones(1))))
        weight = lit / samples.lit_variance
        near = np.abs(samples.level - self.value) ** 2 < 9.0 * samples.lit_variance + 0.25
        self._weight = self._KEEP * self._weight + float(weight[near].sum())
        self._sum = self._KEEP * self._sum + float((weight * samples.level)[near].sum())
        return self.value
