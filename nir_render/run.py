"""The stages of a run, each from folder to folder: render, perceive, evaluate, report."""

import importlib.metadata
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from nir_render import run_folder
from nir_render.errors import InputError
from nir_render.evaluate.lamps import lamp_outlines_px
from nir_render.evaluate.metrics import Evaluation, FrameKey, evaluate
from nir_render.evaluate.truth import SourceTruth, parse_truth
from nir_render.noise_facts import enlarging_facts, noise_facts, noise_warning, sample_facts
from nir_render.render_noise import RenderNoise
from nir_render.scene.load import Scene, load_scene
from nir_render.simulate import simulate
from nir_render.transport.cache import LightCache
from nir_render.transport.light import Light
from perception import (
    ESTIMATORS,
    Calibration,
    Detection,
    Estimator,
    EstimatorError,
    RecordingError,
    calibration_document,
    detect,
    detection_record,
    encode_png16,
    frame_record,
    load_estimator,
    parse_detection,
    read_calibrations,
    read_frame,
    read_frame_records,
    read_frames,
)

FRAMES_FILE = "frames.jsonl"
Item = TypeVar("Item")
Progress = Callable[[int, int], None]
"""Called with the number of frames done, and of all."""


def render_run(
    scene: Scene,
    folder: Path,
    *,
    overwrite: bool,
    progress: Progress,
    keep_light: bool = False,
    cache: LightCache | None = None,
) -> list[str]:
    """Render the frames of a scene with their truth and calibration into a new run folder.

    `keep_light` adds the light of each frame, as spectral EXR and direct table. `cache` keeps light from run
    to run, which saves rendering it and changes nothing else. Returns what the user should be warned of.

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
        noises: dict[str, RenderNoise] = {}
        sampled: dict[str, dict[str, Any]] = {}
        enlarged: dict[str, dict[str, Any]] = {}
        cache = LightCache() if cache is None else cache
        missed, reused = cache.missed, cache.reused
        kept: dict[str, tuple[str, Light]] = {}
        for done, shot in enumerate(simulate(scene, cache=cache)):
            file = f"frames/{shot.frame.camera}/{shot.frame.index:06d}.png"
            run_folder.write_file(aside / file, encode_png16(shot.frame.data_dn))
            records.append(frame_record(shot.frame, file))
            truth += [row.record() for row in shot.truth]
            noises[f"{shot.frame.camera} {shot.frame.index}"] = shot.noise
            if shot.frame.camera not in enlarged:
                enlarged[shot.frame.camera] = enlarging_facts(scene, shot)
                if shot.light.indirect is not None:
                    sampled[shot.frame.camera] = sample_facts(shot.light)
            if keep_light:
                folder_of_light = aside / "light" / shot.frame.camera
                kept[shot.frame.camera] = _write_light(
                    folder_of_light / f"{shot.frame.index:06d}", shot.light, kept.get(shot.frame.camera)
                )
            progress(done + 1, total)
        run_folder.write_lines(aside / FRAMES_FILE, records)
        run_folder.write_lines(aside / "truth.jsonl", truth)
        run_folder.write_json(aside / "calibration.json", calibration_document(calibrations.values()))
        run_folder.write_file(aside / "scene.yaml", scene.resolved_yaml().encode())
        seconds = time.perf_counter() - started
        noise = noise_facts(scene.document.render.noise, noises)
        warning = noise_warning(noise, len(noises))
        facts = {
            "scene": scene.document.name,
            "seed": scene.document.seed,
            "versions": versions(),
            "variant": backend().variant,
            "variant_reason": backend().reason,
            "seconds": {"render": round(seconds, 3)},
            "indirect": _indirect_facts(scene)
            | {"samples_by_camera": sampled, "upsampling_error_share_of_temporal_variance": enlarged},
            # Variance of the Monte Carlo part over shot and read noise: the median over the pixels of each
            # frame that it reaches, and the largest of the sums over flares' apertures; the direct part is
            # closed form and carries none.
            "render_noise": noise,
            "lights": {"rendered": cache.missed - missed, "reused": cache.reused - reused},
        }
        run_folder.write_manifest(aside, facts)
    return [] if warning is None else [warning]


def _write_light(stem: Path, light: Light, last: tuple[str, Light] | None) -> tuple[str, Light]:
    """Write a light; its arrays only where they are not those of the last one. Returns their file, and it."""
    from nir_render.export.spectral_exr import direct_document, write_light

    same = last is not None and last[1].indirect is light.indirect
    file = last[0] if last is not None and same else f"{stem.name}.exr"
    held = {"indirect": file if light.indirect is not None else None}
    run_folder.write_json(stem.with_suffix(".direct.json"), direct_document(light) | held)
    try:
        if not same:
            write_light(stem.with_suffix(".exr"), light)
    except RuntimeError as error:  # how OpenEXR says that the disk is full
        raise InputError(f"{stem}.exr: cannot be written ({error})") from None
    return file, light


def _indirect_facts(scene: Scene) -> dict[str, Any]:
    """Return how the indirect light of a run was asked for; `samples` is null where a target ruled."""
    from nir_render.transport import stock
    from nir_render.transport.backend import backend

    settings = scene.document.render
    used = None if backend().vectorised and settings.noise is not None else stock.samples_of(scene)
    asked = settings.indirect.samples
    wanted = "a target for the noise was" if asked is None else f"{asked}"
    note = "" if used == asked else f"{wanted} asked for; no usable LLVM"
    rendered = scene.document.has_indirect_light()
    return {"rendered": rendered, "scale": settings.indirect.scale, "samples": used, "note": note}


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
    found: dict[str, list[Detection]] = {name: [] for name in estimators}
    try:
        calibrations = read_calibrations(folder)
        total = len(_frame_keys(folder))
        for done, frame in enumerate(read_frames(folder)):
            if frame.camera not in calibrations:
                raise InputError(f"{folder / 'calibration.json'}: knows no camera {frame.camera!r}")
            for name, estimator in estimators.items():
                found[name] += detect(frame, calibrations[frame.camera], estimator)
            progress(done + 1, total)
    except EstimatorError as error:
        raise InputError(f"--estimator {error}") from None
    except ValueError as error:  # a broken recording, or a frame that does not match its calibration
        raise InputError(str(error)) from None
    for name, detections in found.items():
        run_folder.write_lines(folder / f"detections.{name}.jsonl", map(detection_record, detections))
    note_seconds(folder, "perceive", started)
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
        keys = _frame_keys(folder)
        truth = parse_lines(truth_path, parse_truth)
        detections = {
            path.name.removeprefix("detections.").removesuffix(".jsonl"): parse_lines(path, parse_detection)
            for path in paths
        }
        _check_frames_known(keys, truth, detections, calibrations, folder)
        result = evaluate(keys, truth, calibrations, detections, _lamps(folder))
        preview = _preview(folder, keys, calibrations, result)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(str(error)) from None
    run_folder.write_json(folder / "summary.json", result.summary)
    run_folder.write_file(folder / "preview.png", preview)
    note_seconds(folder, "evaluate", started)
    return result


def report_run(folder: Path, result: Evaluation) -> Path:
    """Write `report.html` from what lies in a run folder and its evaluation; returns the page's path.

    Raises
    ------
    InputError
        A frame or the calibration cannot be read.
    """
    from nir_render.report.page import report_html

    started = time.perf_counter()
    has_manifest = (folder / run_folder.MANIFEST).is_file()
    try:
        records = {(record.camera, record.index): record for record in read_frame_records(folder)}
        page = report_html(
            keys=list(records),
            result=result,
            load=lambda key: read_frame(folder, records[key]),
            calibrations=read_calibrations(folder),
            manifest=run_folder.read_json(folder / run_folder.MANIFEST) if has_manifest else {},
            folder_name=folder.resolve().name,
            files=sorted(
                path.name
                for path in folder.iterdir()
                if path.is_file() and not path.name.startswith(".") and path.name != "report.html"
            ),
        )
    except RecordingError as error:
        raise InputError(str(error)) from None
    run_folder.write_file(folder / "report.html", page.encode())
    note_seconds(folder, "report", started)
    return folder / "report.html"


def _lamps(folder: Path) -> dict[FrameKey, list[NDArray[np.float32]]]:
    """Return the outlines of lamps and sun in each frame of a rendered run, from the scene that it holds."""
    if not (folder / "scene.yaml").is_file():
        return {}
    scene = load_scene(folder / "scene.yaml")
    if not scene.document.lamps and scene.document.sun is None:
        return {}
    return {
        (record.camera, record.index): lamp_outlines_px(scene, record.camera, record.time_s)
        for record in read_frame_records(folder)
    }


def _frame_keys(folder: Path) -> list[FrameKey]:
    """Return camera and index of all frames of a recording; raise InputError where it has none."""
    keys = [(record.camera, record.index) for record in read_frame_records(folder)]
    if not keys:
        raise InputError(f"{folder / FRAMES_FILE}: names no frame")
    return keys


def parse_lines(path: Path, parse: Callable[[Any], Item]) -> list[Item]:
    """Parse a file of JSON lines; raise InputError with file and line where one is broken."""
    items = []
    for number, record in enumerate(run_folder.read_lines(path), 1):
        try:
            items.append(parse(record))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"{path}, line {number}: {error}") from None
    return items


def _check_frames_known(
    keys: Sequence[FrameKey],
    truth: Sequence[SourceTruth],
    detections: Mapping[str, Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
    folder: Path,
) -> None:
    """Raise InputError where a line speaks of a frame or camera that the recording does not have."""
    for camera in dict.fromkeys(camera for camera, _ in keys):
        if camera not in calibrations:
            raise InputError(f"{folder / 'calibration.json'}: knows no camera {camera!r}")
    lines: dict[str, Sequence[SourceTruth | Detection]] = {"truth.jsonl": truth}
    lines |= {f"detections.{name}.jsonl": found for name, found in detections.items()}
    known = set(keys)
    for file, items in lines.items():
        for item in items:
            if (item.camera, item.index) not in known:
                raise InputError(
                    f"{folder / file}: speaks of frame {item.index} of {item.camera}, "
                    "which frames.jsonl does not name"
                )


def _preview(
    folder: Path, keys: Sequence[FrameKey], calibrations: Mapping[str, Calibration], result: Evaluation
) -> bytes:
    from nir_render.report.preview import preview_png  # Matplotlib loads only where something is drawn

    at = {(record.camera, record.index): record for record in read_frame_records(folder)}
    estimators = list(result.summary["estimators"])
    return preview_png(
        keys=keys,
        scores=result.scores,
        ghosts=result.ghosts,
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


def note_seconds(folder: Path, stage: str, started: float) -> None:
    """Add to the manifest, where there is one, how long a stage took, and the hashes of what it wrote."""
    if not (folder / run_folder.MANIFEST).is_file():
        return
    seconds = run_folder.read_json(folder / run_folder.MANIFEST).get("seconds", {})
    run_folder.refresh_manifest(
        folder, {"seconds": {**seconds, stage: round(time.perf_counter() - started, 3)}}
    )
