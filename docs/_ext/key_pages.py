"""The reference of scene files and campaigns from their schemas: every key, its unit, default and meaning."""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from nir_render.scene.documents.base import Document
from nir_render.scene.schema import scene_schema
from nir_render.stress.campaign import campaign_schema

Schema = Mapping[str, Any]

_SCENE_TOP = """# Keys of scene files

Made from the schema that the program checks with (`nir-render schema`);
[Scene files](../scene_files.md) tells how they work together. A value with a unit is text: `"940 nm"`. NAME
stands for a name of your own, N for a place in a list from 0 on. A dotted path such as `fog.visibility` is
what `--set`, `scene.with_` and campaigns take. Keys marked * must be given, by a preset or beside it.

"""
_CAMPAIGN_TOP = """# Keys of campaigns

Made from the schema that the program checks with (`nir-render schema --campaign`);
[Stress tests](../stress.md) tells how to write one. Keys marked * must be given.

"""
_TITLES = {
    "CurveDocument": "Curve",
    "PatternDocument": "Emission pattern",
    "PatternGrid": "Emission pattern on a grid",
    "AxisDocument": "Axis",
    "Bandpass": "Filter",
}
_PRESET = "a preset"
_BOUNDLESS = 2**62  # what only keeps a number within 64 bits is not worth a word
_KINDS = {
    "integer": "a whole number",
    "number": "a number",
    "string": "text",
    "array": "a list",
    "object": "keys with values",
}


def scene_page() -> str:
    """Return the page of scene files, Markdown."""
    return _SCENE_TOP + _Reference(scene_schema()).text("Scene")


def campaign_page() -> str:
    """Return the page of campaigns, Markdown."""
    return _CAMPAIGN_TOP + _Reference(campaign_schema()).text("Campaign")


@dataclass
class _Reference:
    """A schema on its way to a page: where each definition stands, under the first key that leads to it."""

    schema: Schema
    places: dict[str, list[str]] = field(default_factory=dict)
    groups: dict[str, list[str]] = field(default_factory=dict)

    def text(self, title: str) -> str:
        """Return a table of the document's own keys, then a section for each definition."""
        for key, value in self.schema["properties"].items():
            self._walk(value, key, key)
        parts = [f"## {title}\n\n{self.schema.get('description', '')}\n\n{self._table(self.schema, {})}"]
        for key, names in self.groups.items():
            alone = self.places[names[0]] == [key]  # its first definition is all that stands under the key
            parts += [] if alone else [f"## `{key}`\n"]
            parts += [self._section(name, key if alone and name == names[0] else None) for name in names]
        return "\n".join(parts)

    def _walk(self, schema: Schema, path: str, top: str) -> None:
        for name in dict.fromkeys(_references(schema)):
            met_before = name in self.places
            places = self.places.setdefault(name, [])
            below = path + _item_of(schema, name)
            if below not in places:
                places.append(below)
            if not met_before:
                self.groups.setdefault(top, []).append(name)
                for key, value in self._keys(name).items():
                    self._walk(value, f"{below}.{key}", top)

    def _keys(self, name: str) -> dict[str, Any]:
        return dict(_with_keys(self.schema["$defs"][name]).get("properties", {}))

    def _title(self, name: str) -> str:
        kind = self._keys(name).get("type", {}).get("const")
        return f"`type: {kind}`" if kind else _TITLES.get(name, _spaced(name))

    def _section(self, name: str, key: str | None) -> str:
        definition = self.schema["$defs"][name]
        whole, forms = _with_keys(definition), definition.get("anyOf", ())
        where = ", ".join(f"`{place}`" for place in self.places[name][:3])
        more = " and elsewhere" if len(self.places[name]) > 3 else ""
        heading = f"### {self._title(name)}\n\n{where}{more}" if key is None else f"## `{key}`"
        parts = [f"(key-{name.lower()})=\n{heading}", whole.get("description", "")]
        for form in forms:
            if _PRESET in form.get("description", ""):
                presets = ", ".join(f"`{preset}`" for preset in form["examples"])
                parts.append(
                    f"In its place may stand the name of a preset ({presets}) or of a `.yaml` file beside "
                    "the scene; or under `preset`, with changes beside it."
                )
            elif form.get("type") == "number":
                parts.append("A number in its place is a constant.")
        return "\n\n".join(part for part in [*parts, self._table(whole, _defaults(name))] if part)

    def _table(self, definition: Schema, defaults: Mapping[str, Any]) -> str:
        lines = ["| key | value | default |", "|---|---|---|"]
        for key, value in definition.get("properties", {}).items():
            if (key == "type" and "const" in value) or _PRESET in value.get("description", ""):
                continue
            star = "*" if key in definition.get("required", ()) else ""
            default = _shown(defaults.get(key, value.get("default")))
            lines.append(f"| `{key}`{star} | {self._value(value)} | {default} |")
        return "\n".join(lines) + "\n"

    def _value(self, value: Schema) -> str:
        """Return in words what may stand behind a key."""
        forms = value.get("anyOf") or value.get("oneOf") or [value]
        words = dict.fromkeys(self._form(form) for form in forms if form.get("type") != "null")
        return " or ".join(words).replace("|", "\\|")

    def _form(self, form: Schema) -> str:
        if "$ref" in form:
            name = form["$ref"].rpartition("/")[2]
            return f"[{self._title(name)}](#key-{name.lower()})"
        if "const" in form or "enum" in form:
            return " or ".join(f"`{_plain(choice)}`" for choice in form.get("enum", [form.get("const")]))
        if (inner := _by_name(form)) is not None:
            return f"by NAME: {self._value(inner)}"
        if form.get("type") == "object" and "properties" in form:
            return "; ".join(
                f"`{key}`: {inner.get('description', '')}" for key, inner in form["properties"].items()
            )
        return f"{self._plain_form(form)}{_bounds(form)}"

    def _plain_form(self, form: Schema) -> str:
        text, examples = form.get("description", ""), form.get("examples", [])
        if match := re.fullmatch(r"(.* such as )'(.*?)'(.*)", text):
            return f"{match[1]}`{match[2]}`{match[3]}"
        items = form.get("items", {})
        if form.get("type") == "array" and items and "prefixItems" not in items and not examples:
            return f"a list, each {self._value(items)}"
        if examples:
            shown = " or ".join(f"`{_plain(example)}`" for example in examples[:3])
            return f"{text}, such as {shown}" if text else f"such as {shown}"
        if "prefixItems" in form:
            return f"{len(form['prefixItems'])} numbers in a list"
        if "prefixItems" in items:
            return '`[["place", value], …]`'
        return text or _KINDS.get(form.get("type", ""), "any value")


def _with_keys(definition: Schema) -> Schema:
    """Return that form of a definition which has keys."""
    return next((form for form in definition.get("anyOf", ()) if "properties" in form), definition)


def _references(schema: Any) -> Iterator[str]:
    """Yield the names of the definitions that a part of a schema refers to."""
    if isinstance(schema, Mapping):
        if "$ref" in schema:
            yield schema["$ref"].rpartition("/")[2]
        for key, value in schema.items():
            if key not in ("discriminator", "default"):
                yield from _references(value)
    elif isinstance(schema, list):
        for value in schema:
            yield from _references(value)


def _by_name(schema: Schema) -> Schema | None:
    """Return what stands under names of one's own, None where keys have fixed names."""
    if "patternProperties" in schema:
        return next(iter(schema["patternProperties"].values()))  # type: ignore[no-any-return]
    more = schema.get("additionalProperties")
    return more if isinstance(more, Mapping) else None


def _item_of(schema: Schema, name: str) -> str:
    """Return the step from a key to what it holds: `.NAME`, `.N`, or none."""
    if _by_name(schema) is not None:
        return ".NAME"
    in_list = schema.get("type") == "array" and name in set(_references(schema.get("items", {})))
    return ".N" if in_list else ""


def _defaults(name: str) -> dict[str, Any]:
    """Return the defaults of a definition as a document has them: with their units."""
    waiting: list[type[Document]] = [Document]
    while waiting:
        model = waiting.pop()
        if model.__name__ == name:
            return dict(json.loads(model.model_construct().model_dump_json(by_alias=True, warnings=False)))
        waiting += model.__subclasses__()
    return {}


def _shown(default: Any) -> str:
    if default is None or default in ([], {}, ""):
        return ""
    if isinstance(default, dict):
        default = {key: value for key, value in default.items() if value is not None}
    text = _plain(default)
    return f"`{text}`" if len(text) <= 60 else "what its keys have"


def _plain(value: Any) -> str:
    """Return a value as one would write it in YAML, on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_plain(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_plain(inner) for inner in value) + "]"
    return re.sub(r"(\d)\.0\b", r"\1", str(value))


def _bounds(form: Schema) -> str:
    said = [
        text.format(_plain(form[bound]))
        for bound, text in (
            ("exclusiveMinimum", "above {}"),
            ("minimum", "from {}"),
            ("exclusiveMaximum", "below {}"),
            ("maximum", "up to {}"),
        )
        if bound in form and abs(form[bound]) < _BOUNDLESS
    ]
    return f", {' '.join(said)}" if said else ""


def _spaced(name: str) -> str:
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name).capitalize()
