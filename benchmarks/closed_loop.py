"""Camera frames a second of a closed loop: rendered, exposed, perceived, controlled. One JSON object.

Five robots of the flocking experiment, of which four look by four cameras of 1280 × 960 each. Timed are the
steps after the second; indirect light is held, and what rendering it takes stands beside it. `cpu` is of one
core's time: as seeds run side by side in processes of one thread each, that many a core are done in a second.
"""

import argparse
import hashlib
import json
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from nir_render import load_scene
from nir_render.experiments.flocking.loop import Flocking
from nir_render.experiments.flocking.outcome import ARENA


def measured(steps: int) -> dict[str, object]:
    """Return the figures."""
    loop = Flocking(level="frames", lasts_s=3600.0, refresh_s=3600.0).loop(load_scene(ARENA), seed=0)
    began, cpu = time.perf_counter(), time.process_time()
    loop.step()
    first_s, first_cpu_s = time.perf_counter() - began, time.process_time() - cpu
    loop.step()
    digest = hashlib.sha256()
    began, cpu = time.perf_counter(), time.process_time()
    for _ in range(steps):
        digest.update(json.dumps(loop.step().lines).encode())
    wall_s, cpu_s = time.perf_counter() - began, time.process_time() - cpu
    frames = steps * 4 * len(loop.followers)
    return {
        "frames": frames,
        "frames_per_s": round(frames / wall_s, 2),
        "frames_per_s_of_one_core": round(frames / cpu_s, 2),
        "first_step_s": round(first_s, 2),
        "first_step_cpu_s": round(first_cpu_s, 2),
        "told_sha256": digest.hexdigest()[:16],
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=10)
    print(json.dumps(measured(parser.parse_args().steps)))
