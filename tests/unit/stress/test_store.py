"""A campaign in object storage: from several machines, stopped and killed, against moto's server of S3."""

import io
import json
import os
import signal
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pyarrow.parquet as pq
import pytest

from nir_render.errors import InputError
from nir_render.stress import sweep as sweeps
from nir_render.stress.campaign import Campaign, load_campaign
from nir_render.stress.jobs import Job, plan
from nir_render.stress.store import Store, is_url
from nir_render.stress.table import write_part
from nir_render.stress.workers import pool
from nir_render.stress.workers.pool import Done, Work, part_file
from tests.paths import ROOT
from tests.system.test_stress import campaign as tiny_campaign
from tests.system.test_stress import workers_of

pytest.importorskip("s3fs", reason="s3fs is not installed")
moto = pytest.importorskip("moto.server", reason="moto, which plays S3, is not installed")

PLACE = "s3://bucket/runs/tiny"


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Start a server that has an empty bucket; give what S3's own client makes of it."""
    import boto3

    server = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    _, port = server.get_host_and_port()
    settings = {
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
    }
    for name, value in settings.items():
        monkeypatch.setenv(name, value)
    urllib.request.urlopen(f"http://127.0.0.1:{port}/moto-api/reset", data=b"").close()
    client = boto3.client("s3")
    client.create_bucket(Bucket="bucket")
    yield client
    server.stop()


@pytest.fixture(autouse=True)
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have each test open storage anew: each has a server of its own."""
    import s3fs

    from nir_render.stress import store

    store._opened.cache_clear()
    s3fs.S3FileSystem.clear_instance_cache()


def objects(client: Any) -> dict[str, tuple[Any, bytes]]:
    """Return when each object was put, and what it holds, by its name within the place."""
    listed = client.list_objects_v2(Bucket="bucket").get("Contents", [])
    return {
        one["Key"].removeprefix("runs/tiny/"): (
            one["LastModified"],
            client.get_object(Bucket="bucket", Key=one["Key"])["Body"].read(),
        )
        for one in listed
    }


def worked(done: list[str]) -> Any:
    """Return what does jobs as workers do, without a render; it notes their keys."""

    def run(work: Work, jobs: list[Job], *_: object) -> Iterator[Done]:
        for job in jobs:
            done.append(job.key)
            write_part(part_file(work.parts, job), [], job.key * 2)
            context = pool._Context(work, None)
            context._put(job, part_file(work.parts, job))
            yield Done(job)

    return run


@pytest.fixture
def tiny(tmp_path: Path) -> Campaign:
    return load_campaign(tiny_campaign(tmp_path, ranges=2, exposures=3))


def swept(campaign: Campaign, jobs: list[Job], folder: Path) -> sweeps.Sweep:
    return sweeps.sweep(campaign, jobs, folder, workers=1, progress=lambda *_: None, store=Store(PLACE))


@pytest.mark.mitsuba
def test_another_machine_goes_on_with_what_is_there(
    tmp_path: Path, tiny: Campaign, bucket: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs, done = plan(tiny), list[str]()
    monkeypatch.setattr(sweeps, "run_jobs", worked(done))
    swept(tiny, jobs, tmp_path / "one")
    assert done == [job.key for job in jobs]
    first = objects(bucket)
    assert set(first) == {
        "campaign.json", "planned.json", "jobs.jsonl", "table.parquet", *(f"jobs/{job.key}.parquet" for job in jobs),
    }  # fmt: skip
    for name, (_, held) in first.items():
        assert held == (tmp_path / "one" / name).read_bytes(), name
    status = {"campaign": "tiny", "jobs": 6, "done": 6, "others": 0}
    assert sweeps.status_record(tiny, tmp_path / "none", Store(PLACE)) == status
    assert sweeps.plan_record(tiny, jobs, tmp_path / "none", Store(PLACE))["done"] == 6

    # Elsewhere, one object lost and one cut off, as no S3 leaves it; and one that was done here before.
    done.clear()
    bucket.delete_object(Bucket="bucket", Key=f"runs/tiny/jobs/{jobs[2].key}.parquet")
    bucket.put_object(
        Bucket="bucket",
        Key=f"runs/tiny/jobs/{jobs[4].key}.parquet",
        Body=first[f"jobs/{jobs[4].key}.parquet"][1][:-9],
    )
    (tmp_path / "two" / "jobs").mkdir(parents=True)
    (tmp_path / "two" / "campaign.json").write_bytes((tmp_path / "one" / "campaign.json").read_bytes())
    kept = part_file(tmp_path / "one" / "jobs", jobs[2])
    part_file(tmp_path / "two" / "jobs", jobs[2]).write_bytes(kept.read_bytes())
    assert sweeps.status_record(tiny, tmp_path / "none", Store(PLACE))["done"] == 5
    result = swept(tiny, jobs, tmp_path / "two")
    assert done == [jobs[4].key]
    assert (result.reused, result.failed) == (5, {})
    assert {name: held for name, (_, held) in objects(bucket).items()} == {
        name: held for name, (_, held) in first.items()
    }


@pytest.mark.mitsuba
def test_rows_of_workers_elsewhere_are_fetched(
    tmp_path: Path, tiny: Campaign, bucket: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They write into a folder of that name on their own machine, which this one does not see."""
    jobs, own = plan(tiny), worked([])

    def elsewhere(work: Work, jobs: list[Job], *more: object) -> Iterator[Done]:
        for ended in own(work, jobs, *more):
            part_file(work.parts, ended.job).unlink()
            yield ended

    monkeypatch.setattr(sweeps, "run_jobs", elsewhere)
    result = swept(tiny, jobs, tmp_path / "out")
    assert result.failed == {}
    assert len(list((tmp_path / "out" / "jobs").iterdir())) == 6


@pytest.mark.mitsuba
def test_what_is_not_this_campaigns_or_not_there_is_refused(
    tiny: Campaign, bucket: Any, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="no sweep has begun there"):
        sweeps.status_record(tiny, tmp_path, Store(PLACE))
    bucket.put_object(Bucket="bucket", Key="runs/tiny/photo.png", Body=b"mine")
    with pytest.raises(InputError, match="s3://bucket/runs/tiny: holds objects that are no campaign's"):
        sweeps.status_record(tiny, tmp_path, Store(PLACE))
    other = json.dumps({"format": 1, "name": "other"}).encode()
    bucket.put_object(Bucket="bucket", Key="runs/tiny/campaign.json", Body=other)
    with pytest.raises(InputError, match="holds the campaign 'other', not 'tiny'"):
        sweeps.status_record(tiny, tmp_path, Store(PLACE))
    with pytest.raises(
        InputError, match="s3://nowhere/a: The specified bucket does not exist; check the bucket"
    ):
        sweeps.status_record(tiny, tmp_path, Store("s3://nowhere/a"))
    with pytest.raises(InputError, match="sb://a: Protocol not known: sb"):
        Store("sb://a").names()
    assert not is_url("outputs/tiny")


def start(folder: Path, file: Path, *more: str) -> "subprocess.Popen[str]":
    command = [sys.executable, "-m", "nir_render.command.main", "stress", str(file), "-o", PLACE]
    folder.mkdir(exist_ok=True)
    return subprocess.Popen(
        [*command, "--workers", "2", *more], cwd=folder, text=True, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip


@pytest.mark.verify
@pytest.mark.mitsuba
def test_a_driver_and_a_worker_are_killed_and_nothing_is_half_there_or_done_twice(
    tmp_path: Path, bucket: Any
) -> None:
    """A worker is killed after two jobs, the driver after four; another machine, with an empty disk, ends it."""
    file = tiny_campaign(tmp_path, ranges=3, exposures=4)
    process = start(tmp_path / "one", file)
    until, killed = time.monotonic() + 300, False
    while (done := sum(name.startswith("jobs/") for name in objects(bucket))) < 4:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        if done >= 2 and not killed:
            os.kill(workers_of(psutil.Process(process.pid))[0].pid, signal.SIGKILL)
            killed = True
        time.sleep(0.05)
    workers = workers_of(psutil.Process(process.pid))
    process.kill()
    process.communicate(timeout=60)
    psutil.wait_procs(workers, timeout=20)
    before = objects(bucket)
    for name, (_, held) in before.items():
        if name.startswith("jobs/"):
            pq.read_table(io.BytesIO(held))  # whole
    again = start(tmp_path / "two", file, "--json")
    out, err = again.communicate(timeout=600)
    assert again.returncode == 0, err
    said = json.loads(out)
    parts = {name for name in before if name.startswith("jobs/")}
    assert (said["jobs"], said["done_before"], said["failed"]) == (12, len(parts), 0)
    after = objects(bucket)
    assert {name: after[name] for name in parts} == {name: before[name] for name in parts}
    assert sum(name.startswith("jobs/") for name in after) == 12
    for name in ("table.parquet", "report.html"):
        assert after[name][1] == (tmp_path / "two" / "outputs" / "tiny" / name).read_bytes()
