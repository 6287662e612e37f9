"""YAML as people mean it: what it silently turns into something else is refused, with the line.

So is what no machine can bear: aliases of aliases, and nesting without end.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from nir_render.errors import shown

# What a file may hold at most: beyond it, reading takes seconds.
_MOST_CHARACTERS = 20_000_000
_MOST_VALUES = 50_000
_MOST_DEPTH = 32
_OCTAL = re.compile(r"[-+]?0[0-7_]+")
# What the reader of YAML says, and what it means.
_IN_WORDS = (
    ("undefined alias", "an alias (*name) without its anchor (&name); define it above, or use quotes"),
    ("duplicate anchor", "an anchor (&name) stands twice; give the second another name"),
    ("mapping values are not", "a ':' where no key can be; put text in quotes, check the indentation"),
    ("expected ':'", "a key without its ':'; write it such as key: value, or put text in quotes"),
    ("quoted scalar", "a quote that is not closed, or a '\\' in double quotes; close it, use single quotes"),
    ("unknown escape", "a '\\' that double quotes do not take; use single quotes"),
    ("'\\t'", "a tab; indent with spaces"),
    ("found character", "a value cannot begin with this character; put it in quotes"),
    ("']'", "a list that lacks its ']', or a comma between two values; write it such as [1, 2]"),
    ("'}'", "a mapping that lacks its '}', or a comma between two keys; write it such as {a: 1, b: 2}"),
    ("block sequence", "this line does not fit the list above; check its indentation and its '- '"),
    ("block mapping", "this line does not fit the keys above; check its indentation and its ':'"),
    ("sequence entries", "a '- ' where no list can be; check the indentation"),
    ("single document", "a second document begins; write one file for each"),
    ("tag", "a tag ('!…'), or a value that YAML takes for one; take tags out, put text in quotes"),
    ("", "is no YAML; check indentation, quotes and brackets"),
)  # fmt: skip


@dataclass(frozen=True)
class _Trap:
    """A value that YAML takes for something else than it looks like; `line` counts from 1."""

    line: int
    message: str


class Loader(yaml.SafeLoader):
    """Reads YAML 1.1 as people mean it, and no more of it than a machine can bear.

    YAML lets a repeated key silently replace the first, takes 1:30:00 for 5400 and 010 for 8: errors here. An
    alias stands for a copy of what it names, so that nine levels of nine are 387 million values: what a
    document becomes is counted while it is read.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.traps: list[_Trap] = []
        self._open: list[str] = []  # anchors of what is being read
        self._size_of: dict[str, int] = {}  # values that an anchor's alias adds
        self._size = 0
        self._depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Read a value, with what it holds."""
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        anchor = event.anchor
        if self.check_event(yaml.AliasEvent):
            if anchor in self._open:
                raise _refused(
                    event, f"the alias *{anchor[:40]} stands inside what it names; write out what is meant"
                )
            self._grow(event, self._size_of.get(anchor, 0))
            return super().compose_node(parent, index)
        before = self._size
        self._grow(event, 1)
        self._depth += 1
        if self._depth > _MOST_DEPTH:
            raise _refused(
                event, f"values are nested more than {_MOST_DEPTH} deep; take some of the brackets out"
            )
        self._open.append(anchor)
        node = super().compose_node(parent, index)
        self._open.pop()
        self._depth -= 1
        self._size_of[anchor] = self._size - before
        return node

    def _grow(self, event: Any, values: int) -> None:
        self._size += values
        if self._size > _MOST_VALUES:
            raise _refused(
                event,
                f"with its aliases written out the file holds more than {_MOST_VALUES} values; put tables "
                "into CSV files, and take aliases of aliases out",
            )

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Read keys with values; refuse keys that are no text, and those that stand twice."""
        seen = set()
        for key_node, _ in node.value:
            line = key_node.start_mark.line + 1
            if key_node.tag == "tag:yaml.org,2002:merge":
                raise yaml.constructor.ConstructorError(
                    None, None, f"line {line}: '<<' is not read here; take a preset, or write the keys out"
                )
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                said = shown(key_node.value) if isinstance(key_node, yaml.ScalarNode) else "a list or mapping"
                raise yaml.constructor.ConstructorError(
                    None, None, f"line {line}: the key {said} is not a name; write it as text, in quotes"
                )
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"line {line}: key {shown(key)} stands twice; take one of them out"
                )
            seen.add(key)
        return super().construct_mapping(node, deep)

    def construct_number(self, node: yaml.ScalarNode) -> Any:
        """Read a number; what only YAML takes for one is a trap."""
        text = self.construct_scalar(node)
        read = self.construct_yaml_int if node.tag.endswith(":int") else self.construct_yaml_float
        value = read(node)
        if ":" in text:
            self._trap(node, f"the number {value:g}, in base 60")
        elif isinstance(value, int) and _OCTAL.fullmatch(text):
            self._trap(node, f"the octal number {value}")
        return value

    def construct_no_date(self, node: yaml.ScalarNode) -> str:
        """Read a date as its text: nothing here is one."""
        self._trap(node, "a date")
        return str(node.value)

    def _trap(self, node: yaml.ScalarNode, taken_for: str) -> None:
        message = (
            f"YAML takes {shown(node.value)} for {taken_for}; put it in quotes if it is text, or write the "
            "number that is meant"
        )
        self.traps.append(_Trap(node.start_mark.line + 1, message))


for _tag in ("int", "float"):
    Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", Loader.construct_number)
Loader.add_constructor("tag:yaml.org,2002:timestamp", Loader.construct_no_date)


def _refused(event: Any, message: str) -> yaml.YAMLError:
    return yaml.MarkedYAMLError(problem=message, problem_mark=event.start_mark)


def parse_yaml(text: str, name: str) -> Any:
    """Read YAML; raise ValueError with `name` and line where it is broken or has a key twice."""
    if len(text) > _MOST_CHARACTERS:
        raise ValueError(
            f"{name}: holds {len(text)} characters, at most {_MOST_CHARACTERS} are read; "
            "put tables into CSV files"
        )
    try:
        loader = Loader(text)
        data = loader.get_single_data()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        raise ValueError(f"{name}{where}: {_in_words(error)}") from None
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError):
        raise ValueError(
            f"{name}: a tag ('!!…') or a number does not fit what it is written before; take tags out, and "
            "write numbers in digits"
        ) from None
    if loader.traps:
        raise ValueError("\n".join(f"{name}, line {trap.line}: {trap.message}" for trap in loader.traps[:20]))
    return data


def _in_words(error: yaml.YAMLError) -> str:
    """Return what is wrong with a text that is no YAML, and how to mend it."""
    if isinstance(error, yaml.reader.ReaderError):
        return f"holds the character {chr(error.character)!r}, which YAML does not take; take it out"
    problem = str(getattr(error, "problem", None) or "")
    if problem.startswith(("line ", "values are nested", "the alias *", "with its aliases")):
        return problem
    said = f"{getattr(error, 'context', None) or ''} {problem}"
    return next(words for part, words in _IN_WORDS if part in said)


def read_yaml(path: Path) -> Any:
    """Read a YAML file; errors as `parse_yaml`."""
    try:
        return parse_yaml(path.read_text(encoding="utf-8"), str(path))
    except UnicodeDecodeError:
        raise ValueError(f"{path} is not UTF-8 text; save it as UTF-8") from None
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}; check its name and its rights") from None


def line_numbers(path: Path) -> dict[tuple[str, ...], int]:
    """Return the line of each key of a YAML file that `read_yaml` reads, by its path of keys."""
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

    root = Loader(path.read_text(encoding="utf-8")).get_single_node()
    if root is not None:
        walk(root, ())
    return lines
