"""Jobs over worker processes of this machine, by Dask: what runs where, and what becomes of what is killed.

A job that is done has left its file; so what comes back from a worker is only that it is done. A worker that
is killed is started again, and its job goes to another; one that dies with several workers is given up.
"""

import contextlib
import hashlib
import logging
import multiprocessing
import shutil
import signal
from collections.abc import Collection, Generator, Iterator, Sequence
from concurrent.futures import CancelledError
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess
from pathlib import Path

import cv2
import dask
from distributed import Client, Future, LocalCluster, as_completed, get_worker
from distributed.client import ClosedClientError
from distributed.comm import CommClosedError
from distributed.diagnostics.plugin import WorkerPlugin
from distributed.scheduler import KilledWorker

from nir_render.errors import DiskFullError, InputError
from nir_render.run.perceive import estimators_in_process
from nir_render.scene.scene import Scene
from nir_render.stress.job.execute import execute
from nir_render.stress.jobs import Job, is_same, made_by_of
from nir_render.stress.store import Store
from nir_render.stress.table import read_part, write_part
from nir_render.stress.workers.cluster import (
    DASK_SETTINGS,
    RefusedError,
    Scheduler,
    Terms,
    check_this_worker,
    connected,
    terms_of,
    workers_beside,
)
from nir_render.stress.workers.recycle import JOBS, recycle
from nir_render.transport.backend.cores import cores, thread_settings
from nir_render.transport.backend.variant import set_threads
from nir_render.transport.cache import LightCache
from perception import Estimator, OwnSetEstimator

PARTS = "jobs"
PART_KIND = ".parquet"
_STARTS = 4
_MEMORY_LIMIT_BYTES = 256 * 2**20
_ENDS_WITHIN_S = 5
_PLUGIN = "nir_render"
_GONE = "the scheduler is gone; what is done stays done, and the same command goes on"


@dataclass(frozen=True)
class Work:
    """What all jobs of a campaign share.

    `scene` is what the jobs' settings change; `threads` how many each worker computes with, None where
    workers of one host share its cores; `processor` that of the machine that asks; `jobs_per_process` how
    many a worker does before it begins anew. All paths are absolute, those of the scene and of estimators
    too: workers have folders of their own. With a `store`, what a worker has written into its `parts` is put
    there, and workers elsewhere need not share folders with this program.
    """

    scene: Scene
    estimators: tuple[str, ...]
    parts: Path
    light: Path
    light_limit_bytes: int
    threads: int | None
    processor: str
    jobs_per_process: int = JOBS
    store: Store | None = None


@dataclass(frozen=True)
class Done:
    """A job that has ended: with its file written, or with what went wrong."""

    job: Job
    error: str | None = None


def part_file(parts: Path, job: Job) -> Path:
    """Return where a job leaves its rows."""
    return parts / f"{job.key}{PART_KIND}"


def part_object(job: Job) -> str:
    """Return how a job's rows are called in object storage."""
    return f"{PARTS}/{job.key}{PART_KIND}"


def run_jobs(
    work: Work, jobs: Sequence[Job], workers: int, scratch: Path, scheduler: Scheduler | None = None
) -> Generator[Done]:
    """Do jobs in `workers` processes, or by those of a `scheduler`; yield each as it ends.

    The first job of those that share light renders it; the others begin when it has ended, and find it in the
    cache. When the generator is closed, or an exception goes through it, the workers end.

    Raises
    ------
    InputError
        There is no scheduler, or none any more; or a worker is refused, at the start or later.
    DiskFullError
        A worker has no room for what a job has found: the next ones would have none either.
    """
    # `scratch` may hold what a killed run has left.
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir(parents=True)
    settings = {
        **DASK_SETTINGS,
        "distributed.nanny.pre-spawn-environ": thread_settings(work.threads or 1),
        "temporary-directory": str(scratch),
    }
    if scheduler is None:  # one that takes long to begin anew is not lost
        settings["distributed.deploy.lost-worker-timeout"] = "1 hour"
    try:
        terms: Terms | None = None
        with contextlib.ExitStack() as stack:
            stack.enter_context(dask.config.set(settings))
            if scheduler is None:
                client = stack.enter_context(_client(workers))
            else:
                shared = (work.parts, work.light) if work.store is None else ()
                terms = stack.enter_context(terms_of(shared))
                client = stack.enter_context(connected(scheduler.address, terms))
            plugin = _plugin_name(work)
            _tell_workers(client, _Context(work, terms), plugin)
            if scheduler is not None:  # it outlives this campaign
                stack.callback(_forget, client, plugin)
            order = {job.key: number for number, job in enumerate(jobs)}
            followers: dict[str, list[Job]] = {}
            first: list[Job] = []
            for job in jobs:
                if job.light in followers:
                    followers[job.light].append(job)
                else:
                    followers[job.light] = []
                    first.append(job)
            job_of: dict[Future, Job] = {}

            def submitted(job: Job) -> Future:
                # Named after the campaign's folder too: others may do the same job by the same scheduler.
                key, priority = f"{plugin}-{job.key}", -order[job.key]
                future = client.submit(_do, job, plugin, key=key, priority=priority, retries=0, pure=False)
                job_of[future] = job
                return future

            ending = as_completed([submitted(job) for job in first])
            for future in ending:
                if future.cancelled():
                    raise InputError(_GONE)
                job = job_of.pop(future)
                # However it has ended: one that takes its workers along must not take the others along.
                for follower in followers.pop(job.light, ()):
                    ending.add(submitted(follower))
                problem = _fault(future)
                del future  # what it told is then dropped, and a worker that has done enough may end
                yield Done(job, problem)
    except (ClosedClientError, CommClosedError, CancelledError):
        raise InputError(_GONE) from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


@contextlib.contextmanager
def _client(workers: int) -> Iterator[Client]:
    """Start worker processes; they end with the block."""
    others = set(multiprocessing.active_children())
    with contextlib.ExitStack() as stack:
        with _interrupts_held():
            cluster = _started(workers)
            stack.callback(_end, cluster, others)
            client = stack.enter_context(Client(cluster))
        yield client


def _started(workers: int) -> LocalCluster:
    """Start worker processes; again where one is killed before it is ready: later Dask sees to it."""
    for attempt in range(_STARTS):
        try:
            return LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address="127.0.0.1:0",  # none, but for a port that is free
                memory_limit=0,
                silence_logs=logging.CRITICAL,
            )
        except RuntimeError:
            if attempt == _STARTS - 1:
                raise
    raise AssertionError


def _plugin_name(work: Work) -> str:
    place = f"{work.parts} {work.store}"
    return f"{_PLUGIN}-{hashlib.sha256(place.encode()).hexdigest()[:12]}"


def _forget(client: Client, plugin: str) -> None:
    """Take from workers what this campaign told them; a scheduler that is gone has forgotten it."""
    with contextlib.suppress(OSError, TimeoutError, RuntimeError, ValueError, ClosedClientError):
        client.unregister_worker_plugin(plugin)


def _tell_workers(client: Client, context: "_Context", plugin: str) -> None:
    """Give workers what their jobs share; again where one is killed meanwhile."""
    for attempt in range(_STARTS):
        try:
            client.register_plugin(context, name=plugin)
        except OSError:  # Dask's CommClosedError is one
            if attempt == _STARTS - 1:
                raise
        else:
            return


def _end(cluster: LocalCluster, others: Collection[BaseProcess]) -> None:
    """End the workers: what has been done is on the disk, so those that do not end in time are killed."""
    try:
        cluster.close(timeout=_ENDS_WITHIN_S)
    except TimeoutError:  # one was just being started in the place of another that was killed
        for child in multiprocessing.active_children():
            if child not in others:
                child.kill()


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Hold Ctrl-C back until the end of the block.

    Threads and processes that begin in it never see one, those that replace a killed worker neither: it is
    the driver's, and ends them in order.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # to start it later would let Ctrl-C through in the thread that does
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


class _Context(WorkerPlugin):  # type: ignore[misc]
    """What a worker keeps from job to job: estimators, light, and how many threads it has.

    `terms` are those of workers that someone else has started; None for this program's own.
    """

    def __init__(self, work: Work, terms: Terms | None) -> None:
        self.work, self.terms = work, terms
        self._estimators: dict[str, Estimator | OwnSetEstimator] | None = None
        self._made_by: tuple[str, ...] = ()
        self._cache: LightCache | None = None
        self._threads = 0
        self._jobs = 0

    def do(self, job: Job) -> None:
        """Do a job, and leave its file.

        Raises
        ------
        RefusedError
            Here the job would be another one than was asked for.
        """
        if self._estimators is None:  # here, not at the start: Mitsuba's variant belongs to this thread
            if self.terms is not None:
                check_this_worker(self.terms)
            self._estimators = estimators_in_process(self.work.estimators)
            self._cache = LightCache(
                self.work.light,
                limit_bytes=self.work.light_limit_bytes,
                memory_limit_bytes=_MEMORY_LIMIT_BYTES,
            )
            self._made_by = made_by_of(self.work.estimators, self.work.processor)
        self._share_cores()
        file = part_file(self.work.parts, job)
        if read_part(file) is not None:  # by a worker that was killed before it could say so
            self._put(job, file)
            return
        if not is_same(job, self.work.scene, self._made_by, self.work.processor):
            raise RefusedError(
                f"the worker {get_worker().address} would do another job than was asked for: a file of the "
                "scene or of an estimator, the code or a version has changed or is another one there; "
                "the same command goes on"
            )
        self._jobs += 1
        scene = self.work.scene.with_(job.settings)
        rows, frames_sha256 = execute(scene, self._estimators, self._cache)
        write_part(file, rows, frames_sha256)
        self._put(job, file)

    def _put(self, job: Job, file: Path) -> None:
        if self.work.store is not None:
            self.work.store.put(file, part_object(job))

    def begin_anew_in_time(self) -> None:
        """Have another process take the place of this one, where the job that ends is its last."""
        worker = get_worker()
        if self._jobs >= self.work.jobs_per_process and recycle(worker, worker.get_current_task()):
            self._jobs = 0

    def _share_cores(self) -> None:
        """Take this worker's share of the cores; others may have come or gone since the last job."""
        threads = self.work.threads
        if threads is None:
            threads = max(cores() // workers_beside(), 1)
        if threads != self._threads:
            set_threads(threads)
            cv2.setNumThreads(threads)
            self._threads = threads


def _do(job: Job, plugin: str) -> str | None:
    """Do one job in a worker; return what went wrong, in words."""
    context = get_worker().plugins[plugin]
    try:
        context.do(job)
    except (RefusedError, DiskFullError):
        raise
    except Exception as error:  # one job that fails must not take the others along
        return str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    finally:
        context.begin_anew_in_time()
    return None


def _fault(future: Future) -> str | None:
    error = future.exception()
    if error is None:
        problem: str | None = future.result()
        return problem
    if isinstance(error, RefusedError | DiskFullError):
        raise error
    if isinstance(error, KilledWorker):
        deaths = error.allowed_failures + 1  # a scheduler that someone else has started has its own limit
        return f"{deaths} workers died with it, perhaps for want of memory: fewer on a machine need less"
    return f"{type(error).__name__}: {error}"
