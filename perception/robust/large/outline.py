"""The outline of a large blob, as that of a sphere: all that tells a near source from a lit patch."""

import math
from dataclasses import dataclass

import numpy as np

from perception.model.bearing import direction_camera
from perception.model.lens import project
from perception.robust.search.blobs import Blob
from perception.robust.search.prepare import PreparedFrame

_HALF = 0.5  # of its brightest, where an unclipped disc ends
_WIDER_THAN_SPILL_PX = 5
_FEWEST = 24  # pixels of an outline
_ROUNDS, _OUTLYING = 3, 4.0


@dataclass(frozen=True)
class Outline:
    """The circle in the sky that fits the outline of a blob best.

    Attributes
    ----------
    u_px, v_px
        Its middle.
    angle_rad
        Its radius, of the image of a sphere r / d = sin of that.
    off_share
        How far, on the median, the outline lies off it, of its radius.
    """

    u_px: float
    v_px: float
    angle_rad: float
    off_share: float


def outline_of(blob: Blob, prepared: PreparedFrame) -> Outline | None:
    """Fit a circle to the outline of what is clipped of a blob, or else of half of its maximum.

    Whatever the lens, the directions n to the limb of a sphere lie on a cone, m · n = 1, m along its axis.
    Where the frame's border cuts the blob that is no outline; nor are columns that charge spilled over.

    Returns
    -------
    The circle; None where there is too little of an outline, or what is there is none of a sphere.
    """
    from scipy.ndimage import binary_erosion, binary_opening

    box, (rows, columns) = blob.box, prepared.shape
    clips = blob.pixels & prepared.clipped_in(box)
    lit = clips if clips.any() else blob.pixels & (blob.filtered_e > _HALF * blob.peak_e)
    whole = binary_opening(np.pad(lit, 1), np.ones((1, _WIDER_THAN_SPILL_PX), dtype=np.bool_))
    places = np.argwhere(whole & ~binary_erosion(whole)) - 1 + (box.top, box.left)
    inside = ((places > 0) & (places < (rows - 1, columns - 1))).all(axis=1)
    limb = direction_camera(places[inside][:, ::-1], prepared.calibration)
    limb = limb[np.isfinite(limb).all(axis=1)]
    if len(limb) < _FEWEST:
        return None
    kept = np.ones(len(limb), dtype=np.bool_)
    for _ in range(_ROUNDS):
        axis = np.linalg.lstsq(limb[kept], np.ones(np.count_nonzero(kept)), rcond=None)[0]
        length = float(np.linalg.norm(axis))
        if not length > 1.0:
            return None
        angle_rad = math.acos(1.0 / length)
        off_rad = abs(np.arccos(np.clip(limb @ axis / length, -1.0, 1.0)) - angle_rad)
        median_rad = float(np.median(off_rad))
        kept = off_rad <= _OUTLYING * median_rad
    ((u_px, v_px),) = project(
        np.asarray(axis[None] / length, dtype=np.float64), prepared.calibration
    ).tolist()
    return Outline(u_px, v_px, angle_rad, median_rad / angle_rad)
