"""Code of the user's own, `file.py:function`: loaded, and told of in one line when it goes wrong."""

import importlib.util
import re
import sys
import traceback
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

_BESIDE: dict[Path, tuple[Path, ...]] = {}
"""By file of the user's: the files that lie beside it and that it has imported."""


def load_function(
    reference: str, kind: str, example: str, taken: Collection[str], error: type[ValueError]
) -> tuple[str, Path, Callable[..., Any]]:
    """Load the function that `file.py:function` names; the file may import modules that lie beside it.

    Parameters
    ----------
    reference
        What the user wrote.
    kind, example
        What it is to be, and what one may be called, for error texts.
    taken
        Names that are built in.
    error
        What is raised.

    Returns
    -------
    The function's name, the file, the function.

    Raises
    ------
    error
        If there is no such file or function, it cannot be called, the file raises while it is imported, or
        the function's name cannot name a file.
    """
    file, _, name = reference.rpartition(":")
    if not (file and name.isidentifier()):
        raise error(f"{reference}: wanted file.py:function, such as {example}")
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        raise error(f"{reference}: the name may hold letters a to z, digits and _; rename it")
    if name.lower() in taken:
        article = "an" if kind[0] in "aeiou" else "a"
        raise error(f"{reference}: {name.lower()!r} is {article} {kind} that is built in; rename yours")
    path = Path(file)
    if not path.is_file():
        raise error(f"{reference}: there is no file {file!r}")
    contents = _import_file(path, reference, error)
    if name not in contents:
        raise error(f"{reference}: there is no {name!r} in the file{_functions_listed(contents)}")
    function = contents[name]
    if not callable(function):
        raise error(f"{reference}: {name!r} is {kind_of(function)}, which cannot be called")
    return name, path, function


def files_of(path: Path) -> tuple[Path, ...]:
    """Return the files that a loaded one follows from: itself, and what it has imported from beside it."""
    return (path.resolve(), *_BESIDE.get(path.resolve(), ()))


def _import_file(path: Path, reference: str, error: type[ValueError]) -> dict[str, Any]:
    """Import a file and return what it defines."""
    # A name that no other module has: a file may be called numpy.py.
    module_name = f"own_code_{path.stem}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None or spec.loader is None:
        raise error(f"{reference}: {path.name!r} is no Python file; its name must end in .py")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses with annotations look their module up while it is being imported.
    sys.modules[module_name] = module
    try:
        with _importing_from(path.parent.resolve()) as beside:
            spec.loader.exec_module(module)
        _BESIDE[path.resolve()] = tuple(beside)
    except (Exception, SystemExit) as raised:
        raise error(f"{reference}: importing it failed: {error_line(raised, path)}") from raised
    finally:
        del sys.modules[module_name]
    return vars(module)


@contextmanager
def _importing_from(folder: Path) -> Iterator[list[Path]]:
    """Let modules that lie in a folder be imported, anew; installed ones come first.

    Modules of that folder, and those of the same names that lay beside another user's file, are set aside:
    versions of one's own code may be loaded one after the other, each with its own modules, in a process that
    lives long. Yields a list that holds the files imported from the folder, once the block has ended.
    """
    imported: list[Path] = []
    names = {beside.name for beside in folder.glob("*.py")}
    aside = {
        name: module
        for name, module, file in _plain_modules()
        if file.parent == folder or (file.name in names and str(file.parent) not in sys.path)
    }
    for name in aside:
        del sys.modules[name]
    sys.path.append(str(folder))
    try:
        yield imported
    finally:
        sys.path.remove(str(folder))
        imported += sorted({file for _, _, file in _plain_modules() if file.parent == folder})
        for name, module in aside.items():
            sys.modules.setdefault(name, module)


def _plain_modules() -> Iterator[tuple[str, ModuleType, Path]]:
    """Yield modules of one file each, called after it, by name; not those of packages."""
    for name, module in list(sys.modules.items()):
        file = getattr(module, "__file__", None)
        if file is not None and Path(file).name == f"{name}.py" and name != "__main__":
            yield name, module, Path(file).resolve()


def error_line(error: BaseException, path: Path) -> str:
    """Say in one line what was raised, and in which line of the user's file."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    lines = [
        entry.lineno
        for entry in traceback.extract_tb(error.__traceback__)
        if Path(entry.filename).resolve() == path.resolve()
    ]
    return f"{text} ({path.name}, line {lines[-1]})" if lines else text


def _functions_listed(contents: dict[str, Any]) -> str:
    """List the functions that a file itself defines."""
    there = [
        name
        for name, value in contents.items()
        if callable(value)
        and not name.startswith("_")
        and getattr(value, "__module__", None) == contents["__name__"]
    ]
    return f"; it has {', '.join(there)}" if there else ""


def kind_of(value: object) -> str:
    """Say what a value is, for an error text."""
    return "None" if value is None else f"an object of type {type(value).__name__}"
