"""Detections as lines of `detections.NAME.jsonl`: the fields of `Detection`; NaN stands as null."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from perception.files.fields import (
    Place,
    Reader,
    check_format,
    flag,
    get,
    integer,
    number,
    number_or_nan,
    read_fields,
    text,
)
from perception.types import Detection


def detection_record(detection: Detection) -> dict[str, Any]:
    """Make the JSON object of one detection.

    Raises
    ------
    ValueError
        If a field is infinite, which JSON cannot hold.
    """
    record = {"format": 1, **asdict(detection)}
    record["bearing_body"] = [_null_for_nan("bearing_body", value) for value in detection.bearing_body]
    return {
        name: _null_for_nan(name, value) if isinstance(value, float) else value
        for name, value in record.items()
    }


def parse_detection(
    record: Mapping[str, Any], file: str = "detections.jsonl", line: int | None = None
) -> Detection:
    """Read one object of `detections.NAME.jsonl`.

    Parameters
    ----------
    record
        The object.
    file, line
        Where it stands, for error texts.

    Raises
    ------
    RecordingError
        If a field is missing or of the wrong type.
    """
    place = Place(file, line)
    check_format(record, place)
    return Detection(**read_fields(Detection, {**_OPTIONAL, **record}, place, _READERS))


def _bearing(record: Mapping[str, Any], field: str, place: Place) -> tuple[float, ...]:
    bearing = get(record, field, place)
    if not isinstance(bearing, list) or len(bearing) != 3:
        raise place.error(f"is {bearing!r}", "Write a list of 3 numbers", field)
    parts = {f"{field}[{i}]": value for i, value in enumerate(bearing)}
    return tuple(number_or_nan(parts, name, place) for name in parts)


_READERS: dict[Any, Reader] = {
    str: text,
    int: integer,
    bool: flag,
    float: number_or_nan,
    "time_s": number,
    "bearing_body": _bearing,
}


_OPTIONAL = {"flux_sigma_dn": None, "range_sigma_common_m": None}


def _null_for_nan(name: str, value: float) -> float | None:
    if math.isinf(value):
        raise ValueError(f"{name} of a detection is infinite, which JSON cannot hold; use NaN")
    return None if math.isnan(value) else value
