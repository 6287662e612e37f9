"""What a campaign loses when its processes are killed at random: one JSON object for each way of doing jobs.

    PYTHONPATH=. python -P benchmarks/kills.py [--jobs 1000] [--kills 100] [--by own|scheduler] [--seed 20]

A campaign of small scenes (48 × 64 pixels, a floor and a wall; ten exposures of each geometry, so that light
goes through the cache) runs calmly once. Then it is begun anew, and processes are killed by SIGKILL, by lot:
workers and the command itself (`own`, in processes of this machine); the scheduler and what watches over its
workers too (`scheduler`). Between two kills so many jobs are done, by lot, that all kills fall within the
campaign, or a time by lot passes, so that processes that have only begun are killed too. The same command is
given again at once, whatever the last one's workers still do.

`lost` are jobs without rows in the end; `changed` those whose file is not the calm run's, byte by byte, the
hashes of frames included; `written_again` those whose file was replaced after it was there, as seen ten times
a second; `more` files of no job of it; `tables` whether `table.parquet` and `jobs.jsonl` are the calm run's;
`left_over` what killed writers left; `tracebacks` the ends of the command by an error that is not its own.
All should be nothing, and `tables` true.
"""

import argparse
import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import psutil
import yaml

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.memory import SCENE

EXPOSURES = 10
LOOKS_EVERY_S = 0.1
UNKILLED = 4.0
"""The mean time until something is killed, however little is done, over that to the calm run's first job."""
WORKERS = 2
WEIGHTS = {"worker": 6.0, "nanny": 1.0, "scheduler": 1.5, "driver": 1.5}
"""Of ten kills, how many are of which process."""


class Parts:
    """The files of jobs in a folder, and which of them were replaced after they were there."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "jobs"
        self.seen: dict[str, tuple[int, int]] = {}
        self.written_again: set[str] = set()

    def look(self) -> int:
        """Take note of what is there; return how many are done."""
        with contextlib.suppress(FileNotFoundError):
            for entry in os.scandir(self.folder):
                if not entry.name.startswith("."):
                    status = entry.stat()
                    now = (status.st_ino, status.st_mtime_ns)
                    if self.seen.setdefault(entry.name, now) != now:
                        self.written_again.add(entry.name)
                        self.seen[entry.name] = now
        return len(self.seen)


class Family:
    """The command and, with `others`, a scheduler and its workers; what has ended is begun anew."""

    def __init__(self, campaign: Path, output: Path, place: Path, *, others: bool) -> None:
        self.campaign, self.output, self.place, self.others = campaign, output, place, others
        self.ends: Counter[int] = Counter()
        self.tracebacks: list[str] = []
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._said = (place / "said.txt").open("ab")
        self._address = ""
        self._began = 0

    def begin(self) -> None:
        """Start what does not run; workers and the command anew where the scheduler has gone."""
        if self.has_ended_well():
            return
        if self.others and self._ended("scheduler"):
            for name in ("nanny", "driver"):
                self._ends(name)
            file = self.place / f"scheduler.{self._began}.json"
            self._began += 1
            words = ["--host", "127.0.0.1", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)]
            self._start("scheduler", ["-m", "dask", "scheduler", *words])
            self._address = _address_in(file)
        if self.others and self._ended("nanny"):
            words = ["--nthreads", "1", "--nworkers", str(WORKERS), "--no-dashboard"]
            self._start("nanny", ["-m", "dask", "worker", self._address, *words])
        if self._ended("driver"):
            self._ends("driver")
            where = ["--scheduler", self._address] if self.others else ["--workers", str(WORKERS)]
            words = ["stress", str(self.campaign), "-o", str(self.output), *where]
            self._start("driver", ["-m", "nir_render.command.main", *words])

    def has_ended_well(self) -> bool:
        """Tell whether the command has come to its end, with all jobs done."""
        return "driver" in self._running and self._running["driver"].poll() == 0

    def kill(self, chance: random.Random) -> str | None:
        """Kill a process by lot; return of which kind it was, None where there is none of that kind."""
        kinds = list(WEIGHTS) if self.others else ["worker", "driver"]
        kind = chance.choices(kinds, [WEIGHTS[name] for name in kinds])[0]
        if kind != "worker":
            self._running[kind].kill()
            self._running[kind].wait()
            return kind
        above = self._running["nanny" if self.others else "driver"]
        workers = []
        with contextlib.suppress(psutil.Error):
            for one in psutil.Process(above.pid).children(recursive=True):
                with contextlib.suppress(psutil.Error):
                    if "spawn_main" in " ".join(one.cmdline()):
                        workers.append(one)
        if not workers:
            return None
        with contextlib.suppress(psutil.Error):
            os.kill(chance.choice(workers).pid, signal.SIGKILL)
        return kind

    def end(self) -> None:
        """End all of it."""
        for name in list(self._running):
            self._ends(name)
        self._said.close()

    def _start(self, name: str, words: list[str]) -> None:
        file = self.place / "driver.txt"
        said = file.open("wb") if name == "driver" else self._said
        self._running[name] = subprocess.Popen(  # noqa: S603 (our own commands)
            [sys.executable, *words], cwd=self.place, stdout=said, stderr=said
        )

    def _ended(self, name: str) -> bool:
        return name not in self._running or self._running[name].poll() is not None

    def _note(self, code: int) -> None:
        self.ends[code] += 1
        said = (self.place / "driver.txt").read_text(errors="replace")
        if "Traceback" in said and code != -signal.SIGKILL:
            self.tracebacks.append(said[-2000:])

    def _ends(self, name: str) -> None:
        """End a process; the command by itself where it does, as its scheduler has gone."""
        process = self._running.get(name)
        if process is None:
            return
        if name == "driver":
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(timeout=60)
            if process.poll() is not None:
                self._note(process.returncode)
        process.terminate()
        try:
            process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        del self._running[name]


def _address_in(file: Path) -> str:
    until = time.monotonic() + 120
    while time.monotonic() < until:
        with contextlib.suppress(OSError, ValueError, KeyError):
            return str(json.loads(file.read_text())["address"])
        time.sleep(LOOKS_EVERY_S)
    raise SystemExit(f"{file}: no scheduler came")


def campaign_in(folder: Path, jobs: int) -> Path:
    """Write a campaign of so many small jobs; return its file."""
    (folder / "scene.yaml").write_text(yaml.safe_dump(SCENE))
    document = {
        "format": 1, "name": "kills", "scene": "scene.yaml", "axes": {
            "place": {"path": "robots.r2.position.x", "from": "0.7 m", "to": "2.5 m",
                      "count": jobs // EXPOSURES},
            "exposure": {"path": "robots.r1.rig.cameras.front.exposure", "from": "50 us", "to": "500 us",
                         "count": EXPOSURES, "spacing": "log"},
        },
    }  # fmt: skip
    file = folder / "campaign.yaml"
    file.write_text(yaml.safe_dump(document))
    return file


def killed(
    family: Family, parts: Parts, jobs: int, kills: int, unkilled_s: float, chance: random.Random
) -> tuple[Counter[str], int]:
    """Run a campaign to its end while its processes are killed.

    `unkilled_s` is the mean time until something is killed, however little is done meanwhile. Returns
    how many of which kind were killed, and how many of these before the last job was done.
    """
    done: Counter[str] = Counter()
    while_running = 0

    def next_kill() -> tuple[float, float]:
        left = kills - sum(done.values())
        if left == 0:
            return float("inf"), float("inf")
        # Of what is left to do an even share; the last is for the end without a kill.
        jobs_on = chance.expovariate((left + 1) / max(jobs - len(parts.seen), 1))
        return len(parts.seen) + jobs_on, time.monotonic() + chance.expovariate(1.0 / unkilled_s)

    family.begin()
    jobs_then, until = next_kill()
    while not family.has_ended_well():
        time.sleep(LOOKS_EVERY_S)
        if parts.look() >= jobs_then or time.monotonic() > until:
            kind = family.kill(chance)
            if kind is not None:
                done[kind] += 1
                while_running += len(parts.seen) < jobs
                jobs_then, until = next_kill()
        family.begin()
    return done, while_running


def held_against(calm: Path, output: Path, parts: Parts) -> dict[str, Any]:
    """Return how a campaign's folder differs from that of a calm run."""
    names = sorted(path.name for path in (calm / "jobs").iterdir())
    own = {name: output / "jobs" / name for name in names}
    return {
        "lost": sum(not file.is_file() for file in own.values()),
        "changed": sum(
            file.is_file() and file.read_bytes() != (calm / "jobs" / name).read_bytes()
            for name, file in own.items()
        ),
        "written_again": len(parts.written_again),
        "more": sum(path.name not in own for path in (output / "jobs").iterdir()),
        "tables": all(
            (output / name).read_bytes() == (calm / name).read_bytes()
            for name in ("table.parquet", "jobs.jsonl")
        ),
        "left_over": [
            str(path.relative_to(output))
            for path in output.rglob("*")
            if ".partial-" in path.name or path.name == ".workers"
        ],
    }


def main() -> None:
    """Run the campaign calmly, then kill; print what was lost."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=1000)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--by", choices=("own", "scheduler"), action="append")
    parser.add_argument("--seed", type=int, default=20)
    asked = parser.parse_args()
    jobs = asked.jobs // EXPOSURES * EXPOSURES
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        campaign = campaign_in(place, jobs)
        calm = Family(campaign, place / "calm", place, others=False)
        calm.begin()
        started = time.perf_counter()
        first_s = 0.0
        while not calm.has_ended_well():
            time.sleep(LOOKS_EVERY_S)
            if not first_s and any((place / "calm" / "jobs").glob("*")):
                first_s = time.perf_counter() - started
            calm.begin()
        calm_s = time.perf_counter() - started
        calm.end()
        for by in asked.by or ("own", "scheduler"):
            (place / by).mkdir()
            output = place / by / "out"
            family = Family(campaign, output, place / by, others=by == "scheduler")
            parts, started = Parts(output), time.perf_counter()
            chance = random.Random(asked.seed)  # noqa: S311 (no secret)
            try:
                done, while_running = killed(family, parts, jobs, asked.kills, UNKILLED * first_s, chance)
                seconds = time.perf_counter() - started
                time.sleep(10 * LOOKS_EVERY_S)
                parts.look()
            finally:
                family.end()
            record = {
                "benchmark": "kills",
                "by": by,
                "jobs": jobs,
                "kills": dict(done),
                "kills_before_the_last_job": while_running,
                "ends_of_the_command": {str(code): count for code, count in sorted(family.ends.items())},
                **held_against(place / "calm", output, parts),
                "tracebacks": family.tracebacks,
                "seconds": {"calm": round(calm_s, 1), "killed": round(seconds, 1)},
            }
            print(json.dumps(record), flush=True)


if __name__ == "__main__":
    main()
