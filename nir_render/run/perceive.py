"""The stage `perceive`: the frames of any folder become detections, by one or several estimators."""

import time
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from nir_render.errors import InputError
from nir_render.run import folder as run_folder
from nir_render.run.folder import note_seconds
from nir_render.run.render import Progress
from perception import (
    ESTIMATORS,
    Calibration,
    Detection,
    Estimator,
    EstimatorError,
    FrameRecord,
    detect,
    detection_record,
    frame_sets,
    load_estimator,
    measure_set,
    measurement_record,
    mirror_record,
    read_recording,
)
from perception.rig.frame_sets import robot_of


def chosen_estimators(names: Sequence[str]) -> dict[str, Estimator]:
    """Return the estimators of these names, by name; `file.py:function` loads one of the user's own.

    Raises
    ------
    InputError
        An estimator is unknown or cannot be loaded, or two of them have the same name.
    """
    chosen: dict[str, Estimator] = {}
    for name in dict.fromkeys(names):
        if name in ESTIMATORS:
            chosen[name] = ESTIMATORS[name]
            continue
        if ":" not in name and not name.endswith(".py"):
            known = ", ".join(ESTIMATORS)
            raise InputError(f"--estimator {name}: unknown; known: {known}, or one's own as file.py:function")
        try:
            own = load_estimator(name)
        except EstimatorError as error:
            raise InputError(f"--estimator {error}") from None
        if own.name in chosen:
            raise InputError(
                f"--estimator {name}: another estimator is called {own.name!r} too; rename one of them"
            )
        chosen[own.name] = own
    return chosen


def perceive_run(folder: Path, *, estimators: Mapping[str, Estimator], progress: Progress) -> dict[str, int]:
    """Run estimators over the frames of a folder; returns the number of detections by estimator.

    Raises
    ------
    InputError
        The folder is no recording, or one's own estimator fails on a frame.
    """
    started = time.perf_counter()
    found: dict[str, list[list[Detection]]] = {name: [] for name in estimators}
    try:
        recording = read_recording(folder)
        for done, frame in enumerate(recording.frames()):
            for name, estimator in estimators.items():
                found[name].append(detect(frame, recording.calibrations[frame.camera], estimator))
            progress(done + 1, len(recording.records))
    except EstimatorError as error:
        raise InputError(f"--estimator {error}") from None
    except ValueError as error:  # a broken recording, or a frame that does not match its calibration
        raise InputError(str(error)) from None
    for name, detections in found.items():
        hits = [hit for of_frame in detections for hit in of_frame]
        run_folder.write_lines(folder / f"detections.{name}.jsonl", map(detection_record, hits))
        _measure_sets(folder, name, recording.records, detections, recording.calibrations)
    note_seconds(folder, "perceive", started)
    return {name: sum(map(len, detections)) for name, detections in found.items()}


def _measure_sets(
    folder: Path,
    name: str,
    records: Sequence[FrameRecord],
    detections: Sequence[Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
) -> None:
    """Write what each robot's cameras measure together, set by set, and the mirrors that show in it."""
    of_frame = {(record.camera, record.index): hits for record, hits in zip(records, detections, strict=True)}
    measurements, mirrors = [], []
    for frames in frame_sets(records):
        seen = measure_set(frames, [of_frame[frame.camera, frame.index] for frame in frames], calibrations)
        measurements += [measurement_record(each) for each in seen.measurements]
        robot, time_s = robot_of(frames[0].camera), frames[0].time_s
        mirrors += [mirror_record(plane, robot, time_s) for plane in seen.planes]
    run_folder.write_lines(folder / f"measurements.{name}.jsonl", measurements)
    run_folder.write_lines(folder / f"mirrors.{name}.jsonl", mirrors)


def unknown_camera(folder: Path, camera: str, known: Collection[str]) -> InputError:
    """Return the error of a frame whose camera has no calibration."""
    names = ", ".join(known) or "none"
    return InputError(
        f"{folder / run_folder.CALIBRATION}: knows no camera {camera!r}, which {run_folder.FRAMES} names; "
        f"known: {names}; name the camera so, or calibrate it"
    )
