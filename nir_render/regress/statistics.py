"""Whether two renders show the same: statistics on tiles, where a test per pixel sees nothing.

The test is that of docs/physics.md, Comparing renders.

Two means of the same image differ by noise alone if the differences of their tile means, in units of their
own standard errors, look like noise. Tiles add up what pixels cannot tell: 1 % of gain passes a test per
pixel every time, and a test on tiles never.

What paths bring is skewed: a few of them bring much. A tile's mean then strays upwards farther than a normal
variate does, and at the small p-values that many tiles ask for a normal tail would raise false alarms. So the
upper tail is that of a shifted gamma (Pearson III) of the skewness that the reference has measured.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]

TILE_PX = 8
"""Side of the smallest tile; the next are twice as wide, and the largest is the whole frame."""

POWER = 0.95
"""The chance with which a drift that a comparison "could have seen" is found."""

ROUNDING = 1e-4
"""Pixels that differ relatively by less are the same: sums of float32 and changed order of sums."""

_FEWEST_EVENTS = 100.0
_OTHER_PATHS = 0.1  # of the variance of independent renders: rounding leaves some 1e-6 of it
_FEWEST_UNLIKE = 20  # fewer that differ one way are chance too often, with as many tests as a suite has
_UNCANCELLED = 4.25
_TINY = 1e-300


@dataclass(frozen=True, eq=False)
class MonteCarloImage:
    """An image by Monte Carlo.

    Attributes
    ----------
    mean
        Mean of the samples of each pixel, shape (rows, columns).
    variance
        Variance of that mean, same shape.
    samples
        Samples per pixel.
    """

    mean: Array
    variance: Array
    samples: int


@dataclass(frozen=True, eq=False)
class PartTests:
    """The tests of one image by parts: tiles of 8 pixels, of 16, the frame.

    Attributes
    ----------
    parts
        Top, bottom, left, right of each part in pixels, the ends excluded, shape (n, 4).
    before, after
        Sums over the parts of the reference and of the render, shape (n,).
    error
        Standard error of the difference of these sums, shape (n,).
    skewness
        Of that difference, shape (n,).
    p
        Two-sided p-values, shape (n,); 1 where too little light was found to judge a part by itself.
    judged
        Where there was enough, shape (n,).
    tiles
        How many of the parts are tiles of 8 pixels; they are the first.
    """

    parts: NDArray[np.int64]
    before: Array
    after: Array
    error: Array
    skewness: Array
    p: Array
    judged: NDArray[np.bool_]
    tiles: int


@dataclass(frozen=True)
class Judgement:
    """What the tests of one image say, corrected for all tests of a family.

    Attributes
    ----------
    same
        Whether nothing speaks against both being the same.
    smallest_p
        The smallest p-value, corrected by Holm.
    part
        Top, bottom, left, right of the part that differs most: a tile, or the frame where no tile differs.
    change
        Relative change of the light there; infinite where there was none.
    frame_change
        The same of the whole frame.
    tile_drift, frame_drift
        The relative drifts of a tile (median over those that are judged) and of the frame that would have
        been found with a chance of 95 %, whatever the other tests say. Infinite where none would.
    judged_tiles, tiles
        How many tiles of 8 pixels are judged, and how many there are.
    """

    same: bool
    smallest_p: float
    part: tuple[int, int, int, int]
    change: float
    frame_change: float
    tile_drift: float
    frame_drift: float
    judged_tiles: int
    tiles: int


def compare_parts(
    reference: MonteCarloImage, render: MonteCarloImage, third: Array | None = None, *, alike: bool = True
) -> PartTests:
    """Test a render against a reference, part by part.

    The standard error is se² = v (1/n + 1/m), v the variance of one sample, pooled from both by their
    numbers of samples; so light that only one of both has found does not stand without an error. Float32 sums
    of n samples are right to n 2⁻²⁴ at worst, which is added. A part is judged by itself where its light is
    that of a hundred equal samples or more, in both together: fewer follow no smooth law. Its skewness is at
    least that of equal samples, σ/μ: for what is never negative none is less (Cauchy and Schwarz).

    Parameters
    ----------
    reference, render
        Of the same shape.
    third
        Third cumulant of one sample, summed over tiles as of `tile_sums` of 8 pixels; 0 without.
    alike
        Whether one sampler made both. If not, their variances are not pooled.
    """
    n, m = render.samples, reference.samples
    if alike:
        variance = (m**2 * reference.variance + n**2 * render.variance) / (n + m) * (1.0 / n + 1.0 / m)
    else:
        # What few samples say of their own variance falls with what they bring. So it is no less than the
        # reference's, by the ratio of both over the frame.
        ratio = render.variance.sum() / max(float(reference.variance.sum()), _TINY)
        variance = reference.variance + np.maximum(render.variance, ratio * reference.variance)
    rows, columns = reference.mean.shape
    fine = tile_sums(np.stack([reference.mean, render.mean, variance]), TILE_PX)
    cumulant = np.zeros(fine.shape[1:]) if third is None else third * (1.0 / n**2 - 1.0 / m**2)
    before, after, variance, cumulant = _sums_of_parts(np.concatenate([fine, cumulant[None]]))
    rounding = min(n, m) * 2.0**-24 * np.maximum(before, after)
    error = np.sqrt(variance + rounding**2)
    pooled = (m * before + n * after) / (n + m)
    # The mean of all samples has the variance of the difference times n m / (n + m)².
    judged = (pooled**2 >= _FEWEST_EVENTS * variance * n * m / (n + m) ** 2) & (pooled > 0.0)
    least = np.sqrt(variance) / np.maximum(pooled, _TINY)
    unit = np.where(error > 0.0, error, 1.0)
    skewness = np.where(judged, np.maximum(cumulant / unit**3, least), 0.0)
    z = (after - before) / unit
    tail = np.where(z > 0.0, stats.pearson3.sf(z, skewness), stats.norm.cdf(z))
    return PartTests(
        parts=_places_of_parts(rows, columns),
        before=before,
        after=after,
        error=error,
        skewness=skewness,
        p=np.where(judged, np.minimum(2.0 * tail, 1.0), 1.0),
        judged=judged,
        tiles=fine[0].size,
    )


@dataclass(frozen=True, eq=False)
class PathComparison:
    """Two renders with the same random numbers.

    Attributes
    ----------
    unlike, pixels
        How many pixels differ by more than rounding, of how many.
    others
        Whether most paths are others, so that the renders are as good as independent.
    parts
        Tests of the pixels that differ: `before` and `after` are their sums; None where nothing is asked.
    """

    unlike: int
    pixels: int
    others: bool
    parts: PartTests | None


def compare_paths(reference: Array, render: Array, noise: Array) -> PathComparison:
    """Test two renders with the same random numbers, part by part, by the signs of their differences.

    Their paths are the same but for some that rounding sends elsewhere: these bring more as often as less,
    pixel by pixel, whatever they bring. So of the pixels that differ the brighter ones are binomial, and a
    wall that is darker shows in few of them. A sampler that is another on some paths is unbiased, too, but
    its differences are many small ones one way and few large ones the other: so signs count only where the
    differences do not cancel over the frame, Σd² being what they would cancel to.

    Parameters
    ----------
    reference, render
        Means of the samples of each pixel, as many in both, shape (rows, columns).
    noise
        Variance of the difference of two renders with seeds of their own, same shape.
    """
    apart = render - reference
    unlike = np.abs(apart) > ROUNDING * np.maximum(np.abs(reference), np.abs(render))
    count, squares = int(unlike.sum()), float((apart[unlike] ** 2).sum())
    others = bool(squares > _OTHER_PATHS * noise.sum())
    # ±1 σ of a sum whose terms have any signs; 4.25 of them come once in 50 000 unbiased groups.
    if others or abs(apart[unlike].sum()) < _UNCANCELLED * math.sqrt(squares) or not count:
        return PathComparison(count, unlike.size, others, None)
    rows, columns = reference.shape
    images = np.stack([reference, render, apart**2, np.ones_like(apart), apart > 0.0]) * unlike
    fine = tile_sums(images, TILE_PX)
    before, after, error2, differ, brighter = _sums_of_parts(fine)
    judged = differ >= _FEWEST_UNLIKE
    fewer = np.minimum(brighter, differ - brighter)
    parts = PartTests(
        parts=_places_of_parts(rows, columns),
        before=before,
        after=after,
        error=np.sqrt(error2),
        skewness=np.zeros(len(differ)),
        p=np.where(judged, np.minimum(2.0 * stats.binom.cdf(fewer, differ, 0.5), 1.0), 1.0),
        judged=judged,
        tiles=fine[0].size,
    )
    return PathComparison(count, unlike.size, others, parts)


def judge(images: Sequence[PartTests], significance: float) -> list[Judgement]:
    """Judge all images of a family; the chance that any of equal ones is called different is `significance`.

    Whatever the images have in common: Holm's correction asks for no independence.
    """
    if not images:
        return []
    judged = np.concatenate([image.judged for image in images])
    corrected = np.ones(judged.size)
    corrected[judged] = holm(np.concatenate([image.p for image in images])[judged])
    # What one test must reach while all others are still there: Holm's first step.
    count = max(int(judged.sum()), 1)
    begin = np.cumsum([0, *(image.p.size for image in images)])
    return [
        _judgement(image, corrected[begin[i] : begin[i + 1]], significance, 0.5 * significance / count)
        for i, image in enumerate(images)
    ]


def _judgement(image: PartTests, corrected: Array, significance: float, tail: float) -> Judgement:
    # Where it is the tile says that is farthest from noise, of those that differ by themselves.
    far = np.abs(image.after - image.before) / np.maximum(image.error, _TINY)
    differs = corrected[:-1] <= significance
    worst = int(np.argmax(np.where(differs, far[:-1], -1.0))) if differs.any() else int(np.argmin(corrected))
    tiles = np.flatnonzero(image.judged[: image.tiles])
    drift = _detectable(image, tail)
    top, bottom, left, right = (int(edge) for edge in image.parts[worst])
    return Judgement(
        same=bool(corrected.min() > significance),
        smallest_p=float(corrected.min()),
        part=(top, bottom, left, right),
        change=_change(image, worst),
        frame_change=_change(image, -1),
        tile_drift=float(np.median(drift[tiles])) if tiles.size else np.inf,
        frame_drift=float(drift[-1]),
        judged_tiles=tiles.size,
        tiles=image.tiles,
    )


def _change(image: PartTests, part: int) -> float:
    if image.before[part] == image.after[part]:
        return 0.0
    return float(image.after[part] / image.before[part] - 1.0) if image.before[part] > 0.0 else np.inf


def _detectable(image: PartTests, tail: float) -> Array:
    """Return the relative drift of each part that is found with a chance of `POWER` at a one-sided p.

    A drift δ moves the difference by δ μ, and widens the render's own noise by 1 + δ: with z what the test
    asks for and q the quantile of `POWER`, δ μ = z se + (1 + δ) q se.
    """
    asked, chance = stats.pearson3.isf(tail, image.skewness), stats.norm.ppf(POWER)
    left = image.before - chance * image.error
    drift = (asked + chance) * image.error / np.where(left > 0.0, left, 1.0)
    return np.where(image.judged & (left > 0.0), drift, np.inf)


def tile_sums(image: Array, tile_px: int) -> Array:
    """Return sums over tiles of the last two axes; those at the far edges may be smaller."""
    rows = np.arange(0, image.shape[-2], tile_px)
    columns = np.arange(0, image.shape[-1], tile_px)
    return np.asarray(np.add.reduceat(np.add.reduceat(image, rows, axis=-2), columns, axis=-1))


def _sums_of_parts(fine: Array) -> Array:
    """Return sums over all parts, tiles of 8 pixels first, of images of such tiles, shape (images, parts)."""
    stacks = (fine, tile_sums(fine, 2), fine.sum(axis=(1, 2), keepdims=True))
    return np.concatenate([one.reshape(len(fine), -1) for one in stacks], axis=1)


def _places_of_parts(rows: int, columns: int) -> NDArray[np.int64]:
    """Return where the parts are whose sums these are, shape (parts, 4)."""
    sizes = (TILE_PX, 2 * TILE_PX, max(rows, columns))
    return np.concatenate([_places(rows, columns, size) for size in sizes])


def _places(rows: int, columns: int, tile_px: int) -> NDArray[np.int64]:
    """Return top, bottom, left, right of all tiles, row by row, shape (n, 4)."""
    top, left = (part.ravel() for part in np.mgrid[0:rows:tile_px, 0:columns:tile_px])
    return np.stack([top, np.minimum(top + tile_px, rows), left, np.minimum(left + tile_px, columns)], axis=1)


def holm(p: Array) -> Array:
    """Return p-values corrected by Holm's step-down procedure, in the order given."""
    order = np.argsort(p)
    stepped = np.maximum.accumulate(p[order] * (p.size - np.arange(p.size)))
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(stepped, 1.0)
    return corrected
