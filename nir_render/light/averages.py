"""Light of many turns, averaged over blocks of pixels around: what that makes of its noise.

What fog has turned twice or more changes slowly over a surface. In a block it is the value there of the plane
that fits the blocks around best, of the same surface alone; other light is each block's own. Averages of
neighbours share noise: of sums over blocks with weights a it is, by the rest r and the averaged part m of
each, with A the averages, Var Σ a r + (A'a) m.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from nir_render.light.planes import REACH, fit_planes
from perception.compiled import compiled

Array = NDArray[np.float64]

_SIDE = 2 * REACH + 1
_MIDDLE = _SIDE * _SIDE // 2
_KEPT = 4


@dataclass(frozen=True, eq=False)
class Averages:
    """What blocks around each block weigh in it, where its light is averaged; one that is not is itself.

    Attributes
    ----------
    weight
        Of 5 × 5 blocks around each, row by row, shape (rows, columns, 25); 0 beyond the image.
    """

    weight: NDArray[np.float32]

    @cached_property
    def matrix(self) -> csr_array:
        """The weights as a sparse matrix, shape (blocks, blocks)."""
        rows, columns, around = self.weight.shape
        row, column, place = np.nonzero(self.weight)
        other = (row + place // _SIDE - REACH) * columns + column + place % _SIDE - REACH
        first = np.append(0, np.cumsum(np.count_nonzero(self.weight.reshape(-1, around), axis=1)))
        count = rows * columns
        values = self.weight[row, column, place].astype(np.float64)
        return csr_array((values, other, first), shape=(count, count))

    @property
    def own(self) -> Array:
        """What each block weighs in itself, shape (rows, columns)."""
        return self.weight[..., _MIDDLE].astype(np.float64)

    @property
    def squares(self) -> Array:
        """The sum of squares of weights: what is left of like noise, shape (rows, columns)."""
        return np.asarray((self.weight.astype(np.float64) ** 2).sum(axis=-1))

    def of(self, values: Array) -> Array:
        """Return the averages of values, shape (rows, columns); ValueError for an image of another size."""
        if values.shape != self.weight.shape[:2]:
            raise ValueError(
                f"an image of {values.shape} blocks where averages are of {self.weight.shape[:2]}"
            )
        return _averaged(self.weight, np.ascontiguousarray(values, dtype=np.float64))


def averages(surface: NDArray[np.int32]) -> Averages:
    """Return the averages over blocks of equal numbers, shape (rows, columns); those below 0 are alone.

    Lights of one geometry share them, the last few being kept.
    """
    return _averages(surface.shape, np.ascontiguousarray(surface, dtype=np.int32).tobytes())


@lru_cache(maxsize=_KEPT)
def _averages(shape: tuple[int, int], numbers: bytes) -> Averages:
    surface = np.frombuffer(numbers, dtype=np.int32).reshape(shape).copy()
    _, weight, _ = fit_planes(surface, np.arange(surface.size), surface.ravel(), 1, shape[1])
    alone = surface.ravel() < 0
    weight[alone] = 0.0
    weight[alone, _MIDDLE] = 1.0
    return Averages(weight.astype(np.float32).reshape(*shape, -1))


@compiled
def _averaged(weight: NDArray[np.float32], values: Array) -> Array:
    rows, columns = values.shape
    found = np.zeros((rows, columns))
    for row in range(rows):
        for column in range(columns):
            total = 0.0
            for place in range(_SIDE * _SIDE):
                share = weight[row, column, place]
                if share != 0.0:
                    total += share * values[row + place // _SIDE - REACH, column + place % _SIDE - REACH]
            found[row, column] = total
    return found


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
        squares = Averages(self.around.weight**2)
        return self._rest() + squares.of(self.multiple) + 2.0 * self.around.own * self.covariance

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
def _of_neighbours(weight: NDArray[np.float32], rest: Array, multiple: Array, covariance: Array) -> Array:
    rows, columns = rest.shape
    found = np.zeros((5, rows, columns))
    for row in range(rows):
        for column in range(columns):
            for kind in range(5):
                down, across = (kind >= 2) * 1, (kind == 1 or kind == 3) * 1 - (kind == 4) * 1
                if row + down >= rows or not 0 <= column + across < columns:
                    continue
                there_row, there_column = row + down, column + across
                total = 0.0
                for above in range(_SIDE):
                    for left in range(_SIDE):
                        share = weight[row, column, above * _SIDE + left]
                        if share == 0.0 or above < down or not 0 <= left - across < _SIDE:
                            continue
                        other = weight[there_row, there_column, (above - down) * _SIDE + left - across]
                        total += share * other * multiple[row + above - REACH, column + left - REACH]
                # What one block's own rest has to do with its light in the other's average.
                step = down * _SIDE + across
                total += weight[there_row, there_column, _MIDDLE - step] * covariance[row, column]
                total += weight[row, column, _MIDDLE + step] * covariance[there_row, there_column]
                found[kind, row, column] = total + (rest[row, column] if kind == 0 else 0.0)
    return found
