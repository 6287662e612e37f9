"""The command nir-render. Thin: it reads arguments, calls one function, and shows what came back.

Exit status: 0 done, 1 the work failed or a check did not hold, 2 the input was wrong.
"""

import dataclasses
import json
import math
import shlex
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import yaml
from rich.console import Console
from rich.table import Table

from nir_render.console import errors, escape, print_json, progress_bar, warn
from nir_render.errors import InputError
from nir_render.regress.command import app as regress_app

if TYPE_CHECKING:
    from nir_render.scene.load import Scene
    from nir_render.transport.cache import LightCache
    from perception import Estimator

_MOST_WORKERS = 8  # by default: each takes a GiB or more

app = typer.Typer(
    name="nir-render",
    help="Render raw frames of a narrowband near-infrared camera, and score what perception reads in them.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.add_typer(regress_app, name="regress")

SceneArgument = Annotated[Path, typer.Argument(metavar="SCENE", help="A scene file (YAML).")]
FolderArgument = Annotated[Path, typer.Argument(metavar="DIR", help="A run folder.")]
Output = Annotated[
    Path | None,
    typer.Option("-o", "--output", metavar="DIR", help="Where the run goes; outputs/NAME by default."),
]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="PATH=VALUE", help='Change the scene: --set robots.r2.rig.sources.top.flux="0.1 W".'
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the run that the folder holds.")]
Seed = Annotated[int | None, typer.Option("--seed", min=0, help="Replaces the scene's seed.")]
Threads = Annotated[
    int | None, typer.Option("--threads", min=1, help="Threads to render with; all by default.")
]
Estimators = Annotated[
    list[str] | None,
    typer.Option(
        "--estimator",
        metavar="NAME",
        help="paper, robust, or one's own as file.py:function; paper and robust by default. Repeatable.",
    ),
]
KeepLight = Annotated[
    bool, typer.Option("--keep-light", help="Keep the light of each frame: spectral EXR and direct table.")
]
LightFolder = Annotated[
    Path | None,
    typer.Option(
        "--light-cache",
        metavar="DIR",
        help="Keep rendered light here, and render none that is here already; runs may share the folder.",
    ),
]
LightLimit = Annotated[
    float,
    typer.Option(
        "--light-cache-gib",
        help="How large that folder may grow; the least recently used goes first.",
    ),
]
Json = Annotated[
    bool, typer.Option("--json", help="Print one JSON object on standard output, and nothing else there.")
]


def main() -> None:
    """Run the command; turn errors that a user can mend into their text and exit status 2."""
    # Asked to end, it ends as by Ctrl-C: what was written aside goes.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        app()
    except InputError as error:
        for problem in error.problems:
            errors.print(f"[bold red]error:[/] {escape(problem)}", soft_wrap=True)
        sys.exit(2)


@app.command()
def run(
    scene: SceneArgument,
    output: Output = None,
    settings: Settings = None,
    estimators: Estimators = None,
    overwrite: Overwrite = False,
    seed: Seed = None,
    threads: Threads = None,
    keep_light: KeepLight = False,
    light_cache: LightFolder = None,
    light_cache_gib: LightLimit = 4.0,
    as_json: Json = False,
) -> None:
    """Render, perceive, evaluate and report a scene in one go."""
    from nir_render.run import evaluate_run, perceive_run, report_run

    chosen = _estimators(estimators)
    cache = _light_cache(light_cache, light_cache_gib)
    folder = _render(scene, output, settings, overwrite, seed, threads, keep_light, cache)
    with progress_bar("perceive") as progress:
        perceive_run(folder, estimators=chosen, progress=progress)
    result = evaluate_run(folder)
    page = report_run(folder, result)
    _show_evaluation(result, folder, as_json)
    if not as_json:
        typer.echo(f"open {page}")


@app.command()
def render(
    scene: SceneArgument,
    output: Output = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    seed: Seed = None,
    threads: Threads = None,
    keep_light: KeepLight = False,
    light_cache: LightFolder = None,
    light_cache_gib: LightLimit = 4.0,
    only_estimate: Annotated[
        bool,
        typer.Option("--estimate", help="Only say how long it takes without a cache, from small trials."),
    ] = False,
    as_json: Json = False,
) -> None:
    """Render the frames of a scene, with truth and calibration."""
    cache = _light_cache(light_cache, light_cache_gib)
    if only_estimate:
        _show_estimate(_load(scene, settings, seed), output, overwrite, threads, as_json)
        return
    folder = _render(scene, output, settings, overwrite, seed, threads, keep_light, cache)
    frames = len((folder / "frames.jsonl").read_text(encoding="utf-8").splitlines())
    if as_json:
        print_json({"folder": str(folder), "frames": frames})
    else:
        typer.echo(f"{frames} frames in {folder}; next: nir-render perceive {folder}")


@app.command()
def perceive(folder: FolderArgument, estimators: Estimators = None, as_json: Json = False) -> None:
    """Detect and range flares in the frames of any folder, also one recorded by a real camera."""
    from nir_render.run import perceive_run

    with progress_bar("perceive") as progress:
        counts = perceive_run(folder, estimators=_estimators(estimators), progress=progress)
    if as_json:
        print_json({"folder": str(folder), "detections": counts})
    else:
        for name, count in counts.items():
            typer.echo(f"{name}: {count} detections in {folder / f'detections.{name}.jsonl'}")


@app.command()
def evaluate(folder: FolderArgument, as_json: Json = False) -> None:
    """Score the detections of a run against its truth and the physical limit."""
    from nir_render.run import evaluate_run

    _show_evaluation(evaluate_run(folder), folder, as_json)


@app.command()
def calibrate(folder: FolderArgument, as_json: Json = False) -> None:
    """Fit the range constants to frames at known ranges; judge them on every other range, held out."""
    from nir_render.calibrate_run import FITTED_FILE, calibrate_run
    from nir_render.report.calibration_table import calibration_table

    with progress_bar("calibrate") as progress:
        cameras = calibrate_run(folder, progress)
    holds = not any(camera.faults for camera in cameras.values())
    if as_json:
        records = {name: camera.record() for name, camera in cameras.items()}
        print_json({"format": 1, "folder": str(folder), "holds": holds, "cameras": records})
    else:
        console = Console()
        for name, camera in cameras.items():
            console.print(calibration_table(name, camera))
        if holds:
            console.print(f"{folder / FITTED_FILE}: written", soft_wrap=True, highlight=False)
    if not holds:
        for name, camera in cameras.items():
            for fault in camera.faults:
                errors.print(f"[bold red]check failed:[/] {name}: {escape(fault)}", soft_wrap=True)
        errors.print(f"{folder / FITTED_FILE}: not written", soft_wrap=True)
        raise typer.Exit(1)


@app.command()
def report(folder: FolderArgument, as_json: Json = False) -> None:
    """Evaluate a run, and show it on a page that opens from disk: report.html."""
    from nir_render.run import evaluate_run, report_run

    page = report_run(folder, evaluate_run(folder))
    if as_json:
        print_json({"folder": str(folder), "report": str(page)})
    else:
        typer.echo(f"open {page}")


@app.command()
def stress(
    campaign: Annotated[Path, typer.Argument(metavar="CAMPAIGN", help="A campaign file (YAML).")],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Where it goes; outputs/NAME by default."),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            "--workers", min=1, help="Processes to work in; by default as many as cores, at most 8."
        ),
    ] = None,
    light_cache: LightFolder = None,
    light_cache_gib: LightLimit = 4.0,
    only_plan: Annotated[
        bool, typer.Option("--plan", help="Only check the campaign, and say how many jobs it has.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Sweep a scene along axes, and show where estimators fail; goes on where it was stopped."""
    from nir_render.report.campaign_words import verdict_lines
    from nir_render.stress.campaign import load_campaign
    from nir_render.stress.jobs import plan
    from nir_render.stress.summary import summary_of
    from nir_render.stress.sweep import StoppedError, cores, done_before, sweep, write_report

    known = load_campaign(campaign)
    light_limit_bytes = _light_limit_bytes(light_cache_gib)
    with progress_bar("check") as progress:
        jobs = plan(known, progress)
    folder = output if output is not None else Path("outputs") / known.name
    if only_plan:
        done = done_before(known, jobs, folder)
        lights = len({job.light for job in jobs})
        if as_json:
            print_json({"campaign": known.name, "jobs": len(jobs), "done": done, "geometries": lights})
        else:
            typer.echo(f"{known.name}: {len(jobs)} jobs in {lights} geometries; {done} are done in {folder}")
        return
    count = workers if workers is not None else min(cores(), _MOST_WORKERS)
    try:
        with progress_bar("stress") as progress:
            result = sweep(
                known,
                jobs,
                folder,
                workers=count,
                progress=progress,
                light=light_cache,
                light_limit_bytes=light_limit_bytes,
            )
    except StoppedError as stopped:
        again = escape(shlex.join(["nir-render", *sys.argv[1:]]))
        errors.print(f"{stopped}; the same command goes on: {again}", soft_wrap=True)
        raise typer.Exit(128 + signal.SIGINT) from None
    for text in result.warnings:
        warn(text)
    page = write_report(result)
    if as_json:
        counts = {"jobs": len(jobs), "done_before": result.reused, "failed": len(result.failed)}
        print_json({"format": 1, "folder": str(folder), **counts, **summary_of(known, result.table)})
    else:
        for line in verdict_lines(known, result.table):
            typer.echo(line)
        typer.echo(f"open {page}")
    if result.failed:
        for key, text in result.failed.items():
            errors.print(f"[bold red]job {key[:8]} failed:[/] {escape(text)}", soft_wrap=True)
        errors.print("the same command tries these again")
        raise typer.Exit(1)


@app.command()
def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder that is new or empty.")],
    as_json: Json = False,
) -> None:
    """Make a folder with commented example scenes to change, and an estimator of one's own."""
    from nir_render.examples import FIRST_SCENE, new_examples

    files = new_examples(folder)
    if as_json:
        print_json({"folder": str(folder), "files": files})
    else:
        typer.echo(f"{', '.join(files)} in {folder}")
        typer.echo(f"next: nir-render run {shlex.quote(str(folder / FIRST_SCENE))}")


@app.command()
def validate(
    scenes: Annotated[list[Path], typer.Argument(metavar="SCENE...", help="Scene and campaign files.")],
    as_json: Json = False,
) -> None:
    """Check scene and campaign files: every error names file, line, field and what was wanted."""
    from nir_render.scene.load import load_scene
    from nir_render.stress.campaign import is_campaign, load_campaign

    problems: list[str] = []
    valid: list[str] = []
    for path in scenes:
        try:
            load_campaign(path) if is_campaign(path) else load_scene(path)
            valid.append(str(path))
        except InputError as error:
            problems += error.problems
    if as_json:
        print_json({"valid": valid, "errors": problems})
    else:
        for name in valid:
            typer.echo(f"{name}: valid")
    if problems:
        raise InputError(*problems)


@app.command()
def schema(
    campaign: Annotated[bool, typer.Option("--campaign", help="That of campaigns instead.")] = False,
) -> None:
    """Print the JSON Schema of scene files, for editors."""
    from nir_render.scene.schema import scene_schema
    from nir_render.stress.schema import campaign_schema

    typer.echo(json.dumps(campaign_schema() if campaign else scene_schema(), indent=2))


@app.command()
def doctor(as_json: Json = False) -> None:
    """Say what this machine renders with, and hold a tiny render against its closed form."""
    from nir_render.doctor import examine

    report = examine()
    if as_json:
        print_json(report)
    else:
        table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
        for key, value in report.items():
            table.add_row(key.replace("_", " "), escape(str(value)))
        Console().print(table)
    if not report["check_holds"]:
        raise typer.Exit(1)


def _load(path: Path, settings: list[str] | None, seed: int | None) -> "Scene":
    from nir_render.scene.load import load_scene

    overrides = dict(map(_setting, settings or []))
    return load_scene(path, overrides if seed is None else {**overrides, "seed": seed})


def _say_what_is_lowered(scene: "Scene") -> None:
    """Tell, on standard error, where this machine renders with fewer samples than the scene asks for."""
    if not scene.document.has_indirect_light():
        return
    from nir_render.transport.backend import backend
    from nir_render.transport.stock import samples_of

    settings, used = scene.document.render, samples_of(scene)
    asked = settings.indirect.samples
    wanted = "what the target for the noise needs" if asked is None else str(asked)
    if not backend().vectorised and used != asked:
        errors.print(
            f"no usable LLVM: indirect light with {used} samples per pixel instead of {wanted}; "
            "'nir-render doctor' says more",
            soft_wrap=True,
        )


def _show_estimate(
    scene: "Scene", output: Path | None, overwrite: bool, threads: int | None, as_json: bool
) -> None:
    from nir_render.estimate import estimate
    from nir_render.run_folder import check_free
    from nir_render.transport.backend import set_threads

    if output is not None:
        check_free(output, overwrite)
    if threads is not None:
        set_threads(threads)
    guess = estimate(scene)
    if as_json:
        print_json({**dataclasses.asdict(guess), "seconds": guess.seconds})
        return
    typer.echo(
        f"about {guess.seconds:.0f} s: light for {guess.lights} views at {guess.seconds_per_light:.2f} s, "
        f"{guess.frames} frames at {guess.seconds_per_frame:.2f} s"
    )


def _render(
    path: Path,
    output: Path | None,
    settings: list[str] | None,
    overwrite: bool,
    seed: int | None,
    threads: int | None,
    keep_light: bool,
    cache: "LightCache",
) -> Path:
    from nir_render.run import render_run
    from nir_render.run_folder import check_free
    from nir_render.transport.backend import set_threads

    scene = _load(path, settings, seed)
    _say_what_is_lowered(scene)
    folder = output if output is not None else Path("outputs") / scene.document.name
    check_free(folder, overwrite)
    if threads is not None:
        set_threads(threads)
    with progress_bar("render") as progress:
        warnings = render_run(
            scene, folder, overwrite=overwrite, progress=progress, keep_light=keep_light, cache=cache
        )
    for text in warnings:
        warn(text)
    return folder


def _light_cache(folder: Path | None, limit_gib: float) -> "LightCache":
    from nir_render.transport.cache import LightCache

    return LightCache(folder, limit_bytes=_light_limit_bytes(limit_gib), say=warn)


def _light_limit_bytes(limit_gib: float) -> int:
    if not (math.isfinite(limit_gib) and limit_gib > 0.0):
        raise InputError(f"--light-cache-gib {limit_gib:g}: wanted a size above 0, in GiB, such as 4")
    return int(limit_gib * 2**30)


def _setting(text: str) -> tuple[str, Any]:
    path, equals, value = text.partition("=")
    if not equals or not path:
        raise InputError(
            f'--set {text}: wanted PATH=VALUE, such as --set robots.r2.rig.sources.top.flux="0.1 W"'
        )
    try:
        return path.strip(), _yaml_value(value)
    except yaml.YAMLError:
        raise InputError(f"--set {text}: {value!r} is no YAML value") from None


def _yaml_value(text: str) -> Any:
    """Read a value as YAML does, but leave a vector with its unit as the text that it is."""
    if text.lstrip().startswith("[") and not text.rstrip().endswith("]"):
        return text.strip()
    return yaml.safe_load(text)


def _estimators(names: list[str] | None) -> "dict[str, Estimator]":
    from nir_render.run import chosen_estimators
    from perception import ESTIMATORS

    return chosen_estimators(names or list(ESTIMATORS))


def _show_evaluation(result: Any, folder: Path, as_json: bool) -> None:
    from nir_render.report.tables import range_table, summary_table

    if as_json:
        print_json(result.summary)
        return
    console = Console()
    console.print(range_table(result))
    console.print(summary_table(result.summary))
    console.print(
        f"{folder}: frames, truth, detections, summary.json, preview.png", soft_wrap=True, highlight=False
    )


if __name__ == "__main__":
    main()
