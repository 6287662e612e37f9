"""Which detection belongs to which source: without this, recall means nothing."""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from scipy.optimize import linear_sum_assignment

from nir_render.truth.lamps import LampTruth, Outline
from nir_render.truth.sources import SourceTruth
from perception.model import flare as flare_model
from perception.types import Calibration, Detection, FrameKey

Item = TypeVar("Item", SourceTruth, LampTruth, Detection)

GATE_PX = 3.0
MIN_VISIBLE_FRACTION = 0.5
MIN_PEAK_SNR = 5.0
_LAMP_MARGIN_PX = 5.0


@dataclass(frozen=True)
class FrameMatch:
    """One frame: index pairs (truth, detection), and the detections that belong to nothing."""

    pairs: tuple[tuple[int, int], ...]
    unmatched: tuple[int, ...]


def countable(truth: SourceTruth, calibration: Calibration) -> bool:
    """Tell whether a row counts for recall.

    It must be a source, not a ghost, in the image, at least half visible, lit, and of peak SNR 5 or more.
    """
    in_image = (
        -0.5 <= truth.u_px <= calibration.width_px - 0.5 and -0.5 <= truth.v_px <= calibration.height_px - 0.5
    )
    lit = truth.on_fraction > 0.0
    real = truth.ghost_of is None
    return (
        real
        and in_image
        and lit
        and truth.visible_fraction >= MIN_VISIBLE_FRACTION
        and truth.peak_snr >= MIN_PEAK_SNR
    )


def match(
    truth: Sequence[SourceTruth], detections: Sequence[Detection], calibration: Calibration
) -> FrameMatch:
    """Match sources, ghosts among them, and detections of one frame, one to one.

    As many pairs as possible within max(3 px, radius of the source's image), and among these the nearest.
    """
    distance_px = np.empty((len(truth), len(detections)))
    gates_px = np.array([max(GATE_PX, image_radius_px(row, calibration)) for row in truth])
    for i, row in enumerate(truth):
        for j, detection in enumerate(detections):
            distance_px[i, j] = np.hypot(detection.u_px - row.u_px, detection.v_px - row.v_px)
    within = distance_px <= gates_px[:, None] if truth else np.zeros(distance_px.shape, dtype=bool)
    # A pair beyond its gate costs more than all gates together, so it never displaces one within.
    beyond = 1.0 + gates_px.sum()
    rows, columns = linear_sum_assignment(np.where(within, distance_px, beyond))
    pairs = tuple((int(i), int(j)) for i, j in zip(rows, columns, strict=True) if within[i, j])
    taken = {j for _, j in pairs}
    return FrameMatch(pairs, tuple(j for j in range(len(detections)) if j not in taken))


def image_radius_px(truth: SourceTruth, calibration: Calibration) -> float:
    """Return the radius of a source's image along its longer axis; 0 where it is too near to have one."""
    if truth.range_m <= 2.0 * calibration.source_radius_m:
        return 0.0
    angle_rad = math.asin(calibration.source_radius_m / truth.range_m)
    return float(flare_model.image_radius_px(truth.u_px, truth.v_px, angle_rad, calibration))


def by_frame(items: Iterable[Item]) -> dict[FrameKey, list[Item]]:
    """Sort what belongs to frames by camera and index; a frame without any has no entry, or an empty list."""
    frames: dict[FrameKey, list[Item]] = defaultdict(list)
    for item in items:
        frames[item.camera, item.index].append(item)
    return frames


def on_a_lamp(detection: Detection, outlines_px: Sequence[Outline]) -> bool:
    """Tell whether a detection lies on a lamp, or within 5 px of one."""
    place = (detection.u_px, detection.v_px)
    corners = (np.array(outline, dtype=np.float32) for outline in outlines_px)
    return any(cv2.pointPolygonTest(one, place, measureDist=True) >= -_LAMP_MARGIN_PX for one in corners)
