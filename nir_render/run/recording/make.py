"""The stages `new-recording` and `import`: a template, and what becomes of it once it is filled in."""

import itertools
import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from nir_render.errors import InputError, shown
from nir_render.run import folder as run_folder
from nir_render.run.recording.bag import Topic, unpacked
from nir_render.run.recording.calibration import Assumed, camera_calibration
from nir_render.run.recording.document import CameraGiven, KnownRange, RecordingDocument
from nir_render.run.recording.pictures import KINDS, Pictures, find_pictures, read_pictures
from nir_render.run.recording.range_constant import (
    Constant,
    KnownFlare,
    contradictions,
    from_data_sheets,
    from_known_ranges,
)
from nir_render.scene.documents.files import find_file
from nir_render.scene.problems import Places, explain
from nir_render.scene.text.yaml_text import read_yaml
from perception import (
    FrameRecord,
    RecordingError,
    calibration_document,
    read_frame,
    read_picture,
    read_recording,
)
from perception.model.bearing import direction_camera
from perception.types import Calibration

FILE = "recording.yaml"
_TEMPLATE = Path(__file__).parent / "template.yaml"

_WHOLE_BITS, _LESS_BITS = 16, 14
_MISSING, _EMPTY = "this key is missing", "stands empty; fill it in"

_NO_BRIGHTNESS = "nothing tells how bright a source looks; give intensity, power, or a frame of known_ranges"

_Problem = tuple[tuple[str, ...], str]
"""The place of a problem in the document, and what is wrong there."""


@dataclass(frozen=True)
class Imported:
    """What an import made of one camera."""

    calibration: Calibration
    frames: int
    constant: Constant
    assumed: tuple[Assumed, ...]
    lossy_sigma_dn: float
    warnings: tuple[str, ...]

    @property
    def field_of_view_rad(self) -> tuple[float, float]:
        """How much the camera sees across and down, through its principal point or what is nearest to it."""
        known = self.calibration
        u_px = min(max(known.cx_px, 0.0), known.width_px - 1.0)
        v_px = min(max(known.cy_px, 0.0), known.height_px - 1.0)
        ends = [(-0.5, v_px), (known.width_px - 0.5, v_px), (u_px, -0.5), (u_px, known.height_px - 0.5)]
        x, y, z = direction_camera(ends, known).T
        across_rad, down_rad = np.arctan2(x, z), np.arctan2(y, z)
        return float(across_rad[1] - across_rad[0]), float(down_rad[3] - down_rad[2])


def new_recording(folder: Path, bag: Path | None = None) -> list[str]:
    """Write the template into a folder, which may hold pictures already; returns the patterns of their names.

    With a `bag` its pictures are written into the folder first, with the time of each.

    Raises
    ------
    InputError
        The folder holds a `recording.yaml` already, or cannot be written; a bag that is none, or without
        pictures of grey.
    """
    if folder.is_file():
        raise InputError(f"{folder}: is a file; give the folder that holds the pictures, or a new one")
    path = folder / FILE
    if path.exists():
        raise InputError(f"{path}: is there already; fill it in, or take it away for a new one")
    if bag is not None:
        topics = unpacked(bag, folder)
        _write_template(folder, topics[0].pattern, topics)
        return [topic.pattern for topic in topics]
    pattern = "frames/*.png"
    pictures = (
        [one for one in sorted(folder.rglob("*")) if one.suffix.lower() in KINDS] if folder.is_dir() else []
    )
    if pictures:
        first = pictures[0].relative_to(folder)
        pattern = (first.parent / f"*{first.suffix}").as_posix()
    _write_template(folder, pattern, ())
    return [pattern]


def _write_template(folder: Path, pattern: str, topics: Sequence[Topic]) -> None:
    """Write the template for pictures of a pattern, and for further cameras of a bag."""
    when, about = "frame_rate:", 'such as "30 Hz"; or "times: FILE", the time of each in s, one a line'
    if topics:
        when, about = f"times: {topics[0].times}", "of each frame, in s; or write a frame_rate"
    more = "".join(
        f'\n  {one.camera}:\n    frames: "{one.pattern}"\n    times: {one.times}\n'
        + "".join(f"    {key}:\n" for key in ("exposure", "focal_length", "pixel_pitch", "bit_depth"))
        for one in topics[1:]
    )
    found = sorted(folder.glob(pattern)) if folder.is_dir() else []
    camera = topics[0].camera if topics else "r1.front"
    text = _TEMPLATE.read_text(encoding="utf-8").format(
        frames=pattern,
        seen=_seen(folder, found[0].relative_to(folder), len(find_pictures(folder, pattern)))
        if found
        else "",
        camera=f"{camera}:",
        first=camera,
        when=when,
        about_when=about,
        more=more,
    )
    run_folder.write_file(folder / FILE, text.encode())


def _seen(folder: Path, first: Path, count: int) -> str:
    try:
        picture = read_picture(folder / first)
    except RecordingError:
        return ""
    rows, columns = picture.data_dn.shape
    return (
        f"\n                           # Here: {count} of them; the first has {columns} × {rows} pixels of "
        f"{picture.bits} bits."
    )


def import_recording(folder: Path, *, overwrite: bool) -> dict[str, Imported]:
    """Make `frames.jsonl` and `calibration.json` of a `recording.yaml` that is filled in.

    Raises
    ------
    InputError
        All that is missing or wrong in the document and in the pictures that it names; a recording that is
        there already, without `overwrite`.
    """
    path = folder / FILE
    if not path.is_file():
        name = shlex.quote(str(folder))
        raise InputError(
            f"{path}: there is no such file; nir-render new-recording {name} writes one to fill in"
        )
    there = [name for name in (run_folder.FRAMES, run_folder.CALIBRATION) if (folder / name).exists()]
    if there and not overwrite:
        raise InputError(f"{folder}: holds {' and '.join(there)} already; --overwrite replaces them")
    try:
        raw = read_yaml(path)
    except ValueError as error:
        raise InputError(str(error)) from None
    document, pictures = _checked(raw, folder, path)
    places = Places(str(path))
    problems: list[str] = []
    done: dict[str, Imported] = {}
    lines: list[dict[str, Any]] = []
    for name, given in document.cameras.items():
        keys = ("cameras", name)
        try:
            done[name], records = _camera(name, given, document, pictures[name], folder)
        except ValueError as error:
            problems += [places.tell(keys, keys, line) for line in str(error).split("\n")]
        else:
            lines += records
    if problems:
        raise InputError(*problems)
    run_folder.write_json(
        folder / run_folder.CALIBRATION, calibration_document(one.calibration for one in done.values())
    )
    run_folder.write_lines(folder / run_folder.FRAMES, lines)
    try:
        read_recording(folder)
    except RecordingError as error:
        raise InputError(str(error)) from None
    return done


def _checked(raw: Any, folder: Path, path: Path) -> tuple[RecordingDocument, dict[str, Pictures]]:
    """Return the document and its pictures; raise InputError with all that is wrong in both."""
    problems: list[str] = []
    document: RecordingDocument | None = None
    empty = tuple(f": {key}: {_MISSING}" for key in _empty_keys(raw))
    raw = _without_empty(raw)
    try:
        document = RecordingDocument.model_validate(raw)
    except ValidationError as error:
        problems += (
            line.removesuffix(_MISSING) + _EMPTY if line.endswith(empty) else line
            for line in explain(error, raw, str(path))
        )
    places = Places(str(path))
    pictures: dict[str, Pictures] = {}
    for name, pattern in _patterns(raw).items():
        keys = ("cameras", name, "frames")
        try:
            pictures[name] = read_pictures(folder, pattern)
        except InputError as error:
            problems += [places.tell(keys, keys, line) for line in error.problems]
    if document is None and _says_no_brightness(raw):
        problems.append(places.tell(("source",), ("source",), _NO_BRIGHTNESS))
    if document is not None:
        problems += [places.tell(keys, keys, said) for keys, said in _contradictions(document, pictures)]
    if problems or document is None:
        raise InputError(*problems)
    return document, pictures


def _says_no_brightness(raw: Any) -> bool:
    """Tell whether a document, which may be wrong, says nothing of how bright sources are."""
    if not isinstance(raw, Mapping):
        return False
    source = raw.get("source")
    keys = source.keys() if isinstance(source, Mapping) else ()
    return not raw.get("known_ranges") and not {"intensity", "power"} & set(keys)


def _patterns(raw: Any) -> dict[str, str]:
    """Return the pattern of each camera's pictures, in a document that may be wrong."""
    cameras = raw.get("cameras") if isinstance(raw, Mapping) else None
    if not isinstance(cameras, Mapping):
        return {}
    return {
        str(name): camera["frames"]
        for name, camera in cameras.items()
        if isinstance(camera, Mapping) and isinstance(camera.get("frames"), str) and camera["frames"]
    }


def _contradictions(document: RecordingDocument, pictures: Mapping[str, Pictures]) -> Iterator[_Problem]:
    """Yield what is wrong between the document's parts and the pictures, each with its place."""
    for name, given in document.cameras.items():
        keys = ("cameras", name)
        yield from ((keys + place, said) for place, said in _wrong_counts(given, pictures.get(name)))
        known = any(one.camera == name for one in document.known_ranges)
        if not known and document.source.intensity is None and document.source.power_w is None:
            yield ("source",), f"{name}: {_NO_BRIGHTNESS}"
        elif not known and (given.f_number is None or given.pixel_pitch_m is None):
            missing = "f_number" if given.f_number is None else "pixel_pitch"
            yield keys, f"{missing} is missing; give it for a range from intensity or power, or a known range"
    for number, one in enumerate(document.known_ranges):
        place = ("known_ranges", str(number))
        if one.camera not in document.cameras:
            known_names = ", ".join(document.cameras)
            yield (*place, "camera"), f"there is no camera {shown(one.camera)}; known: {known_names}"
        elif one.camera in pictures and _index_of(one, pictures[one.camera]) is None:
            files = pictures[one.camera].files
            most = f"0 to {len(files) - 1}, or a name such as {files[0]}"
            yield (*place, "frame"), f"there is no frame {shown(one.frame)}; write {most}"


def _wrong_counts(given: CameraGiven, pictures: Pictures | None) -> Iterator[_Problem]:
    """Yield what is wrong between a camera's counts and its pictures."""
    bits = int(given.bit_depth_bit)
    full_scale_dn = 2**bits - 1
    if pictures is not None and bits > pictures.bits:
        yield ("bit_depth",), f"is {bits} bit; the pictures hold {pictures.bits} bits; write that"
    elif pictures is not None and pictures.most_dn > full_scale_dn:
        said = (
            f"is {bits} bit, full scale {full_scale_dn} DN; the pictures hold counts up to "
            f"{pictures.most_dn}; write the bit depth as stored (some programs shift counts up to 16 bits)"
        )
        yield ("bit_depth",), said
    if given.saturation_dn is not None and given.saturation_dn > full_scale_dn:
        yield ("saturation",), f"is beyond full scale, {full_scale_dn} DN; write less"


def _index_of(one: KnownRange, pictures: Pictures) -> int | None:
    if isinstance(one.frame, int):
        return one.frame if 0 <= one.frame < len(pictures.files) else None
    names = [Path(file).name for file in pictures.files]
    if one.frame in pictures.files:
        return pictures.files.index(one.frame)
    return names.index(one.frame) if names.count(one.frame) == 1 else None


def _camera(
    name: str, given: CameraGiven, document: RecordingDocument, pictures: Pictures, folder: Path
) -> tuple[Imported, list[dict[str, Any]]]:
    """Return what becomes of a camera, and its lines of `frames.jsonl`."""
    times_s = _times_s(given, pictures, folder)
    calibration, assumed = camera_calibration(name, given, document.source, pictures)
    records = [
        FrameRecord(
            camera=name,
            index=index,
            time_s=times_s[index],
            exposure_s=given.exposure_s,
            line_time_s=given.line_time_s,
            gain=1.0,
            black_level_dn=calibration.black_level_dn,
            file=file,
        )
        for index, file in enumerate(pictures.files)
    ]
    constant = from_data_sheets(given, document.source, calibration)
    flares: list[KnownFlare] = []
    for one in document.known_ranges:
        if one.camera == name:
            index = _index_of(one, pictures)
            assert index is not None  # _contradictions has told
            frame, file = read_frame(folder, records[index]), pictures.files[index]
            flares.append(KnownFlare(file, frame, one.range_m, one.place_px))
    if flares:
        constant = from_known_ranges(flares, calibration)
    elif constant is not None:
        assumed += [
            Assumed(key, getattr(given, key))
            for key in ("transmission", "quantum_efficiency")
            if key not in given.model_fields_set
        ]
    assert constant is not None
    sigma = {**calibration.sigma, "range_constant_dn_m2_per_s": constant.sigma_dn_m2_per_s}
    known = replace(calibration, range_constant_dn_m2_per_s=constant.value_dn_m2_per_s, sigma=sigma)
    lines = [{"format": 1, **vars(record)} for record in records]
    warnings = (*_doubts(given, pictures), *contradictions(flares, known))
    return Imported(known, len(records), constant, tuple(assumed), pictures.lossy_sigma_dn, warnings), lines


def _doubts(given: CameraGiven, pictures: Pictures) -> Iterator[str]:
    """Yield what may be a slip in what is given, seen by the pictures."""
    is_whole = given.bit_depth_bit == pictures.bits == _WHOLE_BITS
    if is_whole and given.saturation_dn is None and pictures.most_dn < 2**_LESS_BITS:
        yield (
            f"bit_depth is {_WHOLE_BITS} bit, and no picture has a count above {pictures.most_dn}: if the "
            "sensor counts to less, often to 10, 12 or 14 bit, write that; pixels that clip are else not "
            "known to"
        )
    gaps = pictures.gaps if given.times is None else []
    if gaps:
        after, before = gaps[0]
        yield (
            f"numbers are missing among the pictures, after {after} comes {before}"
            + (f", and {len(gaps) - 1} more times" if len(gaps) > 1 else "")
            + ": frame_rate takes them as following at once; write times: FILE where pictures were lost"
        )


def _times_s(given: CameraGiven, pictures: Pictures, folder: Path) -> list[float]:
    """Return when each picture was taken, by the frame rate or by the file of times."""
    count = len(pictures.files)
    if given.times is None:
        assert given.frame_rate_hz is not None  # one of the two is there
        return [index / given.frame_rate_hz for index in range(count)]
    try:
        times_s = [float(line) for line in find_file(given.times, folder).read_text().split()]
    except ValueError as error:
        raise ValueError(f"times: {given.times}: {error}; wanted a time in seconds on each line") from None
    if len(times_s) != count:
        raise ValueError(f"times: {given.times} has {len(times_s)} times, and there are {count} pictures")
    if not all(math.isfinite(one) and one < other for one, other in itertools.pairwise([*times_s, math.inf])):
        raise ValueError(f"times: {given.times}: times must increase from line to line")
    return times_s


def _empty_keys(raw: Any, above: str = "") -> Iterator[str]:
    """Yield the dotted names of keys that stand empty."""
    pairs = raw.items() if isinstance(raw, Mapping) else enumerate(raw) if isinstance(raw, list) else ()
    for key, value in pairs:
        if value is None:
            yield f"{above}{key}"
        yield from _empty_keys(value, f"{above}{key}.")


def _without_empty(raw: Any) -> Any:
    """Take out keys that stand empty: then they are missing, and told so."""
    if isinstance(raw, Mapping):
        return {key: _without_empty(value) for key, value in raw.items() if value is not None}
    if isinstance(raw, list):
        return [_without_empty(value) for value in raw]
    return raw
