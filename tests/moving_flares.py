"""Frames of spheres that move while they are exposed, by brute force: it shares no code with `perception`."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.types import Calibration
from tests.unit.perception.simulation import calibration, random

LIT_S = 2e-4
NEAREST_M, FARTHEST_M, LONGEST_PX = 0.7, 6.0, 5.0
APART_PX = 80
FINE, HALF = 12, 18
CAMERA = calibration(width_px=640, height_px=480, cx_px=319.5, cy_px=239.5)

Array = NDArray[np.float64]


def drawn_out_e(
    camera: Calibration, u: float, v: float, range_m: float, way_px: tuple[float, float]
) -> tuple[int, int, Array]:
    """Return the mean electrons of a sphere that moves evenly by `way_px`: left, top, shape (rows, columns).

    The cap of directions that the sphere fills, on `FINE`² samples a pixel; the point spread and the way are
    taken in by their transforms, exp(−2 π² σ² k²) and sinc(k · way).
    """
    left, top, size = round(u) - HALF, round(v) - HALF, (2 * HALF + 1) * FINE
    centre = np.array([(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, 1.0])
    cos_theta = 1.0 / float(np.linalg.norm(centre))
    centre *= cos_theta
    grid = (np.arange(size) + 0.5) / FINE - 0.5
    x = (left + grid - camera.cx_px) / camera.fx_px
    y = ((top + grid - camera.cy_px) / camera.fy_px)[:, None]
    norm = np.sqrt(x**2 + y**2 + 1.0)
    cap = np.cos(np.arcsin(camera.source_radius_m / range_m))
    depth = (x * centre[0] + y * centre[1] + centre[2]) / norm - cap
    down, across = np.gradient(depth)
    light = np.clip(0.5 + depth / (abs(down) + abs(across)).clip(1e-300), 0.0, 1.0) / norm**4
    k_u, k_v = np.fft.rfftfreq(size, 1.0 / FINE), np.fft.fftfreq(size, 1.0 / FINE)[:, None]
    spread = np.exp(-2.0 * np.pi**2 * camera.psf_sigma_px**2 * (k_u**2 + k_v**2))
    spread *= np.sinc(k_u * way_px[0] + k_v * way_px[1])
    blurred = np.fft.irfft2(np.fft.rfft2(light) * spread, light.shape)
    share = blurred.reshape(2 * HALF + 1, FINE, 2 * HALF + 1, FINE).sum(axis=(1, 3)).clip(0.0)
    at_1_m_e = camera.range_constant_dn_m2_per_s / camera.system_gain_dn_per_e * LIT_S
    return left, top, at_1_m_e * cos_theta / range_m**2 * share / share.sum()


def drawn(key: int) -> tuple[Array, Array]:
    """Return a frame's mean electrons, and its sources: u, v, range and length of each."""
    rng = random(1691, key)
    mean_e = np.full((CAMERA.height_px, CAMERA.width_px), float(rng.choice([0.0, 20.0, 200.0])))
    sources = []
    for row in range(APART_PX // 2, CAMERA.height_px, APART_PX):
        for column in range(APART_PX // 2, CAMERA.width_px, APART_PX):
            u, v = (row_or_column + rng.uniform(-5.0, 5.0) for row_or_column in (column, row))
            range_m = float(np.exp(rng.uniform(np.log(NEAREST_M), np.log(FARTHEST_M))))
            length, angle = rng.uniform(0.0, LONGEST_PX), rng.uniform(0.0, np.pi)
            way_px = (length * np.cos(angle), length * np.sin(angle))
            left, top, flare_e = drawn_out_e(CAMERA, u, v, range_m, way_px)
            mean_e[top : top + len(flare_e), left : left + len(flare_e)] += flare_e
            sources.append((u, v, range_m, length))
    return mean_e, np.array(sources)


def lit_for(exposure_s: float) -> dict[str, Any]:
    """Return the range constant, and its σ, of sources that give the light of `LIT_S` in an exposure."""
    constant = CAMERA.range_constant_dn_m2_per_s * LIT_S / exposure_s
    sigma = {name: one * LIT_S / exposure_s for name, one in CAMERA.sigma.items()}
    return {"range_constant_dn_m2_per_s": constant, "sigma": sigma}
