"""The stages of a run, each from folder to folder: render, perceive, evaluate."""

import importlib.metadata
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from nir_render import run_folder
from nir_render.errors import InputError
from nir_render.evaluate.metrics import Evaluation, FrameKey, evaluate
from nir_render.evaluate.truth import parse_truth
from nir_render.report.preview import preview_png
from nir_render.scene.load import Scene
from nir_render.simulate import simulate
from perception import (
    ESTIMATORS,
    Detection,
    RecordingError,
    calibration_document,
    detect,
    detection_record,
    encode_png16,
    frame_record,
    parse_detection,
    read_calibrations,
    read_frame,
    read_frame_records,
    read_frames,
)

Progress = Callable[[int, int], None]
"""Called with the number of frames done, and of all."""


@dataclass(frozen=True)
class Rendered:
    """What `render_run` made."""

    frames: int
    seconds: float


def render_run(scene: Scene, folder: Path, *, seed: int, overwrite: bool, progress: Progress) -> Rendered:
    """Render the frames of a scene with their truth and calibration into a new run folder.

    Raises
    ------
    InputError
        The scene cannot be rendered, the folder is taken, the disk is full.
    """
    from nir_render.transport.backend import backend

    run_folder.check_free(folder, overwrite)
    started = time.perf_counter()
    cameras = scene.cameras()
    total = scene.document.clock.frames * len(cameras)
    calibrations = {name: scene.calibration(name) for name in cameras}
    with run_folder.new_run_folder(folder, overwrite) as aside:
        records, truth = [], []
        for done, shot in enumerate(simulate(scene, seed)):
            file = f"frames/{shot.frame.camera}/{shot.frame.index:06d}.png"
            run_folder.write_file(aside / file, encode_png16(shot.frame.data_dn))
            records.append(frame_record(shot.frame, file))
            truth += [row.record() for row in shot.truth]
            progress(done + 1, total)
        run_folder.write_lines(aside / "frames.jsonl", records)
        run_folder.write_lines(aside / "truth.jsonl", truth)
        run_folder.write_json(aside / "calibration.json", calibration_document(calibrations.values()))
        run_folder.write_file(aside / "scene.yaml", scene.resolved_yaml().encode())
        seconds = time.perf_counter() - started
        facts = {
            "scene": scene.document.name,
            "seed": seed,
            "versions": versions(),
            "variant": backend().variant,
            "variant_reason": backend().reason,
            "seconds": {"render": round(seconds, 3)},
            # The direct part is closed form: it carries no Monte Carlo noise.
            "render_noise": {"share_of_temporal_variance": 0.0},
        }
        run_folder.write_manifest(aside, facts)
    return Rendered(total, seconds)


def check_estimators(names: Sequence[str]) -> None:
    """Raise InputError where an estimator is unknown."""
    for name in names:
        if name not in ESTIMATORS:
            raise InputError(f"--estimator {name}: unknown; known: {', '.join(ESTIMATORS)}")


def perceive_run(folder: Path, *, estimators: Sequence[str], progress: Progress) -> dict[str, int]:
    """Run the perception stack over the frames of a folder; returns the number of detections by estimator.

    Raises
    ------
    InputError
        The folder is no recording, or an estimator is unknown.
    """
    check_estimators(estimators)
    started = time.perf_counter()
    found: dict[str, list[Detection]] = {name: [] for name in estimators}
    try:
        calibrations = read_calibrations(folder)
        total = len(run_folder.read_lines(folder / "frames.jsonl"))
        for done, frame in enumerate(read_frames(folder)):
            if frame.camera not in calibrations:
                raise InputError(f"{folder / 'calibration.json'}: knows no camera {frame.camera!r}")
            for name in estimators:
                found[name] += detect(frame, calibrations[frame.camera], name)
            progress(done + 1, total)
    except RecordingError as error:
        raise InputError(str(error)) from None
    for name, detections in found.items():
        run_folder.write_lines(folder / f"detections.{name}.jsonl", map(detection_record, detections))
    _note_seconds(folder, "perceive", started)
    return {name: len(detections) for name, detections in found.items()}


def evaluate_run(folder: Path) -> Evaluation:
    """Score every `detections.*.jsonl` of a run against its truth; writes `summary.json`, `preview.png`.

    Raises
    ------
    InputError
        The folder has no truth or no detections, or a file is broken.
    """
    started = time.perf_counter()
    paths = sorted(folder.glob("detections.*.jsonl"))
    truth_path = folder / "truth.jsonl"
    if not truth_path.is_file():
        raise InputError(
            f"{truth_path}: there is no such file; only rendered runs have truth to evaluate against"
        )
    if not paths:
        raise InputError(f"{folder}: there are no detections; run 'nir-render perceive {folder}' first")
    try:
        calibrations = read_calibrations(folder)
        keys = [
            (record["camera"], int(record["index"]))
            for record in run_folder.read_lines(folder / "frames.jsonl")
        ]
        truth = [parse_truth(record) for record in run_folder.read_lines(truth_path)]
        detections = {
            path.name.removeprefix("detections.").removesuffix(".jsonl"): [
                parse_detection(record) for record in run_folder.read_lines(path)
            ]
            for path in paths
        }
        result = evaluate(keys, truth, calibrations, detections)
    except RecordingError as error:
        raise InputError(str(error)) from None
    except (KeyError, TypeError) as error:
        raise InputError(f"{folder}: a line of truth, frames or detections is broken ({error})") from None
    run_folder.write_json(folder / "summary.json", result.summary)
    run_folder.write_file(folder / "preview.png", _preview(folder, keys, result))
    _note_seconds(folder, "evaluate", started)
    return result


def _preview(folder: Path, keys: Sequence[FrameKey], result: Evaluation) -> bytes:
    records = read_frame_records(folder)
    at = {(record.camera, record.index): record for record in records}
    calibrations = read_calibrations(folder)
    estimators = list(result.summary["estimators"])
    return preview_png(
        keys=keys,
        scores=result.scores,
        estimators=estimators,
        load=lambda key: read_frame(folder, at[key]),
        calibrations=calibrations,
        title=folder.resolve().name,
    )


def versions() -> dict[str, str]:
    """Return the versions of what decides the bits of a run."""
    packages = ("nir-render", "mitsuba", "drjit", "numpy", "scipy", "opencv-python-headless")
    known = {}
    for package in packages:
        try:
            known[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            known[package] = "not installed"
    return {"python": platform.python_version(), "platform": platform.platform(), **known}


def _note_seconds(folder: Path, stage: str, started: float) -> None:
    if not (folder / run_folder.MANIFEST).is_file():
        return
    seconds = run_folder.read_json(folder / run_folder.MANIFEST).get("seconds", {})
    run_folder.refresh_manifest(
        folder, {"seconds": {**seconds, stage: round(time.perf_counter() - started, 3)}}
    )
