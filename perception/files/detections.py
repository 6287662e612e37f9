"""Detections as lines of `detections.NAME.jsonl`: the fields of `Detection`; NaN stands as null.

And why their ranges are no surer, as lines of `causes.NAME.jsonl`.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from perception.causes import CAUSES, DetectionCauses
from perception.files.entries import MOST_INDEX, MOST_PX, MOST_TIME_S, Entry, read_record
from perception.files.fields import Place
from perception.types import Detection

_NO_CLAIM = "no claim"
_MOST_DN = 1e15
_MOST_M = 1e9

DETECTION_ENTRIES = (
    Entry("camera", "text", "the camera, as in `frames.jsonl`"),
    Entry("index", "whole", "the frame, as there", 0, MOST_INDEX),
    Entry("time_s", "number", "start of the frame's exposure", -MOST_TIME_S, MOST_TIME_S),
    Entry("u_px", "number", "place, to the right", -MOST_PX, MOST_PX),
    Entry("v_px", "number", "place, downwards", -MOST_PX, MOST_PX),
    Entry("u_sigma_px", "number", "its standard deviation", 0.0, MOST_PX, null=_NO_CLAIM),
    Entry("v_sigma_px", "number", "its standard deviation", 0.0, MOST_PX, null=_NO_CLAIM),
    Entry("flux_dn", "number", "integral above the background", -_MOST_DN, _MOST_DN, null=_NO_CLAIM),
    Entry("mean_dn", "number", "mean grey value, black level included", -_MOST_DN, _MOST_DN, null=_NO_CLAIM),
    Entry("background_dn", "number", "background there, as read", -_MOST_DN, _MOST_DN, null=_NO_CLAIM),
    Entry("area_px", "whole", "pixels that it covers", 0, 2**53),
    Entry("saturated", "flag", "whether pixels of it clipped"),
    Entry("merged", "flag", "whether it does not look like one source"),
    Entry("ghost", "flag", "whether it is taken for a mirror image"),
    Entry(
        "range_m", "number", "distance from the camera's centre", 0.0, _MOST_M, above=True, null=_NO_CLAIM
    ),
    Entry("range_sigma_m", "number", "its standard deviation", 0.0, _MOST_M, null=_NO_CLAIM),
    Entry("bearing_body", "bearing", "unit vector from the camera's centre in body axes", -1e6, 1e6, size=3),
    Entry(
        "flux_sigma_dn", "number", "the flux's standard deviation", 0.0, _MOST_DN, null=_NO_CLAIM,
        default=math.nan,
    ),
    Entry(
        "range_sigma_common_m", "number", "the part of `range_sigma_m` that a source's measurements share",
        0.0, _MOST_M, null=_NO_CLAIM, default=math.nan,
    ),
    Entry(
        "range_by_size_m", "number", "what size alone says of the range, where fog is not excluded",
        0.0, _MOST_M, null=_NO_CLAIM, default=math.nan,
    ),
    Entry(
        "range_by_size_sigma_m", "number", "its standard deviation", 0.0, _MOST_M, null=_NO_CLAIM,
        default=math.nan,
    ),
)  # fmt: skip
"""The fields of a line of `detections.NAME.jsonl`; null says that no claim is made."""


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


def parse_detection(record: Mapping[str, Any], file: str = "", line: int | None = None) -> Detection:
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
        All that is missing, of the wrong type or out of bounds.
    """
    values = read_record(record, DETECTION_ENTRIES, Place(file, line))
    return Detection(**values)


def _null_for_nan(name: str, value: float) -> float | None:
    if math.isinf(value):
        raise ValueError(f"{name} of a detection is infinite, which JSON cannot hold; use NaN")
    return None if math.isnan(value) else value


CAUSES_ENTRIES = (
    Entry("camera", "text", "the camera, as in `frames.jsonl`"),
    Entry("index", "whole", "the frame, as there", 0, MOST_INDEX),
    Entry("detection", "whole", "number of the detection among its frame's, from 0", 0, MOST_INDEX),
    Entry("range_m", "number", "as detected", 0.0, _MOST_M, above=True),
    Entry("range_sigma_m", "number", "as detected", 0.0, _MOST_M),
    *(Entry(name, "number", "its part", 0.0, _MOST_M) for name in (*CAUSES, "response_m")),
)
"""The fields of a line of `causes.NAME.jsonl`: what the σ of a detection's range is made of."""


def parse_causes(record: Mapping[str, Any], file: str = "", line: int | None = None) -> DetectionCauses:
    """Read one object of `causes.NAME.jsonl`.

    Raises
    ------
    RecordingError
        All that is missing, of the wrong type or out of bounds.
    """
    values = read_record(record, CAUSES_ENTRIES, Place(file, line))
    causes_m = {name: values.pop(name) for name in CAUSES}
    return DetectionCauses(causes_m=causes_m, **values)
