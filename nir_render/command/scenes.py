"""The commands of scene files, what stands in them, and the machine that renders them.

They are new, validate, schema, look, goniometer, doctor.
"""

import math
import shlex
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nir_render.command.options import Json, Overwrite, SceneArgument, Settings, read_scene
from nir_render.errors import InputError

if TYPE_CHECKING:
    from typing import Any


def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder that is new or empty.")],
    as_json: Json = False,
) -> None:
    """Make a folder with commented example scenes to change, and an estimator of one's own."""
    from nir_render.command.terminal.console import print_json
    from nir_render.run.examples import FIRST_SCENE, new_examples

    files = new_examples(folder)
    if as_json:
        print_json({"folder": str(folder), "files": files})
    else:
        typer.echo(f"{', '.join(files)} in {folder}")
        typer.echo(f"next: nir-render run {shlex.quote(str(folder / FIRST_SCENE))}")


def validate(
    files: Annotated[list[Path], typer.Argument(metavar="SCENE...", help="Scene and campaign files.")],
    as_json: Json = False,
) -> None:
    """Check scene and campaign files: every error names file, line, field and what was wanted."""
    from nir_render.command.terminal.console import print_json
    from nir_render.stress.campaign import is_campaign, load_campaign

    valid: list[str] = []
    problems: list[str] = []
    for file in files:
        try:
            load_campaign(file) if is_campaign(file) else _check_scene(file)
            valid.append(str(file))
        except InputError as error:
            problems += error.problems
    if as_json:
        print_json({"valid": valid, "errors": problems})
    else:
        for name in valid:
            typer.echo(f"{name}: valid")
    if problems:
        raise InputError(*problems)


def _check_scene(file: Path) -> None:
    from nir_render.scene.documents.materials import curves_of
    from nir_render.scene.load import load_scene

    scene = load_scene(file)
    if any(curves_of(material) for material in scene.document.materials.values()):
        # Whether curves reach as far as cameras see, emitters and filters tell.
        from nir_render.transport.wavelengths import carried_wavelengths

        world = scene.at(scene.document.clock.start_s)
        for camera in scene.cameras():
            carried_wavelengths(world, camera)


class Format(StrEnum):
    """What there is a schema of."""

    SCENE = "scene"
    CAMPAIGN = "campaign"
    RECORDING = "recording"
    CALIBRATION = "calibration"
    FRAMES = "frames"
    DETECTIONS = "detections"


def schema(
    of: Annotated[Format, typer.Argument(metavar="FORMAT", help=", ".join(Format))] = Format.SCENE,
    campaign: Annotated[bool, typer.Option("--campaign", help="As FORMAT campaign.")] = False,
) -> None:
    """Print the JSON Schema of scene files, for editors, or of another format."""
    import json

    typer.echo(json.dumps(_schema_of(Format.CAMPAIGN if campaign else of), indent=2))


def _schema_of(of: Format) -> "dict[str, Any]":
    if of is Format.CAMPAIGN:
        from nir_render.stress.campaign import campaign_schema

        return campaign_schema()
    if of is Format.RECORDING:
        from nir_render.run.recording.document import recording_schema

        return recording_schema()
    if of is Format.SCENE:
        from nir_render.scene.schema import scene_schema

        return scene_schema()
    from perception.files.schema import calibration_schema, detections_schema, frames_schema

    by_name = {
        Format.CALIBRATION: calibration_schema,
        Format.FRAMES: frames_schema,
        Format.DETECTIONS: detections_schema,
    }
    return by_name[of]()


def look(
    scene: SceneArgument,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FILE", help="A PNG; outputs/NAME.look.png by default."),
    ] = None,
    time_s: Annotated[float, typer.Option("--time", metavar="S", help="When, in seconds.")] = 0.0,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """Draw a scene from outside and from above, in seconds: to check it by before it is rendered."""
    from nir_render.command.terminal.console import print_json
    from nir_render.look.sheet import look_png
    from nir_render.run.folder import write_file

    if not math.isfinite(time_s):
        raise InputError(f"--time {time_s:g}: wanted seconds, such as 2.5")
    file = output or Path("outputs") / f"{scene.stem}.look.png"
    if file.suffix.lower() != ".png":
        raise InputError(f"-o {file}: a picture is written as .png; name it such as {file.stem}.png")
    picture = look_png(read_scene(scene, settings, None), time_s)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_file(file, picture)
    if as_json:
        print_json({"picture": str(file)})
    else:
        typer.echo(f"open {file}")


def goniometer(
    source: Annotated[
        str, typer.Argument(metavar="SOURCE", help="A source as built: bare, diffused, or a .yaml file.")
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Where it goes; outputs/NAME by default."),
    ] = None,
    photons: Annotated[int, typer.Option("--photons", min=1000, help="How many are sent.")] = 4_000_000,
    step_deg: Annotated[
        float, typer.Option("--step", metavar="DEG", help="Between polar angles; a whole part of 180.")
    ] = 5.0,
    azimuths: Annotated[
        int, typer.Option("--azimuths", help="Around the axis, of what is not the same all around it.")
    ] = 24,
    distance_m: Annotated[
        float, typer.Option("--distance", metavar="M", help="From its middle to where it is measured.")
    ] = 1.0,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the photons' random numbers.")] = 1,
    overwrite: Overwrite = False,
    as_json: Json = False,
) -> None:
    """Measure a source as it is built over the sphere: an emission pattern that scenes use, and its flux."""
    from nir_render.command.terminal.console import print_json
    from nir_render.command.terminal.progress import progress_bar
    from nir_render.run.goniometer.measure_into import SOURCE, measure_into
    from nir_render.transport.goniometer.measure import Settings

    folder = output or Path("outputs") / Path(source).stem
    settings = Settings(photons, seed, _steps(step_deg), azimuths, distance_m)
    with progress_bar("goniometer") as progress:
        figures = measure_into(source, folder, settings, overwrite=overwrite, progress=progress)
    if as_json:
        print_json({**figures, "folder": str(folder)})
        return
    _show_goniometer(figures)
    typer.echo(f"{folder / SOURCE} stands for it in scenes; open {folder / 'polar.png'}")


def _steps(step_deg: float) -> int:
    steps = 180.0 / step_deg if math.isfinite(step_deg) and step_deg > 0.0 else 0.0
    if steps < 2.0 or abs(steps - round(steps)) > 1e-6:
        raise InputError(f"--step {step_deg:g}: wanted degrees that divide 180 evenly, such as 5")
    return round(steps)


def _show_goniometer(figures: "dict[str, Any]") -> None:
    from rich.table import Table

    from nir_render.command.terminal.tables import print_table

    table = Table(title=f"{figures['source']}, at {figures['distance_m']:g} m", title_justify="left")
    table.add_column("")
    table.add_column("as built", justify="right")
    bare = figures["variation_without_cover"]
    if bare is not None:
        table.add_column("without cover", justify="right")
    own = figures["variation"]
    reach = f"{own['reach_deg']:g}°"
    for key, label in (
        ("peak_to_peak", f"varies over ±{reach} by (max − min)/max"),
        ("plus_minus", "± about the middle, (max − min)/(max + min)"),
        ("about_mean", "largest difference from the mean"),
        ("edge", f"at {reach}, of that on the axis"),
    ):
        others = [] if bare is None else [f"{100.0 * bare[key]:.1f} %"]
        table.add_row(label, f"{100.0 * own[key]:.1f} %", *others)
    others = [] if bare is None else [f"{100.0 * bare['noise_alone']:.2g} %"]
    table.add_row("noise alone would vary by", f"{100.0 * own['noise_alone']:.2g} %", *others)
    shares = figures["shares"]
    table.add_row("flux that leaves", f"{1e3 * figures['flux_w']:.4g} mW, {100.0 * shares['left']:.1f} %")
    taken = f"{100.0 * shares['absorbed_in_board']:.1f} %, {100.0 * shares['absorbed_in_cover']:.2f} %"
    table.add_row("taken by board, cover", taken)
    if figures["azimuthal_spread"] is not None:
        table.add_row(f"± around the axis, within {reach}", f"{100.0 * figures['azimuthal_spread']:.1f} %")
    print_table(table)


def doctor(as_json: Json = False) -> None:
    """Say what this machine renders with, and hold a tiny render against its closed form."""
    from nir_render.command.terminal.console import print_json
    from nir_render.command.terminal.tables import facts_table, print_table
    from nir_render.run.doctor import examine

    facts = examine()
    if as_json:
        print_json(facts)
    else:
        print_table(facts_table(facts))
    if not facts["check_holds"]:
        raise typer.Exit(1)
