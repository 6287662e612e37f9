"""What the commands share: how they show progress, warnings and errors, and print JSON."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

__all__ = ["errors", "escape", "print_json", "progress_bar", "warn"]

errors = Console(stderr=True, highlight=False)
"""Standard error: everything that is not what was asked for."""

_LINE_EVERY_S = 30.0
_AVERAGED_OVER_S = 600.0  # of the rate: some work takes minutes each


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int], None]]:
    """Show a bar with rate and time left on standard error; yield the function that moves it.

    Its first call says what is done already. Where no one watches, it is a line now and then.
    """
    columns = (TextColumn(f"{what:<9}"), BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn())
    with Progress(
        *columns, console=errors, transient=not errors.is_terminal, speed_estimate_period=_AVERAGED_OVER_S
    ) as bar:
        task = bar.add_task(what, total=None)
        began = said = time.monotonic()
        first: int | None = None

        def move(done: int, total: int) -> None:
            nonlocal began, said, first
            now = time.monotonic()
            if first is None:
                first, began = done, now
                bar.reset(task, completed=done, total=total)  # what was done before has no part in the rate
            bar.update(task, completed=done, total=total)
            if not errors.is_terminal and now - said > _LINE_EVERY_S and first < done < total:
                said = now
                left_s = (now - began) / (done - first) * (total - done)
                errors.print(
                    f"{what}: {done} of {total}, {_rate((done - first) / (now - began))}, "
                    f"about {left_s:.0f} s left"
                )

        yield move


class _Rate(ProgressColumn):
    """How many are done in a second, or in a minute."""

    def render(self, task: Task) -> Text:
        return Text("" if not task.speed else _rate(task.speed), style="progress.data.speed")


def _rate(per_s: float) -> str:
    return f"{per_s:.1f}/s" if per_s >= 1.0 else f"{60.0 * per_s:.1f}/min"


def warn(text: str) -> None:
    """Tell the user of something that did not stop the work."""
    errors.print(f"[bold yellow]warning:[/] {escape(text)}", soft_wrap=True)


def print_json(document: Any) -> None:
    """Print one JSON object on standard output."""
    typer.echo(json.dumps(document, allow_nan=False))
