"""From a scene file to a Scene: read, include, override, validate, check."""

import copy
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from nir_render.errors import InputError
from nir_render.scene.base import merge, read_yaml, without_alternatives
from nir_render.scene.checks import check
from nir_render.scene.devices import Camera, Source
from nir_render.scene.document import Robot, SceneDocument
from nir_render.scene.explain import explain
from nir_render.scene.units import with_component
from nir_render.scene.world import Lamp, Sun

# Two ways to say how finely to sample; a change that writes one takes the other away.
_RIVALS = ("render.noise", "render.indirect.samples")


_COMPONENTS = {"x": 0, "y": 1, "z": 2, "0": 0, "1": 1, "2": 2}  # of vectors


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene, read and checked.

    `document` holds everything in SI units; `raw` is the document as written, with includes and overrides
    but before presets; `folder` is where file names in it count from; `path` names it in errors.
    """

    document: SceneDocument
    raw: Mapping[str, Any]
    folder: Path
    path: str

    def with_(self, overrides: Mapping[str, Any]) -> "Scene":
        """Return a copy changed at dotted paths, such as {"robots.r2.position": "[3, 0, 0.2] m"}."""
        return _build(apply_overrides(self.raw, overrides), self.folder, self.path, overrides)

    def cameras(self) -> list[str]:
        """Return the names, `robot.camera`, of the cameras that take frames."""
        names = [name for selector in self.document.observe for name in self.document.cameras_of(selector)]
        return list(dict.fromkeys(names))

    def camera(self, name: str) -> tuple[Robot, Camera]:
        """Return the robot and the camera named `robot.camera`; raise InputError where there is none."""
        if "." not in name or not self.document.cameras_of(name):
            raise InputError(
                f"{self.path}: there is no camera {name!r}; known: {', '.join(self.all_cameras())}"
            )
        robot, camera = name.split(".")
        return self.document.robots[robot], self.document.robots[robot].rig.cameras[camera]

    def all_cameras(self) -> list[str]:
        """Return the names of all cameras, observing or not."""
        return [name for robot in self.document.robots for name in self.document.cameras_of(robot)]

    def sources(self) -> dict[str, tuple[Robot, Source]]:
        """Return robot and source of each light group, by name `robot.source`."""
        return {
            f"{name}.{source_name}": (robot, source)
            for name, robot in self.document.robots.items()
            for source_name, source in robot.rig.sources.items()
        }

    def emitters(self) -> dict[str, Source | Lamp | Sun]:
        """Return what each light group is, by name: `robot.source`, then `lamps.name`, then `sun`."""
        known: dict[str, Source | Lamp | Sun] = {name: source for name, (_, source) in self.sources().items()}
        known |= {f"lamps.{name}": lamp for name, lamp in self.document.lamps.items()}
        return known if self.document.sun is None else known | {"sun": self.document.sun}

    def calibration(self, camera: str) -> Any:
        """Return what perception may know about a camera, a `perception.Calibration`, exact."""
        from nir_render.calibration import calibration  # a room further down the way of the data

        return calibration(self, camera)

    def resolved_yaml(self) -> str:
        """Return the document with everything expanded, in SI units; it loads to the same scene."""
        data = self.document.model_dump(mode="json", by_alias=True, exclude_none=True)
        for robot in data["robots"].values():
            if not robot["motion"]:
                del robot["motion"]
            else:
                del robot["position"], robot["orientation"]
        return yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=110)


def load_scene(path: str | Path, overrides: Mapping[str, Any] | None = None) -> Scene:
    """Read a scene file.

    Parameters
    ----------
    path
        A YAML file, format 1.
    overrides
        Values at dotted paths, laid over the file.

    Raises
    ------
    InputError
        A line per problem: file, line, field, value, what was wanted, how to mend it.
    """
    file = Path(path)
    if not file.is_file():
        raise InputError(f"{file}: there is no such scene file")
    raw = _read_with_includes(file, ())
    return _build(apply_overrides(raw, overrides or {}), file.parent, str(file), overrides or {})


def apply_overrides(raw: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of a raw document with values set at dotted paths.

    Numbers in a path index lists; x, y, z (or 0, 1, 2) at its end are components of a vector:
    `robots.r2.position.x`.
    A preset's name on the way becomes the ground under the change: `...sensor.read_noise` on
    `sensor: mt9m031` gives `{preset: mt9m031, read_noise: ...}`.
    """
    changed: dict[str, Any] = copy.deepcopy(dict(raw))
    for path, value in overrides.items():
        keys = path.split(".")
        if not all(keys):
            raise InputError(f"--set {path}: a dotted path such as 'robots.r2.position' was wanted")
        if keys[0] not in SceneDocument.model_fields:
            raise InputError(
                f"--set {path}: {keys[0]!r} is no part of a scene; "
                f"known: {', '.join(SceneDocument.model_fields)}"
            )
        changed = _set(changed, keys, value, path)
    return _without_rivals(changed, overrides)


def _without_rivals(changed: dict[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Drop the fixed count of samples where a target for the noise has been set, and the other way round."""
    set_now = {path for path in _RIVALS if overrides.get(path) is not None}
    if len(set_now) != 1:
        return changed
    (rival,) = set(_RIVALS) - set_now
    *way, last = rival.split(".")
    node: Any = changed
    for key in way:
        node = node.get(key) if isinstance(node, dict) else None
    if isinstance(node, dict):
        node.pop(last, None)  # `_set` has copied all on the way to the other one; the rest is a deep copy
    return changed


def _set(node: Any, keys: list[str], value: Any, path: str) -> Any:
    if not keys:
        return value
    if isinstance(node, list):
        numbers = all(isinstance(item, int | float) for item in node)
        known = _COMPONENTS if numbers else {}
        index = int(keys[0]) if keys[0].isdigit() else known.get(keys[0], -1)
        if not 0 <= index < len(node):
            raise InputError(f"--set {path}: {keys[0]!r} is no index of a list of {len(node)}")
        return [_set(item, keys[1:], value, path) if i == index else item for i, item in enumerate(node)]
    if isinstance(node, str) and node.lstrip().startswith("["):
        if len(keys) != 1 or keys[0] not in _COMPONENTS:
            raise InputError(f"--set {path}: {keys[0]!r} is no component of {node!r}; take x, y or z")
        try:
            return with_component(node, _COMPONENTS[keys[0]], value)
        except ValueError as error:
            raise InputError(f"--set {path}: {error}") from None
    if node is None:
        node = {}
    elif isinstance(node, str):
        node = {"preset": node}
    elif not isinstance(node, dict):
        raise InputError(f"--set {path}: {keys[0]!r} lies inside the value {node!r}")
    if len(keys) == 1:
        node = without_alternatives(node, {keys[0]: value})
    return {**node, keys[0]: _set(node.get(keys[0]), keys[1:], value, path)}


def _read_with_includes(file: Path, trail: tuple[Path, ...]) -> dict[str, Any]:
    if file.resolve() in trail:
        raise InputError(f"{file}: includes itself by way of {' > '.join(step.name for step in trail)}")
    try:
        raw = read_yaml(file)
    except ValueError as error:
        raise InputError(str(error)) from None
    if not isinstance(raw, dict):
        raise InputError(f"{file}: wanted a mapping of keys such as 'format' and 'robots'")
    includes = raw.pop("include", [])
    if not isinstance(includes, list) or not all(isinstance(name, str) for name in includes):
        raise InputError(f"{file}: include: wanted a list of file names")
    ground: dict[str, Any] = {}
    for name in includes:
        if not (file.parent / name).is_file():
            raise InputError(f"{file}: include: there is no file {name!r} beside the scene")
        ground = merge(ground, _read_with_includes(file.parent / name, (*trail, file.resolve())))
    merged: dict[str, Any] = merge(ground, raw)
    return merged


def _build(raw: dict[str, Any], folder: Path, path: str, overrides: Iterable[str]) -> Scene:
    try:
        document = SceneDocument.model_validate(raw, context={"folder": folder})
    except ValidationError as error:
        raise InputError(*explain(error, raw, path, overrides)) from None
    scene = Scene(document, raw, folder, path)
    problems = check(document)
    if problems:
        raise InputError(*[f"{path}: {problem}" for problem in problems])
    return scene
