"""Workers that a cluster's job queue (Slurm, PBS, LSF) starts: asked for, waited for, in the end cancelled.

dask-jobqueue writes and submits the scripts. What it cannot know stands here: that a render wants a process
of one thread; that workers leave before the queue ends them, so that no job is blamed; that others take their
place.
"""

import contextlib
import logging
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import dask
from dask.utils import parse_bytes
from pydantic import Field, ValidationError, field_validator, model_validator

from nir_render.errors import InputError
from nir_render.scene.documents.base import Document, Positive, Time
from nir_render.scene.problems import explain
from nir_render.scene.text.yaml_text import read_yaml
from nir_render.stress.workers.cluster import DASK_SETTINGS, Scheduler

_SUBMITS = {"slurm": "sbatch", "pbs": "qsub", "lsf": "bsub"}
_CLUSTERS = {"slurm": "SLURMCluster", "pbs": "PBSCluster", "lsf": "LSFCluster"}
_LEAVES_BEFORE_S = 60.0  # the queue ends a job: a worker leaves in order before
_LEAST_WALLTIME_S = 120.0
_STAGGER = 0.1  # of the lifetime, either way: not all workers leave at once
_LOOKS_EVERY_S = 0.5
_OURS = ("cores", "processes", "memory", "walltime", "queue", "account", "interface", "n_workers", "job_cls")


class QueueDocument(Document):
    """A job queue, and what is asked of it: `jobs` of it, each with `workers` processes of one thread.

    `memory` and `walltime` are of a job; `settings` are further arguments of dask-jobqueue's cluster, such as
    `job_script_prologue: [module load python]` or `job_extra_directives: ["--qos=low"]`.
    """

    example: ClassVar[str] = "{format: 1, system: slurm, jobs: 4, workers: 8, memory: 16 GiB, walltime: 2 h}"

    format: Literal[1]
    system: Literal["slurm", "pbs", "lsf"]
    jobs: Annotated[int, Field(ge=1, le=10_000)]
    workers: Annotated[int, Field(ge=1, le=1024)]
    memory: str
    walltime_s: Annotated[Time, Positive]
    queue: str | None = None
    account: str | None = None
    interface: str | None = None
    settings: dict[str, Any] = {}

    @field_validator("memory")
    @classmethod
    def _memory_is_one(cls, memory: str) -> str:
        try:
            parse_bytes(memory)
        except ValueError:
            raise ValueError(f"{memory!r} is no size of memory; write one such as 16 GiB") from None
        return memory

    @model_validator(mode="after")
    def _workers_live(self) -> "QueueDocument":
        if self.walltime_s < _LEAST_WALLTIME_S:
            raise ValueError(
                f"'walltime' is {self.walltime_s:g} s: workers leave {_LEAVES_BEFORE_S:g} s before its end; "
                f"take {_LEAST_WALLTIME_S:g} s or more"
            )
        if taken := sorted(set(self.settings) & set(_OURS)):
            raise ValueError(
                f"'settings' holds {taken[0]!r}, which a key of its own says; leave it out there"
            )
        return self


def load_queue(file: Path) -> QueueDocument:
    """Read a file that says which job queue starts workers, and what is asked of it.

    Raises
    ------
    InputError
        A line per problem.
    """
    if not file.is_file():
        raise InputError(f"{file}: there is no such file; it says which job queue starts the workers")
    try:
        raw = read_yaml(file)
    except ValueError as error:
        raise InputError(*str(error).split("\n")) from None
    try:
        return QueueDocument.model_validate(raw)
    except ValidationError as error:
        raise InputError(*explain(error, raw, str(file))) from None


@contextlib.contextmanager
def queued(file: Path, document: QueueDocument, logs: Path) -> Iterator[Scheduler]:
    """Have a job queue start workers; yield their scheduler as soon as one has come.

    Until the block ends, workers that leave are followed by others; then all are cancelled.

    Parameters
    ----------
    file
        Where the document stands; it is named in errors.
    logs
        The folder for what workers say; all of the cluster see it under this name.

    Raises
    ------
    InputError
        There is no such queue here, or it refuses; dask-jobqueue is not installed, or refuses a setting.
    """
    command = _SUBMITS[document.system]
    if shutil.which(command) is None:
        raise InputError(
            f"{file}: there is no {command} here, which hands jobs to {document.system}; begin where there is"
        )
    try:
        import dask_jobqueue
    except ImportError:
        raise InputError(
            f"{file}: dask-jobqueue is not installed; pip install 'nir_render[cluster]'"
        ) from None
    for name in ("distributed", "dask_jobqueue"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    with dask.config.set(DASK_SETTINGS):
        try:
            cluster = getattr(dask_jobqueue, _CLUSTERS[document.system])(
                **_arguments(document, logs.absolute())
            )
        except (ValueError, TypeError, RuntimeError, OSError) as error:
            raise InputError(f"{file}: dask-jobqueue refuses it: {_first_line(error)}") from None
    try:
        _submit(cluster, document, file)
        while not cluster.scheduler_info["workers"]:
            time.sleep(_LOOKS_EVERY_S)
        yield Scheduler(cluster.scheduler_address, threads=1)
    finally:
        with contextlib.suppress(AssertionError):  # Dask's, of jobs that the queue has refused
            cluster.close()


def _arguments(document: QueueDocument, logs: Path) -> dict[str, Any]:
    """Return what dask-jobqueue's cluster is made with."""
    lives_s = document.walltime_s - _LEAVES_BEFORE_S
    lifetime_s, stagger_s = lives_s / (1.0 + _STAGGER), lives_s / (1.0 + _STAGGER) * _STAGGER
    settings = dict(document.settings)
    lifetime = ["--lifetime", f"{lifetime_s:.0f}s", "--lifetime-stagger", f"{stagger_s:.0f}s"]
    return {
        "cores": document.workers,
        "processes": document.workers,
        "memory": document.memory,
        "walltime": _clock(document.walltime_s, seconds_too=document.system != "lsf"),
        "queue": document.queue,
        "project" if document.system == "lsf" else "account": document.account,
        "interface": document.interface,
        "log_directory": str(logs),
        "silence_logs": logging.CRITICAL,
        "scheduler_options": {"dashboard_address": ":0", **settings.pop("scheduler_options", {})},
        "worker_extra_args": [*lifetime, *settings.pop("worker_extra_args", [])],
        **settings,
    }


def _clock(seconds: float, *, seconds_too: bool) -> str:
    """Return a time as queues write it, such as 02:00:00; LSF leaves the seconds out."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours:02d}:{minutes:02d}" + (f":{rest:02d}" if seconds_too else "")


def _submit(cluster: Any, document: QueueDocument, file: Path) -> None:
    """Hand the jobs to the queue; from then on those that end are followed by others."""
    for _ in range(document.jobs):
        cluster.worker_spec.update(cluster.new_worker_spec())
    try:
        cluster.sync(
            cluster._correct_state
        )  # `scale` does this beside us, and only logs what a queue refuses
    except (RuntimeError, ValueError, OSError) as error:
        raise InputError(f"{file}: {document.system} refuses the job: {_refusal(error)}") from None
    cluster.adapt(minimum_jobs=document.jobs, maximum_jobs=document.jobs)


def _refusal(error: Exception) -> str:
    """Return what the queue's command wrote, of all that dask-jobqueue tells of its failure."""
    text = str(error)
    said = text.partition("stderr:")[2].strip() or text
    return " ".join(said.split())


def _first_line(error: Exception) -> str:
    return str(error).strip().partition("\n")[0]
