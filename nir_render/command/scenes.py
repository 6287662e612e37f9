"""The commands of scene files and of the machine that renders them: new, validate, schema, doctor."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from nir_render.command.options import Json
from nir_render.errors import InputError


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


def schema(
    campaign: Annotated[bool, typer.Option("--campaign", help="That of campaigns instead.")] = False,
) -> None:
    """Print the JSON Schema of scene files, for editors."""
    import json

    if campaign:
        from nir_render.stress.campaign import campaign_schema as written_schema
    else:
        from nir_render.scene.schema import scene_schema as written_schema
    typer.echo(json.dumps(written_schema(), indent=2))


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
