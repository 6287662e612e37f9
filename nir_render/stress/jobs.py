"""The jobs of a campaign: one for each point and seed, named by a hash of what it does."""

import hashlib
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from nir_render.errors import InputError
from nir_render.run.manifest import versions as run_versions
from nir_render.run.perceive import estimators_in_process
from nir_render.scene.documents.base import Same
from nir_render.scene.documents.camera import Rig
from nir_render.scene.documents.document import SceneDocument
from nir_render.scene.documents.shapes import ShapeDocument
from nir_render.scene.scene import Scene
from nir_render.stress.campaign import Campaign
from nir_render.stress.design.points import Point, points_of
from nir_render.transport.backend.cores import usual_workers
from nir_render.transport.backend.llvm.choice import cpu_name
from nir_render.transport.fingerprint import code_hash
from perception.estimators import OwnEstimator, OwnSetEstimator
from perception.own_code import files_of

# What shows results, and what is asked for, do not change them.
_NOT_IN_A_RESULT = (
    *("command/", "experiments/", "data/experiments/", "export/", "stress/", "regress/", "report/"),
    *("run/calibrate.py", "run/doctor.py", "run/examples.py", "run/time_estimate.py"),
)
_OF_STRESS = ("stress/job/", "stress/table.py")
_DIGITS = 32
_MANY, _CHUNK = 4000, 500
"""Scenes from which on they are shared among processes, and how many a process builds at a time."""


@dataclass(frozen=True)
class Job:
    """One scene to be rendered and perceived.

    Attributes
    ----------
    key
        32 hexadecimal digits: the hash of the resolved scene with its seed, the estimators, and the code.
    point
        What is set in the campaign's scene.
    settings
        The same with the seed, by dotted path.
    light
        Jobs with the same words here see the same geometry: they share light.
    """

    key: str
    point: Point
    seed: int
    settings: dict[str, Any]
    light: str


def plan(
    campaign: Campaign,
    progress: Callable[[int, int], None] = lambda *_: None,
    planned: Sequence[Job] = (),
    points: Sequence[Point] | None = None,
) -> list[Job]:
    """Return the jobs of a campaign, in the order of its points and seeds.

    Every scene is built, so that nothing that the input does wrong is found after hours. `progress` is told
    how many are, of all; `planned` are jobs of the same campaign with fewer points, whose scenes were built;
    `points` stand in place of all that the campaign has (`points_of`).

    Raises
    ------
    InputError
        A point that makes no scene, or one whose camera cannot see.
    """
    if points is None:
        points = list(points_of(campaign.axes, campaign.sample))
    number = len(points)
    made_by = made_by_of(campaign.estimators)
    known: dict[tuple[float | str, ...], list[Job]] = {}
    for job in planned:
        known.setdefault(job.point.written, []).append(job)
    jobs: list[Job] = []
    problems: list[str] = []

    def place_of(point: Point) -> str:
        named = zip(campaign.axes, point.labels, strict=True)
        return ", ".join(f"{axis.name} = {label}" for axis, label in named)

    point_of_scene: dict[str, Point] = {}
    hashes = _hashes(campaign.scene, [point.settings for point in points if point.written not in known])
    for built, point in enumerate(points):
        progress(built, number)
        if point.written in known:
            jobs += [replace(job, point=point) for job in known[point.written]]
            continue
        found = next(hashes)
        problems += [f"{campaign.path}: at {place_of(point)}: {problem}" for problem in found.problems]
        if found.problems:
            continue
        if found.scene in point_of_scene:
            same = place_of(point_of_scene[found.scene])
            problems.append(f"{campaign.path}: at {place_of(point)}: the same scene as at {same}")
        point_of_scene[found.scene] = point
        for seed in campaign.seeds:
            jobs.append(
                Job(
                    found.key(seed, made_by),
                    point,
                    seed,
                    {**point.settings, "seed": seed},
                    f"{seed} {found.geometry}",
                )
            )
    progress(number, number)
    if problems:
        raise InputError(*_first_of(problems))
    return jobs


@dataclass(frozen=True)
class Hashes:
    """The hashes of a scene and of its geometry; or what is wrong with it."""

    scene: str = ""
    geometry: str = ""
    problems: tuple[str, ...] = ()

    def key(self, seed: int, made_by: Sequence[str]) -> str:
        """Return the key of the job that renders the scene with a seed (`made_by_of`)."""
        parts = (self.scene, f"seed {seed}", self.geometry, *made_by)
        return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:_DIGITS]


def _hashes(scene: Scene, settings: Sequence[Mapping[str, Any]]) -> Iterator[Hashes]:
    """Yield what a scene is with each of the settings, in their order.

    Building one takes a millisecond or some: many are shared among processes.
    """
    workers = usual_workers()
    if len(settings) < _MANY or workers == 1:
        yield from (hashes_of(scene, one) for one in settings)
        return
    chunks = [settings[first : first + _CHUNK] for first in range(0, len(settings), _CHUNK)]
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        for found in pool.map(_hashes_of_all, itertools.repeat(scene), chunks):
            yield from found


def _hashes_of_all(scene: Scene, settings: Sequence[Mapping[str, Any]]) -> list[Hashes]:
    return [hashes_of(scene, one) for one in settings]


def hashes_of(scene: Scene, settings: Mapping[str, Any]) -> Hashes:
    """Return what a scene is with settings, whatever its seed."""
    try:
        changed = scene.with_({**settings, "seed": 0})
        return Hashes(_scene_hash(changed.document), _geometry(changed))
    except InputError as error:
        return Hashes(problems=error.problems)


def is_same(job: Job, scene: Scene, made_by: Sequence[str], processor: str) -> bool:
    """Tell whether a job that was planned elsewhere is the same here: scene, files, `made_by_of`.

    On another processor the last digits of a geometry may be others: there it is not compared.
    """
    found = hashes_of(scene, job.settings)
    geometry = job.light.partition(" ")[2]
    if processor == cpu_name() and found.geometry != geometry:
        return False
    return replace(found, geometry=geometry).key(job.seed, made_by) == job.key


def _scene_hash(document: SceneDocument) -> str:
    """Return the hash of a resolved scene; what scenes share, as they were read once, is written once."""
    # Scattered robots are among the others.
    without: dict[str, Any] = {"robots": {"__all__": {"rig"}}, "shapes": True, "scatter": True}
    hashed = hashlib.sha256(document.model_dump_json(exclude=without).encode())
    for name, shape in document.shapes.items():
        hashed.update(f"\0{name}\0".encode() + _text(Same(shape)))
    for robot in document.robots.values():
        hashed.update(b"\0" + _text(Same(robot.rig)))
    return hashed.hexdigest()


@lru_cache(maxsize=8192)
def _text(same: Same[Rig | ShapeDocument]) -> bytes:
    return same.part.model_dump_json().encode()


def _geometry(scene: Scene) -> str:
    """Return the hash of what all cameras of a scene see at all its times; meshes count by what they hold."""
    from nir_render.transport.render import geometry_of

    hashed = hashlib.sha256()
    document = scene.document
    times_s = document.frame_times_s()
    if not any(body.moves for body in (*document.robots.values(), *document.shapes.values())):
        del times_s[1:]  # the world is the same at all of them
    for time_s in times_s:
        for camera in scene.cameras():
            hashed.update(geometry_of(scene.at(time_s), camera).encode())
    return hashed.hexdigest()


def made_by_of(names: Sequence[str], processor: str = "") -> tuple[str, ...]:
    """Return what a result follows from besides its scene: estimators, code, versions, machine.

    `processor` stands for this machine's own where another one asks for the job.
    """
    from nir_render.transport.backend.variant import backend
    from nir_render.transport.cache_key import versions

    estimators = estimators_in_process(names)
    own = (one.path for one in estimators.values() if isinstance(one, OwnEstimator | OwnSetEstimator))
    files = sorted({file for path in own for file in files_of(path)})
    contents = (hashlib.sha256(file.read_bytes()).hexdigest() for file in files)
    packages = (f"{name} {version}" for name, version in run_versions().items() if name != "platform")
    own_processor = cpu_name()
    computed_by = (
        processor if processor and part == own_processor else part
        for part in versions(backend().variant, backend().compiler)
    )
    return (*estimators, *contents, results_code_hash(), *packages, *computed_by)


@cache
def results_code_hash() -> str:
    """Return the hash of all code and tables that results follow from."""
    root = Path(__file__).parents[2]
    return code_hash((root, _code_files(root)))


def _code_files(root: Path) -> Iterator[Path]:
    package = root / "nir_render"
    for file in sorted([*package.rglob("*"), *(root / "perception").rglob("*.py")]):
        inner = file.relative_to(package).as_posix() if file.is_relative_to(package) else ""
        known = file.suffix in (".py", ".yaml", ".csv") and not inner.startswith("data/scenes/")
        if known and (inner.startswith(_OF_STRESS) or not inner.startswith(_NOT_IN_A_RESULT)):
            yield file


def _first_of(problems: list[str], most: int = 10) -> list[str]:
    more = len(problems) - most
    return problems if more <= 0 else [*problems[:most], f"… and {more} more"]
