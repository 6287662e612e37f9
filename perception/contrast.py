"""Whether a blob stands above what lies right around it, not only above the coarse background."""

import math

import numpy as np

from perception.blobs import Blob
from perception.preparation import PreparedFrame

CONTRAST_SIGMAS = 6.03
"""As for detection against the coarse background: Gaussian noise passes 8e-10 of the time."""

_RING_PX = 4
_FEWEST_RING_PIXELS = 8


def stands_above_surroundings(blob: Blob, prepared: PreparedFrame) -> bool:
    """Tell whether a blob's peak exceeds the level of a ring around it by more than noise does.

    The sheen of a lamp on metal, or a wall's lit corner, bends within a cell of the background mesh; on the
    slope that is left, noise alone passes the detection limit. The ring lies just outside the PSF's reach and
    takes that slope with it. Its median is blind to other flares in less than half of it.

    Parameters
    ----------
    blob
        The blob.
    prepared
        The frame it was found in.

    Returns
    -------
    True also where the frame's edges leave too little of the ring.
    """
    gap_px = math.ceil(3.0 * prepared.calibration.psf_sigma_px) + 1
    inner, outer = blob.box.grown(gap_px), blob.box.grown(gap_px + _RING_PX)
    rows, columns = prepared.filtered_e.shape
    place = np.s_[
        max(outer.top, 0) : min(outer.top + outer.height, rows),
        max(outer.left, 0) : min(outer.left + outer.width, columns),
    ]
    ring = np.ones(prepared.filtered_e[place].shape, dtype=bool)
    top, left = inner.top - max(outer.top, 0), inner.left - max(outer.left, 0)
    ring[max(top, 0) : top + inner.height, max(left, 0) : left + inner.width] = False
    if int(ring.sum()) < _FEWEST_RING_PIXELS:
        return True
    level_e = float(np.median(prepared.filtered_e[place][ring]))
    around_e = max(level_e + float(np.median(prepared.background_e[place][ring])), 0.0)
    noise_e = prepared.filtered_noise * math.sqrt(around_e + prepared.floor_e2)
    peak_e = float(prepared.filtered_e[blob.box.slices][blob.pixels].max())
    return peak_e - level_e > CONTRAST_SIGMAS * noise_e
