"""Large discs, whole, alone and not clipped: one fit explains them, with no look at outlines or piles."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import direction_camera
from perception.model.layout import SEEN
from perception.model.sensor import pixel_variance_e2
from perception.model.window import Camera
from perception.robust.clusters import LEAST_RANGE_M, Candidate, Cluster
from perception.robust.forward_light import fit_beside_forward_light
from perception.robust.goodness import MODEL_ERROR
from perception.robust.overlap.limb import may_be_other_shape
from perception.robust.problem import Window
from perception.robust.search.blobs import half_axes_px
from perception.robust.search.prepare import PreparedFrame
from perception.robust.solve import Solution

MOST_FITTED_RADIUS_PX = 130.0
"""So far are images laid out exactly (`model.discs`)."""

_OF_ITS_BOX = (0.55, 0.85)  # parts of the box around it that an ellipse fills: π/4 where it is upright
_OF_ITS_CIRCLE = (0.3, 1.3)  # and of the circle that its light says
_MOST_LONGER = 1.15  # than the lens makes it
_MOST_CHI2 = 2.0  # for each pixel: with more left over nothing is explained


def as_whole_discs(found: Sequence[Cluster], prepared: PreparedFrame) -> dict[Cluster, Cluster]:
    """Return clusters that seem to be one large disc, each with itself as it is to be fitted.

    Fits of what is none are given up early.
    """
    return {
        cluster: replace(cluster, window=replace(cluster.window, to_beat=_most_deviance(cluster.window)))
        for cluster in found
        if len(cluster.members) == 1 and _seems_whole(cluster.members[0], prepared)
    }


def explained_by_one(solutions: Mapping[Cluster, Solution | None], camera: Camera) -> dict[Cluster, Solution]:
    """Return the clusters of which one disc, whole and far enough away, leaves nothing over."""
    fits = [
        None if one is None else replace(one, window=cluster.window) for cluster, one in solutions.items()
    ]
    fit_beside_forward_light(fits, camera)
    return {
        cluster: one
        for cluster, one in zip(solutions, fits, strict=True)
        if one is not None and one.left_over.is_nothing and one.ranged.all()
        if float(one.log_range.min()) >= math.log(LEAST_RANGE_M)
        if not may_be_other_shape(one, camera)
    }


def _seems_whole(member: Candidate, prepared: PreparedFrame) -> bool:
    """Tell whether a blob is whole, as long as a source, and as large as one of its light."""
    if member.is_clipped or not 0.0 < member.image_radius_px < MOST_FITTED_RADIUS_PX:
        return False
    if member.blob.box.touches_border(prepared.shape):
        return False
    if member.log_range(member.flux_e) < math.log(LEAST_RANGE_M):
        return False
    lit = member.blob.bright_half
    least, most = _OF_ITS_CIRCLE
    is_as_large = least < np.count_nonzero(lit) / (math.pi * member.image_radius_px**2) < most
    return bool(is_as_large) and _is_ellipse(lit, member, prepared)


def _is_ellipse(lit: NDArray[np.bool_], member: Candidate, prepared: PreparedFrame) -> bool:
    """Tell whether what is lit fills its box as an ellipse does, and is no longer than the lens makes it."""
    height, width = np.ptp(np.argwhere(lit), axis=0) + 1
    least, most = _OF_ITS_BOX
    if not least < np.count_nonzero(lit) / (height * width) < most:
        return False
    direction = direction_camera([(member.u_px, member.v_px)], prepared.calibration)[0]
    shorter_px, longer_px = half_axes_px(lit)
    return bool(longer_px * abs(direction[2]) < _MOST_LONGER * shorter_px)


def _most_deviance(window: Window) -> float:
    """Return −2 ln L of a fit that leaves a window's pixels hardly explained: by noise as they are seen."""
    seen_e = window.image_e[window.state == SEEN]
    variance = pixel_variance_e2(seen_e, window.floor_e2, window.prnu)
    by_model = (MODEL_ERROR * seen_e) ** 2
    return float(np.sum(np.log(variance) + _MOST_CHI2 * (1.0 + by_model / variance)))
