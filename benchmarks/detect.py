"""How long perception takes for a frame of the demo scene: one JSON object, medians in milliseconds.

Frames of 1280 × 960 with one source at 1, 3 and 10 m, both estimators, on one core.
"""

import json
import statistics
import time
from pathlib import Path

import cv2

import nir_render as nr
import perception

RUNS = 9


def main() -> None:
    """Time each estimator on each frame, in turn, and print the medians."""
    cv2.setNumThreads(1)
    scene = nr.load_scene(Path(__file__).parents[1] / "scenes" / "one_source.yaml")
    calibration = nr.calibration(scene, "r1.front")
    frames = [nr.expose(nr.render(scene, "r1.front", time_s), scene) for time_s in (0.0, 2.0, 9.0)]
    spent_ms: dict[str, list[float]] = {name: [] for name in perception.ESTIMATORS}
    for _ in range(RUNS):
        for name in perception.ESTIMATORS:
            started = time.perf_counter()
            for frame in frames:
                perception.detect(frame, calibration, name)
            spent_ms[name].append(1e3 * (time.perf_counter() - started) / len(frames))
    medians = {f"{name}_ms": round(statistics.median(times), 2) for name, times in spent_ms.items()}
    print(json.dumps({"benchmark": "perception", "frames": len(frames), "runs": RUNS, **medians}))


if __name__ == "__main__":
    main()
