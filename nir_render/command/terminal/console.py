"""What the commands print: JSON on standard output; errors, warnings and notes on standard error."""

import json
from functools import cache
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from rich.console import Console


@cache
def standard_error() -> "Console":
    """Return the console of everything that is not what was asked for."""
    from rich.console import Console

    return Console(stderr=True, highlight=False)


def print_error(text: str, label: str = "error") -> None:
    """Tell the user what went wrong."""
    _print_labelled(f"[bold red]{label}:[/]", text)


def warn(text: str) -> None:
    """Tell the user of something that did not stop the work."""
    _print_labelled("[bold yellow]warning:[/]", text)


def note(text: str) -> None:
    """Tell the user something on standard error."""
    standard_error().print(text, soft_wrap=True, markup=False)


def print_json(document: Any) -> None:
    """Print one JSON object on standard output."""
    typer.echo(json.dumps(document, allow_nan=False))


def _print_labelled(label: str, text: str) -> None:
    from rich.markup import escape

    standard_error().print(f"{label} {escape(text)}", soft_wrap=True)
