"""Workers that end after so many jobs, and begin anew: what Mitsuba does not give back is given back then.

A worker is closed between two jobs: it takes no more, waits until the driver has heard of the last one, and
its nanny starts another in its place. No job is in it then, and none is blamed.
"""

import asyncio
import time

from distributed import Status, Worker
from distributed.utils import sync

JOBS = 200
"""Scenes that a worker renders before it begins anew."""

_HEARD_WITHIN_S = 10.0
_LOOKS_EVERY_S = 0.05


def recycle(worker: Worker, job: str) -> bool:
    """End a worker once its job is told, and have it started anew; call it from within that job.

    `job` is the key by which Dask knows it. Returns False, and does nothing, where nobody would start the
    worker again: it has no nanny.
    """
    if worker.nanny is None:
        return False
    sync(worker.loop, _take_no_more, worker)
    worker.loop.add_callback(_end, worker, job)
    return True


async def _take_no_more(worker: Worker) -> None:
    worker.status = Status.paused


async def _end(worker: Worker, job: str) -> None:
    """Close a worker when the driver has taken what its last job told: a few bytes, which would be lost.

    Where they are lost all the same, the job goes to another worker, which finds its file.
    """
    until = time.monotonic() + _HEARD_WITHIN_S
    while job in worker.state.tasks and time.monotonic() < until:
        await asyncio.sleep(_LOOKS_EVERY_S)
    await worker.close_gracefully(restart=True, reason="nir_render: jobs enough for one process")
