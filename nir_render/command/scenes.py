"""The commands of scene files and of the machine that renders them: new, validate, schema, doctor."""

import shlex
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nir_render.command.options import Json
from nir_render.errors import InputError

if TYPE_CHECKING:
    from typing import Any


def new(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A folder that is new or empty.")],
    as_json: Json = False,
) -> None:
    """Make a folder with commented example scenes to change, and an estimator of one's own."""
    from nir_render.command.console import print_json
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
    from nir_render.command.console import print_json
    from nir_render.scene.load import load_scene
    from nir_render.stress.campaign import is_campaign, load_campaign

    valid: list[str] = []
    problems: list[str] = []
    for file in files:
        try:
            load_campaign(file) if is_campaign(file) else load_scene(file)
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


def doctor(as_json: Json = False) -> None:
    """Say what this machine renders with, and hold a tiny render against its closed form."""
    from nir_render.command.console import print_json
    from nir_render.command.tables import facts_table, print_table
    from nir_render.run.doctor import examine

    facts = examine()
    if as_json:
        print_json(facts)
    else:
        print_table(facts_table(facts))
    if not facts["check_holds"]:
        raise typer.Exit(1)
