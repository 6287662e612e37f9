"""Checked access to the fields of a JSON object, with errors that say where and how to mend."""

import json
import math
import reprlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_MOST_SHOWN = 20
_BRIEF = reprlib.Repr()
_BRIEF.maxstring = _BRIEF.maxother = _BRIEF.maxlong = 80
_BRIEF.maxlist = _BRIEF.maxdict = 6
_BRIEF.maxlevel = 2


class RecordingError(ValueError):
    """A recording cannot be read; the text names file, line and field, and what to do.

    `problems` holds one line per thing to mend; the text is the first twenty of them, and how many more.
    """

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(first_of(problems)))
        self.problems = problems


def first_of(problems: Sequence[str]) -> list[str]:
    """Return the first twenty problems, and how many more there are: beyond that nobody reads on."""
    more = len(problems) - _MOST_SHOWN
    return [*problems[:_MOST_SHOWN], *([f"… and {more} more"] if more > 0 else [])]


class Faults:
    """What is wrong, gathered while reading goes on, so that all of it is said at once."""

    def __init__(self) -> None:
        self.problems: list[str] = []

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Keep the faults that the block raises; what stands behind the block goes on."""
        try:
            yield
        except RecordingError as error:
            self.problems += error.problems

    def raise_any(self) -> None:
        """Raise RecordingError if anything was wrong."""
        if self.problems:
            raise RecordingError(*self.problems)


@dataclass(frozen=True)
class Place:
    """Where a JSON object stands: its file, and the line or the path within it."""

    file: str
    line: int | None = None
    inside: str = ""

    def error(self, problem: str, remedy: str, field: str | None = None) -> RecordingError:
        """Make an error about this place, or about one field here."""
        name = ".".join(part for part in (self.inside, field) if part)
        parts = [self.file, f"line {self.line}" if self.line else "", f"field {shown(name)}" if name else ""]
        where = ", ".join(part for part in parts if part)
        return RecordingError(f"{where}{': ' if where else ''}{problem}. {remedy}.")

    def within(self, name: str) -> "Place":
        """Return the place of an object inside this one."""
        return Place(self.file, self.line, f"{self.inside}.{name}" if self.inside else name)


def shown(value: object) -> str:
    """Return what was written, in quotes where it is text, for a message: of long values both ends."""
    try:
        return _BRIEF.repr(value)
    except ValueError:  # Python writes no whole number of more than 4300 digits
        return "a number of thousands of digits"


def parse_json(text: str, place: Place) -> Any:
    """Parse a JSON value.

    Raises
    ------
    RecordingError
        If the text is no JSON, holds NaN, Infinity or a number beyond them, names a field twice, or nests
        without end.
    """

    def refuse(name: str) -> None:
        raise place.error(
            f"holds {shown(name).strip(chr(39))}, which is no JSON number",
            "Write a finite number, or null where allowed",
        )

    def finite(written: str) -> float:
        value = float(written)
        if math.isinf(value):
            refuse(written)
        return value

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            names = [name for name, _ in pairs]
            twice = next(name for name in names if names.count(name) > 1)
            raise place.error("the field stands twice", "Keep one of them", twice)
        return found

    try:
        return json.loads(text, parse_constant=refuse, parse_float=finite, object_pairs_hook=once)
    except json.JSONDecodeError as error:
        raise place.error(
            f"broken JSON at column {error.colno} ({error.msg})", "Write the file again, or mend that place"
        ) from error
    except RecordingError:
        raise
    except RecursionError as error:
        raise place.error("nests lists or objects without end", "Write the file again") from error
    except ValueError as error:  # a whole number of more digits than Python reads
        raise place.error("holds a number of thousands of digits", "Write it with fewer") from error


def parse_object(text: str, place: Place) -> dict[str, Any]:
    """Parse one JSON object; errors as `parse_json`, and where the value is no object."""
    value = parse_json(text, place)
    if not isinstance(value, dict):
        raise place.error(f"holds a {type(value).__name__}", "Put a JSON object { } there")
    return value


def read_text(path: Path) -> str:
    """Read a text file of a recording.

    Raises
    ------
    RecordingError
        If it is missing or no UTF-8 text.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise Place(str(path)).error(
            "the file is missing", "A recording is a folder with frames.jsonl and calibration.json"
        ) from error
    except UnicodeDecodeError as error:
        raise Place(str(path)).error("the file is no UTF-8 text", "Save it as UTF-8") from error
    except OSError as error:
        raise Place(str(path)).error(
            f"the file cannot be read ({error.strerror})", "Check its kind and its rights"
        ) from error


def check_format(record: Mapping[str, Any], place: Place) -> None:
    """Refuse a record of another format than 1."""
    value = get(record, "format", place)
    if value != 1 or isinstance(value, bool):
        raise place.error(f"is {shown(value)}", 'This program reads "format": 1', "format")


def get(record: Mapping[str, Any], field: str, place: Place) -> Any:
    """Return a field that must be there."""
    if field not in record:
        raise place.error("the field is missing", "Add it", field)
    return record[field]
