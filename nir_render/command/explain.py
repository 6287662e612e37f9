"""The command that tells a scene's photon budget without rendering: explain."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nir_render.command.options import Json, SceneArgument, Settings, read_scene
from nir_render.errors import InputError

if TYPE_CHECKING:
    from nir_render.budget.budget import Budget
    from nir_render.report.parts import Table


def explain(
    scene: SceneArgument,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Write explain.html and explain.json there."),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the explain.html and explain.json that are there.")
    ] = False,
    time_s: Annotated[
        float, typer.Option("--time", metavar="S", help="When robots are looked at, in seconds.")
    ] = 0.0,
    assume: Annotated[
        list[str] | None,
        typer.Option(
            "--assume",
            metavar="NAME=VALUE",
            help="What the scene does not say: wall_reflectance, led_temperature, unit_flux, "
            'unit_wavelength, field_angle, such as led_temperature="5 K". Repeatable.',
        ),
    ] = None,
    settings: Settings = None,
    as_json: Json = False,
) -> None:
    """Tell electrons, saturation, σ of ranges by cause, ambient light and eye safety, without rendering."""
    from nir_render.budget.assumptions import assumptions_of
    from nir_render.budget.budget import photon_budget
    from nir_render.budget.page import check_free, write_budget
    from nir_render.command.terminal.console import print_json
    from nir_render.command.terminal.progress import progress_bar

    if not math.isfinite(time_s):
        raise InputError(f"--time {time_s:g}: wanted seconds, such as 2.5")
    if output is not None and not overwrite:
        check_free(output)
    assumed = assumptions_of(assume or [])
    world = read_scene(scene, settings, None)
    with progress_bar("point spread") as progress:
        budget = photon_budget(world, time_s, assumed, progress)
    page = None if output is None else write_budget(budget, output)
    if as_json:
        print_json({**budget.record(), "page": None if page is None else str(page)})
        return
    _show(budget)
    if page is not None:
        typer.echo(f"open {page}")


def _show(budget: "Budget") -> None:
    from nir_render.budget.page import camera_sentence
    from nir_render.budget.tables import (
        alike,
        ambient_table,
        cause_table,
        eye_table,
        fog_sentence,
        range_table,
        source_sentences,
        view_table,
        view_title,
    )

    if budget.fog is not None:
        typer.echo(f"{fog_sentence(budget.fog)}\n")
    for camera in budget.cameras:
        name = alike(camera.cameras)
        typer.echo(f"{name}: {camera_sentence(camera)}\n")
        for source in camera.sources:
            first = [curve for curve in source.curves if curve.exposure == camera.exposures[0]]
            typer.echo(f"{alike(source.sources)}: {source_sentences(source)}")
            for curve in source.curves:
                if curve.place.name == "axis":
                    _print(
                        range_table(curve),
                        f"{alike(source.sources)} before {name}, {curve.exposure}, on the axis",
                    )
            _print(cause_table(first[:1]), "What makes a range uncertain")
        if camera.in_view:
            _print(view_table(camera), view_title(camera))
        if camera.ambient:
            _print(ambient_table(camera), f"Other light before {name}")
    if budget.eye_safety:
        _print(eye_table(budget), "Eye safety by IEC 62471: of the exempt group's limits")


def _print(table: "Table", title: str) -> None:
    from rich import box
    from rich.markup import escape
    from rich.table import Table as RichTable

    from nir_render.command.terminal.tables import print_table

    shown = RichTable(
        title=escape(title), title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), pad_edge=False
    )
    for number, heading in enumerate(table.headings):
        shown.add_column(
            escape(heading), justify="left" if number == 0 else "right", overflow="fold", no_wrap=number == 0
        )
    for row in table.rows:
        shown.add_row(*map(escape, row))
    print_table(shown)
