"""What is wrong with a document, in words: file, line, field, what was wanted, and how to mend it."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from nir_render.errors import shown
from nir_render.scene.documents.base import KeyProblem
from nir_render.scene.text.units import format_in_unit_of
from nir_render.scene.text.yaml_text import line_numbers

_BOUNDS = {
    "greater_than": "greater than",
    "greater_than_equal": "greater than or equal to",
    "less_than": "less than",
    "less_than_equal": "less than or equal to",
}
# What is not what a field holds: {} is the value.
_KINDS = {
    "int": "{} is no whole number; write it in digits, such as 3",
    "float": "{} is no number; write it in digits, such as 0.5",
    "string": "{} is no text; put it in quotes, such as 'a name'",
    "tuple": "{} is no list; write it in brackets, such as [1, 2]",
    "list": "{} is no list; write it in brackets, such as [1, 2]",
    "dict": "{} stands where keys with values are wanted, such as {{name: value}}",
    "model": "{} stands where keys with values are wanted, such as {{name: value}}",
    "finite": "{} is not a finite number; write one such as 0.5",
    "bool": "{} is neither true nor false; write one of them",
}
# How the alternatives of a field are called in a problem's place: no keys of the document.
_BRANCH = re.compile(
    r"(constrained-)?(int|str|float|none)|(literal|tuple|list|dict|function-\w+|nullable)\[.*\]"
)
_MOST_PROBLEMS = 50
_PLAIN_KEY = re.compile(r"[\w.\[\] -]{1,200}")


@dataclass(frozen=True)
class _Found:
    """A problem: where it is, as keys of the document, and whether other alternatives were tried there."""

    keys: tuple[str, ...]
    field: tuple[str, ...]  # the keys up to where the alternatives part
    message: str
    shown_keys: tuple[str, ...]


def explain(error: ValidationError, raw: Any, path: str, overrides: Iterable[str] = ()) -> Iterable[str]:
    """Yield one line per problem: file, line or override, field, and what is wrong.

    Parameters
    ----------
    error
        What was found in the document.
    raw
        The document as it was validated.
    path
        The file that it was read from, or what names a document that was read from none.
    overrides
        The dotted paths that were laid over it.
    """
    places = Places(path, overrides)
    found = _without_guesses(error, raw)
    for place in dict.fromkeys(one.field for one in found):
        alternatives = [one for one in found if one.field == place]
        deepest = max(len(one.keys) for one in alternatives)
        kept = [one for one in alternatives if len(one.keys) == deepest or one.keys == one.field == place]
        if any(len(one.keys) > len(place) for one in kept):
            kept = [one for one in kept if len(one.keys) == deepest]
        message = "; or: ".join(dict.fromkeys(one.message for one in kept))
        yield places.tell(kept[0].keys, kept[0].shown_keys, message)


class Places:
    """Where in a file, or in what was laid over it, a problem is."""

    def __init__(self, path: str, overrides: Iterable[str] = ()) -> None:
        self._path = path
        self._lines = line_numbers(Path(path)) if Path(path).is_file() else {}
        self._overrides = [one.split(".") for one in overrides]

    def tell(self, keys: Sequence[str], shown_keys: Sequence[str], message: str) -> str:
        """Return a problem as one line: where the keys are, what keys to show, and what is wrong."""
        lines = self._lines
        line = next(
            (lines[tuple(keys[:n])] for n in range(len(keys), 0, -1) if tuple(keys[:n]) in lines), None
        )
        where = f"{self._path}:{line}" if line else self._path
        if keys and any(_meet(one, keys) for one in self._overrides):
            where = f"{self._path} with --set"  # the file's line may hold another value
        place = ".".join(key if _PLAIN_KEY.fullmatch(key) else shown(key) for key in shown_keys)
        message = message.replace("\n", "; ")
        return f"{where}: {place}: {message}" if place else f"{where}: {message}"

    def tell_of(self, problem: str) -> str:
        """Return a problem that begins with its place in the document, `robots.r1: …`, as one line."""
        place, _, message = problem.partition(": ")
        keys = place.split(".")
        known = message and any(tuple(keys[:1]) == lines[:1] for lines in self._lines)
        return self.tell(keys, keys, message) if known else self.tell((), (), problem)


def _without_guesses(error: ValidationError, raw: Any) -> list[_Found]:
    """Return the problems, without keys that are missing only as they are misspelt."""
    problems = error.errors(include_url=False)
    meant = {
        (*problem["loc"][:-1], problem["input"].meant)
        for problem in problems
        if isinstance(problem["input"], KeyProblem)
    }
    found = []
    for problem in problems:
        if problem["type"] == "missing" and problem["loc"] in meant:
            continue
        keys, branch_at = _document_keys(problem["loc"], raw)
        shown_keys = keys[:-1] if isinstance(problem["input"], KeyProblem) else keys
        field = keys if branch_at is None else keys[:branch_at]
        found.append(_Found(keys, field, _message(problem), shown_keys))
    # Problems of one place stand together; of a document that is all wrong the first tell enough.
    return found[:_MOST_PROBLEMS]


def _message(problem: Mapping[str, Any]) -> str:
    """Return what is wrong, and what was wanted."""
    kind, written, context = problem["type"], problem["input"], problem.get("ctx", {})
    if isinstance(written, KeyProblem):
        return written.message
    if kind == "value_error":
        return str(context["error"])
    if kind == "missing":
        within = problem["loc"][-1]
        return "this key is missing" if isinstance(within, str) else "a value is missing here; write one more"
    if kind in _BOUNDS:
        return _beyond(_BOUNDS[kind], context, written)
    if kind == "literal_error":
        return f"{shown(written)} is not known here; wanted {context['expected']}"
    if kind == "string_pattern_mismatch":
        more = ", '-', '.' and spaces" if " -]" in context["pattern"] else " and '-', no digit first"
        return f"{shown(written)} is no name; take up to 100 letters, digits, '_'{more}, such as wall_2"
    if kind == "string_too_long":
        return f"{shown(written)} is longer than {context['max_length']} characters; shorten it"
    if kind in ("too_short", "too_long"):
        least = "at least" if kind.endswith("short") else "at most"
        count = context.get("min_length", context.get("max_length"))
        return f"holds {context.get('actual_length', 'other than wanted')}; wanted {least} {count} item(s)"
    for name, wanted in _KINDS.items():
        if kind.startswith(name):
            return wanted.format(shown(written))
    return f"{shown(written)} does not fit; for what is wanted see the JSON Schema, by nir-render schema"


def _meet(way: Sequence[str], keys: Sequence[str]) -> bool:
    """Tell whether one of two places in a document lies within the other."""
    return all(one == other for one, other in zip(way, keys, strict=False))


def _beyond(bound: str, context: Mapping[str, Any], written: Any) -> str:
    """Say which bound a value is beyond, in the unit that it was written in."""
    (limit,) = (context[key] for key in ("gt", "ge", "lt", "le") if key in context)
    return f"input should be {bound} {format_in_unit_of(written, float(limit))}, not {shown(written)}"


def _document_keys(location: tuple[int | str, ...], raw: Any) -> tuple[tuple[str, ...], int | None]:
    """Return a problem's place as keys of the document, and after how many of them alternatives part.

    Without the tags of unions (`rectangle`, …), and the names of alternatives (`tuple[int, ...]`, …).
    """
    keys: list[str] = []
    branch_at = None
    node = raw
    for part in location:
        within = isinstance(node, Mapping) and part in node
        if isinstance(node, Mapping) and not within and node.get("type") == part:
            continue
        if part == "[key]":
            continue
        if keys[:1] == ["materials"] and len(keys) == 2 and not within and "type" not in (node or {}):
            continue  # the type that its preset is of
        if not within and isinstance(part, str) and _BRANCH.fullmatch(part):
            branch_at = len(keys) if branch_at is None else branch_at
            continue
        keys.append(str(part))
        if isinstance(node, Mapping):
            node = node.get(part)
        elif isinstance(node, list) and isinstance(part, int) and part < len(node):
            node = node[part]
        else:
            node = None
    return tuple(keys), branch_at
