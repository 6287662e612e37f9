"""What all models of a scene file share: closed fields, aliases without unit suffix, presets."""

import copy
import difflib
from collections.abc import Mapping
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Any, ClassVar, get_args

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationInfo, model_validator

_UNIT_SUFFIXES = (
    "_m_per_k",
    "_e_per_s",
    "_dn_per_e",
    "_w_per_m3",
    "_per_m",
    "_px",
    "_dn",
    "_hz",
    "_rad",
    "_lm",
    "_nm",
    "_m",
    "_s",
    "_w",
    "_e",
    "_k",
    "_bit",
)
# Keys of which a document has one: a change that writes another replaces the first.
_ALTERNATIVES = (
    {"constant", "gaussian", "points", "grid", "file"},
    {"extinction", "visibility"},
    {"full_well", "saturation_capacity"},
    {"values", "file"},
    {"constant", "square", "bits"},
    {"auto_exposure", "bracket"},
)
_COLOUR_KEYS = {"rgb", "color", "colour", "srgb"}
RGB_REFUSED = "RGB colours have no meaning at 940 nm; give the value in the band, a number from 0 to 1"


def document_key(field: str) -> str:
    """Return a field's key in the document: `exposure_s` is written `exposure: 1 ms`."""
    for suffix in _UNIT_SUFFIXES:
        if field.endswith(suffix):
            return field.removesuffix(suffix)
    return field


class Document(BaseModel):
    """A part of a scene file. Unknown keys are refused with the nearest known one.

    `example` shows how one is written; `read_keys` are keys of the document that become others
    when it is read.
    """

    example: ClassVar[str] = ""
    read_keys: ClassVar[tuple[str, ...]] = ()

    model_config = ConfigDict(
        extra="forbid", frozen=True, alias_generator=document_key, allow_inf_nan=False, strict=False
    )

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, data: Any) -> Any:
        if not isinstance(data, Document):
            cls.check_keys(data)
        return data

    @classmethod
    def check_keys(cls, data: Any) -> None:
        """Raise ValueError where data are no mapping, or have a key that is unknown here or a truth value."""
        known = [*(document_key(name) for name in cls.model_fields), *cls.read_keys]
        if not isinstance(data, Mapping):
            like = f"such as {cls.example}" if cls.example else f"known keys: {', '.join(sorted(known))}"
            raise ValueError(f"{data!r} stands where keys with values are wanted, {like}")
        for key, value in data.items():
            if isinstance(value, bool):  # Python counts true as 1
                raise ValueError(
                    f"{key!r} is {str(value).lower()}; nothing here is true or false; to do without it, "
                    "leave the key out or write null"
                )
            if key in known:
                continue
            if str(key).lower() in _COLOUR_KEYS:
                raise ValueError(f"{key!r}: {RGB_REFUSED}")
            near = difflib.get_close_matches(str(key), known, n=1, cutoff=0.5)
            hint = f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(sorted(known))}"
            raise ValueError(f"unknown key {key!r}; {hint}")


def typed(example: str, *models: type[Document]) -> BeforeValidator:
    """Return what refuses data for one of some models where their key `type` tells none of them."""
    kinds = [str(get_args(model.model_fields["type"].annotation)[0]) for model in models]
    known = f"known: {', '.join(kinds)}; write it such as {example}"

    def check(data: Any) -> Any:
        if isinstance(data, Document):
            return data
        if not isinstance(data, Mapping):
            raise ValueError(f"{data!r} stands where keys with values are wanted, 'type' among them; {known}")
        if data.get("type") is None:
            raise ValueError(f"the key 'type' is missing; {known}")
        if data["type"] not in kinds:
            near = difflib.get_close_matches(str(data["type"]), kinds, n=1, cutoff=0.5)
            raise ValueError(
                f"there is no type {data['type']!r}; " + (f"did you mean {near[0]!r}?" if near else known)
            )
        return data

    return BeforeValidator(check)


class PresetDocument(Document):
    """A part that may be named instead of written: a preset of `data/`, or a `.yaml` file beside the scene.

    `sensor: mt9m031` takes a preset whole; `sensor: {preset: mt9m031, read_noise: 5 e}` changes a part.
    """

    preset_folder: ClassVar[str]

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
    path = _folder_of(info) / name
    if not path.is_file():
        raise ValueError(f"there is no file {name!r} beside the scene (looked for {path})")
    return path.resolve()


def preset_names(folder: str) -> list[str]:
    """Return the names of the presets of one kind."""
    entries = resources.files("nir_render").joinpath("data", folder).iterdir()
    return sorted(entry.name.removesuffix(".yaml") for entry in entries if entry.name.endswith(".yaml"))


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
        raise ValueError(f"the preset {name!r} stands on itself")
    if isinstance(name, str) and name.endswith(".yaml"):
        path = folder / name
        if not path.is_file():
            raise ValueError(f"there is no file {name!r} beside the scene (looked for {path})")
        return expand_preset(read_yaml(path), kind, folder, (*trail, name))
    known = preset_names(kind)
    if name not in known:
        near = difflib.get_close_matches(str(name), known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
        raise ValueError(f"there is no preset {name!r} in {kind}; {hint}")
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
    for forms in _ALTERNATIVES:
        if any(change[key] is not None for key in forms & change.keys()):
            kept = {key: value for key, value in kept.items() if key not in forms}
    return kept


class _UniqueKeyLoader(yaml.SafeLoader):
    """YAML 1.1 lets a repeated key silently replace the first; here it is an error."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            line = key_node.start_mark.line + 1
            if not isinstance(key, str):
                raise yaml.constructor.ConstructorError(
                    None, None, f"line {line}: the key {key!r} is not a name; write it as text"
                )
            if key in seen:
                raise yaml.constructor.ConstructorError(None, None, f"line {line}: key {key!r} stands twice")
            seen.add(key)
        return super().construct_mapping(node, deep)


def parse_yaml(text: str, name: str) -> Any:
    """Read YAML; raise ValueError with `name` and line where it is broken or has a key twice."""
    try:
        return yaml.load(text, _UniqueKeyLoader)  # noqa: S506 (a subclass of SafeLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        raise ValueError(f"{name}{where}: {getattr(error, 'problem', error)}") from None
    except RecursionError:
        raise ValueError(f"{name}: an alias refers to what holds it") from None


def read_yaml(path: Path) -> Any:
    """Read a YAML file; errors as `parse_yaml`."""
    try:
        return parse_yaml(path.read_text(encoding="utf-8"), str(path))
    except UnicodeDecodeError:
        raise ValueError(f"{path} is not UTF-8 text") from None
