import dataclasses
import json
import math

import pytest

from perception import Detection, RecordingError, detection_record, parse_detection

HIT = Detection(
    camera="r1.front",
    index=3,
    time_s=0.1,
    u_px=100.25,
    v_px=1 / 3,
    u_sigma_px=0.01,
    v_sigma_px=math.nan,
    flux_dn=1e4,
    mean_dn=300.0,
    background_dn=64.5,
    area_px=21,
    saturated=True,
    merged=False,
    ghost=False,
    range_m=2.5,
    range_sigma_m=math.nan,
    bearing_body=(1.0, 0.0, 0.0),
)


def test_round_trip_through_text() -> None:
    record = json.loads(json.dumps(detection_record(HIT), allow_nan=False))
    assert record["format"] == 1
    assert record["range_sigma_m"] is None
    assert set(record) == {"format"} | {field.name for field in dataclasses.fields(Detection)}
    back = parse_detection(record)
    assert repr(back) == repr(HIT)


def test_errors_name_line_and_field() -> None:
    record = detection_record(HIT)
    with pytest.raises(
        RecordingError, match=r"d.jsonl, line 7, field 'saturated': is 1. Write true or false"
    ):
        parse_detection({**record, "saturated": 1}, "d.jsonl", 7)
    with pytest.raises(RecordingError, match="'bearing_body'"):
        parse_detection({**record, "bearing_body": [1.0, 0.0]})
    with pytest.raises(RecordingError, match=r"'bearing_body\[1\]'"):
        parse_detection({**record, "bearing_body": [1.0, "x", 0.0]})
    with pytest.raises(ValueError, match="infinite"):
        detection_record(dataclasses.replace(HIT, range_m=math.inf))
