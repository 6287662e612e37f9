"""What the detections of a set say, as arrays: where from, whither, how far, when, and how sure."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.bearing import bearing_body, pixel_turns
from perception.rig.frame_sets import Exposed
from perception.rig.rays import UNKNOWN_RANGE, Rays, axes_into
from perception.types import Calibration, Detection

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Flags = NDArray[np.bool_]

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
    frame: Indices
    rays: Rays
    together: Rays
    mounting_rad2: Array
    claimed: Flags
    saturated: Flags
    merged: Flags
    ghost: Flags


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
        ],
        dtype=np.float64,
    ).reshape(-1, 10)  # fmt: skip
    saturated, merged, ghost = np.ascontiguousarray(columns[:, 7:].T > 0.0)
    cameras = [calibrations[taken.camera] for taken in frames]
    of_frame = np.array(
        [
            (
                *camera.position_body_m, taken.time_s + 0.5 * taken.exposure_s, taken.line_time_s,
                camera.sigma.get("rotation_body_camera", 0.0), camera.sigma.get("position_body_m", 0.0),
            )
            for taken, camera in zip(frames, cameras, strict=True)
        ],
        dtype=np.float64,
    ).reshape(-1, 7)  # fmt: skip
    to_body = np.array([camera.rotation_body_camera.T for camera in cameras]).reshape(-1, 3, 3)
    turn = pixel_turns(columns[:, :2], cameras, frame) @ to_body[frame]
    rays, mounting_rad2, claimed = _rays(columns, frame, of_frame, turn, _bearings(hits, calibrations))
    return Sightings(
        keys=tuple(
            (hit.camera, hit.index, number) for found in detections for number, hit in enumerate(found)
        ),
        frame=frame,
        rays=rays,
        together=rays,
        mounting_rad2=mounting_rad2,
        claimed=claimed,
        saturated=saturated,
        merged=merged,
        ghost=ghost,
    )


@compiled
def _rays(
    columns: Array, frame: Indices, of_frame: Array, turn: Array, bearing: Array
) -> tuple[Rays, Array, Flags]:
    """Return sightings as rays, the variance by their cameras' mounting, and whether σ are claimed.

    Parameters
    ----------
    columns
        u, v and their σ in px, range, its σ and the common part of it in m, saturated, merged, ghost,
        shape (n, 10).
    frame
        Which frame each is of, shape (n,).
    of_frame
        Camera's centre in m, middle of the exposure and time of a line in s, σ of its rotation in rad and of
        its place in m, shape (frames, 7).
    turn
        How far the direction turns over a pixel along u, and along v, in body axes, shape (n, 2, 3).
    bearing
        Unit vectors, shape (n, 3).
    """
    n = len(columns)
    rays = Rays(
        np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 2, 2)), np.full(n, np.nan),
        np.full(n, UNKNOWN_RANGE), np.zeros(n), np.empty(n),
    )  # fmt: skip
    mounting_rad2, claimed, slope = np.empty(n), np.empty(n, dtype=np.bool_), np.empty((2, 2))
    for i in range(n):
        _, v_px, u_sigma_px, v_sigma_px, range_m, sigma_m, common_m, saturated = columns[i, :8]
        middle_s, line_s, turned_rad, moved_m = of_frame[frame[i], 3:]
        rays.origin_m[i] = of_frame[frame[i], :3]
        rays.time_s[i] = middle_s + line_s * v_px
        # Of a clipped flare that was not recovered the range is but a bound.
        is_claimed = math.isfinite(sigma_m)
        is_known = 0.0 < range_m < FARTHEST_KNOWN_M and (is_claimed or saturated == 0.0)
        if is_known:
            rays.range_m[i], rays.noise[i] = range_m, UNCLAIMED_RANGE
        if is_known and is_claimed:
            common2 = 0.0 if math.isnan(common_m) else (common_m / range_m) ** 2
            of_source2 = common2 - min(CAMERAS_SHARE * common2, CAMERAS_MOST**2)
            rays.noise[i] = math.sqrt(max((sigma_m / range_m) ** 2 - of_source2, LEAST_NOISE**2))
            rays.common[i] = math.sqrt(of_source2)
        claimed[i] = math.isfinite(u_sigma_px + v_sigma_px) and (is_claimed or not is_known)
        mounting_rad2[i] = turned_rad**2 + (moved_m / (range_m if is_known else 1.0)) ** 2
        axes_into(rays.axes[i], bearing[i])
        for pixel in range(2):
            sigma_px = u_sigma_px if pixel == 0 else v_sigma_px
            sigma_px = max(sigma_px if math.isfinite(sigma_px) else UNCLAIMED_PX, LEAST_PX)
            for a in range(2):
                along = 0.0
                for k in range(3):
                    along += rays.axes[i, a, k] * turn[i, pixel, k]
                slope[a, pixel] = along * sigma_px
        for a in range(2):
            for b in range(2):
                rays.angular_rad2[i, a, b] = slope[a, 0] * slope[b, 0] + slope[a, 1] * slope[b, 1]
            rays.angular_rad2[i, a, a] += mounting_rad2[i]
    return rays, mounting_rad2, claimed


def _bearings(hits: Sequence[Detection], calibrations: Mapping[str, Calibration]) -> Array:
    """Return the unit vectors that detections say; those of their pixels where they say none."""
    bearing = np.array([hit.bearing_body for hit in hits]).reshape(-1, 3)
    for k in np.flatnonzero(~np.isfinite(bearing).all(axis=1)).tolist():
        bearing[k] = bearing_body([[hits[k].u_px, hits[k].v_px]], calibrations[hits[k].camera])[0]
    return bearing
