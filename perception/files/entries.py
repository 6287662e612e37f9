"""What a field of a recording's files may hold: tables to read by, to publish as a schema, to document.

`Entry` is a row of such a table. Bounds are far beyond what any camera has: what lies outside is a slip, and
no sum or square of what lies inside overflows.
"""

import difflib
import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

from perception.files.fields import Faults, Place, check_format, get, shown

Kind = Literal["text", "whole", "number", "flag", "list", "places", "bearing", "choice", "objects"]

REQUIRED: Any = object()
"""The default of what has none: the field must be there."""

MOST_INDEX = 2**63 - 1
MOST_PX = 1e6
MOST_TIME_S = 1e12
_UNIT_SLACK = 1e-3  # of the length of a bearing
_MOST_TEXT = 4096
_MOST_LIST = 100_000
_BOUNDLESS = 1e6  # of the numbers of a list: a bound that is not worth a word


@dataclass(frozen=True)
class Entry:
    """A field of a file.

    Attributes
    ----------
    name, kind, meaning
        Its name, what it is, and what it says, in a sentence.
    least, most
        Bounds of a number, or of each number of a list.
    above
        Whether `least` itself is refused.
    size
        Of a list; None where any but 0 will do.
    choices
        Of a `choice`.
    null
        What null says; "" where it is refused.
    default
        What a field that is missing counts as.
    sigma
        Whether it may stand as {"value": v, "sigma": s}.
    fields
        Of each of a list of `objects`.
    """

    name: str
    kind: Kind
    meaning: str
    least: float = -math.inf
    most: float = math.inf
    above: bool = False
    size: int | None = None
    choices: tuple[str, ...] = ()
    null: str = ""
    default: Any = REQUIRED
    sigma: bool = False
    fields: "tuple[Entry, ...]" = ()

    @property
    def required(self) -> bool:
        """Whether the field must be there."""
        return self.default is REQUIRED


def read_entries(
    record: Mapping[str, Any], entries: Iterable[Entry], place: Place, faults: Faults
) -> dict[str, Any]:
    """Read the fields of a JSON object by their table.

    Parameters
    ----------
    record, entries, place
        The object, what its fields may hold, and where it stands.
    faults
        Takes what is wrong.

    Returns
    -------
    Values by field; without those that are wrong.
    """
    values = {}
    known = list(entries)
    for entry in known:
        with faults.kept():
            if entry.name in record or entry.required:
                values[entry.name] = read_entry(get(record, entry.name, place), entry, place)
            else:
                values[entry.name] = entry.default
    with faults.kept():
        check_names(record, [entry.name for entry in known], place)
    return values


def read_record(record: Any, entries: Iterable[Entry], place: Place) -> dict[str, Any]:
    """Read a JSON object of format 1 by the table of its fields.

    Raises
    ------
    RecordingError
        All that is wrong.
    """
    if not isinstance(record, Mapping):
        raise place.error(f"is {shown(record)}", "Put a JSON object { } there")
    faults = Faults()
    with faults.kept():
        check_format(record, place)
    values = read_entries(record, entries, place, faults)
    faults.raise_any()
    return values


def check_names(record: Mapping[str, Any], known: Collection[str], place: Place) -> None:
    """Refuse a field that looks like one that is known and missing; others are let be."""
    missing = [name for name in known if name not in record]
    for name in record:
        near = [] if name in known else difflib.get_close_matches(str(name)[:100], missing, n=1, cutoff=0.8)
        if near:
            raise place.error("there is no such field", f"Write {near[0]!r}, if that is meant", name)


def read_entry(value: Any, entry: Entry, place: Place) -> Any:
    """Read one value.

    Raises
    ------
    RecordingError
        If it is of another kind, or out of bounds.
    """
    if value is None and entry.null:
        return math.nan if entry.kind in ("number", "whole") else (math.nan,) * (entry.size or 0)
    match entry.kind:
        case "text":
            return _text(value, entry, place)
        case "choice":
            if value not in entry.choices:
                raise place.error(f"is {shown(value)}", f"Known are {', '.join(entry.choices)}", entry.name)
            return value
        case "flag":
            if not isinstance(value, bool):
                raise place.error(f"is {shown(value)}", "Write true or false", entry.name)
            return value
        case "list":
            return _list(value, entry, place)
        case "places":
            return _places(value, entry, place)
        case "bearing":
            return _bearing(value, entry, place)
        case "objects":
            return _objects(value, entry, place)
        case _:
            return _number(value, entry, place, entry.name)


def wanted(entry: Entry) -> str:
    """Say what kind of value a field takes: "a finite number above 0, at most 1e+06"."""
    if entry.kind == "text":
        return "text"
    if entry.kind == "flag":
        return "true or false"
    if entry.kind == "choice":
        return " or ".join(f'"{choice}"' for choice in entry.choices)
    if entry.kind == "places":
        return "a list of [x, y, z]"
    if entry.kind == "objects":
        return "a list of objects with " + ", ".join(f"`{field.name}`" for field in entry.fields)
    if entry.kind in ("list", "bearing"):
        count = "numbers" if entry.size is None else f"{entry.size} numbers"
        return f"a list of {count}{_bounds(entry)}"
    return f"{'a whole number' if entry.kind == 'whole' else 'a finite number'}{_bounds(entry)}"


def _bounds(entry: Entry) -> str:
    low, high = math.isfinite(entry.least), math.isfinite(entry.most)
    if entry.kind == "bearing":
        return ", of length 1"
    if entry.kind == "list" and entry.most >= _BOUNDLESS:
        return ""
    if low and high and entry.least == -entry.most:
        return f" from −{_plain(entry.most)} to {_plain(entry.most)}"
    words = ""
    if low:
        words += f" above {_plain(entry.least)}" if entry.above else f", {_plain(entry.least)} or more"
    return words + (f", at most {_plain(entry.most)}" if high else "")


def _plain(value: float) -> str:
    return str(int(value)) if value == int(value) and abs(value) < 1e6 else f"{value:.4g}"


def _text(value: Any, entry: Entry, place: Place) -> str:
    if not isinstance(value, str) or not value:
        raise place.error(
            f"is {shown(value)}", 'Write a string in double quotes, like "r1.front"', entry.name
        )
    if not value.isprintable() or len(value) > _MOST_TEXT:
        raise place.error(
            f"is {shown(value)}", "Write a text that can be printed, on one line, and not endless", entry.name
        )
    return value


def _number(value: Any, entry: Entry, place: Place, name: str) -> Any:
    whole = entry.kind == "whole"
    kind = int if whole else int | float
    fits = isinstance(value, kind) and not isinstance(value, bool) and entry.least <= value <= entry.most
    if not fits or (entry.above and value == entry.least) or not abs(value) < 2**1023:
        one = wanted(entry) if entry.kind not in ("list", "places") else f"a finite number{_bounds(entry)}"
        raise place.error(f"is {shown(value)}", f"Write {one}", name)
    return value if whole else float(value)


def _list(value: Any, entry: Entry, place: Place) -> list[float]:
    right = isinstance(value, list) and 0 < len(value) <= _MOST_LIST
    if not right or (entry.size is not None and len(value) != entry.size):
        raise place.error(f"is {shown(value)}", f"Write {wanted(entry)}", entry.name)
    faults, numbers = Faults(), []
    for i, part in enumerate(value):
        with faults.kept():
            numbers.append(_number(part, entry, place, f"{entry.name}[{i}]"))
    faults.raise_any()
    return numbers


def _places(value: Any, entry: Entry, place: Place) -> list[list[float]]:
    """Read a list of places, none among them."""
    if not isinstance(value, list) or len(value) > _MOST_LIST:
        raise place.error(f"is {shown(value)}", "Write a list of [x, y, z], in metres", entry.name)
    one = replace(entry, kind="list", size=3)
    faults, found = Faults(), []
    for i, part in enumerate(value):
        with faults.kept():
            found.append(_list(part, replace(one, name=f"{entry.name}[{i}]"), place))
    faults.raise_any()
    return found


def _objects(value: Any, entry: Entry, place: Place) -> list[dict[str, Any]]:
    """Read a list of objects, none among them."""
    if not isinstance(value, list) or len(value) > _MOST_LIST:
        raise place.error(f"is {shown(value)}", f"Write {wanted(entry).replace('`', '')}", entry.name)
    faults, found = Faults(), []
    for i, part in enumerate(value):
        inside = place.within(f"{entry.name}[{i}]")
        with faults.kept():
            if not isinstance(part, dict):
                raise inside.error(f"is {shown(part)}", "Put a JSON object { } there")
            found.append(read_entries(part, entry.fields, inside, faults))
    faults.raise_any()
    return found


def _bearing(value: Any, entry: Entry, place: Place) -> tuple[float, ...]:
    """Read a unit vector; null in all its places where there is none."""
    if not isinstance(value, list) or len(value) != 3:
        raise place.error(f"is {shown(value)}", "Write a list of 3 numbers", entry.name)
    if value == [None, None, None]:
        return (math.nan,) * 3
    numbers = _list(value, entry, place)
    length = math.hypot(*numbers)
    if abs(length - 1.0) > _UNIT_SLACK:
        raise place.error(
            f"has length {length:.6g}", "Write a unit vector: divide it by its length", entry.name
        )
    return tuple(numbers)
