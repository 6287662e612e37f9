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


def compare_batches(one: Array, other: Array, tile_px: int = 16, significance: float = 1e-3) -> Comparison:
    """Compare two stacks of independent estimates of an image.

    Each tile and the whole frame are tested by Welch's t over the batches, all together with Holm's
    correction. Where neither stack varies there is no light, or no Monte Carlo: there they must agree to
    float32 rounding.

    Parameters
    ----------
    one, other
        Estimates, shape (batches, rows, columns), at least two batches each; edge tiles may be smaller.
    tile_px
        Side of a tile.
    significance
        Chance that two equal renders are called different.
    """
    parts = [_part_means(stack, tile_px) for stack in (one, other)]
    means = [part.mean(axis=0) for part in parts]
    error2 = sum(part.var(axis=0, ddof=1) / len(part) for part in parts)
    floor2 = (_ROUNDING * np.maximum(np.abs(means[0]), np.abs(means[1]))) ** 2
    p = 2.0 * stats.norm.sf(np.abs(means[0] - means[1]) / np.sqrt(floor2 + 1e-300))
    varies = error2 > floor2
    if varies.any():
        welch = stats.ttest_ind(parts[0][:, varies], parts[1][:, varies], equal_var=False, axis=0)
        p[varies] = welch.pvalue
    smallest = float(np.min(holm(p)))
    relative = np.sqrt(error2) / np.maximum(np.abs(means[1]), 1e-300)
    lit = np.abs(means[1][:-1]) > 0.0
    return Comparison(
        same=smallest > significance,
        smallest_p=smallest,
        frame_ratio=float(means[0][-1] / means[1][-1]) if means[1][-1] else 1.0,
        frame_drift=3.0 * float(relative[-1]),
        tile_drift=3.0 * float(np.median(relative[:-1][lit])) if lit.any() else 0.0,
    )


def _part_means(stack: Array, tile_px: int) -> Array:
    """Return the means of each tile and, last, of the frame, shape (batches, tiles + 1)."""
    tiles = (tile_sums(stack, tile_px) / tile_sums(np.ones(stack.shape[1:]), tile_px)).reshape(len(stack), -1)
    return np.concatenate([tiles, stack.mean(axis=(1, 2))[:, None]], axis=1)
