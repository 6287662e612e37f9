"""Runs of an experiment over seeds: side by side in processes, kept as they go, gone on with where killed."""

import math
import multiprocessing
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from nir_render.errors import InputError
from nir_render.experiments.flocking import Flocking, Instant, Loop
from nir_render.experiments.frame_sight import FrameSight
from nir_render.experiments.spacing import Spacing, spacing
from nir_render.run.folder import locked, read_json, write_file, write_json
from nir_render.run.manifest import versions
from nir_render.run.render import run_digest
from nir_render.scene.scene import Scene
from nir_render.transport.backend.cores import thread_settings

Progress = Callable[[int, int], None]
"""Called with the number of steps done, and of all."""

_SAVED_STEPS = 50


@dataclass(frozen=True)
class Run:
    """A run of one seed that is done: its spacing, where everybody was, and how well held light held."""

    seed: int
    spacing: Spacing
    record: dict[str, Any]


def run_seeds(
    scene: Scene, plan: Flocking, seeds: Sequence[int], folder: Path, workers: int, progress: Progress
) -> list[Run]:
    """Run an experiment for each seed, in `workers` processes; what is done in the folder is not done again.

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
    return [_read(folder, seed) for seed in seeds]


def _ended(scene: Scene, plan: Flocking, seeds: Sequence[int], folder: Path, workers: int) -> Iterator[int]:
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


def run_seed(scene: Scene, plan: Flocking, seed: int, folder: Path) -> None:
    """Run one seed to its end, from where an earlier process left it, and write its record."""
    state = folder / "runs" / f"{seed:04d}.state"
    # Written by `run_seed` itself, of the same plan, scene and code: the digest is checked before.
    loop: Loop = pickle.loads(state.read_bytes()) if state.exists() else Loop(scene, plan, seed)  # noqa: S301
    while len(loop.instants) < loop.steps:
        loop.step()
        if len(loop.instants) % _SAVED_STEPS == 0:
            write_file(state, pickle.dumps(loop))
    write_json(_file(folder, seed), record_of(loop))
    state.unlink(missing_ok=True)


def record_of(loop: Loop) -> dict[str, Any]:
    """Return a run as plain data: its spacing, the places of all over time, what held light was off by."""
    names = list(loop.world.movers)
    places_m = np.array([[instant.places_m[name] for name in names] for instant in loop.instants])
    shares = [
        share
        for sight in loop.sights.values()
        if isinstance(sight, FrameSight)
        for share in sight.held_shares
    ]
    return {
        "format": 1,
        "seed": loop.seed,
        "spacing": {
            name: value if math.isfinite(value) else None  # no number is no JSON
            for name, value in asdict(spacing_of(loop.instants, loop.plan)).items()
        },
        "robots": names,
        "time_s": [round(instant.time_s, 9) for instant in loop.instants],
        "places_m": np.round(places_m, 6).tolist(),
        "neighbours": [[instant.neighbours.get(name, 0) for name in names[1:]] for instant in loop.instants],
        "held_light_share": max(shares) if shares else None,
    }


def spacing_of(instants: Sequence[Instant], plan: Flocking) -> Spacing:
    """Return how well a run kept its spacing."""
    names = list(instants[0].places_m)
    distances_m = {
        (one, other): np.array([float(np.hypot(*(at.places_m[one] - at.places_m[other]))) for at in instants])
        for number, one in enumerate(names)
        for other in names[number + 1 :]
    }
    times_s = np.array([instant.time_s for instant in instants])
    return spacing(times_s, distances_m, plan.spacing_m, plan.base.diameter_m)


def _read(folder: Path, seed: int) -> Run:
    record = read_json(_file(folder, seed))
    said: dict[str, Any] = {
        name: math.nan if value is None else value for name, value in record["spacing"].items()
    }
    return Run(seed, Spacing(**said), record)


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
