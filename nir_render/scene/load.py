"""From a scene file to a Scene: read, include, override."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from nir_render.errors import InputError, shown
from nir_render.scene.documents.built.source import BuiltSource
from nir_render.scene.documents.files import exists, find_file, merge
from nir_render.scene.overrides import apply_overrides
from nir_render.scene.problems import explain
from nir_render.scene.scene import Scene, parse_scene
from nir_render.scene.text.yaml_text import read_yaml

_FORMAT = 1  # the newest that is read here, and the first
_MOST_SHOWN = 400  # characters of a path


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
    if not exists(file):
        name = str(file) if len(str(file)) <= _MOST_SHOWN else shown(str(file))
        raise InputError(f"{name}: there is no such scene file; check its name and folder")
    raw = _read_with_includes(file, ())
    return parse_scene(apply_overrides(raw, overrides or {}), file.parent, str(file), overrides or {})


def load_built(name: str) -> BuiltSource:
    """Read a source as it is built: a preset of `data/built`, or a `.yaml` file.

    Raises
    ------
    InputError
        As `load_scene`.
    """
    file = Path(name)
    is_file = name.endswith(".yaml")
    try:
        raw = read_yaml(file) if is_file else {"preset": name}
    except (OSError, ValueError) as error:
        raise InputError(*str(error).split("\n")) from None
    try:
        return BuiltSource.model_validate(raw, context={"folder": file.parent})
    except ValidationError as error:
        raise InputError(*explain(error, raw, name)) from None


def _read_with_includes(file: Path, trail: tuple[Path, ...]) -> dict[str, Any]:
    if file.resolve() in trail:
        way = " > ".join(step.name for step in trail)
        raise InputError(f"{file}: includes itself by way of {way}; take one include out")
    try:
        raw = read_yaml(file)
    except ValueError as error:
        raise InputError(*str(error).split("\n")) from None
    if not isinstance(raw, dict):
        raise InputError(
            f"{file}: wanted a mapping of keys such as 'format' and 'robots'; see scenes/one_source.yaml"
        )
    written = raw.get("format")
    if isinstance(written, int) and written > _FORMAT:
        # What a newer format means is not known here: its keys would be reported as wrong, one by one.
        raise InputError(
            f"{file}: format: {written} is newer than this nir_render reads, which is {_FORMAT}; "
            "install a newer nir_render, or write the scene in that format"
        )
    includes = raw.pop("include", [])
    if not isinstance(includes, list) or not all(isinstance(name, str) for name in includes):
        raise InputError(f"{file}: include: wanted a list of file names, such as [ground.yaml]")
    ground: dict[str, Any] = {}
    for name in includes:
        try:
            included = find_file(name, file.parent)
        except ValueError as error:
            raise InputError(f"{file}: include: {error}") from None
        ground = merge(ground, _read_with_includes(included, (*trail, file.resolve())))
    merged: dict[str, Any] = merge(ground, raw)
    return merged
