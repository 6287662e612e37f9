"""Readers of single fields, for records whose fields hold more than a table can say."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from perception.files.entries import MOST_INDEX, Entry, read_entry
from perception.files.fields import Place, get

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
