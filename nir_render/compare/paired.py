"""The statistics of paired differences: a figure of two sides that saw the same frames, and how sure it is.

Every figure is Σ value / Σ count over frames, or its square root. Frames are what is drawn again: sources of
one frame share its exposure, its noise and its background.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from nir_render.randomness import generator

Values = NDArray[np.float64]

LEVEL = 0.95
LEAST_FRAMES = 6
"""Of fewer frames even one that wins in every frame may do so by chance: 2 · 0.5⁵ is more than 0.05."""

REPETITIONS = 2000
_BLOCK_NUMBERS = 4_000_000  # bounds the memory
_SEED = 0
_ROUNDING = 1e-12
_TO_POWER = (1.959964 + 0.841621) / 1.959964
"""From what an interval reaches to what it sees in 4 of 5 runs: quantiles of 97.5 % and 80 %."""


@dataclass(frozen=True, eq=False)
class Sums:
    """A figure of both sides in each frame, shape (frames,): it is Σ value / Σ count, or the root of that.

    `count` is the same for both: what both were asked. `root` tells whether the root is taken.
    """

    first: Values
    second: Values
    count: Values
    root: bool = False

    def asked(self) -> "Sums":
        """Return the frames that have something to say."""
        chosen = self.count > 0.0
        return Sums(self.first[chosen], self.second[chosen], self.count[chosen], self.root)

    def values(self) -> tuple[float, float]:
        """Return the figure of both sides; NaN where nothing was asked."""
        if not self.count.sum() > 0.0:
            return np.nan, np.nan
        first, second = (float(side.sum()) / float(self.count.sum()) for side in (self.first, self.second))
        return (first**0.5, second**0.5) if self.root else (first, second)


@dataclass(frozen=True)
class Interval:
    """Where a difference, second − first, lies with a probability of 95 %."""

    low: float
    high: float

    @property
    def least_seen(self) -> float:
        """The smallest difference that would be told from none in 4 of 5 such comparisons."""
        return 0.5 * (self.high - self.low) * _TO_POWER

    @property
    def side(self) -> int:
        """1 where all of it lies above zero, −1 where all lies below, else 0."""
        return int(self.low > 0.0) - int(self.high < 0.0)


def interval_of_means(sums: Sums, repetitions: int = REPETITIONS) -> Interval | None:
    """Return the interval of the difference of means, or of their roots, by the paired bootstrap over frames.

    Each repetition's deviation is divided by its own linearised standard error, and the quantile of its size
    multiplies that of the data: the symmetric bootstrap-t (Hall 1988, On Symmetric Bootstrap Confidence
    Intervals, JRSS B 50), which keeps its level also of few frames and of large rare errors. Where so few
    frames differ that repetitions are without any, Student's t stands in.

    Returns
    -------
    None of fewer than `LEAST_FRAMES` frames; of zero width where both sides agree in every frame.
    """
    sums = sums.asked()
    if sums.count.size < LEAST_FRAMES:
        return None
    if np.array_equal(sums.first, sums.second):
        return Interval(0.0, 0.0)
    first, second = sums.values()
    difference = second - first
    error = float(_difference_and_error(sums, np.ones((1, sums.count.size)))[1][0])
    if error <= _ROUNDING * max(abs(first), abs(second)):  # the same difference in every frame
        return Interval(difference, difference)
    deviation = np.concatenate([
        _studentised(*_difference_and_error(sums, weight), difference)
        for weight in _draws(sums.count.size, sums.count.size, repetitions)
    ])  # fmt: skip
    # The next larger of the repetitions: an interval is rather too wide.
    quantile = float(np.quantile(deviation, LEVEL, method="higher"))
    if not np.isfinite(quantile):
        quantile = float(stdtrit(sums.count.size - 1, 0.5 * (1.0 + LEVEL)))
    reach = error * quantile
    return Interval(difference - reach, difference + reach)


def interval_of_counts(sums: Sums, repetitions: int = REPETITIONS) -> Interval | None:
    """Return the interval of a difference of counted things, by the paired bootstrap over frames.

    What never happened in these frames may yet happen: two frames are added, in which one thing speaks for
    either side (Bonett and Price 2012, Adjusted Wald Confidence Interval for a Difference of Binomial
    Proportions Based on Paired Data, J. Educ. Behav. Stat. 37). Of n frames n − 1 are drawn and weighted to n
    (Rao and Wu 1988), and the quantiles of the repetitions are taken.

    Returns
    -------
    None of fewer than `LEAST_FRAMES` frames.
    """
    sums = sums.asked()
    frames = sums.count.size
    if frames < LEAST_FRAMES:
        return None
    gained = np.append(sums.second - sums.first, [1.0, -1.0])
    count = np.append(sums.count, np.full(2, sums.count.mean()))
    repeated = np.concatenate([
        _sum(weight, gained) / _sum(weight, count) for weight in _draws(frames + 2, frames + 1, repetitions)
    ])  # fmt: skip
    low, high = np.quantile(repeated, [0.5 * (1.0 - LEVEL), 0.5 * (1.0 + LEVEL)])
    first, second = sums.values()
    difference = second - first
    return Interval(min(float(low), difference), max(float(high), difference))


def exact_probability(gained: Values) -> float:
    """Return how likely chance alone makes a difference of counts as large, if both sides are alike.

    Then who of both gets which result of a frame is a toss: all 2ⁿ tosses are counted (Fisher's randomisation
    test). With one source a frame it is McNemar's exact test.

    Parameters
    ----------
    gained
        Second − first in each frame, whole numbers, shape (frames,).

    Returns
    -------
    Two-sided probability; 1 where no frame differs.
    """
    steps = np.abs(np.rint(gained)).astype(np.int64)
    steps = steps[steps > 0]
    total = int(steps.sum())
    chance = np.zeros(2 * total + 1)  # of a sum from −total to total
    chance[total] = 1.0
    for step in steps:
        chance = 0.5 * (_shifted(chance, step) + _shifted(chance, -step))
    reached = abs(int(np.rint(gained).sum()))
    sums = np.abs(np.arange(-total, total + 1))
    return float(min(chance[sums >= reached].sum(), 1.0))


def _shifted(values: Values, step: int) -> Values:
    moved = np.zeros_like(values)
    if step > 0:
        moved[step:] = values[:-step]
    else:
        moved[:step] = values[-step:]
    return moved


def _draws(size: int, drawn: int, repetitions: int) -> Iterator[Values]:
    """Yield how often each of `size` frames is in each repetition, shape (some, size), in blocks.

    Keyed by the number of frames and the block: the same frames give the same interval.
    """
    rows = max(1, min(repetitions, _BLOCK_NUMBERS // size))
    for block, begin in enumerate(range(0, repetitions, rows)):
        random = generator(_SEED, f"compare/frames/{size}/{drawn}", "", block)
        count = random.multinomial(drawn, np.full(size, 1.0 / size), size=min(rows, repetitions - begin))
        yield np.asarray(count * (size / drawn), dtype=np.float64)


def _difference_and_error(sums: Sums, weight: Values) -> tuple[Values, Values]:
    """Return difference and linearised standard error of each repetition, shape (repetitions,) both.

    The ratio estimator's: a frame's influence is (b − Rb·n)/n̄ − (a − Ra·n)/n̄, over 2√R where roots are taken.
    """
    a, b, n = sums.first, sums.second, sums.count
    frames = n.size
    total_a, total_b, total = _sum(weight, a), _sum(weight, b), _sum(weight, n)
    ratio_a, ratio_b = total_a / total, total_b / total
    slope_a, slope_b = np.ones_like(ratio_a), np.ones_like(ratio_b)
    if sums.root:
        ratio_a, ratio_b = np.maximum(ratio_a, 0.0), np.maximum(ratio_b, 0.0)
        slope_a, slope_b = (
            np.divide(0.5, np.sqrt(ratio), out=np.zeros_like(ratio), where=ratio > 0.0)
            for ratio in (ratio_a, ratio_b)
        )
    shared = slope_a * ratio_a - slope_b * ratio_b
    square = (
        slope_b**2 * _sum(weight, b * b)
        + slope_a**2 * _sum(weight, a * a)
        + shared**2 * _sum(weight, n * n)
        - 2.0 * slope_a * slope_b * _sum(weight, a * b)
        + 2.0 * shared * (slope_b * _sum(weight, b * n) - slope_a * _sum(weight, a * n))
    )
    error = np.sqrt(np.maximum(square, 0.0) * frames / (frames - 1)) / total
    difference = np.sqrt(ratio_b) - np.sqrt(ratio_a) if sums.root else ratio_b - ratio_a
    return difference, error


def _studentised(difference: Values, error: Values, observed: float) -> Values:
    """Return how many of its own standard errors each repetition is off; infinite where it has none."""
    off = np.abs(difference - observed)
    return np.divide(off, error, out=np.where(off > 0.0, np.inf, 0.0), where=error > 0.0)


def _sum(weight: Values, values: Values) -> Values:
    # einsum, not BLAS: its sums do not depend on the number of threads.
    return np.asarray(np.einsum("rn,n->r", weight, values))
