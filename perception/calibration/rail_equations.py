"""Normal equations of a rail, whose pixels err alike at all places.

What is left of a pixel's offset, o, and of its response, r, is the same in every frame, and the windows of a
rail's places lie one on another. So the sum of n frames at place p is, in a pixel of the sensor,
y_p = λ_p + ε_p + n_p o + λ_p r: noise ε of its own, o and r drawn once (DSNU, PRNU). The covariance of all
places is D + A Aᵀ, with two columns of A for each pixel of the sensor, and by Woodbury's identity its inverse
is D⁻¹ − D⁻¹ A (1 + Aᵀ D⁻¹ A)⁻¹ Aᵀ D⁻¹: of 2 × 2 matrices, pixel by pixel. Were they taken for noise of each
place by itself, they would average away, and the share of glare would have intervals that are too short.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import PixelBox

Array = NDArray[np.float64]

SHARED, OWN = 5, 4
"""How many unknowns all places share, and how many each has for itself."""

_TILE_PX = 48


@dataclass(frozen=True, eq=False)
class RailNoise:
    """The noise of sums of frames, as some expectation has it.

    Attributes
    ----------
    boxes
        Which pixels of the sensor each place has.
    own_e2
        Variances of noise of each place by itself, shapes of the boxes.
    common_e
        What one σ of a pixel's offset and of its response do, shapes (2, height, width).
    """

    boxes: tuple[PixelBox, ...]
    own_e2: tuple[Array, ...]
    common_e: tuple[Array, ...]

    def information(self, columns: Sequence[Array], shared: int) -> Array:
        """Return XᵀΣ⁻¹X of columns at all places.

        Parameters
        ----------
        columns
            Of each place, shape (k, height, width).
        shared
            How many of the first belong to all places, as the last does; the others belong to this one.

        Returns
        -------
        Shape (n, n): what is shared, place after place what is its own, the last.
        """
        each = columns[0].shape[0] - shared - 1
        last = shared + each * len(columns)
        found = np.zeros((last + 1, last + 1))

        def at(places: Sequence[int]) -> NDArray[np.int64]:
            own = (shared + each * place + n for place in places for n in range(each))
            return np.array([*range(shared), *own, last])

        weighted = []
        for place, (values, own_e2) in enumerate(zip(columns, self.own_e2, strict=True)):
            scaled, count = values / own_e2, shared + each + 1
            found[np.ix_(at([place]), at([place]))] += scaled.reshape(count, -1) @ values.reshape(count, -1).T
            weighted.append(scaled)
        for tile, places in self._tiles:
            sums = np.zeros((shared + each * len(places) + 1, 2, tile.height, tile.width))
            matrix = np.zeros((2, 2, tile.height, tile.width))
            matrix[0, 0] = matrix[1, 1] = 1.0
            for number, place in enumerate(places):
                part = tile.overlap(self.boxes[place])
                to, of = part.seen_from(tile).slices, part.seen_from(self.boxes[place]).slices
                common_e, scaled = self.common_e[place][:, *of], weighted[place][:, *of]
                matrix[:, :, *to] += common_e[:, None] * (common_e / self.own_e2[place][of])
                first = shared + each * number
                sums[:shared, :, *to] += scaled[:shared, None] * common_e
                sums[first : first + each, :, *to] += scaled[shared:-1, None] * common_e
                sums[-1, :, *to] += scaled[-1] * common_e
            # Whitened by the Cholesky factor of each pixel's matrix.
            root = np.sqrt(matrix[0, 0])
            slant = matrix[0, 1] / root
            sums[:, 0] /= root
            sums[:, 1] -= slant * sums[:, 0]
            sums[:, 1] /= np.sqrt(matrix[1, 1] - slant**2)
            flat = sums.reshape(len(sums), -1)
            found[np.ix_(at(places), at(places))] -= flat @ flat.T
        return found

    def chi2(self, left_e: Sequence[Array]) -> float:
        """Return rᵀΣ⁻¹r of what an expectation leaves, shapes of the boxes."""
        return float(self.information([left[None] for left in left_e], 0)[0, 0])

    @cached_property
    def _tiles(self) -> list[tuple[PixelBox, list[int]]]:
        """Tiles of the sensor, and which places have pixels in each: memory stays small."""
        places: dict[tuple[int, int], list[int]] = {}
        for place, box in enumerate(self.boxes):
            for row in range(box.top // _TILE_PX, (box.top + box.height - 1) // _TILE_PX + 1):
                for column in range(box.left // _TILE_PX, (box.left + box.width - 1) // _TILE_PX + 1):
                    places.setdefault((row, column), []).append(place)
        return [
            (PixelBox(_TILE_PX * row, _TILE_PX * column, _TILE_PX, _TILE_PX), inside)
            for (row, column), inside in sorted(places.items())
        ]


@dataclass(frozen=True, eq=False)
class RailEquations:
    """Normal equations of shared and own unknowns, and χ², with the prior's; the noise of both."""

    matrix: Array
    slope: Array
    chi2: float
    noise: RailNoise

    def step(self, free: NDArray[np.int64], damping: float) -> tuple[Array, Array, Array]:
        """Return the steps of shared (the free) and own unknowns, (places, 4); covariance of the former."""
        at = np.append(free, np.arange(SHARED, len(self.slope)))
        matrix = self.matrix[np.ix_(at, at)]
        damped = matrix + damping * np.diag(np.diagonal(matrix))
        change = np.asarray(np.linalg.solve(damped, self.slope[at]), dtype=np.float64)
        shared = len(free)
        covariance = np.asarray(
            np.linalg.solve(matrix, np.eye(len(at))[:, :shared])[:shared], dtype=np.float64
        )
        return change[:shared], change[shared:].reshape(-1, OWN), covariance


def rail_equations(
    left_e: Sequence[Array], jacobians: Sequence[Array], noise: RailNoise, prior: tuple[Array, Array]
) -> RailEquations:
    """Put the normal equations together.

    Parameters
    ----------
    left_e
        What the expectation leaves of each place, shapes of the boxes.
    jacobians
        Its derivatives by shared and own unknowns, shapes (9, height, width).
    noise
        Of the sums.
    prior
        How far shared unknowns are below what is known beforehand, and its precision, shape (5,) each.
    """
    columns = [np.concatenate([by, left[None]]) for by, left in zip(jacobians, left_e, strict=True)]
    information = noise.information(columns, SHARED)
    below, precision = prior
    matrix, slope = information[:-1, :-1], information[:-1, -1]
    matrix[np.arange(SHARED), np.arange(SHARED)] += precision
    slope[:SHARED] += precision * below
    return RailEquations(matrix, slope, float(information[-1, -1] + below @ (precision * below)), noise)
