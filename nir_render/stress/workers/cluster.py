"""Workers of a Dask cluster that someone else has started: found, and held against this program.

A job's rows are kept under a hash of the code and the versions that made them. Workers that compute anything
else would fill a campaign with what it is not; so they are refused before the first job.
"""

import contextlib
import logging
import secrets
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from distributed import Client, get_worker
from distributed.comm.addressing import get_address_host
from distributed.utils import sync

from nir_render.errors import InputError
from nir_render.report.wording import counted
from nir_render.run.folder import disk_error
from nir_render.run.manifest import versions
from nir_render.stress.jobs import results_code_hash
from nir_render.transport.backend.variant import backend

_ANSWERS_WITHIN_S = 10
_STARTS_WITHIN_S = 120
_MAY_DIFFER = ("platform",)  # the processor: its bits may differ, its statistics do not
MARK = ".seen-"  # not one of the names that a cache takes for a killed writer's, and removes in time
DEATHS = 3  # of workers, that a job is given up after
DASK_SETTINGS = {
    "distributed.scheduler.allowed-failures": DEATHS - 1,
    "distributed.scheduler.worker-saturation": 1.0,  # none waits at a worker, which may end after its job
    "distributed.scheduler.worker-ttl": None,  # a worker that renders may be silent for long
    "distributed.worker.profile.enabled": False,  # it costs 4 % of a job
}
_THREADS = "start workers with '--nthreads 1', and '--nworkers' for more"


@dataclass(frozen=True)
class Scheduler:
    """The scheduler of workers that run elsewhere.

    `address` is as Dask writes it, tcp://host:8786; `threads` how many each worker computes with, None where
    workers of one host share its cores.
    """

    address: str
    threads: int | None = None


class RefusedError(InputError):
    """A worker that computes other than this program does; no job may go to it."""


@dataclass(frozen=True)
class Terms:
    """What each worker is held against, by itself: facts of this program, and a file in each shared folder.

    The files hold the token: a folder of the same name may be another one there.
    """

    facts: Mapping[str, str]
    marks: tuple[Path, ...]
    token: str

    def problems(self) -> list[str]:
        """Return what is wrong with this process as a worker, such as "has numpy 1, here it is 2"."""
        found = [
            f"does not see {mark.parent}; give -o, and --light-cache, a folder that all share"
            for mark in self.marks
            if _content(mark) != self.token
        ]
        own = process_facts()
        return found + [
            f"has {key} {own.get(key)}, here it is {value}; make them alike"
            for key, value in self.facts.items()
            if own.get(key) != value
        ]


def process_facts() -> dict[str, str]:
    """Return what results of this process follow from."""
    facts = {
        **versions(),
        "code": results_code_hash(),
        "variant": backend().variant,
        "compiler": backend().compiler,
    }
    return {key: value for key, value in facts.items() if key not in _MAY_DIFFER}


def _content(file: Path) -> str:
    try:
        return file.read_text()
    except (OSError, ValueError):
        return ""


@contextlib.contextmanager
def terms_of(folders: Sequence[Path]) -> Iterator[Terms]:
    """Mark folders until the end of the block; yield the terms of workers that share them.

    Raises
    ------
    InputError
        A folder cannot be written.
    """
    token = secrets.token_hex(16)
    marks = tuple(folder / f"{MARK}{token[:8]}" for folder in dict.fromkeys(folders))
    try:
        for mark in marks:
            try:
                mark.parent.mkdir(parents=True, exist_ok=True)
                mark.write_text(token)
            except OSError as error:
                raise disk_error(mark.parent, error) from None
        yield Terms(process_facts(), marks, token)
    finally:
        for mark in marks:
            with contextlib.suppress(OSError):
                mark.unlink()


@contextlib.contextmanager
def connected(address: str, terms: Terms) -> Iterator[Client]:
    """Connect to the cluster whose scheduler is at an address; yield its client.

    Parameters
    ----------
    address
        As Dask writes it: tcp://host:8786.
    terms
        What all workers are held against.

    Raises
    ------
    InputError
        Nobody answers, no worker is there in time, or workers are not of one mind with this program.
    """
    # That a scheduler goes is told by what becomes of the jobs; Dask's own log would add tracebacks.
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        client = Client(address, timeout=_ANSWERS_WITHIN_S)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--scheduler {address}: no Dask scheduler answers there ({error}); start one with "
            "'dask scheduler', and give the address that it prints"
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=_STARTS_WITHIN_S)
        except TimeoutError:
            raise InputError(
                f"--scheduler {address}: has no workers after {_STARTS_WITHIN_S} s; start some with "
                f"'dask worker {address} --nthreads 1'"
            ) from None
        _check(client, terms)
        yield client


def check_this_worker(terms: Terms) -> None:
    """Hold the worker that this runs in against the terms: it may have come after the start.

    Raises
    ------
    RefusedError
        It is not of one mind with the program that asks.
    """
    worker = get_worker()
    several = [] if worker.state.nthreads == 1 else [f"has several threads: {_THREADS}"]
    if problems := several + terms.problems():
        raise RefusedError(*(f"--scheduler: the worker {worker.address} {problem}" for problem in problems))


def workers_beside() -> int:
    """Return how many workers the host of this one has now, itself among them."""
    worker = get_worker()
    known: Mapping[str, Any] = sync(worker.loop, worker.scheduler.identity)["workers"]
    hosts: list[str] = [get_address_host(address) for address in known]
    return max(hosts.count(get_address_host(worker.address)), 1)


def _check(client: Client, terms: Terms) -> None:
    """Refuse workers with several threads, without this program, or with another one."""
    workers: Mapping[str, Any] = client.scheduler_info(n_workers=-1)["workers"]
    several = [name for name, worker in workers.items() if worker["nthreads"] != 1]
    if several:
        raise InputError(
            f"--scheduler: {counted(len(several), 'worker')} with several threads, {several[0]} the first; "
            f"a job wants a process of its own: {_THREADS}"
        )
    problems = []
    for name, found in sorted(client.run(terms.problems, on_error="return").items()):
        if isinstance(found, BaseException):
            problems.append(
                f"--scheduler: the worker {name} cannot load nir_render ({type(found).__name__}: {found}); "
                "install the same nir_render there"
            )
        else:
            problems += [f"--scheduler: the worker {name} {problem}" for problem in found]
    if problems:
        raise InputError(*problems)
