"""The command nir-render: which commands there are, and with what status it ends.

Each command is thin: it reads arguments, calls one function, and shows what came back. What is heavy is
loaded within it, so that `--help` is there at once.

Exit status: 0 done, 1 the work failed or a check did not hold, 2 the input was wrong.
"""

import os
import signal
import sys
from typing import Annotated

import typer

from nir_render.command import recordings, regress, runs, scenes, stress
from nir_render.command.compare import compare
from nir_render.command.experiment import experiment
from nir_render.command.explain import explain
from nir_render.errors import InputError

app = typer.Typer(
    name="nir-render",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _show_version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        typer.echo(f"nir-render {version('nir-render')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Render raw frames of a narrowband near-infrared camera, and score what perception reads in them."""


for command in (
    *(runs.run, runs.render, runs.perceive, runs.evaluate, runs.calibrate, runs.report),
    explain,
    compare,
    recordings.export,
    *(stress.stress, experiment),
    *(scenes.new, scenes.validate, scenes.schema, scenes.look, scenes.goniometer, scenes.doctor),
):
    app.command()(command)
app.command("new-recording")(recordings.new_recording)
app.command("import")(recordings.import_recording)
app.add_typer(regress.app, name="regress")


def main() -> None:
    """Run the command; turn errors that a user can mend into their text and exit status 2."""
    # Asked to end, it ends as by Ctrl-C: what was written aside goes.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    # NumPy's library is told as it is loaded: on matrices as small as these its threads wait for each other,
    # and its sums depend on how many they are.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        app(prog_name="nir-render")
    except InputError as error:
        from nir_render.command.terminal.console import print_error

        for problem in error.problems:
            print_error(problem)
        sys.exit(2)


if __name__ == "__main__":
    main()
