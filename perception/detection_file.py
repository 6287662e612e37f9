"""Detections as lines of `detections.NAME.jsonl`: the fields of `Detection`; NaN stands as null."""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from perception.json_fields import (
    Place,
    check_format,
    flag,
    get,
    integer,
    number,
    number_or_nan,
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
    bearing = get(record, "bearing_body", place)
    if not isinstance(bearing, list) or len(bearing) != 3:
        raise place.error(f"is {bearing!r}", "Write a list of 3 numbers", "bearing_body")
    parts = {f"bearing_body[{i}]": value for i, value in enumerate(bearing)}
    x, y, z = (number_or_nan(parts, name, place) for name in parts)

    def real(name: str) -> float:
        return number_or_nan(record, name, place)

    return Detection(
        camera=text(record, "camera", place),
        index=integer(record, "index", place),
        time_s=number(record, "time_s", place),
        u_px=real("u_px"),
        v_px=real("v_px"),
        u_sigma_px=real("u_sigma_px"),
        v_sigma_px=real("v_sigma_px"),
        flux_dn=real("flux_dn"),
        mean_dn=real("mean_dn"),
        background_dn=real("background_dn"),
        area_px=integer(record, "area_px", place),
        saturated=flag(record, "saturated", place),
        merged=flag(record, "merged", place),
        ghost=flag(record, "ghost", place),
        range_m=real("range_m"),
        range_sigma_m=real("range_sigma_m"),
        bearing_body=(x, y, z),
    )


def _null_for_nan(name: str, value: float) -> float | None:
    if math.isinf(value):
        raise ValueError(f"{name} of a detection is infinite, which JSON cannot hold; use NaN")
    return None if math.isnan(value) else value
