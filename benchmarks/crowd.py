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
from perception.model.flare import image_radius_px
from tests.hard_frames.near import union_of_discs
from tests.unit.perception.simulation import calibration, expected_e, expose, random

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
    radii_px: list[float] = []
    for range_m in ranges_m.tolist():
        while True:
            u, v = 25.0 + 1230.0 * generator.random(), 25.0 + 910.0 * generator.random()
            radius_px = float(image_radius_px(u, v, math.asin(CAMERA.source_radius_m / range_m), CAMERA))
            if not kind.apart or all(
                math.hypot(u - a, v - b) > _GAP_PX + radius_px + other_px
                for (a, b, _), other_px in zip(flares, radii_px, strict=True)
            ):
                flares.append((u, v, range_m))
                radii_px.append(radius_px)
                break
    return flares


def frame_of(kind: Kind, flares: Flares, *key: int) -> RawFrame:
    """Return a frame of flares by brute force, of balls the nearer ones before the farther."""
    if kind.near_m < _BALLS_M:
        mean_e = union_of_discs(flares, CAMERA)[0] * kind.exposure_s + BACKGROUND_E
    else:
        mean_e = expected_e(CAMERA, flares, kind.exposure_s, BACKGROUND_E)
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
