"""What a frame of every camera of a swarm costs: rendered and exposed, hall and robots included.

    python benchmarks/swarm.py --robots 100                   # one frame of all 400 cameras, two processes
    python benchmarks/swarm.py --robots 1000 --observers 1    # one robot's four cameras
    python benchmarks/swarm.py --robots 100 --observers 10    # ten robots': `all_cameras_s` is scaled up

One JSON object. Robots stand at 1 per m², hulls below lines of sight; sources blink each by itself, as they
do over a minute. Indirect light is rendered in blocks of 4 × 4 pixels with 4 samples. `peak_gib` is the
largest resident memory of a process. Starting, compiling and reading the scene are part of `seconds`.
"""

import argparse
import json
import multiprocessing
import resource
import sys
import time
from collections.abc import Hashable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from nir_render import load_scene
from nir_render.camera.mean_frame import mean_frame
from nir_render.camera.timing.drive import drive_of, mean_level
from nir_render.camera.timing.exposure_control import own_setting
from nir_render.experiments.swarm.hall import HALL, hall_scene, names_of
from nir_render.randomness import RandomKey
from nir_render.scene.scene import Scene
from nir_render.simulation.clock import frame_of

SEED, TIME_S = 1, 5.0


def hall(robots: int) -> Scene:
    """Return the hall, in which all but the first send."""
    return hall_scene(load_scene(HALL), robots, 1.0, "masts", 100.0, SEED)


def frames_of(robots: int, names: list[str]) -> tuple[float, float, int]:
    """Return peak memory in GiB, processor time, and frames: each of one exposure, at one time.

    All that blinks has one level in it, so one image is enough, and nothing is left off.
    """
    from nir_render.transport.render import render

    scene = hall(robots)
    world, frames = scene.at(0.0), 0
    kept: dict[Hashable, Any] = {}
    for name in (camera for robot in names for camera in scene.document.cameras_of(robot)):
        light = render(world, name, SEED, kept=kept)
        setting = own_setting(world.camera(name).camera, 0)
        levels = {
            source: float(mean_level(drive_of(placed.source), TIME_S, setting.exposure_s))
            for source, placed in world.carried_sources.items()
        }
        mean = mean_frame(light, world.sending(levels), setting.exposure_s, TIME_S)
        frame_of(mean.electrons, mean.camera, setting, TIME_S, RandomKey(SEED, "read_out", name, 0))
        frames += 1
    peak_gib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return peak_gib, time.process_time(), frames


def measured(robots: int, observers: int, workers: int) -> dict[str, object]:
    """Return the figures."""
    names = names_of(robots)[:observers]
    parts = [names[start::workers] for start in range(workers) if names[start::workers]]
    began_s = time.perf_counter()
    with ProcessPoolExecutor(len(parts), multiprocessing.get_context("spawn")) as pool:
        found = list(pool.map(frames_of, [robots] * len(parts), parts))
    seconds = time.perf_counter() - began_s
    frames = sum(one[2] for one in found)
    return {
        "robots": robots,
        "frames": frames,
        "workers": len(parts),
        "seconds": round(seconds, 1),
        "cpu_seconds": round(sum(one[1] for one in found), 1),
        "all_cameras_s": round(seconds * 4 * robots / frames, 1),
        "peak_gib": round(max(one[0] for one in found), 2),
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=100)
    parser.add_argument("--observers", type=int, help="How many robots' cameras; all by default.")
    parser.add_argument("--workers", type=int, default=2)
    given = parser.parse_args()
    print(json.dumps(measured(given.robots, given.observers or given.robots, given.workers)))
