"""The commands of a run folder: run, render, perceive, evaluate, calibrate, report."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nir_render.command.options import (
    CalibrationFile,
    Estimators,
    FolderArgument,
    Json,
    KeepLight,
    LightFolder,
    LightLimit,
    Output,
    Overwrite,
    OwnDecoder,
    OwnTracker,
    Period,
    SceneArgument,
    Seed,
    Settings,
    Threads,
    TimeLimit,
    check_period,
    chosen_estimators,
    light_cache,
    read_scene,
    use_threads,
)
from nir_render.errors import InputError

if TYPE_CHECKING:
    from nir_render.evaluate.metrics import Evaluation
    from nir_render.scene.scene import Scene
    from nir_render.transport.cache import LightCache


def run(
    scene: SceneArgument,
    output: Output = None,
    settings: Settings = None,
    estimators: Estimators = None,
    tracker: OwnTracker = None,
    decoder: OwnDecoder = None,
    time_limit_s: TimeLimit = None,
    period_s: Period = None,
    overwrite: Overwrite = False,
    seed: Seed = None,
    threads: Threads = None,
    keep_light: KeepLight = False,
    light_folder: LightFolder = None,
    light_gib: LightLimit = 4.0,
    as_json: Json = False,
) -> None:
    """Render, perceive, evaluate and report a scene in one go."""
    from nir_render.command.terminal.progress import progress_bar
    from nir_render.look.sheet import look_png
    from nir_render.run.evaluate import evaluate_run
    from nir_render.run.folder import LOOK, write_file
    from nir_render.run.follow import OwnParts
    from nir_render.run.perceive import perceive_run
    from nir_render.run.report import report_run

    chosen = chosen_estimators(estimators, time_limit_s)
    check_period(period_s)
    own = OwnParts.of(tracker, decoder)
    cache = light_cache(light_folder, light_gib)
    loaded = read_scene(scene, settings, seed)
    folder = _render(loaded, output, overwrite, threads, keep_light, cache)
    write_file(folder / LOOK, look_png(loaded, loaded.document.clock.start_s))
    with progress_bar("perceive", compiles=True) as progress:
        perceived = perceive_run(folder, estimators=chosen, progress=progress, own=own, period_s=period_s)
    if not perceived.detections:
        raise InputError(*perceived.problems)
    result = evaluate_run(folder)
    page = report_run(folder, result)
    _show_evaluation(result, folder, as_json)
    if not as_json:
        typer.echo(f"open {page}")
    if perceived.failures:
        raise InputError(*perceived.problems)


def render(
    scene: SceneArgument,
    output: Output = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    seed: Seed = None,
    threads: Threads = None,
    keep_light: KeepLight = False,
    light_folder: LightFolder = None,
    light_gib: LightLimit = 4.0,
    only_estimate: Annotated[
        bool,
        typer.Option("--estimate", help="Only say how long it takes without a cache, from small trials."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Render the frames of a scene, with truth and calibration."""
    from nir_render.command.terminal.console import print_json

    cache = light_cache(light_folder, light_gib)
    loaded = read_scene(scene, settings, seed)
    if only_estimate:
        _show_estimate(loaded, output, overwrite, threads, as_json)
        return
    folder = _render(loaded, output, overwrite, threads, keep_light, cache)
    frames = len((folder / "frames.jsonl").read_text(encoding="utf-8").splitlines())
    if as_json:
        print_json({"folder": str(folder), "frames": frames})
    else:
        typer.echo(f"{frames} frames in {folder}; next: nir-render perceive {folder}")


def perceive(
    folder: FolderArgument,
    estimators: Estimators = None,
    tracker: OwnTracker = None,
    decoder: OwnDecoder = None,
    calibration: CalibrationFile = None,
    causes: Annotated[
        bool,
        typer.Option("--causes", help="Also write what each range's σ is made of: causes.NAME.jsonl."),
    ] = False,
    time_limit_s: TimeLimit = None,
    period_s: Period = None,
    as_json: Json = False,
) -> None:
    """Detect and range flares in the frames of any folder, also one recorded by a real camera."""
    from nir_render.command.terminal.console import print_json, warn
    from nir_render.command.terminal.progress import progress_bar
    from nir_render.run.follow import OwnParts
    from nir_render.run.perceive import perceive_run

    chosen = chosen_estimators(estimators, time_limit_s)
    check_period(period_s)
    own = OwnParts.of(tracker, decoder)
    with progress_bar("perceive", compiles=True) as progress:
        perceived = perceive_run(
            folder,
            estimators=chosen,
            progress=progress,
            own=own,
            calibration=calibration,
            causes=causes,
            period_s=period_s,
        )
    if as_json:
        told: dict[str, Any] = {"failed": dict(perceived.failures)} if perceived.failures else {}
        told |= {"warnings": list(perceived.warnings)} if perceived.warnings else {}
        print_json({"folder": str(folder), "detections": dict(perceived.detections), **told})
    else:
        for name, count in perceived.detections.items():
            typer.echo(f"{name}: {count} detections in {folder / f'detections.{name}.jsonl'}")
    for text in perceived.warnings:
        warn(text)
    if perceived.failures:
        raise InputError(*perceived.problems)


def evaluate(folder: FolderArgument, as_json: Json = False) -> None:
    """Score the detections of a run against its truth and the physical limit."""
    from nir_render.run.evaluate import evaluate_run

    _show_evaluation(evaluate_run(folder), folder, as_json)


def calibrate(folder: FolderArgument, as_json: Json = False) -> None:
    """Learn cameras from frames of darkness, an even surface, known ranges, and shared flares."""
    from nir_render.command.terminal.console import note, print_error, print_json
    from nir_render.command.terminal.progress import progress_bar
    from nir_render.command.terminal.tables import calibration_tables, extrinsics_table, print_table
    from nir_render.run.calibrate import FITTED_FILE, PAGE, calibrate_run

    with progress_bar("calibrate", compiles=True) as progress:
        told = calibrate_run(folder, progress)
    holds = not told.faults
    if as_json:
        cameras = {name: camera.record() for name, camera in told.cameras.items()}
        rigs = {name: rig.record() for name, rig in told.rigs.items()}
        print_json(
            {"format": 1, "folder": str(folder), "holds": holds, "cameras": cameras, "extrinsics": rigs}
        )
    else:
        for name, camera in told.cameras.items():
            for table in calibration_tables(name, camera):
                print_table(table)
            for sentence in camera.kept:
                note(f"{name}: {sentence}")
        for rig in told.rigs.values():
            print_table(extrinsics_table(rig))
        if holds:
            typer.echo(f"{folder / FITTED_FILE}: written")
        typer.echo(f"open {folder / PAGE}")
    if not holds:
        for fault in told.faults:
            print_error(fault, label="check failed")
        note(f"{folder / FITTED_FILE}: not written")
        raise typer.Exit(1)


def report(folder: FolderArgument, as_json: Json = False) -> None:
    """Evaluate a run, and show it on a page that opens from disk: report.html; also one without truth."""
    from nir_render.command.terminal.console import print_json
    from nir_render.run.evaluate import evaluate_run
    from nir_render.run.recording.report import report_recording
    from nir_render.run.report import report_run

    has_truth = (folder / "truth.jsonl").is_file()
    page = report_run(folder, evaluate_run(folder)) if has_truth else report_recording(folder)
    if as_json:
        print_json({"folder": str(folder), "report": str(page)})
    else:
        typer.echo(f"open {page}")


def _render(
    scene: "Scene",
    output: Path | None,
    overwrite: bool,
    threads: int | None,
    keep_light: bool,
    cache: "LightCache",
) -> Path:
    from nir_render.command.terminal.console import warn
    from nir_render.command.terminal.progress import progress_bar
    from nir_render.run.folder import check_free
    from nir_render.run.render import calibrations_of, render_run

    _say_what_is_lowered(scene)
    folder = output if output is not None else Path("outputs") / scene.document.name
    check_free(folder, overwrite)
    use_threads(threads)
    with progress_bar("calibrate", compiles=True) as progress:
        calibrations = calibrations_of(scene, progress)
    with progress_bar("render", compiles=True) as progress:
        warnings = render_run(
            scene,
            folder,
            overwrite=overwrite,
            progress=progress,
            keep_light=keep_light,
            cache=cache,
            calibrations=calibrations,
        )
    for text in warnings:
        warn(text)
    return folder


def _say_what_is_lowered(scene: "Scene") -> None:
    """Tell, on standard error, where this machine renders with fewer samples than the scene asks for."""
    if not scene.document.has_indirect_light():
        return
    from nir_render.command.terminal.console import note
    from nir_render.transport.backend.variant import backend
    from nir_render.transport.indirect.stock import samples_of

    settings, used = scene.document.render, samples_of(scene.document.render.indirect)
    asked = settings.indirect.samples
    wanted = "what the target for the noise needs" if asked is None else str(asked)
    if not backend().vectorised and used != asked:
        note(
            f"no usable LLVM: indirect light with {used} samples per pixel instead of {wanted}; "
            "'nir-render doctor' says more"
        )


def _show_estimate(
    scene: "Scene", output: Path | None, overwrite: bool, threads: int | None, as_json: bool
) -> None:
    import dataclasses

    from nir_render.command.terminal.console import print_json
    from nir_render.run.folder import check_free
    from nir_render.run.time_estimate import time_estimate

    if output is not None:
        check_free(output, overwrite)
    use_threads(threads)
    guess = time_estimate(scene)
    if as_json:
        print_json({**dataclasses.asdict(guess), "seconds": guess.seconds})
        return
    typer.echo(
        f"about {guess.seconds:.0f} s: light for {guess.lights} views at {guess.seconds_per_light:.2f} s, "
        f"{guess.frames} frames at {guess.seconds_per_frame:.2f} s"
    )


def _show_evaluation(result: "Evaluation", folder: Path, as_json: bool) -> None:
    from nir_render.command.terminal.console import print_json
    from nir_render.command.terminal.tables import print_table, range_table, summary_table, time_tables

    if as_json:
        print_json(result.summary)
        return
    print_table(range_table(result))
    print_table(summary_table(result.summary))
    for table in time_tables(result.summary):
        print_table(table)
    typer.echo(f"{folder}: frames, truth, detections, summary.json, preview.png")
