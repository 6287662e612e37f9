"""What time adds, as lines of files: `odometry.jsonl`, and `tracks`, `signals` and `messages` `.NAME.jsonl`.

The fields of `Odometry`, `Track`, `Signal` and `Message`. A rotation is a quaternion (x, y, z, w); what is
not known of a signal, its σ infinite, stands as null.
"""

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.files.fields import Place, check_format, get, parse_object, read_text
from perception.files.readers import (
    Reader,
    detection_keys,
    integer,
    matrix,
    number,
    numbers,
    one_of,
    plain,
    read_fields,
    text,
    vector,
)
from perception.types import Message, Odometry, Signal, Track

ODOMETRY = "odometry.jsonl"

_GHOST = ("no", "possible", "yes")
_UNIT_SLACK = 1e-3
_ODOMETRY_SIGMAS = (
    "position_sigma_m", "rotation_sigma_rad", "position_walk_m_per_sqrt_s", "rotation_walk_rad_per_sqrt_s",
)  # fmt: skip


def odometry_record(odometry: Odometry) -> dict[str, Any]:
    """Make the JSON object of one line of `odometry.jsonl`."""
    from scipy.spatial.transform import Rotation  # loads slowly

    return {
        "format": 1,
        "robot": odometry.robot,
        "time_s": odometry.time_s,
        "position_m": np.asarray(odometry.position_m).tolist(),
        "quaternion_xyzw": Rotation.from_matrix(odometry.rotation).as_quat(canonical=True).tolist(),
        **{name: getattr(odometry, name) for name in _ODOMETRY_SIGMAS},
    }


def parse_odometry(record: Mapping[str, Any], file: str = "", line: int | None = None) -> Odometry:
    """Read one line of `odometry.jsonl`; a σ that is missing is 0.

    Raises
    ------
    RecordingError
        If a field is missing or of the wrong type.
    """
    from scipy.spatial.transform import Rotation

    place = Place(file, line)
    check_format(record, place)
    quaternion = numbers(record, "quaternion_xyzw", place, 4)
    if abs(math.hypot(*quaternion) - 1.0) > _UNIT_SLACK:
        raise place.error("is no rotation", "Write a quaternion of length 1", "quaternion_xyzw")
    sigmas = {name: number(record, name, place) for name in _ODOMETRY_SIGMAS if name in record}
    for name, sigma in sigmas.items():
        if sigma < 0.0:
            raise place.error(f"is {sigma:g}", "Write a standard deviation of 0 or more", name)
    return Odometry(
        robot=text(record, "robot", place),
        time_s=number(record, "time_s", place),
        position_m=np.array(numbers(record, "position_m", place, 3)),
        rotation=Rotation.from_quat(quaternion).as_matrix(),
        **sigmas,
    )


def read_odometry(folder: str | Path) -> dict[str, tuple[Odometry, ...]]:
    """Read `odometry.jsonl` of a recording, by robot; empty where there is none: robots stand still.

    Raises
    ------
    RecordingError
        If a line is broken, or the times of a robot do not increase.
    """
    path = Path(folder) / ODOMETRY
    if not path.is_file():
        return {}
    by_robot: dict[str, list[Odometry]] = defaultdict(list)
    for line, words in enumerate(read_text(path).splitlines(), start=1):
        if not words.strip():
            continue
        one = parse_odometry(parse_object(words, Place(str(path), line)), str(path), line)
        before = by_robot[one.robot]
        if before and not one.time_s > before[-1].time_s:
            raise Place(str(path), line).error(
                f"is {one.time_s:g} s, not after {before[-1].time_s:g} s, the line of {one.robot} before it",
                "Put the lines in the order of time",
                "time_s",
            )
        before.append(one)
    return {robot: tuple(lines) for robot, lines in by_robot.items()}


def track_record(track: Track) -> dict[str, Any]:
    """Make the JSON object of a track at one time, a line of `tracks.NAME.jsonl`."""
    return {name: plain(name, value) for name, value in {"format": 1, **asdict(track)}.items()}


def parse_track(record: Mapping[str, Any], file: str = "", line: int | None = None) -> Track:
    """Read one line of `tracks.NAME.jsonl`.

    Raises
    ------
    RecordingError
        If a field is missing or of the wrong type.
    """
    place = Place(file, line)
    check_format(record, place)
    return Track(**read_fields(Track, record, place, _OF_TRACK))


def message_record(message: Message) -> dict[str, Any]:
    """Make the JSON object of a message, a line of `messages.NAME.jsonl`."""
    return {"format": 1, **asdict(message)}


def parse_message(record: Mapping[str, Any], file: str = "", line: int | None = None) -> Message:
    """Read one line of `messages.NAME.jsonl`.

    Raises
    ------
    RecordingError
        If a field is missing, of the wrong type or out of bounds.
    """
    place = Place(file, line)
    check_format(record, place)
    message = Message(**read_fields(Message, record, place, _OF_MESSAGE))
    if not 0 <= message.word < 128:
        raise place.error(f"is {message.word}", "Write a word from 0 to 127", "word")
    if not 0.0 <= message.confidence <= 1.0:
        raise place.error("is no probability", "Write a number from 0 to 1", "confidence")
    return message


def signal_record(signal: Signal) -> dict[str, Any]:
    """Make the JSON object of the signal of a track, a line of `signals.NAME.jsonl`."""
    columns = {
        name: [value if math.isfinite(value) else None for value in getattr(signal, name).tolist()]
        for name in _COLUMNS
    }
    return {"format": 1, "robot": signal.robot, "track": signal.track, **columns}


def parse_signal(record: Mapping[str, Any], file: str = "", line: int | None = None) -> Signal:
    """Read one line of `signals.NAME.jsonl`.

    Raises
    ------
    RecordingError
        If a field is missing or of the wrong type, or the lists differ in length.
    """
    place = Place(file, line)
    check_format(record, place)
    columns = {name: _column(record, name, place) for name in _COLUMNS}
    for name, column in columns.items():
        if len(column) != len(columns["time_s"]):
            raise place.error("is of another length than time_s", "Write one number per sample", name)
    return Signal(text(record, "robot", place), integer(record, "track", place), **columns)


_COLUMNS = ("time_s", "exposure_s", "level", "sigma_dark", "sigma_lit")


def _column(record: Mapping[str, Any], field: str, place: Place) -> NDArray[np.float64]:
    if field in ("time_s", "exposure_s"):
        return np.array(numbers(record, field, place), dtype=np.float64)
    values = get(record, field, place)
    if not isinstance(values, list):
        raise place.error("is no list", "Write a list of numbers and nulls", field)
    known = numbers({field: [0.0 if value is None else value for value in values]}, field, place)
    unknown = math.nan if field == "level" else math.inf
    return np.array([unknown if value is None else one for value, one in zip(values, known, strict=True)])


def _array(record: Mapping[str, Any], field: str, place: Place) -> NDArray[np.float64]:
    return np.array(vector(record, field, place))


def _text_or_none(record: Mapping[str, Any], field: str, place: Place) -> str | None:
    return None if get(record, field, place) is None else text(record, field, place)


def _integer_or_none(record: Mapping[str, Any], field: str, place: Place) -> int | None:
    return None if get(record, field, place) is None else integer(record, field, place)


_OF_TRACK: dict[Any, Reader] = {
    str: text,
    int: integer,
    float: number,
    "position_body_m": _array,
    "velocity_body_m_per_s": _array,
    "covariance": matrix(6),
    "detections": detection_keys,
    "identity": _text_or_none,
    "ghost": one_of(_GHOST),
}

_OF_MESSAGE: dict[Any, Reader] = {
    str: text,
    int: integer,
    float: number,
    "identity": _text_or_none,
    "ambiguous_with": _integer_or_none,
}
