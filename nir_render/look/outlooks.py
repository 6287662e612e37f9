"""From where a scene is looked at, so that all that matters of it is in the picture."""

import numpy as np
from numpy.typing import NDArray

from nir_render.scene.snapshot import Snapshot
from nir_render.transport.outside import Outlook

Array = NDArray[np.float64]

_MARGIN_M = 0.5
_MOST_TALL = 1.0  # of a picture from above, over its width
_LEAST_REACH_M = 1.0
_AZIMUTH_RAD, _ELEVATION_RAD = np.deg2rad(-125.0), np.deg2rad(38.0)
_HALF_FIELD = 0.5  # of the tangent, along the picture's shorter side


def interest_m(snapshot: Snapshot, bounds_m: Array) -> Array:
    """Return the box that is worth a look, lowest and highest corner, shape (2, 3).

    It holds all robots, lamps and beacons, and of the bodies, `bounds_m` of shape (n, 2, 3), what is no
    farther from them than they are from each other: a ground of 300 m is not shown whole.
    """
    places = [robot.pose.position_m for robot in snapshot.robots.values()]
    places += [placed.pose.position_m for placed in snapshot.sources.values()]
    places += [np.array(lamp.center_m) for lamp in snapshot.lamps.values()]
    low_m, high_m = np.min(places, axis=0), np.max(places, axis=0)
    reach_m = max(_LEAST_REACH_M, 0.5 * float(np.linalg.norm(high_m - low_m)))
    if len(bounds_m):
        low_m = np.minimum(low_m, np.maximum(bounds_m[:, 0].min(axis=0), low_m - reach_m))
        high_m = np.maximum(high_m, np.minimum(bounds_m[:, 1].max(axis=0), high_m + reach_m))
    return np.stack([low_m - _MARGIN_M, high_m + _MARGIN_M])


def from_above(box_m: Array, width_px: int) -> Outlook:
    """Return the outlook straight down, x to the right and y up, that holds a box."""
    size_m = box_m[1] - box_m[0]
    per_px = max(float(size_m[0]) / width_px, float(size_m[1]) / (_MOST_TALL * width_px))
    middle_m = np.array([*box_m.mean(axis=0)[:2], box_m[1, 2] + 1.0])
    rotation = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    across_px, along_px = (max(round(float(one) / per_px), 8) for one in size_m[:2])
    return Outlook(middle_m, rotation, per_px, across_px, along_px, True)


def from_outside(box_m: Array, width_px: int, height_px: int) -> Outlook:
    """Return the outlook from a corner above that holds a box."""
    towards = -np.array(
        [
            np.cos(_ELEVATION_RAD) * np.cos(_AZIMUTH_RAD),
            np.cos(_ELEVATION_RAD) * np.sin(_AZIMUTH_RAD),
            np.sin(_ELEVATION_RAD),
        ]
    )
    right = np.cross(towards, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(towards, right), towards], axis=1)
    corners = np.stack(np.meshgrid(*box_m.T, indexing="ij"), axis=-1).reshape(-1, 3)
    local_m = (corners - box_m.mean(axis=0)) @ rotation
    per_px = 2.0 * _HALF_FIELD / min(width_px, height_px)
    half = 0.5 * per_px * np.array([width_px, height_px])
    # So far back and so far aside that the corners fill the field, which follow from each other.
    back_m, aside_m = 0.0, np.zeros(2)
    for _ in range(12):
        back_m = float(np.max(np.abs(local_m[:, :2] - aside_m) / half - local_m[:, 2:]))
        tangent = (local_m[:, :2] - aside_m) / (local_m[:, 2:] + back_m)
        aside_m += 0.5 * (tangent.max(axis=0) + tangent.min(axis=0)) * back_m
    back_m = float(np.max(np.abs(local_m[:, :2] - aside_m) / half - local_m[:, 2:]))
    eye_m = box_m.mean(axis=0) + rotation @ np.array([*aside_m, -back_m])
    return Outlook(eye_m, rotation, per_px, width_px, height_px, False)
