"""Runs of an experiment over seeds: side by side in processes, kept as they go, gone on with where killed."""

import multiprocessing
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict
from itertools import accumulate
from pathlib import Path
from typing import Any, ClassVar, Protocol

from nir_render.errors import InputError
from nir_render.run.folder import locked, read_json, write_file, write_json
from nir_render.run.manifest import versions
from nir_render.run.render import run_digest
from nir_render.scene.scene import Scene
from nir_render.transport.backend.cores import thread_settings

Progress = Callable[[int, int], None]
"""Called with the number of steps done, and of all."""

_SAVED_STEPS = 50


class Loop(Protocol):
    """A run in the making; it can be pickled between steps."""

    @property
    def steps(self) -> int:
        """How many steps the whole run has."""

    @property
    def done(self) -> int:
        """How many of them are done."""

    def step(self) -> Any:
        """Do the next one."""

    def record(self) -> dict[str, Any]:
        """Return a run that is done as plain data."""


class Plan(Protocol):
    """What the runs of an experiment are: a frozen dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def loop(self, scene: Scene, seed: int) -> Loop:
        """Return the beginning of a run."""


def run_seeds(
    scene: Scene, plan: Plan, seeds: Sequence[int], folder: Path, workers: int, progress: Progress
) -> list[dict[str, Any]]:
    """Return the record of each seed, run in `workers` processes; what is done is not done again.

    Raises
    ------
    InputError
        The folder holds runs of another plan, scene or version, or another process works in it.
    """
    digest = run_digest(scene, repr(plan))
    kept = folder / "plan.json"
    if kept.exists() and read_json(kept).get("digest") != digest:
        raise InputError(
            f"{folder}: holds runs of another plan, scene or version; give another folder, or remove it"
        )
    (folder / "runs").mkdir(parents=True, exist_ok=True)
    write_json(kept, {"digest": digest, "plan": asdict(plan), "versions": versions()})
    with locked(
        folder / ".lock", f"{folder}: another process works there; wait for it, or give another folder"
    ):
        wanted = [seed for seed in seeds if not _file(folder, seed).exists()]
        progress(len(seeds) - len(wanted), len(seeds))
        ended = _ended(scene, plan, wanted, folder, min(workers, len(wanted)))
        for done in accumulate(1 for _ in ended):
            progress(len(seeds) - len(wanted) + done, len(seeds))
    return [read_json(_file(folder, seed)) for seed in seeds]


def _ended(scene: Scene, plan: Plan, seeds: Sequence[int], folder: Path, workers: int) -> Iterator[int]:
    """Yield seeds as their runs end; a single worker is this process."""
    if workers < 2:
        for seed in seeds:
            run_seed(scene, plan, seed, folder)
            yield seed
        return
    with _one_thread_each(), ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        futures = {pool.submit(run_seed, scene, plan, seed, folder): seed for seed in seeds}
        try:
            for future in as_completed(futures):
                future.result()
                yield futures[future]
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def run_seed(scene: Scene, plan: Plan, seed: int, folder: Path) -> None:
    """Run one seed to its end, from where an earlier process left it, and write its record."""
    state = folder / "runs" / f"{seed:04d}.state"
    # Written by `run_seed` itself, of the same plan, scene and code: the digest is checked before.
    loop: Loop = pickle.loads(state.read_bytes()) if state.exists() else plan.loop(scene, seed)  # noqa: S301
    while loop.done < loop.steps:
        loop.step()
        if loop.done % _SAVED_STEPS == 0:
            write_file(state, pickle.dumps(loop))
    write_json(_file(folder, seed), loop.record())
    state.unlink(missing_ok=True)


def _file(folder: Path, seed: int) -> Path:
    return folder / "runs" / f"{seed:04d}.json"


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let processes that start meanwhile compute with one thread each: more gain nothing here."""
    one = {name: str(threads) for name, threads in thread_settings(1).items()}
    before = {name: os.environ.get(name) for name in one}
    os.environ.update(one)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
