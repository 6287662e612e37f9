"""The bar that long commands show: how much is done, at what rate, and how long the rest takes."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

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

from nir_render.command.terminal.console import note, standard_error

_LINE_EVERY_S = 30.0
_AVERAGED_OVER_S = 600.0  # of the rate: some work takes minutes each
_SLOW_AFTER_S = 8.0
_COMPILES = (
    "still at the first; where nir_render is newly installed it compiles its loops now, once: about a minute"
)


@contextmanager
def progress_bar(label: str, *, compiles: bool = False) -> Iterator[Callable[[int, int], None]]:
    """Show a bar with rate and time left on standard error; yield the function that moves it.

    The bar appears with the first call, which says what is done already. Where no one watches, it is a line
    now and then. Where the work `compiles` what it runs, and nothing is done for long, a line says so.
    """
    console = standard_error()
    columns = (TextColumn(f"{label:<9}"), BarColumn(), MofNCompleteColumn(), _Rate(), TimeRemainingColumn())
    bar = Progress(
        *columns, console=console, transient=not console.is_terminal, speed_estimate_period=_AVERAGED_OVER_S
    )
    task = bar.add_task(label, total=None)
    started_s = last_line_s = time.monotonic()
    done_before: int | None = None
    patience = threading.Timer(_SLOW_AFTER_S, lambda: note(f"{label}: {_COMPILES}"))
    patience.daemon = True

    def move(done: int, total: int) -> None:
        nonlocal started_s, last_line_s, done_before
        now_s = time.monotonic()
        if done_before is None:
            done_before, started_s = done, now_s
            bar.start()
            bar.reset(task, completed=done, total=total)  # what was done before has no part in the rate
        if done > done_before:
            patience.cancel()
        bar.update(task, completed=done, total=total)
        if not console.is_terminal and now_s - last_line_s > _LINE_EVERY_S and done_before < done < total:
            last_line_s = now_s
            rate = (done - done_before) / (now_s - started_s)
            left_s = (total - done) / rate
            note(f"{label}: {done} of {total}, {_rate_text(rate)}, about {left_s:.0f} s left")

    if compiles:
        patience.start()
    try:
        yield move
    finally:
        patience.cancel()
        if done_before is not None:
            bar.stop()


class _Rate(ProgressColumn):
    """How many are done in a second, or in a minute."""

    def render(self, task: Task) -> Text:
        return Text("" if not task.speed else _rate_text(task.speed), style="progress.data.speed")


def _rate_text(per_s: float) -> str:
    return f"{per_s:.1f}/s" if per_s >= 1.0 else f"{60.0 * per_s:.1f}/min"
