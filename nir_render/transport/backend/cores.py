"""How many processes this machine can feed, and what tells libraries how many threads each may use."""

import os

_MOST_WORKERS = 8  # by default: each takes a GiB or more
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def usual_workers() -> int:
    """Return how many processes to work in where nobody says."""
    return min(cores(), _MOST_WORKERS)


def thread_settings(threads: int) -> dict[str, int]:
    """Return the environment that tells libraries that bring threads of their own how many to use.

    They read it as they are loaded: it is for processes that are yet to start.
    """
    return dict.fromkeys(_THREAD_VARIABLES, threads)
