"""The outline of a large blob, as that of a sphere: all that tells a near source from a lit patch."""

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import direction_camera
from perception.model.discs.nodes import disc_nodes
from perception.model.lens import project
from perception.robust.hiding.outlines import on_cones, refined_cone
from perception.robust.search.blobs import Blob
from perception.robust.search.prepare import PreparedFrame
from perception.types import Calibration

Array = NDArray[np.float64]

_WIDER_THAN_SPILL_PX = 5
_FEWEST = 24  # pixels of an outline
_TRIED, _LEAST_VOLUME, _ROUNDS = 20, 1e-12, 3
_MOST_ANGLE_RAD = 0.6  # nearly straight lines are no limbs
_COARSE = 0.1  # of the fineness of images: so fine one tells what part of it is lit
_ON_PX, _ON_SHARE = 0.75, 0.01  # so far from a circle, beside a share of its radius, an outline lies on it


@dataclass(frozen=True)
class Outline:
    """The circle in the sky that fits the outline of a blob best.

    Attributes
    ----------
    u_px, v_px
        Its middle.
    angle_rad
        Its radius, of the image of a sphere r / d = sin of that.
    share
        What part of the outline lies on it.
    lit
        What part of it that the frame shows is as bright as half of the blob.
    """

    u_px: float
    v_px: float
    angle_rad: float
    share: float
    lit: float


def outline_of(blob: Blob, prepared: PreparedFrame) -> Outline | None:
    """Fit a circle to the outline of what is clipped of a blob, or else of half of its maximum.

    Whatever the lens, the directions n to the limb of a sphere lie on a cone, m · n = 1, m along its axis.
    Where the frame's border cuts the blob that is no outline; nor are columns that charge spilled over.

    Returns
    -------
    The circle; None where there is too little of an outline, or what is there is none of a sphere.
    """
    import cv2

    box, (rows, columns) = blob.box, prepared.shape
    clips = blob.pixels & prepared.clipped_in(box)
    lit = clips if clips.any() else blob.bright_half
    across_spill = np.ones((1, _WIDER_THAN_SPILL_PX), dtype=np.uint8)
    whole = np.pad(lit, 1).astype(np.uint8)
    whole = np.asarray(cv2.morphologyEx(whole, cv2.MORPH_OPEN, across_spill))
    if not whole.any():
        return None
    # Discs are convex, whatever is missing within: where the mesh of the background took them for some.
    corners = cv2.convexHull(np.argwhere(whole).astype(np.int32))[:, 0] - 1 + (box.top, box.left)
    places = _along(corners.astype(np.float64))
    inside = ((places > 0) & (places < (rows - 1, columns - 1))).all(axis=1)
    limb = direction_camera(places[inside][:, ::-1], prepared.calibration)
    limb = limb[np.isfinite(limb).all(axis=1)]
    if len(limb) < _FEWEST:
        return None
    axis, share = _likeliest_cone(limb, prepared.calibration)
    if axis is None:
        return None
    length = float(np.linalg.norm(axis))
    ((u_px, v_px),) = project(np.asarray(axis[None] / length), prepared.calibration).tolist()
    if not math.isfinite(u_px):
        return None
    angle_rad = math.acos(1.0 / length)
    part = _lit_part(u_px, v_px, axis / length, angle_rad, prepared, blob)
    return Outline(u_px, v_px, angle_rad, share, part)


def _likeliest_cone(limb: Array, calibration: Calibration) -> tuple[Array | None, float]:
    """Return the m of the cone on which most directions lie, shape (n, 3), and what share of them does.

    Of cones through any three of some, refined by those that lie on it (Fischler and Bolles, Comm. ACM 24,
    381, 1981): half of an outline may be another's.
    """
    some = limb[np.linspace(0, len(limb), _TRIED, endpoint=False).astype(np.int64)]
    three = some[np.array(list(combinations(range(_TRIED), 3)))]
    three = three[abs(np.linalg.det(three)) > _LEAST_VOLUME]
    if len(three) == 0:
        return None, 0.0
    cones = np.linalg.solve(three, np.ones((len(three), 3, 1)))[..., 0]
    within = _ON_PX / min(calibration.fx_px, calibration.fy_px), _ON_SHARE
    likeliest = cones[int(np.argmax(on_cones(cones, limb, *within, _MOST_ANGLE_RAD).sum(axis=1)))]
    axis = refined_cone(likeliest, limb, *within, _ROUNDS, _MOST_ANGLE_RAD)
    if axis is None:
        return None, 0.0
    return axis, float(on_cones(axis[None], limb, *within, _MOST_ANGLE_RAD)[0].mean())


def _lit_part(
    u_px: float, v_px: float, axis: Array, angle_rad: float, prepared: PreparedFrame, blob: Blob
) -> float:
    """Return what part of a disc's light that the frame shows falls where it is half as bright as a blob.

    By the counts themselves: where much is lit, the mesh of the background may have taken a disc for some.
    """
    nodes = disc_nodes(
        np.array([u_px]), np.array([v_px]), axis[None], np.array([angle_rad]), prepared.calibration,
        finer=np.array([_COARSE]),
    )  # fmt: skip
    row, column = np.rint(nodes.v_px + v_px), np.rint(nodes.u_px + u_px)
    rows, columns = prepared.shape
    shown = (row >= 0.0) & (row < rows) & (column >= 0.0) & (column < columns)
    counts_dn, black_dn = prepared.pixels.data_dn, prepared.frame.black_level_dn
    bright_dn = float(np.median(counts_dn[blob.box.slices][blob.pixels])) - black_dn
    is_lit = (
        counts_dn[row[shown].astype(np.int64), column[shown].astype(np.int64)] > black_dn + 0.5 * bright_dn
    )
    weight = nodes.weight[shown]
    whole = float(weight.sum())
    return float(weight[is_lit].sum()) / whole if whole > 0.0 else 0.0


def _along(corners: Array) -> Array:
    """Return places a pixel apart along a closed line through corners, shape (corners, 2)."""
    ends = np.roll(corners, -1, axis=0)
    counts = np.ceil(np.hypot(*(ends - corners).T)).astype(np.int64)
    step = np.concatenate([np.arange(count) / count for count in counts if count])
    along = step[:, None] * np.repeat(ends - corners, counts, axis=0)
    return np.asarray(np.repeat(corners, counts, axis=0) + along)
