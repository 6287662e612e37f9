"""Parts of a scene that stand elsewhere: the presets of `data/`, and files beside the scene."""

import copy
import difflib
import marshal
from collections.abc import Mapping
from contextvars import ContextVar
from functools import cache, lru_cache
from importlib import resources
from pathlib import Path
from typing import Any, ClassVar, Self

from pydantic import ModelWrapValidatorHandler, ValidationInfo, model_validator

from nir_render.errors import shown
from nir_render.scene.documents.base import Document
from nir_render.scene.text.yaml_text import parse_yaml, read_yaml

_READ: dict[type, dict[bytes, "ReadOnceDocument"]] = {}
_FILES_FOUND: ContextVar[int] = ContextVar("_FILES_FOUND", default=0)  # by this thread so far
_MOST_NAME_BYTES = 255  # of a file, in the file systems in use
# Keys of which a document has one: a change that writes another replaces the first.
_ALTERNATIVES = (
    {"constant", "gaussian", "points", "grid", "file", "led"},
    {"junction_temperature", "ambient_temperature"},
    {"centroid", "table"},
    {"centre", "table"},
    {"fwhm", "table"},
    {"peak_transmission", "table"},
    {"edge", "table"},
    {"extinction", "visibility"},
    {"phase", "droplets"},
    {"full_well", "saturation_capacity"},
    {"values", "file"},
    {"constant", "square", "bits", "flicker"},
    {"temperature", "illuminant"},
    {"irradiance", "air"},
    {"auto_exposure", "bracket"},
)

# What a change of one key takes away with it: what a preset knows of another quantum efficiency, say.
_GOES_WITH = {
    "quantum_efficiency": {"efficiency_envelope", "efficiency_taken"},
    "droplets": {"albedo"},  # which they tell
}
_WITH_ALTERNATIVES = frozenset(_GOES_WITH).union(*_ALTERNATIVES)


class ReadOnceDocument(Document):
    """A part that, written alike, is read once: thirty robots with one rig, or a campaign's scenes, share it.

    Not so what follows from a file beside the scene, however it is named there: it may have changed since.
    It is made by `model_validate` alone: a constructor would return what it has not filled. So many of a kind
    are kept.
    """

    most_kept: ClassVar[int] = 8192

    @model_validator(mode="wrap")
    @classmethod
    def _read_once(cls, data: Any, read: ModelWrapValidatorHandler[Self]) -> Self:
        try:
            key = marshal.dumps(data, 2)  # by type: {None: 1} is not {"null": 1}
        except ValueError:  # of more than plain data
            return read(data)
        kept = _READ.setdefault(cls, {})
        known = kept.get(key)
        if known is None:
            before = _FILES_FOUND.get()
            known = read(data)
            if _FILES_FOUND.get() != before:
                return known
            if len(kept) >= cls.most_kept:
                kept.pop(next(iter(kept)), None)
            kept[key] = known
        assert isinstance(known, cls)
        return known


class PresetDocument(ReadOnceDocument):
    """A part that may be named instead of written: a preset of `data/`, or a `.yaml` file beside the scene.

    `sensor: mt9m031` takes a preset whole; `sensor: {preset: mt9m031, read_noise: 5 e}` changes a part.
    """

    preset_folder: ClassVar[str]
    most_kept: ClassVar[int] = 1024

    @model_validator(mode="before")
    @classmethod
    def _expand_preset(cls, data: Any, info: ValidationInfo) -> Any:
        return expand_preset(data, cls.preset_folder, _folder_of(info))


def _folder_of(info: ValidationInfo) -> Path:
    return info.context["folder"] if info.context else Path()


def resolve_file(name: str, info: ValidationInfo) -> Path:
    """Return the path of a file that a scene names; relative names count from the scene's folder.

    Raises
    ------
    ValueError
        There is no such file.
    """
    return find_file(name, _folder_of(info)).resolve()


def find_file(name: str, folder: Path) -> Path:
    """Return the path of a file beside a scene, in `folder`; raise ValueError where there is none."""
    path = folder / name
    if exists(path):
        _FILES_FOUND.set(_FILES_FOUND.get() + 1)
        return path
    if any(len(part.encode(errors="replace")) > _MOST_NAME_BYTES for part in path.parts):
        raise ValueError(f"{shown(name)} is too long for the name of a file; give one that exists")
    raise ValueError(
        f"there is no file {shown(name)} beside the scene (looked in {folder}); check its name and folder"
    )


def exists(path: Path) -> bool:
    """Tell whether there is a file, for any text as its name: too long, or none for a name."""
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


@cache
def preset_names(folder: str) -> tuple[str, ...]:
    """Return the names of the presets of one kind."""
    entries = resources.files("nir_render").joinpath("data", folder).iterdir()
    return tuple(
        sorted(entry.name.removesuffix(".yaml") for entry in entries if entry.name.endswith(".yaml"))
    )


def expand_preset(data: Any, kind: str, folder: Path, trail: tuple[str, ...] = ()) -> Any:
    """Replace a preset's name by what it stands for, with the keys beside `preset` laid over it.

    `trail` holds the presets on the way here, so that none stands on itself.
    """
    if isinstance(data, str):
        return _load_preset(data, kind, folder, trail)
    if isinstance(data, Mapping) and "preset" in data:
        base = _load_preset(data["preset"], kind, folder, trail)
        return merge(base, {key: value for key, value in data.items() if key != "preset"})
    return data


def _load_preset(name: Any, kind: str, folder: Path, trail: tuple[str, ...]) -> Any:
    if name in trail:
        raise ValueError(f"the preset {shown(name)} stands on itself; name another")
    if isinstance(name, str) and name.endswith(".yaml"):
        return expand_preset(read_yaml(find_file(name, folder)), kind, folder, (*trail, name))
    known = preset_names(kind)
    if name not in known:
        near = difflib.get_close_matches(str(name), known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
        raise ValueError(f"there is no preset {shown(name)} in {kind}; {hint}")
    return expand_preset(copy.deepcopy(_own_preset(kind, name)), kind, folder, (*trail, name))


@lru_cache(maxsize=256)
def _own_preset(kind: str, name: str) -> Any:
    """Return a preset of `data/` as it is written; scenes are changed and built again by the thousand."""
    text = resources.files("nir_render").joinpath("data", kind, f"{name}.yaml").read_text(encoding="utf-8")
    return parse_yaml(text, f"preset {kind}/{name}")


def merge(base: Any, change: Any) -> Any:
    """Lay `change` over `base`, key by key; a preset's name in `base` stays the ground under the change."""
    if not isinstance(change, Mapping):
        return change
    if isinstance(base, str):
        return change if "preset" in change else {"preset": base, **change}
    if not isinstance(base, Mapping) or change.get("type", base.get("type")) != base.get("type"):
        return dict(change)
    base = without_alternatives(base, change)
    return {**base, **{key: merge(base.get(key), value) for key, value in change.items()}}


def without_alternatives(base: Mapping[str, Any], change: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` without the keys that stand for the same thing as those which `change` sets."""
    kept = dict(base)
    if change.keys().isdisjoint(_WITH_ALTERNATIVES):
        return kept
    for forms in _ALTERNATIVES:
        if any(change[key] is not None for key in forms & change.keys()):
            kept = {key: value for key, value in kept.items() if key not in forms}
    for key in change.keys() & _GOES_WITH.keys():
        kept = {other: value for other, value in kept.items() if other not in _GOES_WITH[key]}
    return kept
