"""Checked access to the fields of a JSON object, with errors that say where and how to mend."""

import dataclasses
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any


class RecordingError(ValueError):
    """A recording cannot be read; the text names file, line and field, and what to do."""


@dataclass(frozen=True)
class Place:
    """Where a JSON object stands: its file, and the line or the path within it."""

    file: str
    line: int | None = None
    inside: str = ""

    def error(self, problem: str, remedy: str, field: str | None = None) -> RecordingError:
        """Make an error about this place, or about one field here."""
        where = self.file if self.line is None else f"{self.file}, line {self.line}"
        name = ".".join(part for part in (self.inside, field) if part)
        return RecordingError(f"{where}{f', field {name!r}' if name else ''}: {problem}. {remedy}.")

    def within(self, name: str) -> "Place":
        """Return the place of an object inside this one."""
        return Place(self.file, self.line, f"{self.inside}.{name}" if self.inside else name)


def parse_object(text: str, place: Place) -> dict[str, Any]:
    """Parse one JSON object.

    Raises
    ------
    RecordingError
        If the text is no JSON, holds NaN or Infinity, or is not an object.
    """

    def refuse_constant(name: str) -> None:
        raise place.error(
            f"holds {name}, which is no JSON number", "Write a finite number, or null where allowed"
        )

    try:
        value = json.loads(text, parse_constant=refuse_constant)
    except json.JSONDecodeError as error:
        raise place.error(
            f"broken JSON at column {error.colno} ({error.msg})", "Write the file again, or mend that place"
        ) from error
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
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise Place(str(path)).error(
            "the file is missing", "A recording is a folder with frames.jsonl and calibration.json"
        ) from error
    except UnicodeDecodeError as error:
        raise Place(str(path)).error("the file is no UTF-8 text", "Save it as UTF-8") from error


Reader = Callable[[Mapping[str, Any], str, Place], Any]
"""Takes a field of a JSON object, by its name, and returns its value."""


def read_fields(
    kind: type[Any], record: Mapping[str, Any], place: Place, readers: Mapping[Any, Reader]
) -> dict[str, Any]:
    """Read the fields of a dataclass from a JSON object.

    Parameters
    ----------
    kind
        The dataclass.
    record, place
        The object, and where it stands.
    readers
        How to read a field, by the field's name or else by its type.

    Raises
    ------
    RecordingError
        If a field is missing or of the wrong type.
    """
    return {
        field.name: (readers.get(field.name) or readers[field.type])(record, field.name, place)
        for field in dataclasses.fields(kind)
    }


def check_format(record: Mapping[str, Any], place: Place) -> None:
    """Refuse a record of another format than 1."""
    value = get(record, "format", place)
    if value != 1 or isinstance(value, bool):
        raise place.error(f"is {value!r}", 'This program reads "format": 1', "format")


def get(record: Mapping[str, Any], field: str, place: Place) -> Any:
    """Return a field that must be there."""
    if field not in record:
        raise place.error("the field is missing", "Add it", field)
    return record[field]


def text(record: Mapping[str, Any], field: str, place: Place) -> str:
    """Return a field that is a string with something in it."""
    value = get(record, field, place)
    if not isinstance(value, str) or not value:
        raise place.error(f"is {value!r}", 'Write a string in double quotes, like "r1.front"', field)
    return value


def flag(record: Mapping[str, Any], field: str, place: Place) -> bool:
    """Return a field that is true or false."""
    value = get(record, field, place)
    if not isinstance(value, bool):
        raise place.error(f"is {value!r}", "Write true or false", field)
    return value


def integer(record: Mapping[str, Any], field: str, place: Place) -> int:
    """Return a field that is a whole number, not negative."""
    value = get(record, field, place)
    if not isinstance(value, int) or isinstance(value, bool) or value < 0:
        raise place.error(f"is {value!r}", "Write a whole number, 0 or more", field)
    return value


def number(record: Mapping[str, Any], field: str, place: Place) -> float:
    """Return a field that is a finite number."""
    return as_number(get(record, field, place), field, place)


def positive(record: Mapping[str, Any], field: str, place: Place) -> float:
    """Return a field that is a finite number above 0."""
    value = number(record, field, place)
    if not value > 0.0:
        raise place.error(f"is {record[field]!r}", "Write a number above 0", field)
    return value


def not_negative(record: Mapping[str, Any], field: str, place: Place) -> float:
    """Return a field that is a finite number, 0 or more."""
    value = number(record, field, place)
    if value < 0.0:
        raise place.error(f"is {record[field]!r}", "Write a number, 0 or more", field)
    return value


def number_or_nan(record: Mapping[str, Any], field: str, place: Place) -> float:
    """Return a field that is a finite number, or NaN for null."""
    value = get(record, field, place)
    return math.nan if value is None else as_number(value, field, place)


def numbers(record: Mapping[str, Any], field: str, place: Place, count: int | None = None) -> list[float]:
    """Return a field that is a list of finite numbers, of a given length if one is given."""
    value = get(record, field, place)
    if not isinstance(value, list) or (count is not None and len(value) != count) or not value:
        wanted = "numbers" if count is None else f"{count} numbers"
        raise place.error(f"is {value!r}", f"Write a list of {wanted}", field)
    return [as_number(entry, f"{field}[{i}]", place) for i, entry in enumerate(value)]


def as_number(value: Any, field: str, place: Place) -> float:
    """Check one value that must be a finite number."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise place.error(f"is {value!r}", "Write a finite number", field)
    return float(value)
