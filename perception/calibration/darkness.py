"""What the dark pixels of frames say of black level and noise."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_ROUNDING_DN2 = 1.0 / 12.0
_WITHIN = 3.0
_LEAST_SIGMA_DN = 0.3  # of a mean of counts that are rounded, and clipped at 0


@dataclass(frozen=True)
class Darkness:
    """The mean count of dark pixels and its σ, and their noise from frame to frame, all in counts."""

    level_dn: float
    level_sigma_dn: float
    noise_dn: float


def darkness(frames: Sequence[NDArray[np.uint16]]) -> Darkness:
    """Measure dark level and noise in frames that are mostly dark.

    The level is the mean count of the pixels within three σ of the median; the noise is that of the
    differences of neighbouring frames there, without what rounding to whole counts adds; of one frame alone,
    the scatter over its pixels.

    Parameters
    ----------
    frames
        Counts of one camera, at least one frame, each of shape (rows, columns).
    """
    levels, squares = [], []
    inside = np.empty(0, dtype=bool)
    for number, frame in enumerate(frames):
        counts = frame.astype(np.float64)
        middle = float(np.median(counts))
        # Of whole counts the median deviation is one too, up to half a count too low.
        scatter = 1.4826 * (float(np.median(np.abs(counts - middle))) + 0.5)
        here = np.abs(counts - middle) <= _WITHIN * scatter
        levels.append(float(counts[here].mean()))
        if number:
            change = (counts - frames[number - 1])[inside & here]
            squares.append(0.5 * float(np.var(change)) if change.size else 0.0)
        inside = here
    if not squares:
        squares = [float(np.var(frames[0].astype(np.float64)[inside]))]
    noise_dn = math.sqrt(max(float(np.median(squares)) - _ROUNDING_DN2, 0.0))
    return Darkness(float(np.mean(levels)), math.hypot(float(np.std(levels)), _LEAST_SIGMA_DN), noise_dn)
