"""The stage `report` of a recording without truth: what was found becomes one page, report.html."""

import time
from collections import defaultdict
from functools import lru_cache
from pathlib import Path

from nir_render.errors import InputError
from nir_render.run import folder as run_folder
from nir_render.run.folder import note_seconds, parse_lines
from perception import Detection, RawFrame, RecordingError, parse_detection, read_recording
from perception.files.detections import parse_causes
from perception.types import FrameKey

_FRAMES_KEPT = 16


def report_recording(folder: Path) -> Path:
    """Write `report.html` from the frames, the calibration and the detections of a folder; returns its path.

    Raises
    ------
    InputError
        There are no detections, or a file is broken.
    """
    from nir_render.report.recording_page import recording_html

    started = time.perf_counter()
    try:
        recording = read_recording(folder)
        records = {(record.camera, record.index): record for record in recording.records}
        found = _detections(folder, set(records))

        @lru_cache(maxsize=_FRAMES_KEPT)
        def load(key: FrameKey) -> RawFrame:
            return recording.frame(records[key])

        page = recording_html(
            keys=list(records),
            found=found,
            load=load,
            calibrations=recording.calibrations,
            folder_name=folder.resolve().name,
            files=run_folder.files_beside(folder / "report.html"),
            causes=run_folder.lines_of(folder, "causes", list(found), parse_causes),
        )
    except RecordingError as error:
        raise InputError(str(error)) from None
    run_folder.write_file(folder / "report.html", page.encode())
    note_seconds(folder, "report", started)
    return folder / "report.html"


def _detections(folder: Path, known: set[FrameKey]) -> dict[str, dict[FrameKey, list[Detection]]]:
    """Return the detections of a folder, by estimator and frame."""
    paths = run_folder.detection_files(folder)
    if not paths:
        raise InputError(f"{folder}: there are no detections; run 'nir-render perceive {folder}' first")
    found: dict[str, dict[FrameKey, list[Detection]]] = {}
    for name, path in paths.items():
        by_frame: dict[FrameKey, list[Detection]] = defaultdict(list)
        for one in parse_lines(path, parse_detection):
            if (one.camera, one.index) not in known:
                raise InputError(
                    f"{path}: speaks of frame {one.index} of {one.camera}, which frames.jsonl does not name; "
                    "take those lines out, or perceive again"
                )
            by_frame[one.camera, one.index].append(one)
        found[name] = dict(by_frame)
    return found
