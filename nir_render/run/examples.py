"""The example scenes that come with the package, for who installed it alone."""

import shutil
from pathlib import Path

from nir_render.errors import InputError
from nir_render.run.folder import disk_error, write_file

FIRST_SCENE = "one_source.yaml"
"""The scene to run first: it takes a second."""

_KINDS = (".yaml", ".json", ".py", ".cpp", ".obj", ".png")
_LEFT_OUT = {
    "__pycache__",
    "references",
}  # references of the regression suite: made anew where they are wanted


def examples_folder() -> Path:
    """Return where the examples lie: in an installed package within it, in a checkout beside it.

    Raises
    ------
    FileNotFoundError
        They are in neither place.
    """
    package = Path(__file__).parents[1]
    for folder in (package / "data" / "scenes", package.parent / "scenes"):
        if (folder / FIRST_SCENE).is_file():
            return folder
    raise FileNotFoundError(f"the example scenes of the package in {package} are missing; install it again")


def new_examples(folder: Path) -> list[str]:
    """Copy the examples into a new or empty folder; returns their names.

    Raises
    ------
    InputError
        The folder holds something already, or cannot be written.
    """
    if folder.is_file():
        raise InputError(f"{folder}: is a file; give a new or empty folder")
    is_new = not folder.exists()
    if not is_new and any(folder.iterdir()):
        raise InputError(f"{folder}: holds files already; give a new or empty folder")
    source = examples_folder()
    files = sorted(
        path
        for path in source.rglob("*")
        if path.suffix in _KINDS and not _LEFT_OUT.intersection(path.relative_to(source).parts)
    )
    names = [path.relative_to(source).as_posix() for path in files]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(folder, error) from None
    try:
        for path, name in zip(files, names, strict=True):
            write_file(folder / name, path.read_bytes())
    except InputError:
        # Half a set of examples would make the next attempt refuse the folder.
        for left in folder.iterdir():
            shutil.rmtree(left) if left.is_dir() else left.unlink()
        if is_new:
            folder.rmdir()
        raise
    return names
