"""Measurements of a rig as lines of `measurements.NAME.jsonl`, its mirrors as lines of `mirrors.NAME.jsonl`.

The fields of `Measurement` and `MirrorPlane`, NaN as null. A measurement says beside them where it is,
`position_body_m`; a mirror says whose it is and when, `robot` and `time_s`.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.files.fields import Place, check_format, get, shown
from perception.files.readers import (
    Reader,
    flag,
    integer,
    number,
    number_or_nan,
    numbers,
    read_fields,
    text,
)
from perception.types import Measurement, MirrorPlane

_GHOST = ("no", "possible", "yes")
_UNIT_SLACK = 1e-3
_KINDS = ("constant", "surface", "pane")


def measurement_record(measurement: Measurement) -> dict[str, Any]:
    """Make the JSON object of one measurement.

    Raises
    ------
    ValueError
        If a number is infinite, which JSON cannot hold.
    """
    record = {"format": 1, **asdict(measurement), "position_body_m": measurement.position_body_m}
    return {name: _plain(name, value) for name, value in record.items()}


def parse_measurement(record: Mapping[str, Any], file: str = "", line: int | None = None) -> Measurement:
    """Read one object of `measurements.NAME.jsonl`.

    Raises
    ------
    RecordingError
        If a field is missing or of the wrong type.
    """
    place = Place(file, line)
    check_format(record, place)
    measurement = Measurement(**read_fields(Measurement, record, place, _OF_MEASUREMENT))
    if not measurement.detections:
        raise place.error("names no detection", "Write those that it is made of", "detections")
    if not 0.0 <= measurement.ghost_probability <= 1.0:
        raise place.error("is no probability", "Write a number from 0 to 1", "ghost_probability")
    if measurement.range_m <= 0.0:
        raise place.error("is not above 0", "Write a range in metres, or null", "range_m")
    if abs(math.hypot(*measurement.bearing_body) - 1.0) > _UNIT_SLACK:
        raise place.error("is no unit vector", "Write a vector of length 1", "bearing_body")
    finite = np.isfinite(measurement.covariance).all()
    if finite and not (np.linalg.eigvalsh(measurement.covariance) > 0.0).all():
        raise place.error("is no covariance", "Write a positive definite matrix, or nulls", "covariance")
    return measurement


def mirror_record(mirror: MirrorPlane, robot: str, time_s: float) -> dict[str, Any]:
    """Make the JSON object of a mirror that a set shows."""
    record = {"format": 1, "robot": robot, "time_s": time_s, **asdict(mirror)}
    return {name: _plain(name, value) for name, value in record.items()}


def parse_mirror(
    record: Mapping[str, Any], file: str = "", line: int | None = None
) -> tuple[str, float, MirrorPlane]:
    """Read one object of `mirrors.NAME.jsonl`: whose it is, when, and the mirror.

    Raises
    ------
    RecordingError
        If a field is missing or of the wrong type.
    """
    place = Place(file, line)
    check_format(record, place)
    plane = MirrorPlane(**read_fields(MirrorPlane, record, place, _OF_MIRROR))
    return text(record, "robot", place), number(record, "time_s", place), plane


def _plain(name: str, value: Any) -> Any:
    """Return a value as JSON holds it: lists for tuples and arrays, null for NaN."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(name, each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        if math.isinf(value):
            raise ValueError(f"{name} is infinite, which JSON cannot hold; use NaN")
        return None
    return value


def _vector(record: Mapping[str, Any], field: str, place: Place) -> tuple[float, ...]:
    return tuple(numbers(record, field, place, 3))


def _matrix(size: int) -> Reader:
    def read(record: Mapping[str, Any], field: str, place: Place) -> NDArray[np.float64]:
        rows = get(record, field, place)
        if not isinstance(rows, list) or [len(row) for row in rows if isinstance(row, list)] != [size] * size:
            raise place.error(f"is {shown(rows)}", f"Write {size} lists of {size} numbers", field)
        cells = [each for row in rows for each in row]
        flat = {f"{field}[{k // size}][{k % size}]": each for k, each in enumerate(cells)}
        return np.array([number_or_nan(flat, name, place) for name in flat]).reshape(size, size)

    return read


def _one_of(words: tuple[str, ...]) -> Reader:
    def read(record: Mapping[str, Any], field: str, place: Place) -> str:
        word = text(record, field, place)
        if word not in words:
            raise place.error(f"is {shown(word)}", f"Write one of {', '.join(words)}", field)
        return word

    return read


def _cameras(record: Mapping[str, Any], field: str, place: Place) -> tuple[str, ...]:
    names = get(record, field, place)
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise place.error(f"is {shown(names)}", "Write a list of cameras' names", field)
    return tuple(names)


def _detections(record: Mapping[str, Any], field: str, place: Place) -> tuple[tuple[str, int, int], ...]:
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


_OF_MEASUREMENT: dict[Any, Reader] = {
    str: text,
    float: number_or_nan,
    bool: flag,
    "time_s": number,
    "cameras": _cameras,
    "detections": _detections,
    "origin_body_m": _vector,
    "bearing_body": _vector,
    "covariance": _matrix(3),
    "ghost": _one_of(_GHOST),
    "ghost_probability": number,
}

_OF_MIRROR: dict[Any, Reader] = {
    float: number,
    int: integer,
    "normal_body": _vector,
    "kind": _one_of(_KINDS),
    "covariance": _matrix(4),
}
