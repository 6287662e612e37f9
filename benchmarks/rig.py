"""What fusion and the search for mirrors take on top of detection, in sets of four cameras: one JSON object.

Detections are drawn from the errors that they claim (`tests/unit/perception/rig/world.py`), so that nothing
else is timed; milliseconds are medians of five calls, then over 40 sets. `called_images` of `measurements`.
"""

import json
import statistics
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from perception.rig.measure_set import measure_set
from perception.types import Detection, SetMeasurements
from perception.warm_up import warm_up
from tests.unit.perception.rig.world import Array, detection, frame_without_pixels, rig
from tests.unit.perception.simulation import random

SETS, REPEATS = 40, 5
RIG = rig(own_source=True)
WALL = (np.array([0.0, 1.0, 0.0]), 2.0)


def places(rng: np.random.Generator, robots: int) -> list[Array]:
    """Robots on a floor, before the wall."""
    found: list[Array] = []
    while len(found) < robots:
        place = np.array([rng.uniform(-4.0, 4.0), rng.uniform(-6.0, 1.8), 0.28])
        if np.linalg.norm(place[:2]) > 0.5 and all(np.linalg.norm(place - other) > 0.3 for other in found):
            found.append(place)
    return found


def detections(rng: np.random.Generator, robots: int, mirrored: bool) -> list[list[Detection]]:
    """Return what four cameras find of them, of their images and the observer's own in a mirror of 90 %."""
    own = places(rng, robots)
    shown = [(place, 1.0) for place in own]
    if mirrored:
        normal, distance_m = WALL
        images = [p + 2.0 * (distance_m - normal @ p) * normal for p in [*own, np.array([0.0, 0.0, 0.28])]]
        shown += [(image, 0.9**-0.5) for image in images]
    found = []
    for camera in RIG.values():
        hits = [
            detection(camera, p, rng, factor=f, relative=1e-3 * (1.0 + 0.5 * float(np.linalg.norm(p))))
            for p, f in shown
        ]
        found.append([hit for hit in hits if hit is not None])
    return found


def measured(robots: int, mirrored: bool) -> dict[str, float | int]:
    """Time sets of so many robots, and count what is called a mirror image."""
    rng = random(1600, robots, int(mirrored))
    frames = [frame_without_pixels(camera) for camera in RIG.values()]
    seconds, flares, called, measurements = [], 0, 0, 0
    for _ in range(SETS):
        found = detections(rng, robots, mirrored)
        times = []
        seen: SetMeasurements | None = None
        for _ in range(REPEATS):
            start = time.perf_counter()
            seen = measure_set(frames, found, RIG)
            times.append(time.perf_counter() - start)
        assert seen is not None
        seconds.append(statistics.median(times))
        flares += sum(map(len, found))
        measurements += len(seen.measurements)
        called += sum(one.ghost == "yes" for one in seen.measurements)
    return {
        "flares_per_set": round(flares / SETS, 1),
        "milliseconds_median": round(1e3 * statistics.median(seconds), 2),
        "milliseconds_most": round(1e3 * max(seconds), 2),
        "measurements": measurements,
        "called_images": called,
    }


def main() -> None:
    """Print the figures."""
    warm_up()
    cases = {
        f"{robots} robots{', mirrored' if mirrored else ''}": measured(robots, mirrored)
        for robots, mirrored in ((4, False), (4, True), (8, True), (16, False), (30, True))
    }
    print(json.dumps({"benchmark": "rig", "sets": SETS, "repeats": REPEATS, "cases": cases}, indent=2))


if __name__ == "__main__":
    main()
