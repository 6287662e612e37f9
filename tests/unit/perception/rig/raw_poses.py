"""Raw frames of a robot with several LEDs, by brute force: spheres that hide each other, photons and read noise."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from perception.model.fisher import flare_limits
from perception.rig.measure_set import detect_set
from perception.types import Calibration, Layout, RawFrame, RobotPose
from tests.unit.perception.rig.poses import COMMON, heading_sigma_rad, turned
from tests.unit.perception.rig.world import seen_by
from tests.unit.perception.simulation import FLUX_PER_S_AT_1_M, expose

Array = NDArray[np.float64]

EXPOSURE_S, BACKGROUND_E = 2.2e-4, 20.0
SAMPLES, REACH_PX, REGION_PX = 16, 6, 128


def places_of(layout: Layout, pose: Array) -> list[Array]:
    """Return where the sources of a robot are that stands at x, y, z, heading."""
    return [pose[:3] + turned(pose[3]) @ np.array(place) for place in layout.places_body_m]


def cropped(cameras: dict[str, Calibration], layout: Layout, pose: Array) -> dict[str, Calibration]:
    """Return the cameras that see a source of the robot, read out around it."""
    around = {}
    for name, camera in cameras.items():
        seen = [at for place in places_of(layout, pose) if (at := seen_by(camera, place)) is not None]
        if not seen:
            continue
        u, v = (round(float(np.mean([at[k] for at in seen]))) for k in range(2))
        left, top = max(u - REGION_PX, 0), max(v - REGION_PX, 0)
        right, bottom = min(u + REGION_PX, camera.width_px), min(v + REGION_PX, camera.height_px)
        around[name] = replace(
            camera, width_px=right - left, height_px=bottom - top,
            cx_px=camera.cx_px - left, cy_px=camera.cy_px - top,
        )  # fmt: skip
    return around


def frames_of_robot(
    cameras: dict[str, Calibration], layout: Layout, pose: Array, rng: np.random.Generator
) -> list[RawFrame]:
    """Return a frame of each camera."""
    places = places_of(layout, pose)
    return [
        expose(mean_e(camera, places, layout.relative_flux), camera, rng, EXPOSURE_S)
        for camera in cameras.values()
    ]


def photographed(
    cameras: dict[str, Calibration], layout: Layout, pose: Array, rng: np.random.Generator
) -> tuple[tuple[RobotPose, ...], tuple[int, ...], float]:
    """Look (`poses.Look`) by raw frames of a region around the robot; one of whom a flare is missing is told, too."""
    around = cropped(cameras, layout, pose)
    seen = detect_set(frames_of_robot(around, layout, pose, rng), around)
    if len(seen.robots) != 1:
        return (), (), math.nan
    places, sources = places_of(layout, pose), []
    for camera, _, number in seen.robots[0].flares:
        (hit,) = [each[number] for each in seen.detections if each and each[0].camera == camera]
        off_px = [
            math.inf if at is None else math.hypot(hit.u_px - at[0], hit.v_px - at[1])
            for at in (seen_by(around[camera], place, -40.0) for place in places)
        ]
        sources.append(int(np.argmin(off_px)))
    return seen.robots, tuple(sources), bound_of_frames_rad(around, layout, pose)


def mean_e(camera: Calibration, places: Sequence[Array], relative_flux: Sequence[float]) -> Array:
    """Return the mean electrons of a frame in which each direction shows the nearest sphere."""
    seen = [seen_by(camera, place, -40.0) for place in places]
    image = np.full((camera.height_px, camera.width_px), BACKGROUND_E)
    for at, flux in zip(seen, relative_flux, strict=True):
        if at is None:
            continue
        radius_px = camera.fx_px * camera.source_radius_m / at[2]
        half = math.ceil(3.0 * radius_px) + REACH_PX  # off the axis an image is longer than on it
        left, top, size = round(at[0]) - half, round(at[1]) - half, 2 * half + 1
        fine = (np.arange(size * SAMPLES) + 0.5) / SAMPLES - 0.5
        x, y = np.meshgrid(
            (left + fine - camera.cx_px) / camera.fx_px, (top + fine - camera.cy_px) / camera.fy_px
        )
        cosine = 1.0 / np.sqrt(1.0 + x**2 + y**2)
        lit = _disc(camera, x, y, cosine, at)
        for other in seen:
            if other is not None and other[2] < at[2]:
                lit *= 1.0 - _disc(camera, x, y, cosine, other)
        radiance = flux * FLUX_PER_S_AT_1_M / (math.pi * camera.source_radius_m**2)
        light = lit * radiance * EXPOSURE_S * cosine**4 / (camera.fx_px * SAMPLES) ** 2
        spread = gaussian_filter(light, camera.psf_sigma_px * SAMPLES, truncate=6.0, mode="constant")
        pixels = spread.reshape(size, SAMPLES, size, SAMPLES).sum(axis=(1, 3))
        rows, columns = slice(max(top, 0), max(top + size, 0)), slice(max(left, 0), max(left + size, 0))
        part = image[rows, columns]
        part += pixels[rows.start - top :, columns.start - left :][: part.shape[0], : part.shape[1]]
    return image


def _disc(camera: Calibration, x: Array, y: Array, cosine: Array, at: tuple[float, float, float]) -> Array:
    """Return how much of each sample of a window a sphere at u, v, range covers."""
    middle = np.array([(at[0] - camera.cx_px) / camera.fx_px, (at[1] - camera.cy_px) / camera.fy_px, 1.0])
    middle /= np.linalg.norm(middle)
    # Twice the sine of half the angle between directions, without cancellation; edges soft over a sample.
    away = np.sqrt((x * cosine - middle[0]) ** 2 + (y * cosine - middle[1]) ** 2 + (cosine - middle[2]) ** 2)
    radius = 2.0 * math.sin(0.5 * math.asin(camera.source_radius_m / at[2]))
    return np.asarray(np.clip(0.5 + (radius - away) * camera.fx_px * SAMPLES, 0.0, 1.0))


def bound_of_frames_rad(cameras: dict[str, Calibration], layout: Layout, pose: Array) -> float:
    """Return the least σ of a heading, from the bounds of each flare in the others' light, by differences.

    Unknown are x, y, z, heading and the range constant's error.
    """
    sigmas: dict[tuple[str, int], tuple[float, float, float]] = {}
    for name, camera in cameras.items():
        exact = {
            number: at
            for number, place in enumerate(places_of(layout, pose))
            if (at := seen_by(camera, place))
        }
        flares = []
        for number, (u, v, range_m) in exact.items():
            cosine = 1.0 / math.hypot(
                (u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, 1.0
            )
            flux = layout.relative_flux[number] * FLUX_PER_S_AT_1_M * EXPOSURE_S * cosine / range_m**2
            flares.append((u, v, range_m, flux))
        # However little the camera's own constant is known: the layout knows the fluxes so well.
        constant = 2.0 * COMMON * camera.range_constant_dn_m2_per_s
        tied = replace(camera, sigma={"range_constant_dn_m2_per_s": constant})
        limits = flare_limits(tied, flares, BACKGROUND_E) if flares else []
        for (number, at), limit in zip(exact.items(), limits, strict=True):
            relative = math.sqrt(max((limit.range_sigma_m / at[2]) ** 2 - COMMON**2, 1e-8))
            sigmas[name, number] = (limit.u_sigma_px, limit.v_sigma_px, relative)

    def seen(unknown: Array) -> Array:
        told = []
        for (name, number), (u_px, v_px, relative) in sigmas.items():
            at = seen_by(cameras[name], places_of(layout, unknown[:4])[number], -5.0)
            assert at is not None
            told += [at[0] / u_px, at[1] / v_px, (math.log(at[2]) + COMMON * unknown[4]) / relative]
        return np.array(told)

    if not sigmas or not np.isfinite(list(sigmas.values())).all():
        return math.inf
    return heading_sigma_rad(seen, pose)
