"""Workers that are killed at a bad moment, or that are not of one mind with the program that asks them."""

import contextlib
import errno
import pickle
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import yaml
from distributed import Client, Future
from distributed.client import ClosedClientError
from distributed.comm import CommClosedError
from distributed.scheduler import KilledWorker

from nir_render import InputError
from nir_render.errors import DiskFullError
from nir_render.stress import sweep as sweeps
from nir_render.stress.campaign import load_campaign
from nir_render.stress.jobs import Job, is_same, made_by_of, plan
from nir_render.stress.table import read_part, write_part
from nir_render.stress.workers import cluster, pool
from nir_render.stress.workers.cluster import RefusedError, check_this_worker, process_facts, terms_of
from nir_render.stress.workers.pool import (
    Done,
    Work,
    _Context,
    _do,
    _fault,
    _tell_workers,
    part_file,
    run_jobs,
)
from nir_render.transport import cache_key
from tests.system.test_stress import campaign as tiny_campaign

OWN = "def none(frame, calibration):\n    return []\n"


def worker(threads: int = 1) -> Any:
    return SimpleNamespace(address="tcp://there:1", state=SimpleNamespace(nthreads=threads))


@pytest.mark.parametrize(("kills", "survives"), [(0, True), (3, True), (4, False)])
def test_a_worker_killed_while_it_is_told_does_not_end_the_campaign(kills: int, survives: bool) -> None:
    """Dask then closes the line to all of them; four times in a row is no accident."""
    told: list[Any] = []

    def register_plugin(plugin: Any, name: str) -> None:
        told.append(plugin)
        if len(told) <= kills:
            raise CommClosedError("Stream is closed")

    client = cast("Client", SimpleNamespace(register_plugin=register_plugin))
    context = cast("_Context", None)
    if survives:
        _tell_workers(client, context, "name")
        assert len(told) == kills + 1
    else:
        with pytest.raises(CommClosedError):
            _tell_workers(client, context, "name")


def work_of(folder: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Work, list[Job]]:
    """Return what a campaign named by a relative path gives its workers; and its jobs."""
    file = tiny_campaign(folder, ranges=1, exposures=2)
    (folder / "mine.py").write_text(OWN)
    file.write_text(yaml.safe_dump({**yaml.safe_load(file.read_text()), "estimators": ["mine.py:none"]}))
    monkeypatch.chdir(folder)
    given: list[Work] = []

    def run(work: Work, *_: object) -> Iterator[pool.Done]:
        given.append(work)
        yield pool.Done(jobs[0])
        raise InputError("enough")

    monkeypatch.setattr(sweeps, "run_jobs", run)
    campaign = load_campaign(file.name)
    jobs = plan(campaign)
    with pytest.raises(InputError, match="enough"):
        sweeps.sweep(campaign, jobs, Path("out"), workers=1, progress=lambda *_: None)
    return given[0], jobs


@pytest.mark.mitsuba
def test_a_worker_needs_no_working_directory_and_does_what_was_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work, jobs = work_of(tmp_path, monkeypatch)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    monkeypatch.setattr(pool, "get_worker", worker)
    assert work.scene.folder == tmp_path
    assert all(path.is_absolute() for path in (work.parts, work.light))
    _Context(work, None).do(jobs[0])
    assert read_part(part_file(work.parts, jobs[0])) is not None
    # Another processor makes other light of the same statistics: that is no other job.
    monkeypatch.setattr("nir_render.stress.jobs.cpu_name", lambda: "another")
    monkeypatch.setattr("nir_render.transport.cache_key.cpu_name", lambda: "another")
    cache_key._versions.cache_clear()
    try:
        assert is_same(jobs[1], work.scene, made_by_of(work.estimators, work.processor), work.processor)
        assert not is_same(jobs[1], work.scene, made_by_of(work.estimators), work.processor)
    finally:
        monkeypatch.undo()
        cache_key._versions.cache_clear()
    monkeypatch.setattr(pool, "get_worker", worker)
    (tmp_path / "mine.py").write_text(OWN + "# edited after the plan\n")
    with pytest.raises(RefusedError, match="another job than was asked for"):
        _Context(work, None).do(jobs[1])
    assert read_part(part_file(work.parts, jobs[1])) is None


@pytest.mark.mitsuba
def test_a_worker_that_comes_late_is_held_against_the_same_terms(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "compiler" in process_facts()
    with terms_of((tmp_path / "parts", tmp_path / "light")) as terms:
        for threads, found, said in (
            (1, terms, None),
            (2, terms, "several threads"),
            (1, replace(terms, facts={**terms.facts, "compiler": "LLVM 1"}), "make them alike"),
            (1, replace(terms, token="another"), "does not see"),  # a folder of this name, but another one
        ):
            monkeypatch.setattr(cluster, "get_worker", lambda threads=threads: worker(threads))
            with contextlib.nullcontext() if said is None else pytest.raises(RefusedError, match=said):
                check_this_worker(found)
        (tmp_path / "light").joinpath(terms.marks[1].name).unlink()
        assert terms.problems() == [
            f"does not see {tmp_path / 'light'}; give -o, and --light-cache, a folder that all share"
        ]
    assert list((tmp_path / "parts").iterdir()) == []


def test_workers_share_the_cores_that_they_have_now(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three of four are on this one's host; a worker that joined is counted with the next job."""
    known = ["tcp://a:1", "tcp://a:2", "tcp://b:1", "tcp://a:3"]
    here = SimpleNamespace(loop=None, scheduler=SimpleNamespace(identity=None), address="tcp://a:1")
    monkeypatch.setattr(cluster, "get_worker", lambda: here)
    monkeypatch.setattr(cluster, "sync", lambda *_: {"workers": dict.fromkeys(known)})
    assert cluster.workers_beside() == 3
    taken: list[int] = []
    monkeypatch.setattr(pool, "set_threads", taken.append)
    monkeypatch.setattr("cv2.setNumThreads", taken.append)
    monkeypatch.setattr(pool, "cores", lambda: 12)
    context = _Context(cast("Work", SimpleNamespace(threads=None)), None)
    context._share_cores()
    context._share_cores()
    known += ["tcp://a:4"]
    context._share_cores()
    assert taken == [4, 4, 3, 3]


class Lost:
    """What is left of a job's future when its scheduler is gone."""

    def cancelled(self) -> bool:
        return True


@pytest.mark.parametrize("gone", ["cancelled", "closed"])
def test_a_scheduler_that_is_gone_is_told_in_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gone: str
) -> None:
    def submit(*_: object, **__: object) -> Any:
        if gone == "closed":
            raise ClosedClientError("submit")
        return Lost()

    monkeypatch.setattr(pool, "_client", lambda _: contextlib.nullcontext(SimpleNamespace(submit=submit)))
    monkeypatch.setattr(pool, "_tell_workers", lambda *_: None)
    monkeypatch.setattr(pool, "as_completed", iter)
    work = cast("Work", SimpleNamespace(threads=1, parts=tmp_path, store=None))
    job = cast("Job", SimpleNamespace(key="a", light="b"))
    with pytest.raises(InputError, match="the same command goes on"):
        list(run_jobs(work, [job], 1, tmp_path / "scratch"))


def test_as_many_deaths_are_told_as_the_scheduler_allows() -> None:
    killed = KilledWorker("a", None, 5)
    assert (_fault(cast("Future", SimpleNamespace(exception=lambda: killed))) or "").startswith(
        "6 workers died"
    )
    refused = RefusedError("no")
    with pytest.raises(RefusedError):
        _fault(cast("Future", SimpleNamespace(exception=lambda: refused)))


@pytest.mark.mitsuba
def test_a_disk_that_fills_up_ends_the_campaign_and_says_how_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No room for the third of six jobs: none is tried after it, and the same call does the four that are missing."""
    campaign = load_campaign(tiny_campaign(tmp_path, ranges=2, exposures=3))
    jobs, tried, room = plan(campaign), list[str](), 2

    def run(work: Work, jobs: list[Job], *_: object) -> Iterator[Done]:
        def do(job: Job) -> None:
            tried.append(job.key)
            if len(tried) > room:
                monkeypatch.setattr("os.fsync", full)
            write_part(part_file(work.parts, job), [], job.key * 2)

        here = SimpleNamespace(plugins={"name": SimpleNamespace(do=do, begin_anew_in_time=lambda: None)})
        monkeypatch.setattr(pool, "get_worker", lambda: here)
        for job in jobs:
            error: BaseException | None = None
            try:
                _do(job, "name")
            except DiskFullError as found:  # goes from the worker to the driver as bytes
                error = pickle.loads(pickle.dumps(found))
            future = SimpleNamespace(exception=lambda error=error: error, result=lambda: None)
            yield Done(job, _fault(cast("Future", future)))

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(sweeps, "run_jobs", run)
    with pytest.raises(InputError) as told:
        sweeps.sweep(campaign, jobs, tmp_path / "out", workers=1, progress=lambda *_: None)
    assert str(told.value).endswith(
        "cannot be written (No space left on device); nothing half-written was left there; "
        "2 of 6 jobs are done; make room, and the same command goes on"
    )
    assert tried == [job.key for job in jobs[:3]]
    assert len(list((tmp_path / "out" / "jobs").iterdir())) == 2
    monkeypatch.undo()
    monkeypatch.setattr(sweeps, "run_jobs", run)
    room = 99
    result = sweeps.sweep(campaign, jobs, tmp_path / "out", workers=1, progress=lambda *_: None)
    assert (result.reused, result.failed, len(tried)) == (2, {}, 7)
