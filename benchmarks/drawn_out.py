"""What `robust` makes of flares that move in an exposure: one JSON object. 2 minutes; `--frames 40` for more.

Spheres of the paper's rig, 0.7 to 6 m away, each drawn out evenly along a line of up to 5 px; their images by
brute force on a fine grid, photons and read noise by NumPy. For each length: how many are taken for two and
more, how many are not found, how many are called merged, ranges, and the errors of ranges and places over
the σ that they claim. The line to hold is a split of one in a thousand.

The light is that of 0.2 ms of the rig's sources, however long the exposure is said to be: in 10 ms 5 px are a
turn of 1 rad/s, in 0.2 ms one of 52, which no robot makes.
"""

import argparse
import json
import sys
import time
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))

from perception.estimators import detect_frames
from perception.types import Calibration
from tests.unit.perception.simulation import calibration, expose, random

LIT_S = 2e-4
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


def main() -> None:
    """Print the figures, by length in whole pixels."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10)
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--exposure-s", type=float, default=0.01)
    parser.add_argument("--kernel", type=float, default=1.0, help="true width over the calibrated one")
    chosen = parser.parse_args()
    known = replace(CAMERA, psf_sigma_px=CAMERA.psf_sigma_px / chosen.kernel, **lit_for(chosen.exposure_s))
    count: dict[int, list[int]] = defaultdict(list)
    merged: dict[int, list[bool]] = defaultdict(list)
    errors: dict[int, list[tuple[float, ...]]] = defaultdict(list)
    started = time.perf_counter()
    for key in range(chosen.frames):
        mean_e, sources = drawn(key)
        for draw in range(chosen.draws):
            frame = expose(mean_e, CAMERA, random(1692, key, draw), chosen.exposure_s)
            (hits,) = detect_frames([frame], {CAMERA.camera: known})
            place = np.array([(hit.u_px, hit.v_px) for hit in hits]).reshape(-1, 2)
            apart_px = np.hypot(*(place[:, None] - sources[:, :2]).transpose(2, 0, 1))
            for (u, v, range_m, length), off_px in zip(sources, apart_px.T, strict=True):
                near = np.flatnonzero(off_px < NEAR_PX)
                count[int(length)].append(len(near))
                merged[int(length)] += [hits[index].merged for index in near]
                if len(near) == 1 and np.isfinite(hits[near[0]].range_sigma_m):
                    hit = hits[near[0]]
                    off_m = hit.range_m - range_m
                    off = (hit.u_px - u) / hit.u_sigma_px, (hit.v_px - v) / hit.v_sigma_px
                    errors[int(length)].append((off_m / range_m, off_m / hit.range_sigma_m, *off))
    figures = {}
    for length in sorted(count):
        found, off = np.array(count[length]), np.array(errors[length]).reshape(-1, 4)
        figures[f"{length} to {length + 1} px"] = {
            "flares": len(found),
            "split": round(float(np.mean(found > 1)), 5),
            "not_found": round(float(np.mean(found == 0)), 5),
            "merged": round(float(np.mean(merged[length])), 5),
            "range_bias": round(float(np.median(off[:, 0])), 4),
            "range_pull_rms": round(float(np.sqrt(np.mean(off[:, 1] ** 2))), 2),
            "place_pull_rms": round(float(np.sqrt(np.mean(off[:, 2:] ** 2))), 2),
        }
    seconds = round(time.perf_counter() - started, 1)
    print(json.dumps({"benchmark": "drawn_out", "seconds": seconds, "length": figures}, indent=2))


if __name__ == "__main__":
    main()
