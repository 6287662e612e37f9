"""Robots with several sources, as a rig's set shows them: lines of `robots.NAME.jsonl`.

The fields of `RobotPose`; each of its hypotheses is an object with the fields of `PoseHypothesis`.
"""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from perception.files.fields import Place, check_format, get, shown
from perception.files.readers import Reader, detection_keys, matrix, number, plain, read_fields, text, vector
from perception.types import PoseHypothesis, RobotPose


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
