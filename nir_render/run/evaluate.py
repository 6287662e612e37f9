"""The stage `evaluate`: the detections of a folder against the truth that lies there, and the limit.

It reads files alone: a folder that another program wrote is scored like one that was rendered here.
"""

import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from nir_render.errors import InputError
from nir_render.evaluate.headings import heading_numbers, stands_of
from nir_render.evaluate.messages import MessageEvaluation, evaluate_messages, parse_told
from nir_render.evaluate.metrics import Evaluation, evaluate
from nir_render.evaluate.sets import SetEvaluation, evaluate_sets
from nir_render.evaluate.tracks import TrackEvaluation, evaluate_tracks, sets_in_time
from nir_render.run import folder as run_folder
from nir_render.run.folder import note_seconds, parse_lines
from nir_render.run.perceive import unknown_camera
from nir_render.truth.lamps import LampTruth, parse_lamp
from nir_render.truth.poses import parse_pose
from nir_render.truth.sent import parse_sent
from nir_render.truth.sources import SourceTruth, parse_truth
from perception import (
    Calibration,
    Detection,
    Recording,
    RecordingError,
    frame_sets,
    parse_detection,
    parse_measurement,
    parse_mirror,
    parse_robot,
    parse_signal,
    parse_track,
    read_frame,
    read_recording,
)
from perception.rig.frame_sets import robot_of
from perception.types import FrameKey

Row = TypeVar("Row", SourceTruth, LampTruth)


def evaluate_run(folder: Path) -> Evaluation:
    """Score every `detections.*.jsonl` of a run against its truth; writes `summary.json`, `preview.png`.

    Raises
    ------
    InputError
        The folder has no truth or no detections, or a file is broken.
    """
    started = time.perf_counter()
    paths = run_folder.detection_files(folder)
    truth_path = folder / run_folder.TRUTH
    if not truth_path.is_file():
        raise InputError(
            f"{truth_path}: there is no such file; without truth there is nothing to score against. A "
            "rendered run has it; docs/run_folder.md says what a line must hold"
        )
    if not paths:
        raise InputError(f"{folder}: there are no detections; run 'nir-render perceive {folder}' first")
    try:
        recording = read_recording(folder)
        calibrations = recording.calibrations
        keys = [(record.camera, record.index) for record in recording.records]
        truth = parse_lines(truth_path, parse_truth)
        detections = {name: parse_lines(path, parse_detection) for name, path in paths.items()}
        lamps_path = folder / run_folder.LAMPS
        lamps = parse_lines(lamps_path, parse_lamp) if lamps_path.is_file() else []
        check_frames_known(keys, truth, lamps, detections, calibrations, folder)
        recording = recording.of_sources
        keys = [(record.camera, record.index) for record in recording.records]
        truth, lamps = rows_of(recording, truth), rows_of(recording, lamps)
        result = evaluate(keys, truth, calibrations, detections, lamps)
        result = _with_sets(result, sets_of(recording, truth, detections, lamps))
        result = _with_tracks(recording, result, truth, list(detections))
        preview = _preview(recording, keys, result)
    except InputError:
        raise
    except RecordingError as error:
        raise InputError(str(error)) from None
    run_folder.write_json(folder / "summary.json", result.summary)
    run_folder.write_file(folder / "preview.png", preview)
    note_seconds(folder, "evaluate", started)
    return result


def check_frames_known(
    keys: Sequence[FrameKey],
    truth: Sequence[SourceTruth],
    lamps: Sequence[LampTruth],
    detections: Mapping[str, Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
    folder: Path,
) -> None:
    """Raise InputError where a line speaks of a frame or camera that the recording does not have."""
    for camera in dict.fromkeys(camera for camera, _ in keys):
        if camera not in calibrations:
            raise unknown_camera(folder, camera, calibrations)
    lines: dict[str, Sequence[SourceTruth | LampTruth | Detection]] = {
        run_folder.TRUTH: truth,
        run_folder.LAMPS: lamps,
    }
    lines |= {f"detections.{name}.jsonl": found for name, found in detections.items()}
    known = set(keys)
    for file, items in lines.items():
        for item in items:
            if (item.camera, item.index) not in known:
                raise InputError(
                    f"{folder / file}: speaks of frame {item.index} of {item.camera}, "
                    "which frames.jsonl does not name"
                )


def rows_of(recording: Recording, rows: Iterable[Row]) -> list[Row]:
    """Return the rows of truth that are of a recording's frames."""
    frames = {(record.camera, record.index) for record in recording.records}
    return [row for row in rows if (row.camera, row.index) in frames]


def sets_of(
    recording: Recording,
    truth: Sequence[SourceTruth],
    detections: Mapping[str, Sequence[Detection]],
    lamps: Sequence[LampTruth],
) -> SetEvaluation | None:
    """Score what the rigs measured, by the folder's `measurements.*.jsonl`; None where there are none.

    Raises
    ------
    InputError
        Such a file is broken, or of other detections.
    """
    folder = recording.folder
    paths = {name: folder / f"measurements.{name}.jsonl" for name in detections}
    measurements = {
        name: parse_lines(path, parse_measurement) for name, path in paths.items() if path.is_file()
    }
    if not measurements:
        return None
    records = frame_sets(recording.records, run_folder.read_period_s(folder))
    sets = [[(frame.camera, frame.index) for frame in each] for each in records]
    began = {(robot_of(each[0].camera), each[0].time_s): number for number, each in enumerate(records)}
    mirrors = {
        name: [
            (began[robot, time_s], plane)
            for robot, time_s, plane in parse_lines(folder / f"mirrors.{name}.jsonl", parse_mirror)
            if (robot, time_s) in began
        ]
        for name in measurements
        if (folder / f"mirrors.{name}.jsonl").is_file()
    }
    for name, found in measurements.items():
        there = Counter((hit.camera, hit.index) for hit in detections[name])
        for camera, index, number in (key for each in found for key in each.detections):
            if number >= there[camera, index]:
                raise InputError(
                    f"{paths[name]}: speaks of detection {number} of frame {index} of {camera}, which "
                    f"detections.{name}.jsonl does not have; run 'nir-render perceive {folder}' again"
                )
    around = evaluate_sets(sets, truth, recording.calibrations, measurements, detections, lamps, mirrors)
    return _with_headings(folder, around)


def _with_sets(result: Evaluation, around: SetEvaluation | None) -> Evaluation:
    """Add the scores of what the rigs measured."""
    if around is None:
        return result
    summary = dict(result.summary)
    summary["estimators"] = {
        name: {**numbers, **around.summary.get(name, {})} for name, numbers in summary["estimators"].items()
    }
    return replace(result, summary=summary, around=around)


def _with_headings(folder: Path, around: SetEvaluation) -> SetEvaluation:
    """Add the scores of robots with several sources, where the folder has `robots.*.jsonl` and poses."""
    robots = run_folder.lines_of(folder, "robots", list(around.summary), parse_robot)
    if not robots or not (folder / run_folder.POSES).is_file():
        return around
    poses = parse_lines(folder / run_folder.POSES, parse_pose)
    stands = {
        name: stands_of(robots[name], around.sets, around.scores, name, poses)
        for name in around.summary
        if name in robots
    }
    summary = {
        name: {**numbers, **heading_numbers(stands[name])} if name in stands else numbers
        for name, numbers in around.summary.items()
    }
    return replace(around, summary=summary, stands=stands)


def _with_tracks(
    recording: Recording, result: Evaluation, truth: Sequence[SourceTruth], names: Sequence[str]
) -> Evaluation:
    """Add the scores of tracks and of what they said, where the folder has `tracks.*.jsonl`."""
    folder = recording.folder
    tracks = run_folder.lines_of(folder, "tracks", names, parse_track)
    if not tracks:
        return result
    period_s = run_folder.read_period_s(folder)
    sets, taken_s = sets_in_time(recording.records, recording.calibrations, period_s)
    poses_path = folder / run_folder.POSES
    poses = parse_lines(poses_path, parse_pose) if poses_path.is_file() else []
    over_time = evaluate_tracks(sets, truth, recording.calibrations, tracks, poses, taken_s)
    scored: list[TrackEvaluation | MessageEvaluation] = [over_time]
    heard = None
    if (folder / run_folder.SENT).is_file():
        heard = evaluate_messages(
            over_time.moments,
            parse_lines(folder / run_folder.SENT, parse_sent),
            run_folder.lines_of(folder, "messages", names, parse_told),
            run_folder.lines_of(folder, "signals", names, parse_signal),
        )
        scored.append(heard)
    summary = dict(result.summary)
    summary["estimators"] = {
        name: {**numbers, **_together(name, scored)} for name, numbers in summary["estimators"].items()
    }
    return replace(result, summary=summary, over_time=over_time, heard=heard)


def _together(name: str, scored: Sequence[TrackEvaluation | MessageEvaluation]) -> dict[str, Any]:
    """Return an estimator's numbers over time; where several robots observe, those of each beside them."""
    numbers: dict[str, Any] = {
        key: value for each in scored for key, value in each.summary.get(name, {}).items()
    }
    by_observer: dict[str, dict[str, Any]] = {}
    for each in scored:
        for robot, own in each.by_observer.get(name, {}).items():
            by_observer.setdefault(robot, {}).update(own)
    return {**numbers, "observers": by_observer} if len(by_observer) > 1 else numbers


def _preview(recording: Recording, keys: Sequence[FrameKey], result: Evaluation) -> bytes:
    from nir_render.report.preview import preview_png  # Matplotlib loads only where something is drawn

    at = {(record.camera, record.index): record for record in recording.records}
    estimators = list(result.summary["estimators"])
    return preview_png(
        keys=keys,
        scores=result.scores,
        ghosts=result.ghosts,
        estimators=estimators,
        load=lambda key: read_frame(recording.folder, at[key]),
        calibrations=recording.calibrations,
        title=recording.folder.resolve().name,
    )
