"""A campaign as people run it: whole, stopped by Ctrl-C, and killed again and again."""

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
import yaml

from nir_render.run.folder import locked
from tests.paths import ROOT

pytestmark = pytest.mark.mitsuba


# A source before a wall, seen by a camera of 64 × 48 pixels.
SCENE: dict[str, Any] = {
    "format": 1,
    "name": "tiny",
    "observe": ["r1.front"],
    "clock": {"frames": 2, "frame_rate": "10 Hz"},
    "render": {"indirect": {"scale": 2, "samples": 4, "max_depth": 3}},
    "robots": {
        "r1": {
            "rig": {
                "cameras": {
                    "front": {
                        "preset": "infra_swarm",
                        "position": "[0, 0, 0.2] m",
                        "exposure": "100 us",
                        "sensor": {"preset": "mt9m031", "rows": 48, "columns": 64, "pixel_pitch": "60 um"},
                    }
                }
            }
        },
        "r2": {"rig": {"sources": {"top": {"preset": "infra_swarm", "position": "[0, 0, 0.2] m"}}},
               "position": "[1, 0, 0] m"},
    },
    "materials": {"paint": {"type": "diffuse", "reflectance": 0.7}},
    "shapes": {"wall": {"type": "rectangle", "center": "[3, 0, 0] m", "size": "[4, 3] m", "normal": [-1, 0, 0],
                        "material": "paint"}},
}  # fmt: skip


def campaign(folder: Path, ranges: int, exposures: int) -> Path:
    (folder / "tiny.yaml").write_text(yaml.safe_dump(SCENE))
    document = {
        "format": 1,
        "name": "tiny",
        "scene": "tiny.yaml",
        "axes": {
            "range": {"path": "robots.r2.position.x",
                      "values": [f"{0.5 + 2.0 * step / ranges:g} m" for step in range(ranges)]},
            "exposure": {"path": "robots.r1.rig.cameras.front.exposure", "from": "20 us", "to": "1 ms",
                         "count": exposures, "spacing": "log"},
        },
        "bounds": {"range_rmse": "5 cm", "recall": "95 %"},
    }  # fmt: skip
    file = folder / "campaign.yaml"
    file.write_text(yaml.safe_dump(document))
    return file


def start(file: Path, output: Path, *more: str, env: dict[str, str] | None = None) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "nir_render.command.main", "stress", str(file), "-o", str(output)]
    command += ["--workers", "2"]
    return subprocess.Popen(
        [*command, *more], cwd=ROOT, text=True, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def finished(file: Path, output: Path, *more: str) -> str:
    process = start(file, output, *more)
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    return out


def workers_of(driver: psutil.Process) -> list[psutil.Process]:
    """The processes that do jobs, not the ones that watch over what they leave."""
    try:
        children = driver.children(recursive=True)
        return [one for one in children if "spawn_main" in " ".join(one.cmdline())]
    except psutil.NoSuchProcess:
        return []


def times_of(folder: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in folder.glob("jobs/*.parquet")}


def contents(folder: Path) -> tuple[bytes, bytes]:
    return (folder / "table.parquet").read_bytes(), (folder / "jobs.jsonl").read_bytes()


def left_over(folder: Path) -> list[str]:
    return [path.name for path in folder.rglob("*") if ".partial-" in path.name or path.name == ".workers"]


def test_a_campaign_runs_stops_and_goes_on(tmp_path: Path) -> None:
    """Ctrl-C after the first jobs: exit 130, and how to go on; then the rest, and then nothing more to do."""
    file, output = campaign(tmp_path, ranges=2, exposures=20), tmp_path / "out"
    process = start(file, output)
    while process.poll() is None and len(list(output.glob("jobs/*.parquet"))) < 3:
        time.sleep(0.05)
    workers = workers_of(psutil.Process(process.pid))
    assert len(workers) == 2
    for one in (process.pid, *(worker.pid for worker in workers)):  # as a terminal does: to all of them
        os.kill(one, signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "of 40 jobs done; the same command goes on: " in err.replace("\n", " ")
    assert "Traceback" not in err
    assert not any(worker.is_running() for worker in workers)
    assert not (output / "table.parquet").exists()
    parts = times_of(output)
    assert 3 <= len(parts) < 40

    summary = json.loads(finished(file, output, "--json"))
    assert (summary["jobs"], summary["done_before"], summary["failed"]) == (40, len(parts), 0)
    assert set(summary["estimators"]) == {"paper", "robust"}
    told = json.loads(finished(file, output, "--status", "--json"))
    assert told == {"campaign": "tiny", "jobs": 40, "done": 40, "others": 0}
    kept = times_of(output)
    assert len(kept) == 40
    assert kept.items() >= parts.items()
    assert left_over(output) == []
    assert "range" in (output / "report.html").read_text()

    before = contents(output)
    assert json.loads(finished(file, output, "--json"))["done_before"] == 40
    assert contents(output) == before


@pytest.mark.verify
def test_one_job_that_kills_its_workers_takes_no_other_along(tmp_path: Path) -> None:
    """The first of six jobs that share light; the others are done, and the same command tries it again."""
    file, output = campaign(tmp_path, ranges=1, exposures=6), tmp_path / "out"
    (tmp_path / "deadly.py").write_text(
        "import os\n\n\ndef deadly(frame, calibration):\n"
        "    if frame.exposure_s < 25e-6 and not os.path.exists(os.environ['MENDED']):\n"
        "        os._exit(1)\n    return []\n"
    )
    document = yaml.safe_load(file.read_text()) | {"estimators": ["deadly.py:deadly"]}
    file.write_text(yaml.safe_dump(document))
    mended = {**os.environ, "MENDED": str(tmp_path / "mended")}
    process = start(file, output, "--json", env=mended)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 1, err
    assert "workers died with it" in err
    assert (json.loads(out)["failed"], len(times_of(output))) == (1, 5)
    (tmp_path / "mended").touch()
    process = start(file, output, "--json", env=mended)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert (json.loads(out)["failed"], json.loads(out)["done_before"]) == (0, 5)


def test_two_cannot_work_in_one_folder(tmp_path: Path) -> None:
    file, output = campaign(tmp_path, ranges=2, exposures=2), tmp_path / "out"
    output.mkdir()
    (output / ".campaign.json.partial-x").touch()  # left by one that was killed as it began
    with locked(output / ".lock", "taken"):
        process = start(file, output)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "another nir-render works on this campaign" in err.replace("\n", " ")


@pytest.mark.verify
def test_twenty_kills_lose_nothing_and_do_nothing_twice(tmp_path: Path) -> None:
    """200 jobs; 20 times the driver or a worker, drawn by lot, is killed without warning, at a random moment.

    After restarts the table, and the hashes of all frames, are those of a run that nobody disturbed. Where
    starting takes longer than the pause between kills, it would never end: of workers that have not done a job
    since their driver began two are killed, as the program gives up at its fourth start.
    """
    chance = random.Random(6)
    file = campaign(tmp_path, ranges=10, exposures=20)
    finished(file, tmp_path / "calm")
    kills = {"driver": 0, "worker": 0}
    output = tmp_path / "stormy"
    written: dict[str, int] = {}
    process = start(file, output)
    began_with, killed_in_start = 0, 0
    while sum(kills.values()) < 20:
        done = len(list(output.glob("jobs/*.parquet")))
        if process.poll() is not None:
            pytest.fail(
                f"ended with {done} jobs done, before the kills did ({kills}):\n{process.communicate()}"
            )
        written = times_of(output) | written  # when each was first seen
        time.sleep(chance.uniform(0.2, 1.5))
        workers = workers_of(psutil.Process(process.pid))
        if not workers:
            continue  # still starting
        victim = chance.choice(["driver", "worker"])
        if victim == "worker" and done == began_with:
            if killed_in_start == 2:
                continue
            killed_in_start += 1
        os.kill(process.pid if victim == "driver" else chance.choice(workers).pid, signal.SIGKILL)
        kills[victim] += 1
        if victim == "driver":
            process.communicate(timeout=60)
            _, alive = psutil.wait_procs(workers, timeout=20)
            assert not alive, "workers outlive their driver"
            process = start(file, output)
            began_with, killed_in_start = len(list(output.glob("jobs/*.parquet"))), 0
    _, err = process.communicate(timeout=600)
    assert process.returncode in (0, 1)  # 1: a job has been with too many workers that died
    assert "Traceback" not in err
    finished(file, output)
    assert times_of(output).items() >= written.items()  # none was done again
    assert min(kills.values()) >= 5
    assert len(list(output.glob("jobs/*.parquet"))) == 200
    assert contents(output) == contents(tmp_path / "calm")
    assert left_over(output) == []


@pytest.mark.verify
@pytest.mark.at_length
@pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="only root may make a small disk")
def test_a_disk_that_fills_up_is_told_and_the_same_command_goes_on(tmp_path: Path) -> None:
    """A disk of 500 kB in memory, the worker's own folders on it too; then one of 50 MB: the table of a calm run."""
    file, disk = campaign(tmp_path, ranges=4, exposures=8), tmp_path / "disk"
    disk.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=500k", "tmpfs", disk]).returncode != 0:
        pytest.skip("this machine lets nobody mount a disk")
    try:
        process = start(file, disk / "out")
        _, err = process.communicate(timeout=300)
        said = " ".join(err.split())
        assert process.returncode == 2, err
        assert "cannot be written (No space left on device)" in said
        done = len(times_of(disk / "out"))
        # A worker may end a job after the command has counted.
        told = re.search(r"(\d+) of 32 jobs are done; make room, and the same command goes on", said)
        assert told is not None, said
        assert done - 2 < int(told[1]) <= done
        assert "Traceback" not in err
        assert 0 < done < 32
        subprocess.run(["mount", "-o", "remount,size=50M", disk], check=True)
        assert json.loads(finished(file, disk / "out", "--json"))["done_before"] == done
        finished(file, tmp_path / "calm")
        assert contents(disk / "out") == contents(tmp_path / "calm")
        assert left_over(disk / "out") == []
    finally:
        subprocess.run(["umount", "-l", disk], check=True)
