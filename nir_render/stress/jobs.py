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

from nir_render import run
from nir_render.errors import InputError
from nir_render.scene.load import Scene
from nir_render.stress.campaign import Campaign
from perception.own_estimator import OwnEstimator

MOST_JOBS = 100_000
# What shows results, and what is asked for, do not change them.
_NOT_IN_A_RESULT = (
    *("report/", "regress/", "export/", "cli.py", "console.py", "doctor.py", "examples.py", "estimate.py"),
    *("calibrate_run.py", "stress/"),
)
_OF_STRESS = ("stress/execute.py", "stress/table.py")
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
        A combination of values that makes no scene, or one whose camera cannot see; too many jobs; an
        estimator that is unknown.
    """
    sizes = [len(axis.values) for axis in campaign.axes]
    count = math.prod(sizes) * len(campaign.seeds)
    if count > MOST_JOBS:
        raise InputError(
            f"{campaign.path}: {' × '.join(map(str, sizes))} values and {len(campaign.seeds)} seeds are "
            f"{count} jobs; at most {MOST_JOBS} are taken at once: split the campaign"
        )
    made_by = _made_by(campaign)
    jobs: list[Job] = []
    problems: list[str] = []
    known: dict[str, tuple[int, ...]] = {}
    for built, values in enumerate(itertools.product(*map(range, sizes))):
        progress(built, math.prod(sizes))
        settings = settings_of(campaign, values)
        try:
            scene = campaign.scene.with_({**settings, "seed": 0})
            geometry = _geometry(scene)
        except InputError as error:
            problems += [f"{campaign.path}: at {_place(campaign, values)}: {one}" for one in error.problems]
            continue
        of_scene = hashlib.sha256(scene.document.model_dump_json().encode()).hexdigest()
        if of_scene in known:
            same = _place(campaign, known[of_scene])
            problems.append(f"{campaign.path}: at {_place(campaign, values)}: the same scene as at {same}")
        known[of_scene] = values
        for seed in campaign.seeds:
            parts = (of_scene, f"seed {seed}", geometry, *made_by)
            key = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:_DIGITS]
            jobs.append(Job(key, values, seed, {**settings, "seed": seed}, f"{seed} {geometry}"))
    progress(math.prod(sizes), math.prod(sizes))
    if problems:
        raise InputError(*_first(problems))
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
            hashed.update(geometry_of(scene, camera, time_s).encode())
    return hashed.hexdigest()


def _made_by(campaign: Campaign) -> tuple[str, ...]:
    """Return what a result follows from besides its scene: estimators, code, versions, machine."""
    from nir_render.transport.backend import backend
    from nir_render.transport.key import versions

    try:
        estimators = run.chosen_estimators(campaign.estimators)
    except InputError as error:
        problems = (problem.removeprefix("--estimator ") for problem in error.problems)
        raise InputError(*(f"{campaign.path}: estimators: {problem}" for problem in problems)) from None
    own = [one.path.resolve() for one in estimators.values() if isinstance(one, OwnEstimator)]
    contents = (hashlib.sha256(file.read_bytes()).hexdigest() for file in _with_imports(own))
    packages = (f"{name} {version}" for name, version in run.versions().items() if name != "platform")
    return (*estimators, *contents, _code(), *packages, *versions(backend().variant, backend().compiler))


def _with_imports(estimators: list[Path]) -> list[Path]:
    """Return files of estimators, and what they have imported from beside them."""
    folders = {file.parent for file in estimators}
    files = (getattr(module, "__file__", None) for module in list(sys.modules.values()))
    imported = {Path(file).resolve() for file in files if file is not None}
    return sorted({*estimators, *(file for file in imported if file.parent in folders and file.is_file())})


@cache
def _code() -> str:
    """Return the hash of all code and tables that results follow from."""
    root = Path(__file__).parents[2]
    hashed = hashlib.sha256()
    for file in _code_files(root):
        hashed.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return hashed.hexdigest()


def _code_files(root: Path) -> Iterator[Path]:
    package = root / "nir_render"
    for file in sorted([*package.rglob("*"), *(root / "perception").rglob("*.py")]):
        inner = file.relative_to(package).as_posix() if file.is_relative_to(package) else ""
        known = file.suffix in (".py", ".yaml", ".csv") and not inner.startswith("data/scenes/")
        if known and (inner in _OF_STRESS or not inner.startswith(_NOT_IN_A_RESULT)):
            yield file


def _first(problems: list[str], most: int = 10) -> list[str]:
    more = len(problems) - most
    return problems if more <= 0 else [*problems[:most], f"… and {more} more"]
