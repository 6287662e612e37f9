"""The arguments and options that several commands take, and what becomes of their text."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nir_render.errors import InputError

if TYPE_CHECKING:
    from nir_render.run.perceive import RunEstimator
    from nir_render.scene.scene import Scene
    from nir_render.transport.cache import LightCache

SceneArgument = Annotated[Path, typer.Argument(metavar="SCENE", help="A scene file (YAML).")]
FolderArgument = Annotated[Path, typer.Argument(metavar="DIR", help="A run folder.")]
Output = Annotated[
    Path | None,
    typer.Option("-o", "--output", metavar="DIR", help="Where it goes; outputs/NAME by default."),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="PATH=VALUE", help='Change the scene: --set robots.r2.rig.sources.top.flux="0.1 W".'
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the run that the folder holds.")]
Seed = Annotated[int | None, typer.Option("--seed", min=0, help="Replaces the scene's seed.")]
Threads = Annotated[
    int | None, typer.Option("--threads", min=1, help="Threads to render with; all by default.")
]
Estimators = Annotated[
    list[str] | None,
    typer.Option(
        "--estimator",
        metavar="NAME",
        help="paper, robust, or one's own as file.py:function or 'cmd: PROGRAM'; paper and robust by "
        "default. Repeatable.",
    ),
]
OwnTracker = Annotated[
    str | None,
    typer.Option(
        "--tracker", metavar="FILE", help="One's own tracker as file.py:function, in place of those built in."
    ),
]
OwnDecoder = Annotated[
    str | None,
    typer.Option(
        "--decoder", metavar="FILE", help="One's own decoder as file.py:function, in place of those built in."
    ),
]
CalibrationFile = Annotated[
    Path | None,
    typer.Option(
        "--calibration",
        metavar="FILE",
        help="In place of the folder's calibration.json, such as the calibration.fitted.json of 'calibrate'.",
    ),
]
TimeLimit = Annotated[
    float | None,
    typer.Option(
        "--time-limit",
        metavar="S",
        help="Seconds for a frame: an estimator 'cmd: …' that takes longer fails (60 by default), and robust "
        "begins with no further flare.",
    ),
]
Period = Annotated[
    float | None,
    typer.Option(
        "--period",
        metavar="S",
        help="Seconds from one set of frames to the next, where it is not a camera's from frame to frame: of "
        "brackets, whose exposures are one set if they begin within half of it.",
    ),
]
KeepLight = Annotated[
    bool, typer.Option("--keep-light", help="Keep the light of each frame: spectral EXR and direct table.")
]
LightFolder = Annotated[
    Path | None,
    typer.Option(
        "--light-cache",
        metavar="DIR",
        help="Keep rendered light here, and render none that is here already; runs may share the folder.",
    ),
]
LightLimit = Annotated[
    float,
    typer.Option(
        "--light-cache-gib",
        help="How large that folder may grow; the least recently used goes first.",
    ),
]
Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON object on standard output, and nothing else there.")
]


def read_scene(path: Path, settings: list[str] | None, seed: int | None) -> "Scene":
    """Return the scene of a file with what `--set` and `--seed` change in it."""
    from nir_render.scene.load import load_scene

    overrides: Mapping[str, Any] = dict(map(_setting, settings or []))
    return load_scene(path, overrides if seed is None else {**overrides, "seed": seed})


def chosen_estimators(names: list[str] | None, time_limit_s: float | None) -> "dict[str, RunEstimator]":
    """Return the estimators that `--estimator` names; paper and robust if none is named."""
    from nir_render.run.perceive import chosen_estimators
    from perception import ESTIMATORS

    if time_limit_s is not None and not (math.isfinite(time_limit_s) and time_limit_s > 0.0):
        raise InputError(f"--time-limit {time_limit_s:g}: wanted seconds above 0, such as 60")
    return chosen_estimators(names or list(ESTIMATORS), time_limit_s)


def check_period(period_s: float | None) -> None:
    """Raise InputError where `--period` is no time."""
    if period_s is not None and not (math.isfinite(period_s) and period_s > 0.0):
        raise InputError(f"--period {period_s:g}: wanted seconds above 0, such as 0.1")


def light_cache(folder: Path | None, limit_gib: float) -> "LightCache":
    """Return the cache that `--light-cache` and `--light-cache-gib` describe."""
    from nir_render.command.terminal.console import warn
    from nir_render.transport.cache import LightCache

    return LightCache(folder, limit_bytes=light_limit_bytes(limit_gib), say=warn)


def light_limit_bytes(limit_gib: float) -> int:
    """Return `--light-cache-gib` in bytes; raise InputError where it is no size."""
    if not (math.isfinite(limit_gib) and limit_gib > 0.0):
        raise InputError(f"--light-cache-gib {limit_gib:g}: wanted a size above 0, in GiB, such as 4")
    return int(limit_gib * 2**30)


def use_threads(threads: int | None) -> None:
    """Render with as many threads as `--threads` says."""
    if threads is not None:
        from nir_render.transport.backend.variant import set_threads

        set_threads(threads)


def _setting(text: str) -> tuple[str, Any]:
    import yaml

    path, equals, value = text.partition("=")
    if not equals or not path:
        raise InputError(
            f'--set {text}: wanted PATH=VALUE, such as --set robots.r2.rig.sources.top.flux="0.1 W"'
        )
    if value.lstrip().startswith("[") and not value.rstrip().endswith("]"):
        return path.strip(), value.strip()  # a vector with its unit is text, though it begins as a list does
    try:
        return path.strip(), yaml.safe_load(value)
    except yaml.YAMLError:
        raise InputError(f"--set {text}: {value!r} is no YAML value") from None
