"""Whether two stacks of renders show the same: Welch's t on tiles and the frame, for tests of the renderer."""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from nir_render.regress.statistics import Array, holm, tile_sums

_ROUNDING = 1e-6  # of float32 sums


@dataclass(frozen=True)
class Comparison:
    """The outcome of one comparison.

    Attributes
    ----------
    same
        Whether nothing speaks against both being the same, at the significance asked for.
    smallest_p
        The smallest p-value of all tiles and the frame, corrected by Holm for their number.
    frame_ratio
        Mean of one over mean of the other.
    frame_drift
        The relative drift of the whole frame that this comparison would have seen (3 standard errors).
    tile_drift
        The same for a tile: median over tiles that hold light.
    """

    same: bool
    smallest_p: float
    frame_ratio: float
    frame_drift: float
    tile_drift: float


@dataclass(frozen=True, eq=False)
class Parts:
    """Tiles and, last, the frame of independent estimates of an image: all that a comparison takes of them.

    Attributes
    ----------
    mean, variance
        Of each part's mean over the estimates, shape (tiles + 1,).
    count
        Of estimates, two or more.
    """

    mean: Array
    variance: Array
    count: int


def parts_of(stack: Array, tile_px: int = 16) -> Parts:
    """Return the tiles and the frame of estimates, shape (batches, rows, columns); edge tiles may be smaller."""
    tiles = (tile_sums(stack, tile_px) / tile_sums(np.ones(stack.shape[1:]), tile_px)).reshape(len(stack), -1)
    means = np.concatenate([tiles, stack.mean(axis=(1, 2))[:, None]], axis=1)
    return Parts(means.mean(axis=0), means.var(axis=0, ddof=1), len(stack))


def compare_batches(one: Array, other: Array, tile_px: int = 16, significance: float = 1e-3) -> Comparison:
    """Compare two stacks of independent estimates of an image, shape (batches, rows, columns), as below."""
    return compare_parts(parts_of(one, tile_px), parts_of(other, tile_px), significance)


def compare_parts(one: Parts, other: Parts, significance: float = 1e-3) -> Comparison:
    """Compare independent estimates of an image by those of another.

    Each tile and the whole frame are tested by Welch's t over the batches, all together with Holm's
    correction. Where neither stack varies there is no light, or no Monte Carlo: there they must agree to
    float32 rounding.

    Parameters
    ----------
    one, other
        The parts of both.
    significance
        Chance that two equal renders are called different.
    """
    error2 = one.variance / one.count + other.variance / other.count
    floor2 = (_ROUNDING * np.maximum(np.abs(one.mean), np.abs(other.mean))) ** 2
    p = 2.0 * stats.norm.sf(np.abs(one.mean - other.mean) / np.sqrt(floor2 + 1e-300))
    varies = error2 > floor2
    if varies.any():
        p[varies] = stats.ttest_ind_from_stats(
            one.mean[varies], np.sqrt(one.variance[varies]), one.count,
            other.mean[varies], np.sqrt(other.variance[varies]), other.count,
            equal_var=False,
        ).pvalue  # fmt: skip
    smallest = float(np.min(holm(p)))
    relative = np.sqrt(error2) / np.maximum(np.abs(other.mean), 1e-300)
    lit = np.abs(other.mean[:-1]) > 0.0
    return Comparison(
        same=smallest > significance,
        smallest_p=smallest,
        frame_ratio=float(one.mean[-1] / other.mean[-1]) if other.mean[-1] else 1.0,
        frame_drift=3.0 * float(relative[-1]),
        tile_drift=3.0 * float(np.median(relative[:-1][lit])) if lit.any() else 0.0,
    )
