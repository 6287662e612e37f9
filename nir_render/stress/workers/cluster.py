"""Workers of a Dask cluster that someone else has started: found, and held against this program.

A job's rows are kept under a hash of the code and the versions that made them. Workers that compute anything
else would fill a campaign with what it is not; so they are refused before the first job.
"""

import contextlib
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from distributed import Client
from distributed.comm.addressing import get_address_host

from nir_render.errors import InputError
from nir_render.report.wording import counted
from nir_render.run.manifest import versions
from nir_render.stress.jobs import results_code_hash
from nir_render.transport.backend.variant import backend

_ANSWERS_WITHIN_S = 10
_STARTS_WITHIN_S = 120
_MAY_DIFFER = ("platform",)  # the processor: its bits may differ, its statistics do not


@contextlib.contextmanager
def connected(address: str, shared: Path) -> Iterator[tuple[Client, dict[str, int]]]:
    """Connect to the cluster whose scheduler is at an address; yield its client, and workers by host.

    Parameters
    ----------
    address
        As Dask writes it: tcp://host:8786.
    shared
        The folder that all workers write to.

    Raises
    ------
    InputError
        Nobody answers, no worker is there in time, or workers are not of one mind with this program.
    """
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
        _check(client, shared)
        hosts = Counter(get_address_host(worker) for worker in _workers(client))
        yield client, dict(hosts)


def worker_facts(shared: str) -> dict[str, str]:
    """Return what results of this process follow from, and whether it sees a folder; runs on a worker."""
    return {
        **versions(),
        "code": results_code_hash(),
        "variant": backend().variant,
        "folder": "seen" if Path(shared).is_dir() else "not seen",
    }


def _workers(client: Client) -> Mapping[str, Any]:
    workers: Mapping[str, Any] = client.scheduler_info(n_workers=-1)["workers"]
    return workers


def _check(client: Client, shared: Path) -> None:
    """Refuse workers with several threads, without this program, or with another one."""
    several = [name for name, worker in _workers(client).items() if worker["nthreads"] != 1]
    if several:
        raise InputError(
            f"--scheduler: {counted(len(several), 'worker')} with several threads, {several[0]} the first; "
            "a job wants a process of its own: start workers with '--nthreads 1', and '--nworkers' for more"
        )
    own = worker_facts(str(shared))
    found = client.run(worker_facts, str(shared), on_error="return")
    problems = []
    for name, facts in sorted(found.items()):
        if isinstance(facts, BaseException):
            problems.append(
                f"--scheduler: the worker {name} cannot load nir_render ({type(facts).__name__}: {facts}); "
                "install the same nir_render there"
            )
            continue
        if facts["folder"] != "seen":
            problems.append(
                f"--scheduler: the worker {name} does not see {shared}; give -o a folder that all share"
            )
        problems += [
            f"--scheduler: the worker {name} has {key} {facts.get(key)}, here it is {value}; make them alike"
            for key, value in own.items()
            if key not in ("folder", *_MAY_DIFFER) and facts.get(key) != value
        ]
    if problems:
        raise InputError(*problems)
