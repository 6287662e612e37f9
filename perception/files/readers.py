"""Readers of single fields, for records whose fields hold more than a table can say."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.files.entries import MOST_INDEX, Entry, read_entry
from perception.files.fields import Place, get, shown

Reader = Callable[[Mapping[str, Any], str, Place], Any]
"""Takes a field of a JSON object, by its name, and returns its value."""

_MOST = 1e30  # of a number of which nothing else is known


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


def text(record: Mapping[str, Any], field: str, place: Place) -> str:
    """Return a field that is a string with something in it."""
    return str(read_entry(get(record, field, place), Entry(field, "text", ""), place))


def flag(record: Mapping[str, Any], field: str, place: Place) -> bool:
    """Return a field that is true or false."""
    return bool(read_entry(get(record, field, place), Entry(field, "flag", ""), place))


def integer(record: Mapping[str, Any], field: str, place: Place) -> int:
    """Return a field that is a whole number, not negative."""
    return int(read_entry(get(record, field, place), Entry(field, "whole", "", 0, MOST_INDEX), place))


def number(record: Mapping[str, Any], field: str, place: Place) -> float:
    """Return a field that is a finite number."""
    return float(read_entry(get(record, field, place), Entry(field, "number", "", -_MOST, _MOST), place))


def number_or_nan(record: Mapping[str, Any], field: str, place: Place) -> float:
    """Return a field that is a finite number, or NaN for null."""
    entry = Entry(field, "number", "", -_MOST, _MOST, null="no claim")
    return float(read_entry(get(record, field, place), entry, place))


def numbers(record: Mapping[str, Any], field: str, place: Place, count: int | None = None) -> list[float]:
    """Return a field that is a list of finite numbers, of a given length if one is given."""
    entry = Entry(field, "list", "", -_MOST, _MOST, size=count)
    return list(read_entry(get(record, field, place), entry, place))


def plain(name: str, value: Any) -> Any:
    """Return a value as JSON holds it: lists for tuples and arrays, null for NaN."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(name, each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        if math.isinf(value):
            raise ValueError(f"{name} is infinite, which JSON cannot hold; use NaN")
        return None
    return value


def vector(record: Mapping[str, Any], field: str, place: Place) -> tuple[float, ...]:
    """Return a field that is a list of three finite numbers."""
    return tuple(numbers(record, field, place, 3))


def matrix(size: int) -> Reader:
    """Return a reader of square matrices, whose cells may be null."""

    def read(record: Mapping[str, Any], field: str, place: Place) -> NDArray[np.float64]:
        rows = get(record, field, place)
        if not isinstance(rows, list) or [len(row) for row in rows if isinstance(row, list)] != [size] * size:
            raise place.error(f"is {shown(rows)}", f"Write {size} lists of {size} numbers", field)
        cells = [each for row in rows for each in row]
        flat = {f"{field}[{k // size}][{k % size}]": each for k, each in enumerate(cells)}
        return np.array([number_or_nan(flat, name, place) for name in flat]).reshape(size, size)

    return read


def one_of(words: tuple[str, ...]) -> Reader:
    """Return a reader of one of a few words."""

    def read(record: Mapping[str, Any], field: str, place: Place) -> str:
        word = text(record, field, place)
        if word not in words:
            raise place.error(f"is {shown(word)}", f"Write one of {', '.join(words)}", field)
        return word

    return read


def detection_keys(record: Mapping[str, Any], field: str, place: Place) -> tuple[tuple[str, int, int], ...]:
    """Return a field that lists detections: camera, index of the frame, number among that frame's."""
    rows = get(record, field, place)
    if not isinstance(rows, list) or not all(isinstance(row, list) and len(row) == 3 for row in rows):
        raise place.error(f"is {shown(rows)}", "Write a list of [camera, index, number]", field)
    parts = [
        {"camera": row[0], "index": row[1], "number": row[2]} for row in rows
    ]  # each checked as fields of its own
    return tuple(
        (text(part, "camera", at), integer(part, "index", at), integer(part, "number", at))
        for i, part in enumerate(parts)
        for at in (place.within(f"{field}[{i}]"),)
    )
