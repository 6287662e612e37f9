"""Recorded frames: `frames.jsonl`, one JSON object per frame, beside pictures of raw counts.

A recording is read as a whole: what is wrong in its files, or between them, is said at once. This module only
encodes and parses; what writes files to disk safely lives elsewhere.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path, PurePosixPath
from typing import Any, Self

from perception.files.calibration import parse_calibration_document
from perception.files.entries import MOST_INDEX, MOST_TIME_S, Entry, read_record
from perception.files.fields import Faults, Place, RecordingError, parse_object, read_text, shown
from perception.files.offsets import read_offsets
from perception.files.pictures import Picture, read_picture
from perception.model.sensor import saturation_dn, without_offsets
from perception.types import Calibration, FrameKey, RawFrame

FRAMES_FILE = "frames.jsonl"
CALIBRATION_FILE = "calibration.json"
SCENE_KIND = "scene"
FRAME_KINDS = (SCENE_KIND, "dark", "flat", "rail", "shared")

FRAME_ENTRIES = (
    Entry("camera", "text", "name of the camera, `robot.camera`; calibration.json has the same"),
    Entry("index", "whole", "number of the frame, once per camera", 0, MOST_INDEX),
    Entry(
        "time_s", "number", "start of the exposure of row 0; within a camera it never goes back",
        -MOST_TIME_S, MOST_TIME_S,
    ),
    Entry("exposure_s", "number", "exposure time", 1e-12, 1e4, above=True),
    Entry("line_time_s", "number", "delay from row to row; 0 of a global shutter", 0.0, 10.0),
    Entry("gain", "number", "factor on the calibrated system gain; 1 as calibrated", 1e-6, 1e6, above=True),
    Entry("black_level_dn", "number", "mean count of a dark pixel in this frame", -65535.0, 65535.0),
    Entry("file", "text", "the picture, from the recording's folder, with forward slashes; once"),
    Entry(
        "kind", "choice",
        "what it shows: a scene, nothing (cap on), an even surface, one source at a known range, sources "
        "that two cameras share; `perceive` passes over `dark` and `flat`",
        choices=FRAME_KINDS, default=SCENE_KIND,
    ),
)  # fmt: skip
"""The fields of a line of `frames.jsonl`."""


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
    kind: str = SCENE_KIND

    @property
    def shows_sources(self) -> bool:
        """Whether there may be sources in it: it was not taken of darkness or of an even surface."""
        return self.kind not in ("dark", "flat")


def frame_record(frame: RawFrame, file: str, kind: str = SCENE_KIND) -> dict[str, Any]:
    """Describe a frame as the JSON object of its line in `frames.jsonl`.

    Parameters
    ----------
    frame
        The frame.
    file
        Where its PNG lies, relative to the recording's folder, with forward slashes.
    kind
        What it was taken of, one of `FRAME_KINDS`.
    """
    taken = {name: getattr(frame, name) for name in _TAKEN}
    return {"format": 1, **taken, "file": file, **({} if kind == SCENE_KIND else {"kind": kind})}


_TAKEN = tuple(field.name for field in fields(FrameRecord) if field.name not in ("file", "kind"))


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
        All fields that are missing, of the wrong type or out of bounds; a file that leaves the folder.
    """
    place = Place(file, line)
    faults = Faults()
    values: dict[str, Any] = {}
    with faults.kept():
        values = read_record(record, FRAME_ENTRIES, place)
    if isinstance(path := record.get("file"), str) and _leaves(path):
        problem = place.error(
            f"is {shown(path)}", "Write a path within the recording's folder, with forward slashes", "file"
        )
        faults.problems += problem.problems
    faults.raise_any()
    return FrameRecord(**values)


def _leaves(path: str) -> bool:
    """Tell whether a path may lead out of the recording's folder, here or on another system."""
    pure = PurePosixPath(path)
    return pure.is_absolute() or ".." in pure.parts or "\\" in path or ":" in path


def read_frame_records(folder: str | Path) -> list[FrameRecord]:
    """Read `frames.jsonl`, without the pixels; empty lines are passed over.

    Raises
    ------
    RecordingError
        If the file is missing; else all lines that are broken, name a frame or a file that another one
        names, or go back in time.
    """
    faults = Faults()
    records = _right_records(Path(folder) / FRAMES_FILE, faults)
    faults.raise_any()
    return records


def _right_records(path: Path, faults: Faults) -> list[FrameRecord]:
    """Return the lines of `frames.jsonl` that are right by themselves."""
    records: dict[int, FrameRecord] = {}
    for line, content in enumerate(read_text(path).split("\n"), start=1):
        if content.strip():
            with faults.kept():
                record = parse_object(content, Place(str(path), line))
                records[line] = parse_frame_record(record, str(path), line)
    for problem in _clashes(records, str(path)):
        faults.problems += problem.problems
    return list(records.values())


def _clashes(records: Mapping[int, FrameRecord], file: str) -> Iterator[RecordingError]:
    """Yield what is wrong between the lines."""
    key_at: dict[FrameKey, int] = {}
    file_at: dict[str, int] = {}
    last: dict[str, tuple[int, float]] = {}
    for line, record in records.items():
        place, key = Place(file, line), (record.camera, record.index)
        if key in key_at:
            yield place.error(
                f"frame {record.index} of {record.camera} stands in line {key_at[key]} already",
                "Give each frame of a camera an index of its own", "index",
            )  # fmt: skip
        if (name := str(PurePosixPath(record.file))) in file_at:
            yield place.error(
                f"{shown(record.file)} stands in line {file_at[name]} already",
                "Name each picture once",
                "file",
            )
        before, time_s = last.get(record.camera, (line, record.time_s))
        if record.time_s < time_s:
            yield place.error(
                f"is {record.time_s!r}, before the {time_s!r} of line {before}",
                f"Sort the frames of {record.camera} by time, in seconds of one clock", "time_s",
            )  # fmt: skip
        key_at.setdefault(key, line)
        file_at.setdefault(name, line)
        last[record.camera] = line, record.time_s


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording whose files are right and fit together: its frames without pixels, its calibrations."""

    folder: Path
    records: tuple[FrameRecord, ...]
    calibrations: Mapping[str, Calibration]

    @property
    def of_sources(self) -> Self:
        """The recording without its dark and flat frames, which serve calibration alone."""
        return replace(self, records=tuple(record for record in self.records if record.shows_sources))

    def calibrated_by(self, path: Path) -> Self:
        """Return the recording with the calibrations of another file in place of its own.

        Frames have a black level of their own; it is moved by what the calibrations differ in.

        Raises
        ------
        RecordingError
            If the file is missing or broken, knows no such camera, or does not fit the frames.
        """
        calibrations, records = read_calibration_file(path), []
        for record in self.records:
            if record.camera in calibrations:
                old, new = self.calibrations[record.camera], calibrations[record.camera]
                moved_dn = new.black_level_dn - old.black_level_dn
                record = replace(record, black_level_dn=record.black_level_dn + moved_dn)
            records.append(record)
        faults = Faults()
        for problem in _contradictions(self.folder, records, path, calibrations):
            faults.problems += problem.problems
        faults.raise_any()
        return replace(self, records=tuple(records), calibrations=calibrations)

    def frames(self) -> Iterator[RawFrame]:
        """Read the frames one by one, in the order of `frames.jsonl`.

        Raises
        ------
        RecordingError
            At its frame, if a picture is damaged, or is none that its calibration describes.
        """
        return (self.frame(record) for record in self.records)

    def frame(self, record: FrameRecord) -> RawFrame:
        """Read one frame, known offsets of pixels taken off; errors as `frames`."""
        path, calibration = self.folder / record.file, self.calibrations[record.camera]
        picture = read_picture(path)
        check_picture(picture, calibration, record.gain, Place(str(path)))
        return without_offsets(_raw_frame(record, picture), calibration)


def read_recording(folder: str | Path) -> Recording:
    """Read what a recording's folder holds, but for the pixels.

    Raises
    ------
    RecordingError
        All that is wrong in `frames.jsonl` and `calibration.json` and between them: cameras without
        calibration, pictures that are not there, black levels beyond saturation.
    """
    folder, faults = Path(folder), Faults()
    records: list[FrameRecord] = []
    calibrations: dict[str, Calibration] | None = None
    with faults.kept():
        calibrations = read_calibrations(folder)
    with faults.kept():
        told = len(faults.problems)
        records = _right_records(folder / FRAMES_FILE, faults)
        if not records and len(faults.problems) == told:
            raise Place(str(folder / FRAMES_FILE)).error("names no frame", "Write one line per frame")
    for problem in _contradictions(folder, records, folder / CALIBRATION_FILE, calibrations):
        faults.problems += problem.problems
    faults.raise_any()
    return Recording(folder, tuple(records), calibrations or {})


def _contradictions(
    folder: Path, records: list[FrameRecord], path: Path, calibrations: Mapping[str, Calibration] | None
) -> Iterator[RecordingError]:
    """Yield what is wrong between frames, calibrations and pictures."""
    file = Place(str(folder / FRAMES_FILE))
    for camera in dict.fromkeys(record.camera for record in records):
        if calibrations is not None and camera not in calibrations:
            yield Place(str(path)).error(
                f"knows no camera {camera!r}, which {FRAMES_FILE} names; known: "
                f"{', '.join(calibrations) or 'none'}",
                "Name the camera so, or calibrate it",
            )
    for record in records:
        known = (calibrations or {}).get(record.camera)
        if known is not None and record.black_level_dn >= saturation_dn(known, record.gain):
            yield file.error(
                f"frame {record.index} of {record.camera} has black_level_dn = {record.black_level_dn:g}, "
                f"not below its saturation at {saturation_dn(known, record.gain)} DN",
                "Write the mean count of a frame taken in the dark",
            )
    missing = [record.file for record in records if not (folder / record.file).is_file()]
    if missing:
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        yield file.error(
            f"names {', '.join(map(shown, missing[:3]))}{more}, which "
            f"{'is' if len(missing) == 1 else 'are'} not there",
            f"Put the PNG there, or remove it from {FRAMES_FILE}",
        )


def check_picture(picture: Picture, calibration: Calibration, gain: float, place: Place) -> None:
    """Refuse a picture that its calibration does not describe.

    Raises
    ------
    RecordingError
        If its size is another, it holds fewer bits than the calibration says or counts beyond full scale, or
        its compression costs more than the noise that the calibration has.
    """
    faults = Faults()
    rows, columns = picture.data_dn.shape
    if (rows, columns) != (calibration.height_px, calibration.width_px):
        with faults.kept():
            raise place.error(
                f"has {columns} × {rows} pixels, its calibration says "
                f"{calibration.width_px} × {calibration.height_px}",
                "Take the calibration of this camera as it recorded: binned or cropped it is another",
            )
    full_scale_dn = 2**calibration.bit_depth - 1
    if picture.bits < calibration.bit_depth:
        with faults.kept():
            raise place.error(
                f"holds {picture.bits}-bit counts, its calibration says bit_depth = {calibration.bit_depth}",
                f"Write bit_depth {picture.bits} and gain, black level and saturation in these counts",
            )
    elif (most_dn := int(picture.data_dn.max(initial=0))) > full_scale_dn:
        with faults.kept():
            raise place.error(
                f"holds the count {most_dn}, beyond full scale, {full_scale_dn} DN at "
                f"{calibration.bit_depth} bits",
                "Write the bit depth of the counts as stored; some programs shift them up to 16 bits",
            )
    noise_dn = calibration.read_noise_e * calibration.system_gain_dn_per_e * gain
    if picture.lossy_sigma_dn > 1.001 * noise_dn:
        needed_e = picture.lossy_sigma_dn / (calibration.system_gain_dn_per_e * gain)
        with faults.kept():
            raise place.error(
                f"is a JPEG whose compression alone has a σ of {picture.lossy_sigma_dn:.3g} DN in a pixel, "
                f"and the calibrated read noise is {noise_dn:.3g} DN",
                f"Add it in quadrature: read_noise_e is {needed_e:.3g} or more; or record PNG or TIFF",
            )
    faults.raise_any()


def read_frame(folder: str | Path, record: FrameRecord) -> RawFrame:
    """Read the frame that a line of `frames.jsonl` describes.

    Raises
    ------
    RecordingError
        If its picture is missing, damaged, or not grey counts of 8 to 16 bits.
    """
    return _raw_frame(record, read_picture(Path(folder) / record.file))


def _raw_frame(record: FrameRecord, picture: Picture) -> RawFrame:
    values = asdict(record)
    return RawFrame(data_dn=picture.data_dn, **{name: values[name] for name in _TAKEN})


def read_frames(folder: str | Path) -> Iterator[RawFrame]:
    """Read the frames of a recording, one by one, in the order of `frames.jsonl`.

    Parameters
    ----------
    folder
        A folder with `frames.jsonl` and the pictures that it names.

    Returns
    -------
    Iterator of RawFrame
        A picture is opened when its frame is asked for.

    Raises
    ------
    RecordingError
        At once if `frames.jsonl` is missing or broken; at its frame for a picture.
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
    return read_calibration_file(Path(folder) / CALIBRATION_FILE)


def read_calibration_file(path: Path) -> dict[str, Calibration]:
    """Read a file of calibrations, whatever its name, and the offsets beside it.

    Raises
    ------
    RecordingError
        If the file, or one that it names, is missing or broken.
    """
    found = parse_calibration_document(parse_object(read_text(path), Place(str(path))), str(path))
    for name, known in found.items():
        if known.offset_file:
            offsets = read_offsets(path.parent / known.offset_file, (known.height_px, known.width_px))
            found[name] = replace(known, offset_dn=offsets)
    return found
