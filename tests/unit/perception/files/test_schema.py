"""The schemas take what the readers take, and the page has the tables that they read by."""

import json
import math
from typing import Any

import numpy as np
import pytest
from jsonschema import Draft202012Validator

from perception import Detection, RecordingError, calibration_document, detection_record, parse_detection
from perception import parse_calibration_document as parse_calibrations
from perception.files.calibration import CALIBRATION_ENTRIES
from perception.files.detections import DETECTION_ENTRIES
from perception.files.recording import FRAME_ENTRIES, FrameRecord, parse_frame_record
from perception.files.schema import calibration_schema, detections_schema, entry_table, frames_schema
from perception.types import Calibration
from tests.paths import ROOT
from tests.unit.perception.simulation import calibration

FRAME = {
    "format": 1, "camera": "r1.front", "index": 0, "time_s": 0.0, "exposure_s": 1e-3, "line_time_s": 0.0, "gain": 1.0,
    "black_level_dn": 64.0, "file": "0.png",
}  # fmt: skip
HIT = Detection(
    "r1.front", 3, 0.1, 100.25, 0.5, 0.01, math.nan, 1e4, 300.0, 64.5, 21, True, False, False, 2.5, math.nan, (1.0, 0.0, 0.0)
)  # fmt: skip
TABLES = {"frames": FRAME_ENTRIES, "calibration": CALIBRATION_ENTRIES, "detections": DETECTION_ENTRIES}


@pytest.mark.parametrize("name", TABLES)
def test_the_page_has_every_field_as_it_is_read(name: str) -> None:
    """Where this fails, put the table that is wanted between the marks of docs/recordings.md."""
    page = (ROOT / "docs" / "recordings.md").read_text(encoding="utf-8")
    shown = page.partition(f"<!-- {name} -->\n")[2].partition("<!-- end -->")[0]
    assert shown == entry_table(TABLES[name])


def test_the_tables_have_every_field() -> None:
    names = {name: [entry.name for entry in entries] for name, entries in TABLES.items()}
    assert names["frames"] == list(FrameRecord.__dataclass_fields__)
    assert names["detections"] == list(Detection.__dataclass_fields__)
    known = set(Calibration.__dataclass_fields__) - {"camera", "sigma", "rotation_body_camera", "offset_dn"}
    assert set(names["calibration"]) == known | {"quaternion_body_camera_xyzw"}
    assert all(entry.meaning for entries in TABLES.values() for entry in entries)


def _calibration(**changes: Any) -> dict[str, Any]:
    known = calibration(sigma={"fx_px": 0.1, "position_body_m": 1e-3}, distortion=(), psf_sigma_px=0.7)
    document = json.loads(json.dumps(calibration_document([known])))
    for name, value in changes.items():
        document["cameras"]["r1.front"][name] = value
    return dict(document)


@pytest.mark.parametrize(
    ("changes", "right"),
    [
        ({}, True),
        ({"dsnu_e": {"value": 4.0, "sigma": 0.1}}, True),
        ({"range_constant_paper_dn_m2_per_s": None}, True),
        ({"lens_model": "fisheye", "distortion": [0.1, 0.0, 0.0, 0.0]}, True),
        ({"fx_px": 0.0}, False),
        ({"bit_depth": 17}, False),
        ({"cx_px": 1e30}, False),
        ({"read_noise_e": {"value": 4.0}}, False),
        ({"lens_model": "pinhole"}, False),
        ({"position_body_m": [0.0, 1.0]}, False),
        ({"wavelength_m": None}, False),
        ({"width_px": "64"}, False),
    ],
)
def test_schema_and_reader_agree_on_calibrations(changes: dict[str, Any], right: bool) -> None:
    document = _calibration(**changes)
    assert Draft202012Validator(calibration_schema()).is_valid(document) == right
    if right:
        assert list(parse_calibrations(document)) == ["r1.front"]
    else:
        with pytest.raises(RecordingError, match=next(iter(changes))):
            parse_calibrations(document)


@pytest.mark.parametrize(
    ("changes", "right"),
    [
        ({}, True),
        ({"exposure_s": 0}, False),
        ({"index": -1}, False),
        ({"index": 2**63}, False),
        ({"camera": ""}, False),
    ],
)
def test_schema_and_reader_agree_on_frames(changes: dict[str, Any], right: bool) -> None:
    record = {**FRAME, **changes}
    assert Draft202012Validator(frames_schema()).is_valid(record) == right
    if right:
        assert parse_frame_record(record).file == "0.png"
    else:
        with pytest.raises(RecordingError, match=next(iter(changes))):
            parse_frame_record(record)


@pytest.mark.parametrize(
    ("changes", "right"),
    [({}, True), ({"flux_dn": None}, True), ({"bearing_body": [None] * 3}, True), ({"u_px": None}, False), ({"ghost": 0}, False)],
)  # fmt: skip
def test_schema_and_reader_agree_on_detections(changes: dict[str, Any], right: bool) -> None:
    record = json.loads(json.dumps({**detection_record(HIT), **changes}))
    assert Draft202012Validator(detections_schema()).is_valid(record) == right
    if right:
        assert np.isnan(parse_detection(record).v_sigma_px)
    else:
        with pytest.raises(RecordingError, match=next(iter(changes))):
            parse_detection(record)
