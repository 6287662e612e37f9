"""What is as bright as near sources: their discs cover much of a frame, and are no part of its background."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.model.ranging import brightness_e, constant_spread
from perception.robust.search.background import as_wide
from perception.robust.search.frame import above
from perception.types import Calibration, RawFrame

_OF_BRIGHTNESS = 0.5
_WINGS_SIGMAS = 4.0  # of the point spread, filtered
_BRIGHTER = 1.3
_LEAST_SHARE = 0.02  # of a cell: of less the scatter knows nothing, as it is blind to its outer thirds
_MOST_SHARE = 0.5  # of which there is more, that is the ground
_LEAST_CELLS = 0.08  # of a frame: what lies around a few may be its structure


def brightness_mesh_e(
    frame: RawFrame, calibration: Calibration, cells: tuple[int, int]
) -> NDArray[np.float64]:
    """Return how bright pixels are, in each cell, that the image of a source covers (`brightness_e`)."""
    (down, across), (height, width) = cells, (calibration.height_px, calibration.width_px)
    v_px, u_px = np.meshgrid(
        (np.arange(down) + 0.5) * height / down - 0.5,
        (np.arange(across) + 0.5) * width / across - 0.5,
        indexing="ij",
    )
    places_px = np.column_stack([u_px.ravel(), v_px.ravel()])
    return brightness_e(places_px, frame.exposure_s, frame.gain, calibration).reshape(cells)


def most_brightness(calibration: Calibration) -> float:
    """Return how many times as bright as a source of its calibration may be what is one."""
    return _BRIGHTER * (1.0 + 4.0 * constant_spread(calibration))


def near_sources(
    lit_at: NDArray[np.int64],
    lit_e: NDArray[np.float32],
    of_source_mesh_e: NDArray[np.floating],
    clips_mesh_e: NDArray[np.floating],
    least_mesh_e: NDArray[np.floating],
    calibration: Calibration,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]] | None:
    """Mark what may be discs of near sources, and their wings.

    Parameters
    ----------
    lit_at, lit_e
        Pixels above the detection limit, as indices in the frame, and the filtered image there.
    of_source_mesh_e, clips_mesh_e
        How bright pixels are, in each cell, that a source covers (`brightness_mesh_e`), and what clips.
    least_mesh_e
        So bright they must be at least.
    calibration
        Of the camera.

    Returns
    -------
    A mask of the frame, and in or beside which cells of the mesh these are so many that they count; None
    where there are none.
    """
    import cv2

    (down, across), (height, width) = clips_mesh_e.shape, (calibration.height_px, calibration.width_px)
    if not ((of_source_mesh_e > 0.0) & np.isfinite(of_source_mesh_e)).any():  # points cover nothing
        return None
    bright_e = (_OF_BRIGHTNESS * np.fmin(of_source_mesh_e, clips_mesh_e)).astype(np.float32)
    bright_e[~(bright_e > least_mesh_e)] = np.inf
    most_e = most_brightness(calibration) * of_source_mesh_e
    most_e = np.where(most_e < clips_mesh_e, most_e, np.inf).astype(np.float32)
    is_bright = above(lit_at, lit_e, as_wide(bright_e, calibration), height)
    is_brighter = above(lit_at, lit_e, as_wide(most_e, calibration), height)
    places = lit_at[is_bright & ~is_brighter]
    cell = places // width * down // height * across + places % width * across // width
    count = np.bincount(cell, minlength=down * across).reshape(down, across)
    share = count * (down * across) / (height * width)
    many = ((share > _LEAST_SHARE) & (share < _MOST_SHARE)).astype(np.uint8)
    if many.sum() < max(1.0, _LEAST_CELLS * many.size):
        return None
    bright = np.zeros((height, width), dtype=np.uint8)
    bright.ravel()[places] = 1
    side = 2 * math.ceil(_WINGS_SIGMAS * math.sqrt(2.0 * calibration.psf_sigma_px**2 + 1.0 / 6.0)) + 1
    bright = np.asarray(cv2.dilate(bright, np.ones((side, side), np.uint8)))
    many = np.asarray(cv2.dilate(many, np.ones((3, 3), np.uint8))).reshape(down, across)
    return bright > 0, many > 0
