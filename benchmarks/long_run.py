"""How long a long run takes, stage by stage: one JSON object, in seconds and milliseconds.

    python -P benchmarks/long_run.py [--frames 1200] [--hall]

Five robots, four of which drive, seen by the four cameras of the fifth, 1280 × 960 pixels at 30 FPS; with
`--hall` between a floor and a wall whose light is interpolated (`render.indirect.error`). `--frames` counts
all cameras' frames, of 1200 for 10 s; `whole_s` scales what was measured up to these, and adds what is done
once (`once`: a first run of a frame per camera). Each number of frames runs in a process of its own, for its
peak memory. `growth_mib_per_1000_frames` is that of the memory held while rendering twice the frames, from
the second quarter of them to the last: what comes once, as the first near robot, is not told from what goes
on below some hundred frames. `-P` keeps this folder off Python's path.
"""

import argparse
import json
import math
import multiprocessing
import resource
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

FRAMES = 1200
CAMERAS = 4
RUNS = 15
WAYS = {
    "r2": ("[2.1, 0.6, 0] m", "[0.5, 2.6, 0] m"),
    "r3": ("[0.3, 1.7, 0] m", "[-2.3, 0.7, 0] m"),
    "r4": ("[-2.9, 1.3, 0] m", "[-0.9, -1.3, 0] m"),
    "r5": ("[1.75, -1.7, 0] m", "[2.75, 1.7, 0] m"),
}


def document(sets: int, hall: bool) -> dict[str, Any]:
    """Return the scene of so many sets of frames."""
    robots: dict[str, Any] = {"r1": {"rig": "infra_swarm"}}
    for name, (first, last) in WAYS.items():
        motion = [{"time": "0 s", "position": first}, {"time": "10 s", "position": last}]
        robots[name] = {"rig": "infra_swarm", "motion": motion}
    scene: dict[str, Any] = {
        "format": 1,
        "seed": 1,
        "clock": {"frames": sets, "frame_rate": "30 Hz"},
        "observe": ["r1"],
        "robots": robots,
    }
    if hall:
        scene["render"] = {"indirect": {"scale": 8, "error": "5 % of temporal variance"}}
        scene["materials"] = {"grey": {"type": "diffuse", "reflectance": 0.3}}
        plane = {"type": "rectangle", "material": "grey"}
        scene["shapes"] = {
            "floor": plane | {"center": "[0, 0, 0] m", "size": "[8, 6] m", "normal": [0, 0, 1]},
            "wall": plane | {"center": "[4, 0, 1.25] m", "size": "[6, 2.5] m", "normal": [-1, 0, 0]},
        }
    return scene


class _Held:
    """The memory that the process holds after each frame, in MiB; none where the system does not tell."""

    def __init__(self) -> None:
        self.after_mib: list[float] = []

    def note(self, _done: int, _of: int) -> None:
        """Note it after a frame."""
        pages = Path("/proc/self/statm")
        if pages.exists():
            self.after_mib.append(int(pages.read_text().split()[1]) * resource.getpagesize() / 2**20)

    def growth_mib_per_1000(self) -> float:
        """Return how much more is held in the last quarter of the frames than in the second, for 1000."""
        quarter = len(self.after_mib) // 4
        if quarter == 0:
            return math.nan
        second, last = self.after_mib[quarter : 2 * quarter], self.after_mib[-quarter:]
        return 1000.0 * (statistics.mean(last) - statistics.mean(second)) / (2 * quarter)


def spent(sets: int, hall: bool) -> dict[str, float]:
    """Return the seconds of each stage of a run, its peak memory, and what exposing one frame takes."""
    import nir_render as nr
    from nir_render.run.evaluate import evaluate_run
    from nir_render.run.perceive import chosen_estimators, perceive_run
    from nir_render.run.render import render_run
    from nir_render.scene.scene import parse_scene

    scene = parse_scene(document(sets, hall))
    seconds, held = {}, _Held()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "run"
        stages: dict[str, Callable[[], object]] = {
            "render_s": lambda: render_run(scene, folder, overwrite=False, progress=held.note),
            "perceive_s": lambda: perceive_run(
                folder, estimators=chosen_estimators(["robust"]), progress=_silent
            ),
            "evaluate_s": lambda: evaluate_run(folder),
        }
        for stage, work in stages.items():
            started = time.perf_counter()
            work()
            seconds[stage] = time.perf_counter() - started
            seconds[stage.replace("_s", "_peak_mib")] = _peak_mib()
    light = nr.render(scene, "r1.front")
    nr.expose(light, scene)
    times_ms = []
    for index in range(RUNS):
        started = time.perf_counter()
        nr.expose(light, scene, index=index)
        times_ms.append(1e3 * (time.perf_counter() - started))
    growth_mib = held.growth_mib_per_1000()
    return seconds | {"expose_ms": statistics.median(times_ms), "growth_mib_per_1000_frames": growth_mib}


def _silent(_done: int, _of: int) -> None:
    """Tell nobody."""


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main() -> None:
    """Run one set, a number of frames, and twice that; print what they took."""
    parser = argparse.ArgumentParser(description="How long a long run takes.")
    parser.add_argument("--frames", type=int, default=FRAMES, help="of all cameras together")
    parser.add_argument("--hall", action="store_true", help="with a floor and a wall")
    asked = parser.parse_args()
    sets = max(asked.frames // CAMERAS, 2)
    with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        once, run, twice = (pool.apply(spent, (count, asked.hall)) for count in (1, sets, 2 * sets))
    stages = [name for name in run if name.endswith("_s") and name != "expose_ms"]
    # What is done once cancels in the difference.
    per_frame_s = {name: (twice[name] - run[name]) / (CAMERAS * sets) for name in stages}
    told = {name: {key: round(value, 4) for key, value in one.items()} for name, one in
            (("once", once), ("frames_n", run), ("frames_2n", twice))}  # fmt: skip
    print(
        json.dumps(
            {
                "benchmark": "long_run",
                "frames": CAMERAS * sets,
                "per_frame_ms": {name[:-2]: round(1e3 * value, 2) for name, value in per_frame_s.items()},
                "whole_s": round(sum(once[name] + FRAMES * per_frame_s[name] for name in stages), 1),
                "growth_mib_per_1000_frames": told["frames_2n"]["growth_mib_per_1000_frames"],
                **told,
            }
        )
    )


if __name__ == "__main__":
    main()
