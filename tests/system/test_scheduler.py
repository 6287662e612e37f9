"""A campaign by the workers of a Dask scheduler: processes of their own, that may die; and what is refused."""

import contextlib
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import yaml

from tests.paths import ROOT
from tests.system.test_stress import campaign, contents, finished, left_over, start, times_of, workers_of

pytestmark = pytest.mark.mitsuba

HERE = {**os.environ, "PYTHONPATH": str(ROOT)}


@contextlib.contextmanager
def process(*words: str, folder: Path, **more: str) -> Iterator["subprocess.Popen[bytes]"]:
    """Run a command of Dask's in a folder; it, and what it has started, end with the block."""
    with (folder / "said.txt").open("ab") as said:
        running = subprocess.Popen(
            [sys.executable, "-m", "dask", *words], cwd=folder, env={**HERE, **more}, stdout=said, stderr=said
        )
        try:
            yield running
        finally:
            with contextlib.suppress(psutil.NoSuchProcess):
                family = psutil.Process(running.pid).children(recursive=True)
                running.terminate()
                psutil.wait_procs([*family, psutil.Process(running.pid)], timeout=10)
                for one in family:
                    with contextlib.suppress(psutil.NoSuchProcess):
                        one.kill()
            running.kill()
            running.wait()


@contextlib.contextmanager
def scheduler(folder: Path) -> Iterator[str]:
    """Run a scheduler; yield its address."""
    folder.mkdir(exist_ok=True)
    file = folder / "scheduler.json"
    words = (
        "scheduler",
        "--host",
        "127.0.0.1",
        "--port",
        "0",
        "--no-dashboard",
        "--scheduler-file",
        str(file),
    )
    with process(*words, folder=folder):
        until = time.monotonic() + 60
        while not file.exists():
            assert time.monotonic() < until, (folder / "said.txt").read_text()
            time.sleep(0.1)
        time.sleep(0.2)
        yield json.loads(file.read_text())["address"]


def by(address: str, file: Path, output: Path, *more: str, folder: Path = ROOT) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "nir_render.command.main", "stress", str(file), "-o", str(output)]
    return subprocess.Popen(
        [*command, "--scheduler", address, *more], cwd=folder, text=True, env=HERE,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


@pytest.mark.verify
def test_workers_of_a_scheduler_give_the_same_table(tmp_path: Path) -> None:
    """Byte for byte that of this machine's own workers; with none of what a worker was told left behind."""
    file = campaign(tmp_path, ranges=2, exposures=3)
    finished(file, tmp_path / "own")
    with scheduler(tmp_path / "dask") as address:
        with process("worker", address, "--nthreads", "2", "--no-dashboard", folder=tmp_path / "dask"):
            _, refused = by(address, file, tmp_path / "out").communicate(timeout=120)
        assert "start workers with '--nthreads 1'" in " ".join(refused.split())
        assert times_of(tmp_path / "out") == {}
        words = ("worker", address, "--nthreads", "1", "--nworkers", "2", "--no-dashboard")
        with process(*words, folder=tmp_path / "dask"):
            running = by(address, file, tmp_path / "out", "--json")
            out, err = running.communicate(timeout=300)
            assert running.returncode == 0, err
            assert json.loads(out)["done_before"] == 0
    assert contents(tmp_path / "out") == contents(tmp_path / "own")
    assert left_over(tmp_path / "out") == []


@pytest.mark.verify
def test_a_worker_that_joins_late_and_differs_ends_the_campaign(tmp_path: Path) -> None:
    """Named by relative paths, with an estimator of one's own: workers are in a folder of their own."""
    file = campaign(tmp_path, ranges=20, exposures=5)
    (tmp_path / "mine.py").write_text("def none(frame, calibration):\n    return []\n")
    file.write_text(yaml.safe_dump({**yaml.safe_load(file.read_text()), "estimators": ["mine.py:none"]}))
    words = ("--nthreads", "1", "--no-dashboard")
    with scheduler(tmp_path / "dask") as address, contextlib.ExitStack() as stack:
        stack.enter_context(process("worker", address, *words, folder=tmp_path / "dask"))
        running = by(address, Path(file.name), Path("out"), folder=tmp_path)
        until = time.monotonic() + 120
        while len(times_of(tmp_path / "out")) < 2 and running.poll() is None:
            assert time.monotonic() < until
            time.sleep(0.1)
        late = process("worker", address, *words, folder=tmp_path / "dask", NIR_RENDER_VARIANT="scalar_rgb")
        stack.enter_context(late)
        _, err = running.communicate(timeout=120)
    assert running.returncode == 2, err
    assert "has variant scalar_rgb, here it is" in " ".join(err.split())
    assert "Traceback" not in err
    assert len(times_of(tmp_path / "out")) >= 2
    assert list((tmp_path / "out" / "jobs").glob(".seen*")) == []


def test_what_is_no_scheduler_is_told(tmp_path: Path) -> None:
    file = campaign(tmp_path, ranges=1, exposures=2)
    cases = [
        (by("here", file, tmp_path / "out"), "no Dask scheduler answers"),
        (by("tcp://127.0.0.1:1", file, tmp_path / "other"), "no Dask scheduler answers"),
        (
            start(file, tmp_path / "third", "--scheduler", "tcp://127.0.0.1:1"),
            "leave out all but one of them",
        ),
    ]
    for running, said in cases:
        _, err = running.communicate(timeout=120)
        assert running.returncode == 2, err
        assert said in " ".join(err.split())
        assert "Traceback" not in err


@pytest.mark.verify
def test_workers_scheduler_and_driver_may_be_killed(tmp_path: Path) -> None:
    """100 jobs, six kills, or ten at length; after each the campaign, or the same command, goes on; the table is that of a calm run.

    Each time all is started a worker is killed first, then the scheduler or the driver, after jobs by lot.
    """
    chance = random.Random(20)
    file = campaign(tmp_path, ranges=10, exposures=10)
    finished(file, tmp_path / "calm")
    output, folder = tmp_path / "out", tmp_path / "dask"
    kills = {"worker": 0, "scheduler": 0, "driver": 0}

    def more_are_done(running: "subprocess.Popen[str]") -> None:
        wanted = min(len(times_of(output)) + chance.randint(2, 6), 97)
        while len(times_of(output)) < wanted:
            assert running.poll() is None, running.communicate()
            time.sleep(0.1)

    while sum(kills.values()) < (10 if "AT_LENGTH" in os.environ else 6):
        with contextlib.ExitStack() as stack:
            address = stack.enter_context(scheduler(folder))
            words = ("worker", address, "--nthreads", "1", "--nworkers", "2", "--no-dashboard")
            nanny = stack.enter_context(process(*words, folder=folder))
            running = by(address, file, output)
            more_are_done(running)
            os.kill(workers_of(psutil.Process(nanny.pid))[0].pid, signal.SIGKILL)
            more_are_done(running)  # by the other one, and by what takes its place
            victim = "scheduler" if kills["scheduler"] <= kills["driver"] else "driver"
            if victim == "driver":
                running.kill()
            else:
                for one in psutil.process_iter(["cmdline"]):
                    if str(folder / "scheduler.json") in (one.info["cmdline"] or []):
                        one.kill()
            kills["worker"] += 1
            kills[victim] += 1
            _, err = running.communicate(timeout=120)
            assert "Traceback" not in err, err
        (folder / "scheduler.json").unlink(missing_ok=True)
    finished(file, output)
    assert contents(output) == contents(tmp_path / "calm")
    assert left_over(output) == []
