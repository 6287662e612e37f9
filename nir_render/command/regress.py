"""The commands of a regression suite: create, check and update its references."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nir_render.command.options import Json

if TYPE_CHECKING:
    from nir_render.regress.findings import Check

app = typer.Typer(
    help="Regression image sets: references of a suite of scenes, and what has drifted from them.",
    no_args_is_help=True,
)

Suite = Annotated[Path, typer.Argument(metavar="SUITE", help="A folder of scene files.")]
Refs = Annotated[
    Path | None,
    typer.Option("--refs", metavar="DIR", help="The folder of references; SUITE/references by default."),
]
Renders = Annotated[
    int, typer.Option("--renders", help="Renders that each reference is the mean of, 8 or more.")
]

_WORDS = {"pass": "[green]pass[/]", "fail": "[bold red]FAIL[/]", "skipped": "[yellow]skipped[/]"}


@app.command()
def create(suite: Suite, refs: Refs = None, renders: Renders = 16, as_json: Json = False) -> None:
    """Make the references of a suite that has none."""
    from nir_render import regress
    from nir_render.command.terminal.console import print_json
    from nir_render.command.terminal.progress import progress_bar

    with progress_bar("create") as progress:
        scenes = regress.create(suite, refs, renders=renders, progress=progress)
    if as_json:
        print_json({"suite": str(suite), "created": list(scenes)})
    else:
        typer.echo(f"references of {', '.join(scenes)}; next: nir-render regress check {suite}")


@app.command()
def check(
    suite: Suite,
    refs: Refs = None,
    seed: Annotated[
        int | None,
        typer.Option("--seed", min=0, help="Of the light: another draw of the render's noise."),
    ] = None,
    page: Annotated[
        Path | None, typer.Option("--page", metavar="FILE", help="Show what was found on a page (HTML).")
    ] = None,
    as_json: Json = False,
) -> None:
    """Hold a suite against its references: 0 nothing drifted, 1 something did."""
    from nir_render import regress
    from nir_render.command.terminal.console import print_json
    from nir_render.command.terminal.progress import progress_bar

    with progress_bar("check") as progress:
        result = regress.check(suite, refs, seed=seed, progress=progress)
    if page is not None:
        from nir_render.regress.page import check_page
        from nir_render.run.folder import write_file

        write_file(page, check_page(result).encode())
    if as_json:
        print_json(result.record())
    else:
        _show(result)
        if page is not None:
            typer.echo(f"open {page}")
    if not result.holds:
        raise typer.Exit(1)


@app.command()
def update(
    suite: Suite,
    reason: Annotated[str, typer.Option("--reason", help="Why, for those who come after.")],
    refs: Refs = None,
    every: Annotated[bool, typer.Option("--all", help="Make all anew, also what has not drifted.")] = False,
    page: Annotated[
        Path | None,
        typer.Option(
            "--page", metavar="FILE", help="Where old, new and difference are shown; in outputs by default."
        ),
    ] = None,
    renders: Annotated[
        int | None,
        typer.Option(
            "--renders", help="Renders of each new reference, 8 or more; as many as before by default."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Make references anew where something has drifted or a scene has changed; show old and new."""
    from nir_render import regress
    from nir_render.command.terminal.console import print_json
    from nir_render.command.terminal.progress import progress_bar

    page = Path("outputs") / "regress" / f"{suite.resolve().name}.html" if page is None else page
    with progress_bar("update") as progress:
        done = regress.update(suite, reason, refs, every=every, page=page, renders=renders, progress=progress)
    if as_json:
        print_json(
            {
                "suite": str(suite),
                "made": list(done.made),
                "kept": list(done.kept),
                "removed": list(done.removed),
                "page": str(page) if done.changed else None,
            }
        )
        return
    if not done.changed:
        typer.echo("nothing has drifted and no scene has changed: the references stay as they are")
        return
    for word, names in (("made", done.made), ("kept", done.kept), ("removed", done.removed)):
        if names:
            typer.echo(f"{word}: {', '.join(names)}")
    typer.echo(f"open {page}")


def _show(result: "Check") -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from nir_render.regress.findings import percent

    table = Table(title_justify="left")
    table.add_column("scene", no_wrap=True)
    table.add_column("what")
    table.add_column("", no_wrap=True)
    table.add_column("seen")
    table.add_column("would have seen")
    for scene in result.scenes:
        for finding in scene.findings:
            same = ", same bits" if finding.same_bits else ""
            table.add_row(
                scene.name,
                f"{finding.stage}: {escape(finding.what)}",
                _WORDS[finding.verdict],
                escape(finding.seen) + same,
                escape(finding.detectable),
                end_section=finding is scene.findings[-1],
            )
    console = Console()
    console.print(table)
    for scene in result.scenes:
        for change in scene.changes:
            console.print(f"{scene.name}: {escape(change)}", soft_wrap=True, highlight=False)
    for change in result.versions:
        console.print(f"not as of the references: {escape(change)}", soft_wrap=True, highlight=False)
    failed = [scene.name for scene in result.scenes if not scene.holds]
    console.print(
        f"[bold red]drifted: {', '.join(failed)}[/]" if failed else "[green]nothing drifted[/]",
        highlight=False,
    )
    console.print(
        f"A drift 'would have been seen' with a chance of 95 %; a check of equal renders finds one in "
        f"{percent(result.false_alarm_rate)} of cases.",
        soft_wrap=True,
        highlight=False,
    )
