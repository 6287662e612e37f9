"""How long perception takes for 300 flares in view, however near or clipped: one JSON object.

Sets of four frames of 1280 × 960, each with 300 flares at random places: points at 4 to 9 m; these clipped
ten times; spheres at 0.4 to 3 m beside one another; these clipped; spheres anywhere, nearer ones before
farther ones; and 600 points. Milliseconds for a frame, medians of several reads: by `detect` in one thread,
and by `DetectorProcesses`, which share a set. `found` counts flares with one detection within 2 px.

    OPENBLAS_NUM_THREADS=1 python benchmarks/crowd.py [kind ...]
"""

import json
import math
import os
import statistics
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import perception
from perception import RawFrame
from perception.model.flare import PixelBox, flare_image
from tests.hard_frames.near import union_of_discs
from tests.unit.perception.simulation import FLUX_PER_S_AT_1_M, calibration, expose, random

CAMERA = replace(calibration(), sigma={})
FRAMES = 4
READS = 5
BACKGROUND_E = 3.0
_GAP_PX = 12.0
_FOUND_PX, _BALLS_M = 2.0, 1.0

Flares = list[tuple[float, float, float]]
"""Places in px and ranges in m."""


@dataclass(frozen=True)
class Kind:
    """What a frame shows: how many flares, how near, for how long exposed, and whether side by side."""

    count: int
    near_m: float
    far_m: float
    exposure_s: float
    apart: bool = True


KINDS = {
    "points": Kind(300, 4.0, 9.0, 1e-4),
    "points_clipped": Kind(300, 4.0, 9.0, 4e-3),
    "near": Kind(300, 0.4, 3.0, 1e-4),
    "near_clipped": Kind(300, 0.4, 3.0, 1e-3),
    "near_anywhere": Kind(300, 0.4, 3.0, 1e-4, apart=False),
    "points_600": Kind(600, 4.0, 9.0, 1e-4),
}


def flares_of(kind: Kind, *key: int) -> Flares:
    """Return flares at random places, ranges evenly spread by their logarithms; the nearest come first."""
    generator = random(*key)
    ranges_m = np.sort(kind.near_m * (kind.far_m / kind.near_m) ** generator.random(kind.count))
    flares: Flares = []
    for range_m in ranges_m.tolist():
        while True:
            u, v = 25.0 + 1230.0 * generator.random(), 25.0 + 910.0 * generator.random()
            if not kind.apart or all(
                math.hypot(u - a, v - b) > _GAP_PX + _radius_px(u, v, range_m) + _radius_px(a, b, other_m)
                for a, b, other_m in flares
            ):
                flares.append((u, v, range_m))
                break
    return flares


def _radius_px(u: float, v: float, range_m: float) -> float:
    return CAMERA.fx_px * CAMERA.source_radius_m / range_m * (1.0 + _tangent2(u, v))


def _tangent2(u: float, v: float) -> float:
    return ((u - CAMERA.cx_px) ** 2 + (v - CAMERA.cy_px) ** 2) / CAMERA.fx_px**2


def frame_of(kind: Kind, flares: Flares, *key: int) -> RawFrame:
    """Return a frame of flares: points as the stack draws them, balls by brute force, nearer ones before."""
    if kind.near_m < _BALLS_M:
        mean_e_per_s, _ = union_of_discs(flares, CAMERA)
        return expose(mean_e_per_s * kind.exposure_s + BACKGROUND_E, CAMERA, random(*key), kind.exposure_s)
    mean_e = np.full((CAMERA.height_px, CAMERA.width_px), BACKGROUND_E)
    for u, v, range_m in flares:
        window = PixelBox.around(u, v, 1.3 * _radius_px(u, v, range_m) + 6.0, CAMERA)
        share = flare_image(u, v, math.asin(CAMERA.source_radius_m / range_m), window, CAMERA).fraction
        cosine = 1.0 / math.sqrt(1.0 + _tangent2(u, v))
        mean_e[window.slices] += FLUX_PER_S_AT_1_M * kind.exposure_s * cosine / range_m**2 * share
    return expose(mean_e, CAMERA, random(*key), kind.exposure_s)


def time_kind(kind: Kind, number: int, beside: perception.DetectorProcesses) -> dict[str, float]:
    """Time both ways of reading a set of such frames, in turn."""
    sets = [flares_of(kind, 93, number, index) for index in range(FRAMES)]
    frames = [frame_of(kind, flares, 94, number, index) for index, flares in enumerate(sets)]
    alone_ms: list[float] = []
    together_ms: list[float] = []
    found = [perception.detect(frame, CAMERA) for frame in frames]
    beside.detect_frames(frames)
    for _ in range(READS):
        for frame in frames:
            started = time.perf_counter()
            perception.detect(frame, CAMERA)
            alone_ms.append(1e3 * (time.perf_counter() - started))
        started = time.perf_counter()
        beside.detect_frames(frames)
        together_ms.append(1e3 * (time.perf_counter() - started) / FRAMES)
    seen = sum(_with_own(flares, hits) for flares, hits in zip(sets, found, strict=True))
    return {
        "one_thread_ms": round(statistics.median(alone_ms), 1),
        "one_thread_least_ms": round(min(alone_ms), 1),
        "processes_ms": round(statistics.median(together_ms), 1),
        "processes_least_ms": round(min(together_ms), 1),
        "found": round(seen / (FRAMES * kind.count), 4),
    }


def _with_own(flares: Flares, hits: Sequence[perception.Detection]) -> int:
    places = np.array([(hit.u_px, hit.v_px) for hit in hits]).reshape(-1, 2)
    return sum(int((np.hypot(*(places - (u, v)).T) < _FOUND_PX).sum()) == 1 for u, v, _ in flares)


def main(wanted: Sequence[str]) -> None:
    """Time what is asked for, and print it."""
    if unknown := set(wanted) - set(KINDS):
        raise SystemExit(f"{', '.join(sorted(unknown))}: not known here; {', '.join(KINDS)} are")
    cores = min(FRAMES, os.cpu_count() or 1)
    perception.warm_up()
    with perception.DetectorProcesses({CAMERA.camera: CAMERA}, count=cores) as beside:
        kinds = {
            name: time_kind(kind, number, beside)
            for number, (name, kind) in enumerate(KINDS.items())
            if not wanted or name in wanted
        }
    print(json.dumps({"benchmark": "crowd", "frames": FRAMES, "processes": cores, "kinds": kinds}))


if __name__ == "__main__":
    main(sys.argv[1:])
