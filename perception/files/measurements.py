"""Measurements of a rig as lines of `measurements.NAME.jsonl`, its mirrors, and robots with several sources.

The fields of `Measurement` and `MirrorPlane`, NaN as null. A measurement says beside them where it is,
`position_body_m`; a mirror says whose it is and when, `robot` and `time_s`.
They stand in `mirrors.NAME.jsonl`; in `robots.NAME.jsonl` the fields of `RobotPose`, each hypothesis an
object with those of `PoseHypothesis`.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from perception.files.fields import Place, check_format, get, shown
from perception.files.readers import (
    Reader,
    detection_keys,
    flag,
    integer,
    matrix,
    number,
    number_or_nan,
    one_of,
    plain,
    read_fields,
    text,
    vector,
)
from perception.types import Measurement, MirrorPlane, PoseHypothesis, RobotPose

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
    return {name: plain(name, value) for name, value in record.items()}


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
    return {name: plain(name, value) for name, value in record.items()}


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


def _cameras(record: Mapping[str, Any], field: str, place: Place) -> tuple[str, ...]:
    names = get(record, field, place)
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise place.error(f"is {shown(names)}", "Write a list of cameras' names", field)
    return tuple(names)


_OF_MEASUREMENT: dict[Any, Reader] = {
    str: text,
    float: number_or_nan,
    bool: flag,
    "time_s": number,
    "cameras": _cameras,
    "detections": detection_keys,
    "origin_body_m": vector,
    "bearing_body": vector,
    "covariance": matrix(3),
    "ghost": one_of(_GHOST),
    "ghost_probability": number,
}

_OF_MIRROR: dict[Any, Reader] = {
    float: number,
    int: integer,
    "normal_body": vector,
    "kind": one_of(_KINDS),
    "covariance": matrix(4),
}


def robot_record(pose: RobotPose) -> dict[str, Any]:
    """Make the JSON object of one robot."""
    record = {name: plain(name, value) for name, value in asdict(pose).items() if name != "hypotheses"}
    hypotheses = [
        {name: plain(name, value) for name, value in asdict(each).items()} for each in pose.hypotheses
    ]
    return {"format": 1, **record, "hypotheses": hypotheses}


def parse_robot(record: Mapping[str, Any], file: str = "", line: int | None = None) -> RobotPose:
    """Read one object of `robots.NAME.jsonl`.

    Raises
    ------
    RecordingError
        If a field is missing or of the wrong type.
    """
    place = Place(file, line)
    check_format(record, place)
    return RobotPose(**read_fields(RobotPose, record, place, _OF_ROBOT))


def _hypotheses(record: Mapping[str, Any], field: str, place: Place) -> tuple[PoseHypothesis, ...]:
    given = get(record, field, place)
    if not isinstance(given, list) or not given or not all(isinstance(each, dict) for each in given):
        raise place.error(f"is {shown(given)}", "Write a list of objects, one for each hypothesis", field)
    found = []
    for k, each in enumerate(given):
        inside = place.within(f"{field}[{k}]")
        hypothesis = PoseHypothesis(**read_fields(PoseHypothesis, each, inside, _OF_HYPOTHESIS))
        if not (np.linalg.eigvalsh(hypothesis.covariance) > 0.0).all():
            raise inside.error("is no covariance", "Write a positive definite matrix", "covariance")
        found.append(hypothesis)
    return tuple(found)


def _sources(record: Mapping[str, Any], field: str, place: Place) -> tuple[int, ...]:
    given = get(record, field, place)
    if not isinstance(given, list) or not all(type(each) is int and each >= 0 for each in given):
        raise place.error(f"is {shown(given)}", "Write a list of whole numbers", field)
    return tuple(given)


_OF_ROBOT: dict[Any, Reader] = {
    str: text,
    "time_s": number,
    "flares": detection_keys,
    "group_odds": number,
    "hypotheses": _hypotheses,
}

_OF_HYPOTHESIS: dict[Any, Reader] = {
    float: number,
    "position_body_m": vector,
    "covariance": matrix(4),
    "sources": _sources,
}
