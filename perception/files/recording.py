"""Recorded frames: `frames.jsonl`, one JSON object per frame, beside raw 16-bit PNG files.

This module only encodes and parses; what writes files to disk safely lives elsewhere.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.files.calibration import parse_calibration_document
from perception.files.fields import (
    Place,
    Reader,
    check_format,
    integer,
    number,
    parse_object,
    positive,
    read_fields,
    read_text,
    text,
)
from perception.types import Calibration, RawFrame

FRAMES_FILE = "frames.jsonl"
CALIBRATION_FILE = "calibration.json"


@dataclass(frozen=True)
class FrameRecord:
    """One line of `frames.jsonl`: a frame without its pixels; `file` counts from the recording's folder."""

    camera: str
    index: int
    time_s: float
    exposure_s: float
    line_time_s: float
    gain: float
    black_level_dn: float
    file: str


def frame_record(frame: RawFrame, file: str) -> dict[str, Any]:
    """Describe a frame as the JSON object of its line in `frames.jsonl`.

    Parameters
    ----------
    frame
        The frame.
    file
        Where its PNG lies, relative to the recording's folder, with forward slashes.
    """
    taken = {field.name: getattr(frame, field.name) for field in fields(FrameRecord) if field.name != "file"}
    return {"format": 1, **taken, "file": file}


def parse_frame_record(
    record: Mapping[str, Any], file: str = FRAMES_FILE, line: int | None = None
) -> FrameRecord:
    """Read one object of `frames.jsonl`.

    Parameters
    ----------
    record
        The object.
    file, line
        Where it stands, for error texts.

    Raises
    ------
    RecordingError
        If a field is missing or of the wrong type, or the file leaves the recording's folder.
    """
    place = Place(file, line)
    check_format(record, place)
    return FrameRecord(**read_fields(FrameRecord, record, place, _READERS))


def _path_within(record: Mapping[str, Any], field: str, place: Place) -> str:
    path = text(record, field, place)
    if PurePosixPath(path).is_absolute() or ".." in PurePosixPath(path).parts or "\\" in path or ":" in path:
        raise place.error(
            f"is {path!r}", "Write a path within the recording's folder, with forward slashes", field
        )
    return path


_READERS: dict[Any, Reader] = {
    str: text,
    int: integer,
    float: number,
    "exposure_s": positive,
    "gain": positive,
    "file": _path_within,
}


def read_frame_records(folder: str | Path) -> list[FrameRecord]:
    """Read `frames.jsonl`, without the pixels; empty lines are passed over.

    Raises
    ------
    RecordingError
        If the file is missing or a line is broken.
    """
    path = Path(folder) / FRAMES_FILE
    return [
        parse_frame_record(parse_object(content, Place(str(path), line)), str(path), line)
        for line, content in enumerate(read_text(path).splitlines(), start=1)
        if content.strip()
    ]


def read_frame(folder: str | Path, record: FrameRecord) -> RawFrame:
    """Read the frame that a line of `frames.jsonl` describes.

    Raises
    ------
    RecordingError
        If its PNG is missing, damaged, or not 16-bit grey.
    """
    taken = {name: value for name, value in asdict(record).items() if name != "file"}
    return RawFrame(data_dn=_read_png16(Path(folder) / record.file), **taken)


def read_frames(folder: str | Path) -> Iterator[RawFrame]:
    """Read the frames of a recording, one by one, in the order of `frames.jsonl`.

    Parameters
    ----------
    folder
        A folder with `frames.jsonl` and the PNG files that it names.

    Returns
    -------
    Iterator of RawFrame
        A PNG is opened when its frame is asked for.

    Raises
    ------
    RecordingError
        At once if `frames.jsonl` is missing or broken; at its frame for a PNG.
    """
    records = read_frame_records(folder)
    return (read_frame(folder, record) for record in records)


def read_calibrations(folder: str | Path) -> dict[str, Calibration]:
    """Read the calibration of every camera of a recording, by the camera's name.

    Raises
    ------
    RecordingError
        If `calibration.json` is missing or broken.
    """
    path = Path(folder) / CALIBRATION_FILE
    return parse_calibration_document(parse_object(read_text(path), Place(str(path))), str(path))


def encode_png16(data_dn: NDArray[np.uint16]) -> bytes:
    """Encode counts as a 16-bit grey PNG, as they are: no scaling, no gamma.

    Raises
    ------
    ValueError
        If the counts are not uint16 of shape (rows, columns).
    """
    import cv2

    if data_dn.dtype != np.uint16 or data_dn.ndim != 2 or data_dn.size == 0:
        raise ValueError(
            f"raw counts are uint16 of shape (rows, columns), not {data_dn.dtype} of shape {data_dn.shape}"
        )
    done, buffer = cv2.imencode(".png", data_dn)
    if not done:
        raise RuntimeError("OpenCV could not encode the frame as PNG")
    return buffer.tobytes()


def _read_png16(path: Path) -> NDArray[np.uint16]:
    import cv2

    place = Place(str(path))
    mend = "Record raw counts as 16-bit grey PNG"
    try:
        content = path.read_bytes()
    except OSError as error:
        raise place.error(
            f"the picture cannot be read ({error.strerror})",
            f"Put the PNG there, or remove it from {FRAMES_FILE}",
        ) from error
    # OpenCV writes to standard error about what it cannot decode; the signature is told here instead.
    if not content.startswith(b"\x89PNG\r\n\x1a\n"):
        raise place.error("is no PNG", mend)
    image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise place.error("is a damaged PNG", mend)
    if image.dtype != np.uint16 or image.ndim != 2:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise place.error(f"holds {image.dtype} with {channels} channel(s), not 16-bit grey", mend)
    return np.asarray(image, dtype=np.uint16)
