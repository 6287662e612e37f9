"""Which frames a picture or page shows, and how their counts become grey."""

from collections.abc import Sequence
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.evaluate.metrics import FrameKey, Score
from perception.picture import tone_map
from perception.types import Calibration, RawFrame

Item = TypeVar("Item")

_FAINT_SOFTENING = 0.001


def key_of(score: Score) -> FrameKey:
    """Return camera and index of the frame that a score belongs to."""
    return score.truth.camera, score.truth.index


def cameras_of(keys: Sequence[FrameKey]) -> list[str]:
    """Return the names of all cameras, in the order in which they appear."""
    return list(dict.fromkeys(camera for camera, _ in keys))


def spread(items: Sequence[Item], count: int) -> list[Item]:
    """Return at most `count` items, evenly spread, first and last among them."""
    if len(items) <= count:
        return list(items)
    return [items[round(index * (len(items) - 1) / (count - 1))] for index in range(count)]


def whole_picture(frame: RawFrame, calibration: Calibration, block_px: int) -> NDArray[np.uint8]:
    """Turn a frame into grey at the scale of a page: in means of blocks faint walls rise from the noise.

    Parameters
    ----------
    frame, calibration
        The frame, shape (rows, columns), and its camera.
    block_px
        Side of a block.

    Returns
    -------
    Grey values, uint8, shape (rows // block_px, columns // block_px).
    """
    rows, columns = frame.data_dn.shape
    small = (max(columns // block_px, 1), max(rows // block_px, 1))
    means_dn = cv2.resize(frame.data_dn.astype(np.float32), small, interpolation=cv2.INTER_AREA)
    return tone_map(
        np.asarray(means_dn, dtype=np.float32),
        frame.black_level_dn,
        float(calibration.saturation_dn),
        _FAINT_SOFTENING,
    )
