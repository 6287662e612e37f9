"""The jobs of a campaign: one for each point and seed, named by a hash of what it does."""

import hashlib
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from nir_render.errors import InputError
from nir_render.run.manifest import versions as run_versions
from nir_render.run.perceive import frame_estimators
from nir_render.scene.scene import Scene
from nir_render.stress.campaign import Campaign
from nir_render.stress.design.points import Point, number_of_points, points_of
from nir_render.transport.fingerprint import code_hash
from perception.estimators import OwnEstimator

# What shows results, and what is asked for, do not change them.
_NOT_IN_A_RESULT = (
    *("command/", "stress/", "regress/", "report/"),
    *("run/calibrate.py", "run/doctor.py", "run/examples.py", "run/time_estimate.py"),
)
_OF_STRESS = ("stress/job/", "stress/table.py")
_DIGITS = 32


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
) -> list[Job]:
    """Return the jobs of a campaign, in the order of its points and seeds.

    Every scene is built, so that nothing that the input does wrong is found after hours. `progress` is told
    how many are, of all; `planned` are jobs of the same campaign with fewer points, whose scenes were built.

    Raises
    ------
    InputError
        A point that makes no scene, or one whose camera cannot see.
    """
    number = number_of_points(campaign.axes, campaign.sample)
    made_by = _made_by(campaign)
    known: dict[tuple[float | str, ...], list[Job]] = {}
    for job in planned:
        known.setdefault(job.point.written, []).append(job)
    jobs: list[Job] = []
    problems: list[str] = []
    place_of_scene: dict[str, str] = {}
    for built, point in enumerate(points_of(campaign.axes, campaign.sample)):
        progress(built, number)
        if point.written in known:
            jobs += [replace(job, point=point) for job in known[point.written]]
            continue
        place = ", ".join(
            f"{axis.name} = {label}" for axis, label in zip(campaign.axes, point.labels, strict=True)
        )
        try:
            scene = campaign.scene.with_({**point.settings, "seed": 0})
            geometry = _geometry(scene)
        except InputError as error:
            problems += [f"{campaign.path}: at {place}: {problem}" for problem in error.problems]
            continue
        scene_hash = hashlib.sha256(scene.document.model_dump_json().encode()).hexdigest()
        if scene_hash in place_of_scene:
            problems.append(f"{campaign.path}: at {place}: the same scene as at {place_of_scene[scene_hash]}")
        place_of_scene[scene_hash] = place
        for seed in campaign.seeds:
            parts = (scene_hash, f"seed {seed}", geometry, *made_by)
            key = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:_DIGITS]
            jobs.append(Job(key, point, seed, {**point.settings, "seed": seed}, f"{seed} {geometry}"))
    progress(number, number)
    if problems:
        raise InputError(*_first_of(problems))
    return jobs


def _geometry(scene: Scene) -> str:
    """Return the hash of what all cameras of a scene see at all its times; meshes count by what they hold."""
    from nir_render.transport.render import geometry_of

    hashed = hashlib.sha256()
    for time_s in scene.document.frame_times_s():
        for camera in scene.cameras():
            hashed.update(geometry_of(scene.at(time_s), camera).encode())
    return hashed.hexdigest()


def _made_by(campaign: Campaign) -> tuple[str, ...]:
    """Return what a result follows from besides its scene: estimators, code, versions, machine."""
    from nir_render.transport.backend.variant import backend
    from nir_render.transport.cache_key import versions

    estimators = frame_estimators(campaign.estimators)
    own_files = [
        estimator.path.resolve() for estimator in estimators.values() if isinstance(estimator, OwnEstimator)
    ]
    contents = (hashlib.sha256(file.read_bytes()).hexdigest() for file in _with_imports(own_files))
    packages = (f"{name} {version}" for name, version in run_versions().items() if name != "platform")
    return (*estimators, *contents, _code_hash(), *packages, *versions(backend().variant, backend().compiler))


def _with_imports(estimators: list[Path]) -> list[Path]:
    """Return files of estimators, and what they have imported from beside them."""
    folders = {file.parent for file in estimators}
    files = (getattr(module, "__file__", None) for module in list(sys.modules.values()))
    imported = {Path(file).resolve() for file in files if file is not None}
    return sorted({*estimators, *(file for file in imported if file.parent in folders and file.is_file())})


@cache
def _code_hash() -> str:
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
