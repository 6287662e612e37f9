"""A campaign by workers that a job queue starts: a Slurm of one node, this machine, begun here."""

import contextlib
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from tests.paths import ROOT
from tests.system.test_stress import campaign, contents, finished, left_over, times_of

pytestmark = [pytest.mark.mitsuba, pytest.mark.verify]

_NEEDED = ("munged", "slurmctld", "slurmd", "sbatch")
_PLACES = os.pathsep.join((os.environ.get("PATH", ""), "/usr/sbin", "/sbin"))


def free_ports(count: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]


def settings(folder: Path) -> str:
    name = socket.gethostname().partition(".")[0]
    ports = free_ports(2)
    lines = {
        "ClusterName": "test",
        "SlurmctldHost": f"{name}(127.0.0.1)",
        "SlurmctldPort": ports[0],
        "SlurmdPort": ports[1],
        "SlurmUser": "root",
        "AuthType": "auth/munge",
        "AuthInfo": f"socket={folder}/munge/socket",
        "CredType": "cred/munge",
        "StateSaveLocation": folder / "state",
        "SlurmdSpoolDir": folder / "spool",
        "SlurmctldPidFile": folder / "slurmctld.pid",
        "SlurmdPidFile": folder / "slurmd.pid",
        "ProctrackType": "proctrack/linuxproc",
        "TaskPlugin": "task/none",
        "SelectType": "select/cons_tres",
        "SelectTypeParameters": "CR_Core",
        "ReturnToService": 2,
        "MailProg": "/bin/true",
        "KillWait": 5,
        "NodeName": f"{name} NodeAddr=127.0.0.1 CPUs={os.cpu_count()} RealMemory=4000 State=UNKNOWN",
        "PartitionName": f"short Nodes={name} Default=YES MaxTime=60 State=UP",
    }
    return "".join(f"{key}={value}\n" for key, value in lines.items())


@pytest.fixture(scope="module")
def slurm() -> Iterator[dict[str, str]]:
    """Run Slurm; yield the environment in which its commands reach it."""
    if missing := [name for name in _NEEDED if shutil.which(name, path=_PLACES) is None]:
        pytest.skip(f"needs Slurm (Debian's slurm-wlm): there is no {missing[0]}")
    if os.geteuid() != 0:
        pytest.skip("needs to be root: Slurm starts jobs for others")
    folder = Path(tempfile.mkdtemp(prefix="slurm-"))  # a short name: that of a socket has 107 characters
    for name in ("state", "spool", "munge"):
        (folder / name).mkdir(mode=0o755)
    folder.chmod(0o755)
    (folder / "munge" / "key").write_bytes(os.urandom(1024))
    (folder / "munge" / "key").chmod(0o400)
    (folder / "slurm.conf").write_text(settings(folder))
    env = {**os.environ, "PATH": _PLACES, "SLURM_CONF": str(folder / "slurm.conf"), "PYTHONPATH": str(ROOT)}
    munge = folder / "munge"
    commands = (
        ["munged", "--foreground", "--force", f"--key-file={munge}/key", f"--socket={munge}/socket",
         f"--pid-file={munge}/pid", f"--log-file={munge}/log", f"--seed-file={munge}/seed"],
        ["slurmctld", "-D"],
        ["slurmd", "-D"],
    )  # fmt: skip
    with contextlib.ExitStack() as stack:
        stack.callback(shutil.rmtree, folder, ignore_errors=True)
        said = stack.enter_context((folder / "said.txt").open("wb"))
        for command in commands:
            running = subprocess.Popen(command, env=env, stdout=said, stderr=said)
            stack.callback(running.wait)
            stack.callback(running.terminate)
            time.sleep(0.5)
        until = time.monotonic() + 20
        while "idle" not in asked(env, "sinfo", "-h", "-o", "%T"):
            if time.monotonic() > until:
                pytest.skip(f"Slurm does not start here: {(folder / 'said.txt').read_text()[-500:]}")
            time.sleep(0.5)
        yield env


def asked(env: dict[str, str], *words: str) -> str:
    return subprocess.run(words, env=env, capture_output=True, text=True, check=False).stdout


def queue_file(folder: Path, **changes: object) -> Path:
    document = {"format": 1, "system": "slurm", "jobs": 2, "workers": 1, "memory": "1500 MiB",
                "walltime": "10 min"}  # fmt: skip
    file = folder / "queue.yaml"
    file.write_text(yaml.safe_dump({**document, **changes}))
    return file


def by_queue(env: dict[str, str], file: Path, output: Path, queue: Path) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "nir_render.command.main", "stress", str(file), "-o", str(output)]
    return subprocess.Popen(
        [*command, "--cluster", str(queue), "--json"], cwd=ROOT, text=True, env=env,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def test_what_the_queue_refuses_is_told(slurm: dict[str, str], tmp_path: Path) -> None:
    file = campaign(tmp_path, ranges=1, exposures=2)
    running = by_queue(slurm, file, tmp_path / "out", queue_file(tmp_path, memory="9 TiB"))
    _, err = running.communicate(timeout=120)
    assert running.returncode == 2, err
    assert "slurm refuses the job: sbatch: error: Memory specification can not be satisfied" in " ".join(
        err.split()
    )
    assert "Traceback" not in err


def test_jobs_that_the_queue_ends_are_followed_by_others(slurm: dict[str, str], tmp_path: Path) -> None:
    """Four of its jobs are ended, as at the end of their time: the table is that of this machine's own workers.

    No job of the campaign is blamed for it, though three deaths would be its end; nothing is left in the queue.
    """
    file = campaign(tmp_path, ranges=6, exposures=5)
    finished(file, tmp_path / "own")
    running = by_queue(slurm, file, tmp_path / "out", queue_file(tmp_path))
    ended: set[str] = set()
    until = time.monotonic() + 400
    while running.poll() is None and len(ended) < 4:
        assert time.monotonic() < until
        time.sleep(0.2)
        begun = asked(slurm, "squeue", "-h", "-t", "R", "-o", "%i").split()
        new = [job for job in begun if job not in ended]
        if len(times_of(tmp_path / "out")) > 2 * len(ended) and new:
            asked(slurm, "scancel", new[0])
            ended.add(new[0])
    out, err = running.communicate(timeout=300)
    assert running.returncode == 0, err
    assert len(ended) >= 2
    assert json.loads(out)["failed"] == 0
    assert contents(tmp_path / "out") == contents(tmp_path / "own")
    assert left_over(tmp_path / "out") == []
    assert asked(slurm, "squeue", "-h").strip() == ""
