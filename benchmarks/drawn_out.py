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

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from perception.estimators import detect_frames
from tests.moving_flares import CAMERA, drawn, lit_for
from tests.unit.perception.simulation import expose, random

NEAR_PX = 25.0


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
        found, pulls = np.array(count[length]), np.array(errors[length]).reshape(-1, 4)
        figures[f"{length} to {length + 1} px"] = {
            "flares": len(found),
            "split": round(float(np.mean(found > 1)), 5),
            "not_found": round(float(np.mean(found == 0)), 5),
            "merged": round(float(np.mean(merged[length])), 5),
            "range_bias": round(float(np.median(pulls[:, 0])), 4),
            "range_pull_rms": round(float(np.sqrt(np.mean(pulls[:, 1] ** 2))), 2),
            "place_pull_rms": round(float(np.sqrt(np.mean(pulls[:, 2:] ** 2))), 2),
        }
    seconds = round(time.perf_counter() - started, 1)
    print(json.dumps({"benchmark": "drawn_out", "seconds": seconds, "length": figures}, indent=2))


if __name__ == "__main__":
    main()
