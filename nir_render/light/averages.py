"""Light of many turns, averaged over blocks of pixels around: what that makes of its noise.

What has been turned twice or more changes slowly over a surface. In a block it is the value there of the
plane that fits the blocks around best, of the same surface alone; other light is each block's own. Averages
of neighbours share noise: of sums over blocks with weights a it is, by the rest r and the averaged part m of
each, with A the averages, Var Σ a r + (A'a) m.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from nir_render.light.planes import REACH, fit_planes
from perception.compiled import compiled

Array = NDArray[np.float64]

_SIDE = 2 * REACH + 1
_MIDDLE = _SIDE * _SIDE // 2


@dataclass(frozen=True, eq=False)
class Averages:
    """What blocks around each block weigh in it, where its light is averaged; one that is not is itself.

    Attributes
    ----------
    block, weight
        Numbers of the blocks around, from the upper left, row by row, and their weights, shape (blocks, 25).
    """

    block: NDArray[np.int64]
    weight: Array

    @property
    def matrix(self) -> csr_array:
        """The weights as a sparse matrix, shape (blocks, blocks)."""
        count, around = self.block.shape
        first = np.arange(0, count * around + 1, around)
        return csr_array((self.weight.ravel(), self.block.ravel(), first), shape=(count, count))

    @property
    def own(self) -> Array:
        """What each block weighs in itself, shape (blocks,)."""
        return self.weight[:, _MIDDLE]

    def of(self, values: Array) -> Array:
        """Return the averages of values, shape (rows, columns)."""
        found: Array = np.einsum("bk,bk->b", self.weight, values.ravel()[self.block])
        return found.reshape(values.shape)


def averages(surface: NDArray[np.int32]) -> Averages:
    """Return the averages over blocks of equal numbers, shape (rows, columns); those below 0 are alone."""
    number = np.arange(surface.size)
    label = surface.ravel()
    block, weight, _ = fit_planes(surface, number, label, 1, surface.shape[1])
    alone = label < 0
    weight[alone] = 0.0
    weight[alone, _MIDDLE] = 1.0
    return Averages(block, weight)


def inside_weights() -> tuple[float, float]:
    """Return what a block far inside a surface weighs in itself, and the sum of squares of all weights."""
    around = averages(np.zeros((_SIDE, _SIDE), dtype=np.int32)).weight[_MIDDLE]
    return float(around[_MIDDLE]), float((around**2).sum())


@dataclass(frozen=True, eq=False)
class BlockVariance:
    """The variance of light in blocks.

    Attributes
    ----------
    whole
        Of each block's light, before anything is averaged, shape (rows, columns).
    multiple, covariance
        Of the part that is averaged, and of it and the rest, same shape; None where nothing is.
    around
        How it is averaged.
    """

    whole: Array
    multiple: Array | None = None
    covariance: Array | None = None
    around: Averages | None = None

    def of_blocks(self) -> Array:
        """Return the variance of each block, same shape."""
        if self.multiple is None or self.covariance is None or self.around is None:
            return self.whole
        squares = Averages(self.around.block, self.around.weight**2)
        own = self.around.own.reshape(self.whole.shape)
        return self._rest() + squares.of(self.multiple) + 2.0 * own * self.covariance

    def of_sums(self, weights: csr_array) -> Array:
        """Return the variance of sums over blocks, of weights of shape (sums, blocks)."""
        if self.multiple is None or self.covariance is None or self.around is None:
            return np.asarray(weights.multiply(weights) @ self.whole.ravel())
        spread = csr_array(weights @ self.around.matrix)
        of_rest = weights.multiply(weights) @ self._rest().ravel()
        of_multiple = spread.multiply(spread) @ self.multiple.ravel()
        return np.asarray(of_rest + of_multiple + 2.0 * (weights.multiply(spread) @ self.covariance.ravel()))

    def drawn(self, random: np.random.Generator) -> Array:
        """Return noise of this variance, normal, shape (rows, columns)."""
        noise = random.standard_normal(self.whole.shape)
        if self.multiple is None or self.covariance is None or self.around is None:
            return np.asarray(np.sqrt(self.whole) * noise)
        multiple = np.sqrt(self.multiple) * noise
        slope = np.where(self.multiple > 0.0, self.covariance / np.maximum(self.multiple, 1e-300), 0.0)
        left = np.maximum(self._rest() - slope * self.covariance, 0.0)
        rest = slope * multiple + np.sqrt(left) * random.standard_normal(self.whole.shape)
        return np.asarray(rest + self.around.of(multiple))

    def of_neighbours(self) -> Array | None:
        """Return covariances of blocks with themselves and with the next ones, None where they have none.

        With itself, the one to the right, below, below to the right, below to the left: shape (5, rows,
        columns).
        """
        if self.multiple is None or self.covariance is None or self.around is None:
            return None
        return _of_neighbours(self.around.weight, self._rest(), self.multiple, self.covariance)

    def _rest(self) -> Array:
        assert self.multiple is not None
        assert self.covariance is not None
        return np.maximum(self.whole - self.multiple - 2.0 * self.covariance, 0.0)


@compiled
def _of_neighbours(weight: Array, rest: Array, multiple: Array, covariance: Array) -> Array:
    rows, columns = rest.shape
    found = np.zeros((5, rows, columns))
    for row in range(rows):
        for column in range(columns):
            here = row * columns + column
            for kind in range(5):
                down, across = (kind >= 2) * 1, (kind == 1 or kind == 3) * 1 - (kind == 4) * 1
                if row + down >= rows or column + across >= columns or column + across < 0:
                    continue
                there = here + down * columns + across
                total = 0.0
                for above in range(_SIDE):
                    for left in range(_SIDE):
                        share = weight[here, above * _SIDE + left]
                        if share == 0.0 or above < down or not 0 <= left - across < _SIDE:
                            continue
                        other = weight[there, (above - down) * _SIDE + left - across]
                        total += share * other * multiple[row + above - REACH, column + left - REACH]
                # What one block's own rest has to do with its light in the other's average.
                total += weight[there, _MIDDLE - down * _SIDE - across] * covariance[row, column]
                total += (
                    weight[here, _MIDDLE + down * _SIDE + across] * covariance[row + down, column + across]
                )
                found[kind, row, column] = total + (rest[row, column] if kind == 0 else 0.0)
    return found
