"""A rig and the robots around it, by numpy alone: what four cameras would see, and what detections would say."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.types import Calibration, Detection, RawFrame
from tests.unit.perception import simulation

Array = NDArray[np.float64]

NAMES = ("front", "left", "back", "right")
REACH_M = 0.06


def rig(own_source: bool = False, **changes: Any) -> dict[str, Calibration]:
    """Four cameras 90 degrees apart, each 6 cm out and 20 cm up, of 106° by 90° (the paper's)."""
    cameras = {}
    for quarter, name in enumerate(NAMES):
        turn = 0.5 * np.pi * quarter
        forward = np.array([np.cos(turn), np.sin(turn), 0.0])
        left = np.array([-np.sin(turn), np.cos(turn), 0.0])
        axes = np.column_stack([-left, [0.0, 0.0, -1.0], forward])  # camera x, y, z in body axes
        base = simulation.calibration(camera=f"r1.{name}")
        cameras[base.camera] = replace(
            base,
            rotation_body_camera=axes,
            position_body_m=REACH_M * forward + np.array([0.0, 0.0, 0.2]),
            own_sources_body_m=np.array([[0.0, 0.0, 0.28]]) if own_source else np.empty((0, 3)),
            **changes,
        )
    return cameras


def seen_by(
    camera: Calibration, position_body_m: Array, margin_px: float = 0.0
) -> tuple[float, float, float] | None:
    """Return u, v and range of a place, or None where it is not in view."""
    local = camera.rotation_body_camera.T @ (position_body_m - camera.position_body_m)
    if local[2] <= 0.05:
        return None
    u = camera.cx_px + camera.fx_px * local[0] / local[2]
    v = camera.cy_px + camera.fy_px * local[1] / local[2]
    inside = margin_px - 0.5 <= u <= camera.width_px - 0.5 - margin_px
    inside &= margin_px - 0.5 <= v <= camera.height_px - 0.5 - margin_px
    return (float(u), float(v), float(np.linalg.norm(local))) if inside else None


def frames_of(
    cameras: dict[str, Calibration],
    places_m: Sequence[Array],
    rng: np.random.Generator,
    exposure_s: float,
    flux: Sequence[float] | None = None,
) -> list[RawFrame]:
    """Return the frames of a set: sources by brute force, photons and read noise by numpy."""
    return exposed(cameras, means_of(cameras, places_m, exposure_s, flux), rng, exposure_s)


def exposed(
    cameras: dict[str, Calibration], means_e: Sequence[Array], rng: np.random.Generator, exposure_s: float
) -> list[RawFrame]:
    """Return one draw of the noise on the frames of a set."""
    return [
        simulation.expose(mean_e, camera, rng, exposure_s)
        for camera, mean_e in zip(cameras.values(), means_e, strict=True)
    ]


def means_of(
    cameras: dict[str, Calibration],
    places_m: Sequence[Array],
    exposure_s: float,
    flux: Sequence[float] | None = None,
) -> list[Array]:
    """Return the mean electrons of a set's frames."""
    means = []
    for camera in cameras.values():
        mean_e = np.full((camera.height_px, camera.width_px), 20.0)
        for place, factor in zip(places_m, flux or [1.0] * len(places_m), strict=True):
            if (seen := seen_by(camera, place, -60.0)) is not None:
                mean_e += simulation.expected_e(camera, [seen], exposure_s, gain_fault=factor)
        means.append(mean_e)
    return means


def frame_without_pixels(camera: Calibration, time_s: float = 0.25) -> RawFrame:
    """Return a frame that has nothing but its name and time."""
    return RawFrame(camera.camera, 3, time_s, 1e-3, np.zeros((1, 1), dtype=np.uint16), 64.0)


def detection(
    camera: Calibration,
    place_m: Array,
    rng: np.random.Generator,
    *,
    px: float = 0.02,
    relative: float = 0.005,
    common: float = 0.0,
    common_error: float = 0.0,
    factor: float = 1.0,
) -> Detection | None:
    """Return what a true estimator would say of a source, errors drawn; None where it is not in view.

    `factor` is by how much its range seems longer, as a mirror image's does, or one's in fog.
    """
    seen = seen_by(camera, place_m)
    if seen is None:
        return None
    u, v = seen[0] + px * rng.normal(), seen[1] + px * rng.normal()
    local = np.array([(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, 1.0])
    bearing = camera.rotation_body_camera @ (local / np.linalg.norm(local))
    range_m = seen[2] * factor * np.exp(relative * rng.normal() + common * common_error)
    return Detection(
        camera=camera.camera, index=3, time_s=0.25, u_px=u, v_px=v, u_sigma_px=px, v_sigma_px=px,
        flux_dn=1e4 / range_m**2, mean_dn=100.0, background_dn=64.0, area_px=9, saturated=False, merged=False,
        ghost=False, range_m=float(range_m), range_sigma_m=float(range_m * np.hypot(relative, common)),
        bearing_body=(float(bearing[0]), float(bearing[1]), float(bearing[2])),
        flux_sigma_dn=1.0, range_sigma_common_m=float(range_m * common),
    )  # fmt: skip
