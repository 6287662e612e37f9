"""What `robust` makes of flares that move in an exposure: one JSON object. A minute; `--frames 40` for more.

Spheres of the paper's rig, 0.7 to 6 m away, each drawn out evenly along a line of up to 5 px; their images by
brute force on a fine grid, photons and read noise by NumPy. For each length: how many are taken for two and
more, how many are not found, ranges and the errors over the σ that they claim. The line to hold is a split of
one in a thousand.
"""

import argparse
import json
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))

from perception.estimators import detect_frames
from perception.types import Calibration
from tests.unit.perception.simulation import calibration, expose, random

EXPOSURE_S = 2e-4
NEAREST_M, FARTHEST_M, LONGEST_PX = 0.7, 6.0, 5.0
APART_PX, NEAR_PX = 80, 25.0
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
    at_1_m_e = camera.range_constant_dn_m2_per_s / camera.system_gain_dn_per_e * EXPOSURE_S
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


def main() -> None:
    """Print the figures, by length in whole pixels."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--draws", type=int, default=10)
    chosen = parser.parse_args()
    count: dict[int, list[int]] = defaultdict(list)
    errors: dict[int, list[tuple[float, float]]] = defaultdict(list)
    started = time.perf_counter()
    for key in range(chosen.frames):
        mean_e, sources = drawn(key)
        for draw in range(chosen.draws):
            frame = expose(mean_e, CAMERA, random(1692, key, draw), EXPOSURE_S)
            (hits,) = detect_frames([frame], {CAMERA.camera: CAMERA})
            place = np.array([(hit.u_px, hit.v_px) for hit in hits]).reshape(-1, 2)
            apart_px = np.hypot(*(place[:, None] - sources[:, :2]).transpose(2, 0, 1))
            for (_, _, range_m, length), off_px in zip(sources, apart_px.T, strict=True):
                near = np.flatnonzero(off_px < NEAR_PX)
                count[int(length)].append(len(near))
                if len(near) == 1 and np.isfinite(hits[near[0]].range_sigma_m):
                    off_m = hits[near[0]].range_m - range_m
                    errors[int(length)].append((off_m / range_m, off_m / hits[near[0]].range_sigma_m))
    figures = {}
    for length in sorted(count):
        found, pairs = np.array(count[length]), np.array(errors[length]).reshape(-1, 2)
        figures[f"{length} to {length + 1} px"] = {
            "flares": len(found),
            "split": round(float(np.mean(found > 1)), 5),
            "not_found": round(float(np.mean(found == 0)), 5),
            "range_bias": round(float(np.median(pairs[:, 0])), 4),
            "range_pull_rms": round(float(np.sqrt(np.mean(pairs[:, 1] ** 2))), 2),
        }
    seconds = round(time.perf_counter() - started, 1)
    print(json.dumps({"benchmark": "drawn_out", "seconds": seconds, "length": figures}, indent=2))


if __name__ == "__main__":
    main()
