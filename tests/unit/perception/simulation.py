"""Test frames of their own making: photons by brute force, noise by numpy's Philox."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from perception.types import Calibration, RawFrame

BLACK_DN = 64.0
FLUX_PER_S_AT_1_M = 1.4e9


def calibration(**changes: Any) -> Calibration:
    """The preset of the paper's rig, or a change of it."""
    base = Calibration(
        camera="r1.front",
        width_px=1280,
        height_px=960,
        fx_px=480.0,
        fy_px=480.0,
        cx_px=639.5,
        cy_px=479.5,
        rotation_body_camera=np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]),
        position_body_m=np.array([0.08, 0.0, 0.12]),
        system_gain_dn_per_e=0.74,
        read_noise_e=10.0,
        black_level_dn=BLACK_DN,
        saturation_dn=4095,
        bit_depth=12,
        psf_sigma_px=0.7,
        response_angle_rad=np.array([0.0, 1.1]),
        response_relative=np.array([1.0, 1.0]),
        range_constant_dn_m2_per_s=0.74 * FLUX_PER_S_AT_1_M,
        range_constant_paper_dn_m2_per_s=1.0e7,
        source_radius_m=0.01,
        wavelength_m=940e-9,
        sigma={"range_constant_dn_m2_per_s": 0.002 * 0.74 * FLUX_PER_S_AT_1_M},
    )
    return replace(base, **changes)


def random(*key: int) -> np.random.Generator:
    """A generator of its own for each key."""
    return np.random.Generator(np.random.Philox(np.random.SeedSequence(key)))


def project(direction: NDArray[np.float64], camera: Calibration) -> NDArray[np.float64]:
    """Image points of directions in camera axes, shape (n, 2)."""
    return np.column_stack(
        [
            camera.cx_px + camera.fx_px * direction[:, 0] / direction[:, 2],
            camera.cy_px + camera.fy_px * direction[:, 1] / direction[:, 2],
        ]
    )


def expected_e(
    camera: Calibration,
    sources: Sequence[tuple[float, float, float]],
    exposure_s: float,
    background_e: float = 0.0,
    gain_fault: float = 1.0,
) -> NDArray[np.float64]:
    """Mean electrons of sources at (u, v, range): brute force, independent of perception.model.flare.

    The image is sampled on a fine grid *in the image* (1/16 px or finer): a sample is lit if its direction
    lies within the sphere's cap; it weighs cos θ times its solid angle, cos³ θ, and is spread by a Gaussian
    sampled alike. Total flux: K t cos θ / d².
    """
    image = np.full((camera.height_px, camera.width_px), background_e)
    for u, v, range_m in sources:
        centre = np.array([(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, 1.0])
        cos_theta = 1.0 / np.linalg.norm(centre)
        centre = centre * cos_theta
        radius_rad = np.arcsin(camera.source_radius_m / range_m)
        radius_px = camera.fx_px * np.tan(radius_rad) / cos_theta**2
        fine = 32 if radius_px < 3 else 16
        theta_rad = np.arccos(cos_theta)  # outwards the image reaches farthest
        reach_px = camera.fx_px * (np.tan(theta_rad + radius_rad) - np.tan(theta_rad))
        half = int(np.ceil(reach_px + 6 * camera.psf_sigma_px + 1))
        left, top = round(u) - half, round(v) - half
        size = 2 * half + 1
        grid = (np.arange(size * fine) + 0.5) / fine - 0.5
        x = (left + grid - camera.cx_px) / camera.fx_px
        y = (top + grid - camera.cy_px) / camera.fy_px
        norm = np.sqrt(x[None, :] ** 2 + y[:, None] ** 2 + 1.0)
        depth = (x[None, :] * centre[0] + y[:, None] * centre[1] + centre[2]) / norm - np.cos(radius_rad)
        down, across = np.gradient(depth)
        # A sample on the rim counts by the part of it that lies inside.
        light = np.clip(0.5 + depth / (abs(down) + abs(across)).clip(1e-300), 0.0, 1.0) / norm**4
        if radius_px < 0.05:  # a point: let the Gaussian carry it all
            # A pixel's samples are a comb, narrower than the pixel by the variance of one sample's width.
            sigma_px = np.hypot(camera.psf_sigma_px, 1.0 / fine / np.sqrt(12.0))
            gx = np.exp(-0.5 * ((left + grid - u) / sigma_px) ** 2)
            gy = np.exp(-0.5 * ((top + grid - v) / sigma_px) ** 2)
            light = gy[:, None] * gx[None, :]
        else:
            light = gaussian_filter(light, camera.psf_sigma_px * fine, truncate=6.0, mode="constant")
        share = light.reshape(size, fine, size, fine).sum(axis=(1, 3))
        share /= share.sum()
        flux = (
            gain_fault
            * camera.range_constant_dn_m2_per_s
            / camera.system_gain_dn_per_e
            * exposure_s
            * cos_theta
            / range_m**2
        )
        rows = slice(max(0, top), min(camera.height_px, top + size))
        columns = slice(max(0, left), min(camera.width_px, left + size))
        if rows.stop <= rows.start or columns.stop <= columns.start:
            continue
        image[rows, columns] += (
            flux * share[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]
        )
    return image


def expose(
    mean_e: NDArray[np.float64], camera: Calibration, rng: np.random.Generator, exposure_s: float = 1e-3
) -> RawFrame:
    """Photons, read noise, gain, rounding, clipping."""
    e = rng.poisson(mean_e) + rng.normal(0.0, camera.read_noise_e, mean_e.shape)
    dn = np.rint(camera.system_gain_dn_per_e * e + camera.black_level_dn)
    return RawFrame(
        camera=camera.camera,
        index=3,
        time_s=0.25,
        exposure_s=exposure_s,
        data_dn=np.clip(dn, 0, camera.saturation_dn).astype(np.uint16),
        black_level_dn=camera.black_level_dn,
    )
