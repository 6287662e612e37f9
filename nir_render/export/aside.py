"""The folder of an export: written aside, so that nothing of an earlier one stays in it."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

from nir_render.run.folder import new_run_folder, write_file

_SIGN = ".nir_render_export"  # tells what we wrote, and may replace, from what is another's


@contextlib.contextmanager
def export_folder(folder: Path, overwrite: bool) -> Iterator[Path]:
    """Give an empty folder to write an export into; it takes its place when the block ends without an error.

    Raises
    ------
    InputError
        The place holds another export and `overwrite` is not given, or holds something that is no export, or
        cannot be written.
    """
    with new_run_folder(folder, overwrite, sign=_SIGN, of="export") as aside:
        yield aside
        write_file(aside / _SIGN, b"an export of nir_render, which --overwrite replaces\n")
