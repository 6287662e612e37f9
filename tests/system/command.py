"""The command nir-render as people call it: in this process, or in one of its own.

A start of Python and its imports take longer than most calls do, so a process of its own is for what a process
is: its first imports, its threads, its limits.
"""

import contextlib
import io
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest import mock

from nir_render.command.main import main
from tests.paths import ROOT

SCENE = str(ROOT / "scenes" / "one_source.yaml")
QUICK = ("--set", "clock.frames=2")

Done = subprocess.CompletedProcess[str]


def nir_render(*arguments: str, cwd: Path) -> Done:
    """Call the command in a folder, in this process; an error that is no `InputError` comes through as it is."""
    said, complained, status = io.StringIO(), io.StringIO(), 0
    asked_to_end = signal.getsignal(signal.SIGTERM)
    with (
        contextlib.chdir(cwd),
        mock.patch.object(sys, "argv", ["nir-render", *arguments]),
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(complained),
    ):
        try:
            main()
        except SystemExit as end:
            status = int(end.code or 0)
        finally:
            signal.signal(signal.SIGTERM, asked_to_end)
    return subprocess.CompletedProcess(arguments, status, said.getvalue(), complained.getvalue())


def nir_render_process(*arguments: str, cwd: Path, **more: Any) -> Done:
    """Call the command in a folder, in a process of its own, where warnings are errors."""
    command = [
        sys.executable,
        "-W",
        "error",
        "-c",
        "from nir_render.command.main import main; main()",
        *arguments,
    ]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False, timeout=240, **more)
