"""The jobs of a campaign: one for each combination of values and seed, named by a hash of what it does."""

import hashlib
import itertools
import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from nir_render.errors import InputError
from nir_render.run.manifest import versions as run_versions
from nir_render.run.perceive import frame_estimators
from nir_render.scene.scene import Scene
from nir_render.stress.campaign import Campaign
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
    values
        The index into each axis's values, shape (axes,).
    settings
        What is changed in the campaign's scene, the seed included, by dotted path.
    light
        Jobs with the same words here see the same geometry: they share light.
    """

    key: str
    values: tuple[int, ...]
    seed: int
    settings: dict[str, Any]
    light: str


def plan(campaign: Campaign, progress: Callable[[int, int], None] = lambda *_: None) -> list[Job]:
    """Return the jobs of a campaign, in the order of its axes and seeds.

    Every scene is built, so that nothing that the input does wrong is found after hours. `progress` is told
    how many are, of all.

    Raises
    ------
    InputError
        A combination of values that makes no scene, or one whose camera cannot see.
    """
    sizes = [len(axis.values) for axis in campaign.axes]
    made_by = _made_by(campaign)
    jobs: list[Job] = []
    problems: list[str] = []
    values_of_scene: dict[str, tuple[int, ...]] = {}
    for built, values in enumerate(itertools.product(*map(range, sizes))):
        progress(built, math.prod(sizes))
        settings = settings_of(campaign, values)
        try:
            scene = campaign.scene.with_({**settings, "seed": 0})
            geometry = _geometry(scene)
        except InputError as error:
            problems += [
                f"{campaign.path}: at {_place(campaign, values)}: {problem}" for problem in error.problems
            ]
            continue
        scene_hash = hashlib.sha256(scene.document.model_dump_json().encode()).hexdigest()
        if scene_hash in values_of_scene:
            same = _place(campaign, values_of_scene[scene_hash])
            problems.append(f"{campaign.path}: at {_place(campaign, values)}: the same scene as at {same}")
        values_of_scene[scene_hash] = values
        for seed in campaign.seeds:
            parts = (scene_hash, f"seed {seed}", geometry, *made_by)
            key = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:_DIGITS]
            jobs.append(Job(key, values, seed, {**settings, "seed": seed}, f"{seed} {geometry}"))
    progress(math.prod(sizes), math.prod(sizes))
    if problems:
        raise InputError(*_first_of(problems))
    return jobs


def _place(campaign: Campaign, values: tuple[int, ...]) -> str:
    return ", ".join(f"{axis.name} = {axis.labels[i]}" for axis, i in zip(campaign.axes, values, strict=True))


def settings_of(campaign: Campaign, values: tuple[int, ...]) -> dict[str, Any]:
    """Return what a combination of values changes in the campaign's scene, by dotted path."""
    return {
        path: value
        for axis, index in zip(campaign.axes, values, strict=True)
        for path, value in axis.settings(index).items()
    }


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
