"""The command that holds two runs, or two estimators of one, against each other: compare."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from nir_render.command.options import Json

if TYPE_CHECKING:
    from nir_render.compare.compare import Comparison

_WIDEST = 32
_SHORT = {"no difference seen": "none seen", "too few frames": "too few"}
_STYLES = {"better": "green", "worse": "bold red", "differs": "yellow"}


def compare(
    first: Annotated[Path, typer.Argument(metavar="RUN", help="A run folder with truth and detections.")],
    second: Annotated[
        Path | None, typer.Argument(metavar="RUN", help="Another of the same scene, such as after a change.")
    ] = None,
    estimators: Annotated[
        str | None,
        typer.Option(
            "--estimators",
            metavar="A[,B]",
            help="A of the first run against B of the second, or two of one run; by default all that both "
            "have.",
        ),
    ] = None,
    page: Annotated[
        Path | None,
        typer.Option("--page", metavar="FILE", help="Where the page goes; compare.html in the last RUN."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Hold two runs, or two estimators of one, against each other: what is better or worse, and how sure."""
    from nir_render.command.terminal.console import print_json, warn
    from nir_render.compare.compare import compare_runs
    from nir_render.compare.page import PAGE, write_page

    names = [name.strip() for name in estimators.split(",")] if estimators else []
    result = compare_runs(first, second, names)
    target = page if page is not None else (second if second is not None else first) / PAGE
    write_page(result, target)
    if as_json:
        print_json({**result.record(), "page": str(target)})
        return
    for text in result.pairing.notes:
        warn(text)
    _show(result)
    typer.echo(f"open {target}")


def _show(result: "Comparison") -> None:
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    from nir_render.command.terminal.tables import print_table
    from nir_render.compare.words import counts_sentence, has_content, interval_text, row_of, sentence_of

    for pair in result.estimators:
        labels = result.sides(pair)
        title = pair.first if pair.first == pair.second else f"{pair.first} against {pair.second}"
        table = Table(
            title=f"{escape(title)}, {len(pair.frames)} frames",
            title_justify="left",
            box=box.SIMPLE_HEAD,
            padding=(0, 1, 0, 0),
            pad_edge=False,
        )
        headings = ("figure", *labels, "difference (95 %)", "verdict", "would see")
        for heading in headings:
            table.add_column(
                escape(heading),
                justify="left" if heading in ("figure", "verdict") else "right",
                no_wrap=heading != "difference (95 %)",
                max_width=_WIDEST,
            )
        for compared in pair.all_figures:
            if has_content(compared):
                title, first, second, *_, least, _ = row_of(compared)
                said = _SHORT.get(compared.verdict, compared.verdict)
                style = _STYLES.get(compared.verdict)
                said = f"[{style}]{said}[/]" if style else said
                title = title.replace(" per frame", "\nper frame")
                table.add_row(title, first, second, interval_text(compared, difference=True), said, least)
        print_table(table)
        recall = next(compared for compared in pair.figures if compared.figure.name == "recall")
        typer.echo(
            f"{sentence_of(pair.all_figures, pair.identical)} {counts_sentence(recall)}".rstrip() + "\n"
        )
