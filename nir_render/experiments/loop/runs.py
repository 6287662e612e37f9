"""Runs of an experiment over seeds: side by side in processes, kept as they go, gone on with where killed."""

import multiprocessing
import os
import pickle
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict
from itertools import accumulate
from pathlib import Path
from typing import Any, ClassVar, Protocol

from nir_render.errors import InputError
from nir_render.experiments.loop.journal import Journal, Told, check_whole
from nir_render.run.folder import locked, read_json, write_file, write_json
from nir_render.run.manifest import versions
from nir_render.run.render import run_digest
from nir_render.scene.scene import Scene
from nir_render.transport.backend.cores import thread_settings
from perception import Calibration

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

    def calibrations(self) -> list[Calibration]:
        """Return what is known of the cameras that robots look by."""

    def step(self) -> Told:
        """Do the next one; return what there is to tell of it."""

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
    loop: Loop
    journal: Journal
    if state.exists():
        # Written by `run_seed` itself, of the same plan, scene and code: the digest is checked before.
        loop, journal = pickle.loads(state.read_bytes())  # noqa: S301
        journal = Journal(run_folder(folder, seed), journal.lengths)
        check_whole(journal)
    else:
        loop = plan.loop(scene, seed)
        shutil.rmtree(run_folder(folder, seed), ignore_errors=True)
        journal = Journal.begin(run_folder(folder, seed), loop.calibrations())
    while loop.done < loop.steps:
        journal.write(loop.step())
        if loop.done % _SAVED_STEPS == 0:
            journal.sync()
            write_file(state, pickle.dumps((loop, journal)))
    journal.sync()
    write_json(_file(folder, seed), loop.record())
    state.unlink(missing_ok=True)


def run_folder(folder: Path, seed: int) -> Path:
    """Return the folder of a seed: what was told as it went, in the files of a run folder."""
    return folder / "runs" / f"{seed:04d}"


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
