"""Which light in which blocks is averaged with that of blocks around: in fog, on surfaces alike throughout.

In fog most of a render's noise is in light that was turned twice and more, by fog at least once. It is smooth
in the image, where turns in fog by less than some blocks are wide do not count: on flat matt surfaces of one
reflectance and where nothing is seen but fog, as far as the fog in front changes only linearly from block to
block.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.light.averages import averages
from nir_render.light.light import Multiple
from nir_render.light.planes import REACH
from nir_render.scene.snapshot import Snapshot
from nir_render.transport.indirect.enlargement import Labels, labels_of_blocks
from nir_render.transport.world.fog_depth import optical_depth

_NARROW_BLOCKS = 2 * REACH + 1  # all that an average is made of
_FAR_M = 1e6  # in place of endless ways, whose depth in fog over height is no number
_BENT = 0.01  # what fog lets through may be off by so much in the mean of the blocks around


@dataclass(frozen=True, eq=False)
class Averaging:
    """What is averaged.

    Attributes
    ----------
    surface
        A number for the surface in each block, −1 where a block stands alone, shape (rows, columns).
    narrow
        A turn of light is one by an angle whose versine, 1 − cos θ, is above this.
    """

    surface: NDArray[np.int32]
    narrow: float

    def multiple(self, apart: Sequence[NDArray[np.float32]]) -> Multiple:
        """Return light of many turns, of its mean, its variance, and the covariance with the rest."""
        radiance_per_w, variance, covariance = apart
        return Multiple(radiance_per_w, variance, covariance, self.surface)

    def without(self, pixels: NDArray[np.int32], columns: int, scale: int) -> "Averaging":
        """Return what is averaged where blocks with some pixels, numbered row by row, stand alone."""
        surface = self.surface.copy()
        row, column = np.divmod(pixels, columns)
        surface[row // scale, column // scale] = -1
        return Averaging(surface, self.narrow)


def averaging_of(
    snapshot: Snapshot,
    labels: Labels,
    origin_m: NDArray[np.float64],
    corners: NDArray[np.float64],
    scale: int,
) -> Averaging | None:
    """Return what is averaged in an image of blocks of scale × scale pixels, None where nothing is.

    Parameters
    ----------
    origin_m, corners
        The camera's rays (`groups.Rays`).
    """
    fog = snapshot.fog
    if fog is None or fog.extinction_per_m == 0.0 or scale == 1:
        return None
    pure = labels_of_blocks(labels, scale)
    surface = np.where((pure >= 0) & labels.even[pure], pure, -1).astype(np.int32)
    if not (surface >= 0).any():
        return None
    direction = middle_directions(corners[::scale, ::scale])
    rows, columns = surface.shape
    nearness_per_m = labels.nearness_per_m.reshape(rows, scale, columns, scale).mean(axis=(1, 3)).ravel()
    length_m = 1.0 / np.maximum(nearness_per_m, 1.0 / _FAR_M)
    start_m = np.broadcast_to(origin_m, (surface.size, 3))
    through = np.exp(-optical_depth(fog, start_m, direction.reshape(-1, 3), length_m)).reshape(surface.shape)
    bent = np.abs(averages(surface).of(through) - through) > _BENT
    return Averaging(np.where(bent, -1, surface).astype(np.int32), narrow_versine(corners, scale))


def narrow_versine(corners: NDArray[np.float64], scale: int) -> float:
    """Return 1 − cos of the angle over all the blocks that an average is made of, in the image's middle."""
    return 1.0 - float(np.cos(min(_NARROW_BLOCKS * scale * pixel_angle_rad(corners), np.pi)))


def pixel_angle_rad(corners: NDArray[np.float64]) -> float:
    """Return the angle that a pixel fills in the image's middle, of corners of pixels."""
    row, column = (count // 2 for count in corners.shape[:2])
    first, second = unit(corners[row, column - 1 : column + 1])
    return float(np.linalg.norm(second - first))


def middle_directions(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return unit vectors to the middles of pixels or blocks that have these corners."""
    return unit(corners[:-1, :-1] + corners[:-1, 1:] + corners[1:, :-1] + corners[1:, 1:])


def unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vectors along the last axis as unit vectors."""
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
