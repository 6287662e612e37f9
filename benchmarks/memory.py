"""Whether memory grows over many scene loads and renders: one JSON object, in MiB.

    python -P benchmarks/memory.py [--jobs 2000] [--workers 2] [--jobs-per-process N]

A campaign of one small scene (48 × 64 pixels, a floor and a wall, two materials, a lamp) with so many places
of its robot: each is loaded and rendered anew. `all` is the memory of this process and of its workers, what
they share counted once (PSS), `driver` this process's own (USS), looked at five times a second. `windows_mib`
are their highest values in tenths of the jobs, `growth_percent` that of the last three of these over the
second to fourth: the first has what comes once. With `--jobs-per-process` above `--jobs`, and one worker, it
is the growth within one process. `-P` keeps this folder off Python's path.
"""

import argparse
import hashlib
import json
import os
import statistics
import tempfile
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import psutil
import yaml

WINDOWS = 10
LOOKS_EVERY_S = 0.2
SCENE: dict[str, Any] = {
    "format": 1,
    "name": "small",
    "observe": ["r1.front"],
    "render": {"indirect": {"scale": 1, "samples": 4, "max_depth": 3}},
    "robots": {
        "r1": {"rig": {"cameras": {"front": {
            "preset": "infra_swarm", "position": "[0, 0, 0.3] m", "exposure": "100 us",
            "sensor": {"preset": "mt9m031", "rows": 48, "columns": 64, "pixel_pitch": "60 um"},
        }}}},
        "r2": {"rig": "infra_swarm", "position": "[1, 0.2, 0] m"},
    },
    "materials": {
        "grey": {"type": "diffuse", "reflectance": 0.3},
        "varnish": {"type": "plastic", "index": 1.5, "reflectance": 0.5, "roughness": 0.2},
    },
    "shapes": {
        "floor": {"type": "rectangle", "center": "[3, 0, 0] m", "size": "[8, 3] m", "normal": [0, 0, 1],
                  "material": "grey"},
        "wall": {"type": "rectangle", "center": "[3, 0, 1] m", "size": "[3, 2] m", "normal": [-1, 0, 0],
                 "material": "varnish"},
    },
    "lamps": {"ceiling": {"preset": "halogen", "center": "[0, 0, 2.5] m", "luminous_flux": "400 lm"}},
}  # fmt: skip


class Watch:
    """The memory of this process and of those below it, noted beside the number of jobs that are done."""

    def __init__(self) -> None:
        self.done = 0
        self.driver: list[tuple[int, float]] = []
        self.all: list[tuple[int, float]] = []
        self.processes: set[int] = set()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def __enter__(self) -> "Watch":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _look(self) -> None:
        own = psutil.Process()
        while not self._ended.wait(LOOKS_EVERY_S):
            children = own.children(recursive=True)
            self.processes.update(child.pid for child in children)
            self.driver.append((self.done, mib([own], "uss")))
            self.all.append((self.done, mib([own, *children], "pss")))


def mib(processes: Iterable[psutil.Process], kind: str) -> float:
    """Return the memory of processes, of a kind as psutil names it; one that has just ended holds none."""
    total = 0
    for process in processes:
        try:
            total += getattr(process.memory_full_info(), kind)
        except psutil.Error:
            continue
    return total / 2**20


def told(looks: list[tuple[int, float]], jobs: int) -> dict[str, Any]:
    """Return the highest value of each window, and how much the last are above the early ones."""
    windows = [0.0] * WINDOWS
    for done, held_mib in looks:
        window = min(done * WINDOWS // jobs, WINDOWS - 1)
        windows[window] = max(windows[window], held_mib)
    early, late = statistics.mean(windows[1:4]), statistics.mean(windows[-3:])
    return {
        "windows_mib": [round(held_mib, 1) for held_mib in windows],
        "growth_percent": round(100.0 * (late / early - 1.0), 2),
    }


def main() -> None:
    """Run the campaign, and print what memory did meanwhile."""
    from nir_render.stress.campaign import load_campaign
    from nir_render.stress.jobs import plan
    from nir_render.stress.workers.pool import Work, part_file, run_jobs
    from nir_render.stress.workers.recycle import JOBS
    from nir_render.transport.backend.cores import cores
    from nir_render.transport.backend.llvm.choice import cpu_name

    parser = argparse.ArgumentParser(description="Whether memory grows over many scenes.")
    parser.add_argument("--jobs", type=int, default=2000)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--jobs-per-process", type=int, default=JOBS)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        (place / "scene.yaml").write_text(yaml.safe_dump(SCENE))
        axis = {"path": "robots.r2.position.x", "from": "0.7 m", "to": "2.5 m"}
        sample = {"design": "random", "count": asked.jobs}
        document = {
            "format": 1, "name": "memory", "scene": "scene.yaml", "axes": {"place": axis}, "sample": sample
        }  # fmt: skip
        (place / "campaign.yaml").write_text(yaml.safe_dump(document))
        campaign = load_campaign(place / "campaign.yaml")
        jobs = plan(campaign)
        parts = place / "jobs"
        parts.mkdir()
        threads = max(cores() // asked.workers, 1)
        work = Work(
            campaign.scene, campaign.estimators, parts, place / "light", 2**30, threads, cpu_name(),
            asked.jobs_per_process,
        )  # fmt: skip
        started = time.perf_counter()
        with Watch() as watch:
            for ended in run_jobs(work, jobs, asked.workers, place / "scratch"):
                if ended.error is not None:
                    raise SystemExit(ended.error)
                watch.done += 1
        seconds = time.perf_counter() - started
        # All parts, in the order of the jobs: whoever did them, they hold the same.
        hashed = hashlib.sha256(b"".join(part_file(parts, job).read_bytes() for job in jobs)).hexdigest()
    print(
        json.dumps(
            {
                "benchmark": "memory",
                "jobs": asked.jobs,
                "workers": asked.workers,
                "jobs_per_process": asked.jobs_per_process,
                "processes": len(watch.processes),
                "seconds": round(seconds, 1),
                "parts_sha256": hashed[:16],
                "driver": told(watch.driver, asked.jobs),
                "all": told(watch.all, asked.jobs),
            }
        )
    )


if __name__ == "__main__":
    main()
