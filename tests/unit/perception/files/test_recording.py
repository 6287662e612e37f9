import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from perception import RawFrame, RecordingError, encode_png16, frame_record, read_calibrations, read_frames
from perception.files.calibration import calibration_document
from tests.unit.perception.simulation import calibration

DATA = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5957
FRAME = RawFrame("r1.front", 4, 0.1, 1.35e-3, DATA, 64.25, line_time_s=1e-5, gain=2.0)


def record(folder: Path, **changes: Any) -> Path:
    """Write a recording of one frame, with changes to its line; None leaves a field out."""
    folder.joinpath("frames").mkdir()
    folder.joinpath("frames/4.png").write_bytes(encode_png16(DATA))
    line = {**frame_record(FRAME, "frames/4.png"), **changes}
    text = json.dumps({name: value for name, value in line.items() if value is not None})
    folder.joinpath("frames.jsonl").write_text("\n" + text + "\n")
    return folder


def test_round_trip(tmp_path: Path) -> None:
    (frame,) = read_frames(record(tmp_path))
    assert frame.data_dn.dtype == np.uint16
    assert np.array_equal(frame.data_dn, DATA)
    assert frame_record(frame, "x.png") == frame_record(FRAME, "x.png")
    assert frame.black_level_dn == 64.25


def test_frames_are_opened_one_by_one(tmp_path: Path) -> None:
    record(tmp_path)
    lines = tmp_path / "frames.jsonl"
    lines.write_text(
        lines.read_text() + json.dumps({**frame_record(FRAME, "frames/5.png"), "index": 5}) + "\n"
    )
    frames = read_frames(tmp_path)
    assert next(frames).index == 4
    with pytest.raises(RecordingError, match=r"5\.png.*Put the PNG there"):
        next(frames)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"exposure_s": None}, "'exposure_s': the field is missing"),
        ({"exposure_s": "2 ms"}, "'exposure_s': is '2 ms'. Write a finite number"),
        ({"exposure_s": 0.0}, "'exposure_s'.*above 1e-12"),
        ({"index": True}, "'index'"),
        ({"index": 1.5}, "'index'.*whole number"),
        ({"camera": 3}, "'camera'.*string"),
        ({"format": 2}, "'format'.*reads \"format\": 1"),
        ({"time_s": float("nan")}, "holds NaN"),
        ({"file": "../secret.png"}, "'file'.*within the recording"),
        ({"file": "/etc/x.png"}, "'file'.*within the recording"),
    ],
)
def test_bad_lines_name_file_line_and_field(tmp_path: Path, changes: dict[str, Any], text: str) -> None:
    with pytest.raises(RecordingError, match=f"frames.jsonl, line 2.*{text}"):
        list(read_frames(record(tmp_path, **changes)))


def test_broken_json(tmp_path: Path) -> None:
    tmp_path.joinpath("frames.jsonl").write_text('{"format": 1,\n')
    with pytest.raises(RecordingError, match="line 1: broken JSON at column"):
        list(read_frames(tmp_path))
    tmp_path.joinpath("frames.jsonl").write_text("[1]\n")
    with pytest.raises(RecordingError, match="JSON object"):
        list(read_frames(tmp_path))


def test_missing_files_are_told_at_once(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"frames.jsonl: the file is missing"):
        read_frames(tmp_path)
    with pytest.raises(RecordingError, match=r"calibration.json: the file is missing"):
        read_calibrations(tmp_path)


@pytest.mark.parametrize(
    ("picture", "text"),
    [
        (np.zeros((3, 4, 4), np.uint8), "uint8 with 4 channel"),
        (np.zeros((3, 4, 3), np.uint16), "uint16 with 3 channel"),
    ],
)
def test_pictures_that_are_no_raw_counts(tmp_path: Path, picture: Any, text: str) -> None:
    record(tmp_path)
    done, buffer = cv2.imencode(".png", picture)
    assert done
    tmp_path.joinpath("frames/4.png").write_bytes(buffer.tobytes())
    with pytest.raises(RecordingError, match=f"{text}.*16-bit grey PNG"):
        list(read_frames(tmp_path))


def test_no_png_at_all(tmp_path: Path) -> None:
    record(tmp_path)
    tmp_path.joinpath("frames/4.png").write_bytes(b"P5 3 4 255 ")
    with pytest.raises(RecordingError, match="is no PNG"):
        list(read_frames(tmp_path))


def test_only_raw_counts_are_encoded() -> None:
    with pytest.raises(ValueError, match="float64"):
        encode_png16(np.zeros((3, 4)))  # type: ignore[arg-type]


def test_calibrations_of_a_folder(tmp_path: Path) -> None:
    tmp_path.joinpath("calibration.json").write_text(json.dumps(calibration_document([calibration()])))
    assert read_calibrations(tmp_path)["r1.front"].fx_px == 480.0
