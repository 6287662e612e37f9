"""What glare spreads over a frame of an even surface."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STEPS_PER_RADIUS = 3.0
_MARGIN = 3


@dataclass(frozen=True, eq=False)
class Glare:
    """A lens's glare, and how well it is known.

    `covariance` is that of the share g, ln r₀ and ln (γ − 1), shape (3, 3).
    """

    share: float
    radius_px: float
    exponent: float
    covariance: Array

    @property
    def off_by_sigma(self) -> Sequence["Glare"]:
        """Glares off by one σ along each of the covariance's axes: their effects add in quadrature."""
        values, axes = np.linalg.eigh(self.covariance)
        return [
            replace(
                self,
                share=self.share + step[0],
                radius_px=self.radius_px * math.exp(step[1]),
                exponent=1.0 + (self.exponent - 1.0) * math.exp(step[2]),
            )
            for step in (np.sqrt(np.maximum(values, 0.0)) * axes).T.tolist()
        ]


def veil_of(image_e: Array, glare: Glare) -> Array:
    """Return what glare brings to a frame of the light in it, shape (rows, columns).

    Light from beyond the frame is not known; it counts as none. The convolution is done on a coarser grid:
    an even surface is smooth, and so is glare.
    """
    from scipy.ndimage import map_coordinates
    from scipy.signal import fftconvolve

    step = max(int(glare.radius_px / _STEPS_PER_RADIUS), 1)
    # Some darkness around, for the veil does not end where the frame does.
    rows, columns = (math.ceil(size / step) + 2 * _MARGIN for size in image_e.shape)
    padded = np.zeros((rows * step, columns * step))
    margin = _MARGIN * step
    padded[margin : margin + image_e.shape[0], margin : margin + image_e.shape[1]] = image_e
    cells_e = padded.reshape(rows, step, columns, step).sum(axis=(1, 3))
    v = step * np.arange(-rows + 1, rows)[:, None]
    u = step * np.arange(-columns + 1, columns)
    away = (u**2 + v**2) / glare.radius_px**2
    density = (glare.exponent - 1.0) / (math.pi * glare.radius_px**2) * (1.0 + away) ** -glare.exponent
    spread_e = fftconvolve(cells_e, glare.share * density)[
        rows - 1 : 2 * rows - 1, columns - 1 : 2 * columns - 1
    ]
    at = [(np.arange(size) + 0.5) / step - 0.5 + _MARGIN for size in image_e.shape]
    return np.asarray(map_coordinates(spread_e, np.stack(np.meshgrid(*at, indexing="ij")), order=3))
