"""What is wrong with a document, in words: file, line, field, and what was wanted."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from nir_render.scene.units import format_in_unit_of

_BOUNDS = {
    "greater_than": "greater than",
    "greater_than_equal": "greater than or equal to",
    "less_than": "less than",
    "less_than_equal": "less than or equal to",
}


def explain(error: ValidationError, raw: Any, path: str, overrides: Iterable[str] = ()) -> Iterable[str]:
    """Yield one line per problem: file, line or override, field, and what is wrong.

    Parameters
    ----------
    error
        What was found in the document.
    raw
        The document as it was validated.
    path
        The file that it was read from.
    overrides
        The dotted paths that were laid over it.
    """
    lines = _line_numbers(path)
    for problem in error.errors():
        keys = _document_keys(problem["loc"], raw)
        line = next(
            (lines[tuple(keys[:n])] for n in range(len(keys), 0, -1) if tuple(keys[:n]) in lines), None
        )
        where = f"{path}:{line}" if line else path
        if keys and any(_meet(one.split("."), keys) for one in overrides):
            where = f"{path} with --set"  # the file's line may hold another value
        message = problem["msg"].removeprefix("Value error, ")
        if problem["type"] == "missing":
            message = "this key is missing"
        elif problem["type"] in _BOUNDS:
            message = _beyond(_BOUNDS[problem["type"]], problem["ctx"], problem["input"])
        yield f"{where}: {'.'.join(keys)}: {message}" if keys else f"{where}: {message}"


def _meet(way: Sequence[str], keys: Sequence[str]) -> bool:
    """Tell whether one of two places in a document lies within the other."""
    return all(one == other for one, other in zip(way, keys, strict=False))


def _beyond(bound: str, context: Mapping[str, Any], written: Any) -> str:
    """Say which bound a value is beyond, in the unit that it was written in."""
    (limit,) = (context[key] for key in ("gt", "ge", "lt", "le") if key in context)
    return f"input should be {bound} {format_in_unit_of(written, float(limit))}, not {written!r}"


def _document_keys(location: tuple[int | str, ...], raw: Any) -> list[str]:
    """Return a problem's place as keys of the document, without the tags of unions (`rectangle`, …)."""
    keys: list[str] = []
    node = raw
    for part in location:
        tag = isinstance(node, Mapping) and part not in node and node.get("type") == part
        if tag:
            continue
        keys.append(str(part))
        if isinstance(node, Mapping):
            node = node.get(part)
        elif isinstance(node, list) and isinstance(part, int) and part < len(node):
            node = node[part]
        else:
            node = None
    return keys


def _line_numbers(path: str) -> dict[tuple[str, ...], int]:
    """Return the line of each key of a YAML file, by its path of keys."""
    lines: dict[tuple[str, ...], int] = {}

    def walk(node: yaml.Node, keys: tuple[str, ...]) -> None:
        if isinstance(node, yaml.MappingNode):
            for key, value in node.value:
                lines[(*keys, key.value)] = key.start_mark.line + 1
                walk(value, (*keys, key.value))
        elif isinstance(node, yaml.SequenceNode):
            for index, value in enumerate(node.value):
                lines[(*keys, str(index))] = value.start_mark.line + 1
                walk(value, (*keys, str(index)))

    root = yaml.compose(Path(path).read_text(encoding="utf-8"), yaml.SafeLoader)
    if root is not None:
        walk(root, ())
    return lines
