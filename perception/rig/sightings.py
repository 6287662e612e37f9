"""What the detections of a set say, as arrays: where from, whither, how far, when, and how sure."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.model.bearing import bearing_body, pixel_turn
from perception.rig.frame_sets import Exposed
from perception.rig.rays import UNKNOWN_RANGE, Rays
from perception.types import Calibration, Detection, bearing_axes

Array = NDArray[np.float64]

UNCLAIMED_PX = 1.0
"""Standard deviation that the place of a detection is given in association where none is claimed."""

UNCLAIMED_RANGE = 0.3
"""As for a range, relatively."""

LEAST_PX, LEAST_NOISE = 1e-3, 1e-4
"""No place and no range, relatively, is taken to be better than this."""

FARTHEST_KNOWN_M = 1e4
"""A range beyond is none."""

CAMERAS_SHARE, CAMERAS_MOST = 0.5, 0.01
"""The part of the common error's variance that is a camera's own, as its K was calibrated by itself, and
the most that it is of a range. The rest is the source's, as LEDs differ, and shared by all cameras."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """The detections of a set, n of them.

    Attributes
    ----------
    keys
        Camera, index and number among the detections of its frame.
    frame
        Which frame of the set, shape (n,).
    rays
        What they say of the source's place.
    together
        The same for sightings of several cameras: less sure where the observer moved between (`moving`).
    mounting_rad2
        Of the angular variances what comes of the cameras' mounting, shape (n,).
    claimed
        Whether the estimator claims the standard deviations, shape (n,).
    saturated, merged, ghost
        As of the detection, shape (n,).
    """

    keys: tuple[tuple[str, int, int], ...]
    frame: NDArray[np.int64]
    rays: Rays
    together: Rays
    mounting_rad2: Array
    claimed: NDArray[np.bool_]
    saturated: NDArray[np.bool_]
    merged: NDArray[np.bool_]
    ghost: NDArray[np.bool_]


def sightings_of(
    frames: Sequence[Exposed],
    detections: Sequence[Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
) -> Sightings:
    """Return what the detections of each frame say.

    Parameters
    ----------
    frames
        The frames of a set, or their records.
    detections
        Those of each frame.
    calibrations
        Of each camera, by its name. What their `sigma` says of `rotation_body_camera` (rad) and
        `position_body_m` counts as uncertainty of each bearing.
    """
    hits = [hit for found in detections for hit in found]
    frame = np.repeat(np.arange(len(frames)), [len(found) for found in detections])
    columns = np.array(
        [
            [
                hit.u_px, hit.v_px, hit.u_sigma_px, hit.v_sigma_px, hit.range_m, hit.range_sigma_m,
                hit.range_sigma_common_m, hit.saturated, hit.merged, hit.ghost,
            ]
            for hit in hits
        ]
    ).reshape(-1, 10).T  # fmt: skip
    u_px, v_px, u_sigma_px, v_sigma_px, range_m, sigma_m, common_m = columns[:7]
    saturated, merged, ghost = np.ascontiguousarray(columns[7:].astype(bool))
    axes = bearing_axes(_bearings(hits, calibrations))
    ranged = (range_m > 0.0) & (range_m < FARTHEST_KNOWN_M)
    # Of a clipped flare that was not recovered the range is but a bound.
    bound = saturated & ~np.isfinite(sigma_m)
    known = ranged & ~bound
    claimed = known & np.isfinite(sigma_m)
    at_m = np.where(known, range_m, 1.0)
    shared = np.where(claimed, np.nan_to_num(common_m) / at_m, 0.0)
    of_camera2 = np.minimum(CAMERAS_SHARE * shared**2, CAMERAS_MOST**2)
    of_source2 = shared**2 - of_camera2
    noise2 = np.where(claimed, np.nan_to_num(sigma_m) / at_m, 0.0) ** 2 - of_source2
    noise = np.where(claimed, np.sqrt(np.maximum(noise2, LEAST_NOISE**2)), UNCLAIMED_RANGE)
    common = np.sqrt(of_source2)
    sigmas_px = np.column_stack([u_sigma_px, v_sigma_px])
    sigmas_px = np.maximum(np.where(np.isfinite(sigmas_px), sigmas_px, UNCLAIMED_PX), LEAST_PX)
    places_px, end, turn = np.column_stack([u_px, v_px]), 0, np.empty((len(hits), 2, 3))
    of_frame = np.empty((len(frames), 7))
    for row, (taken, found) in enumerate(zip(frames, detections, strict=True)):
        these, calibration = slice(end, end := end + len(found)), calibrations[taken.camera]
        if found:
            turn[these] = pixel_turn(places_px[these], calibration) @ calibration.rotation_body_camera.T
        of_frame[row, :3] = calibration.position_body_m
        of_frame[row, 3:] = (
            taken.time_s + 0.5 * taken.exposure_s,
            taken.line_time_s,
            calibration.sigma.get("rotation_body_camera", 0.0),
            calibration.sigma.get("position_body_m", 0.0),
        )
    middle_s, line_s, turned_rad, moved_m = of_frame[frame, 3:].T
    slope = axes[:, :2] @ np.swapaxes(turn, 1, 2) * sigmas_px[:, None, :]
    mounting_rad2 = turned_rad**2 + (moved_m / at_m) ** 2
    origin_m, time_s = of_frame[frame, :3], middle_s + line_s * v_px
    angular_rad2 = slope @ np.swapaxes(slope, 1, 2) + mounting_rad2[:, None, None] * np.eye(2)
    rays = Rays(
        origin_m,
        axes,
        angular_rad2,
        np.where(known, range_m, np.nan),
        np.where(known, noise, UNKNOWN_RANGE),
        common,
        time_s,
    )
    return Sightings(
        keys=tuple(
            (hit.camera, hit.index, number) for found in detections for number, hit in enumerate(found)
        ),
        frame=frame,
        rays=rays,
        together=rays,
        mounting_rad2=mounting_rad2,
        claimed=np.isfinite(u_sigma_px + v_sigma_px) & (claimed | ~known),
        saturated=saturated,
        merged=merged,
        ghost=ghost,
    )


def _bearings(hits: Sequence[Detection], calibrations: Mapping[str, Calibration]) -> Array:
    """Return the unit vectors that detections say; those of their pixels where they say none."""
    bearing = np.array([hit.bearing_body for hit in hits]).reshape(-1, 3)
    for k in np.flatnonzero(~np.isfinite(bearing).all(axis=1)).tolist():
        bearing[k] = bearing_body([[hits[k].u_px, hits[k].v_px]], calibrations[hits[k].camera])[0]
    return bearing
