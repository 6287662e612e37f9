"""The stage `report`: a run folder and its evaluation become one page, report.html."""

import time
from collections.abc import Mapping
from pathlib import Path

from nir_render.errors import InputError
from nir_render.evaluate.metrics import Evaluation
from nir_render.run import folder as run_folder
from nir_render.run.folder import note_seconds
from perception import (
    FrameRecord,
    RecordingError,
    parse_message,
    parse_signal,
    read_calibrations,
    read_frame,
    read_frame_records,
)
from perception.files.detections import parse_causes
from perception.types import FrameKey


def report_run(folder: Path, result: Evaluation) -> Path:
    """Write `report.html` from what lies in a run folder and its evaluation; returns the page's path.

    Raises
    ------
    InputError
        A frame or the calibration cannot be read.
    """
    from nir_render.report.page import report_html
    from nir_render.report.time.section import Said

    started = time.perf_counter()
    names = list(result.summary["estimators"])
    has_manifest = (folder / run_folder.MANIFEST).is_file()
    try:
        records = {(record.camera, record.index): record for record in read_frame_records(folder)}
        film = _film(folder, records, result)
        if film is not None:
            run_folder.write_file(folder / run_folder.FILM, film)
        page = report_html(
            keys=list(records),
            result=result,
            load=lambda key: read_frame(folder, records[key]),
            calibrations=read_calibrations(folder),
            manifest=run_folder.read_json(folder / run_folder.MANIFEST) if has_manifest else {},
            folder_name=folder.resolve().name,
            files=run_folder.files_beside(folder / "report.html"),
            said=Said(
                run_folder.lines_of(folder, "signals", names, parse_signal),
                run_folder.lines_of(folder, "messages", names, parse_message),
            ),
            film=run_folder.FILM if film is not None else "",
            look=run_folder.LOOK if (folder / run_folder.LOOK).is_file() else "",
            causes=run_folder.lines_of(folder, "causes", names, parse_causes),
        )
    except RecordingError as error:
        raise InputError(str(error)) from None
    run_folder.write_file(folder / "report.html", page.encode())
    note_seconds(folder, "report", started)
    return folder / "report.html"


def _film(folder: Path, records: Mapping[FrameKey, FrameRecord], result: Evaluation) -> bytes | None:
    """Return the film of the estimator with the best tracks; None where nothing was tracked."""
    if result.over_time is None:
        return None
    from nir_render.report.time.film import film_gif

    scores = {name: numbers["track_hota"] or 0.0 for name, numbers in result.over_time.summary.items()}
    return film_gif(
        list(records),
        result.over_time.moments,
        max(scores, key=lambda name: scores[name]),
        lambda key: read_frame(folder, records[key]),
        read_calibrations(folder),
    )
