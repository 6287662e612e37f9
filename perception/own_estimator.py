"""One's own estimator: a function in a Python file, `file.py:function`, loaded and watched over.

Whatever goes wrong in code that somebody is still writing becomes one line that says where.
"""

import dataclasses
import importlib.util
import math
import operator
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from perception.pipeline import ESTIMATORS
from perception.types import Calibration, Detection, RawFrame


class EstimatorError(ValueError):
    """An estimator cannot be loaded, or failed on a frame; the text is one line."""


@dataclass(frozen=True)
class OwnEstimator:
    """An estimator of the user's own; calling it checks what comes back.

    `name` is the function's, and names the file of its detections; `reference` is what the user wrote,
    for error texts; `path` is the file that holds it.
    """

    name: str
    reference: str
    path: Path
    function: Callable[[RawFrame, Calibration], Iterable[Detection]]

    def __call__(self, frame: RawFrame, calibration: Calibration) -> list[Detection]:
        """Find the flares of one frame.

        The function gets counts of its own, which it may change. NumPy numbers in its detections become
        plain ones.

        Raises
        ------
        EstimatorError
            If the function raises, or returns anything but detections of this frame.
        """
        where = f"{self.reference}: frame {frame.index} of {frame.camera}"
        own = dataclasses.replace(frame, data_dn=frame.data_dn.copy())
        try:
            # A generator raises only while it is being read.
            found = self.function(own, calibration)
            listed = list(found) if isinstance(found, Iterable) else None
        except Exception as error:
            raise EstimatorError(f"{where}: {_said(error, self.path)}") from error
        if listed is None:
            raise EstimatorError(f"{where}: returned {_a(found)}; wanted a list of detections")
        return [_plain(detection, frame, where) for detection in listed]


def load_estimator(reference: str) -> OwnEstimator:
    """Load the function that `file.py:function` names.

    The file may import modules that lie beside it.

    Parameters
    ----------
    reference
        Path of a Python file, a colon, and the name of a function in it that takes a frame and its
        calibration and returns detections.

    Returns
    -------
    OwnEstimator

    Raises
    ------
    EstimatorError
        If there is no such file or function, it cannot be called, the file raises while it is imported,
        or the function's name cannot name a file of detections.
    """
    file, _, name = reference.rpartition(":")
    if not (file and name.isidentifier()):
        raise EstimatorError(f"{reference}: wanted file.py:function, such as my_estimator.py:brightest_blob")
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        raise EstimatorError(f"{reference}: the name may hold letters a to z, digits and _; rename it")
    if name.lower() in ESTIMATORS:
        raise EstimatorError(f"{reference}: {name.lower()!r} is an estimator that is built in; rename yours")
    path = Path(file)
    if not path.is_file():
        raise EstimatorError(f"{reference}: there is no file {file!r}")
    contents = _contents(path, reference)
    if name not in contents:
        raise EstimatorError(f"{reference}: there is no {name!r} in the file{_those_there(contents)}")
    function = contents[name]
    if not callable(function):
        raise EstimatorError(f"{reference}: {name!r} is {_a(function)}, which cannot be called")
    return OwnEstimator(name, reference, path, function)


def _contents(path: Path, reference: str) -> dict[str, Any]:
    """Import a file and return what it defines."""
    # A name that no other module has: a file may be called numpy.py.
    module_name = f"own_estimator_{path.stem}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None or spec.loader is None:
        raise EstimatorError(f"{reference}: {path.name!r} is no Python file; its name must end in .py")
    module = importlib.util.module_from_spec(spec)
    # Dataclasses with annotations look their module up while it is being imported.
    sys.modules[module_name] = module
    try:
        with _importing_from(path.parent):
            spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise EstimatorError(f"{reference}: importing it failed: {_said(error, path)}") from error
    finally:
        del sys.modules[module_name]
    return vars(module)


@contextmanager
def _importing_from(folder: Path) -> Iterator[None]:
    """Let modules that lie in a folder be imported; installed ones come first."""
    entry = str(folder.resolve())
    sys.path.append(entry)
    try:
        yield
    finally:
        sys.path.remove(entry)


def _plain(detection: object, frame: RawFrame, where: str) -> Detection:
    """Return a detection with plain numbers, or say what about it is wrong."""
    if not isinstance(detection, Detection):
        raise EstimatorError(f"{where}: returned {_a(detection)} among its detections; wanted a Detection")
    if (detection.camera, detection.index) != (frame.camera, frame.index):
        raise EstimatorError(
            f"{where}: returned a detection of frame {detection.index} of {detection.camera}; "
            "give it this frame's camera and index"
        )
    fields = {}
    for field in dataclasses.fields(Detection):
        value = getattr(detection, field.name)
        try:
            fields[field.name] = _KINDS[field.type](value) if field.type in _KINDS else value
        except (TypeError, ValueError) as error:
            raise EstimatorError(f"{where}: {field.name} of a detection is {value!r}: {error}") from None
    return Detection(**fields)


def _number(value: Any) -> float:
    number = float(value)
    if math.isinf(number):
        raise ValueError("wanted a finite number, or NaN where there is none")
    return number


def _vector(values: Any) -> tuple[float, float, float]:
    numbers = [_number(value) for value in values]
    if len(numbers) != 3:
        raise ValueError("wanted three numbers")
    return numbers[0], numbers[1], numbers[2]


_KINDS: dict[Any, Callable[[Any], Any]] = {
    float: _number,
    int: operator.index,
    bool: bool,
    tuple[float, float, float]: _vector,
}


def _said(error: BaseException, path: Path) -> str:
    """Say in one line what was raised, and in which line of the user's file."""
    text = " ".join(f"{type(error).__name__}: {error}".split())
    lines = [
        entry.lineno
        for entry in traceback.extract_tb(error.__traceback__)
        if Path(entry.filename).resolve() == path.resolve()
    ]
    return f"{text} ({path.name}, line {lines[-1]})" if lines else text


def _those_there(contents: dict[str, Any]) -> str:
    """List the functions that a file itself defines."""
    there = [
        name
        for name, value in contents.items()
        if callable(value)
        and not name.startswith("_")
        and getattr(value, "__module__", None) == contents["__name__"]
    ]
    return f"; it has {', '.join(there)}" if there else ""


def _a(value: object) -> str:
    return "None" if value is None else f"an object of type {type(value).__name__}"
