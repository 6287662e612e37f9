"""Whether two renders show the same: statistics on tiles, where a test per pixel sees nothing (PHYSICS 9).

Two means of the same image differ by noise alone if the differences of their tile means, in units of their
own standard errors, look like noise. Tiles add up what pixels cannot tell: 1 % of gain passes a test per
pixel every time, and a test on tiles never.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]


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

    Each tile's mean and its standard error come from the scatter of the batches; the tile and the whole
    frame are tested by Welch's t, all together with Holm's correction.

    Parameters
    ----------
    one, other
        Estimates, shape (batches, rows, columns), at least two batches each; edge tiles may be smaller.
    tile_px
        Side of a tile.
    significance
        Chance that two equal renders are called different.
    """
    tiles = [
        np.concatenate([_tile_means(stack, tile_px), _frame_means(stack)], axis=1) for stack in (one, other)
    ]
    means = [tile.mean(axis=0) for tile in tiles]
    errors2 = [tile.var(axis=0, ddof=1) / len(tile) for tile in tiles]
    error2 = errors2[0] + errors2[1]
    # Where neither varies there is no light, or no Monte Carlo: they must agree to float32 rounding.
    floor = (1e-6 * np.maximum(np.abs(means[0]), np.abs(means[1]))) ** 2
    t = (means[0] - means[1]) / np.sqrt(np.maximum(error2, floor) + 1e-300)
    spread = errors2[0] ** 2 / (len(tiles[0]) - 1) + errors2[1] ** 2 / (len(tiles[1]) - 1)
    freedom = np.where(spread > 0.0, error2**2 / np.maximum(spread, 1e-300), np.inf)
    p = np.asarray(2.0 * stats.t.sf(np.abs(t), np.maximum(freedom, 1.0)))
    smallest = float(np.min(_holm(p)))
    relative = np.sqrt(error2) / np.maximum(np.abs(means[1]), 1e-300)
    lit = np.abs(means[1][:-1]) > 0.0
    return Comparison(
        same=smallest > significance,
        smallest_p=smallest,
        frame_ratio=float(means[0][-1] / means[1][-1]) if means[1][-1] else 1.0,
        frame_drift=3.0 * float(relative[-1]),
        tile_drift=3.0 * float(np.median(relative[:-1][lit])) if lit.any() else 0.0,
    )


def _tile_means(stack: Array, tile_px: int) -> Array:
    rows = np.arange(0, stack.shape[1], tile_px)
    columns = np.arange(0, stack.shape[2], tile_px)
    sums = np.add.reduceat(np.add.reduceat(stack, rows, axis=1), columns, axis=2)
    counts = np.add.reduceat(np.add.reduceat(np.ones(stack.shape[1:]), rows, axis=0), columns, axis=1)
    return np.asarray((sums / counts).reshape(len(stack), -1))


def _frame_means(stack: Array) -> Array:
    return np.asarray(stack.mean(axis=(1, 2))[:, None])


def _holm(p: Array) -> Array:
    """Return p-values corrected by Holm's step-down procedure, in the order given."""
    order = np.argsort(p)
    stepped = np.maximum.accumulate(p[order] * (p.size - np.arange(p.size)))
    corrected = np.empty_like(p)
    corrected[order] = np.minimum(stepped, 1.0)
    return corrected
