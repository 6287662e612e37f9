"""Loops that are compiled, by one decorator.

NumPy's arrays are for what is done to many numbers at once; a fit that goes its own way in every window, or
a look at a pixel's neighbours, is a loop. Numba compiles it when it is first called and keeps the result on
disk, so that only the first call on a machine (`make setup` makes it) takes longer. The same code runs
without being compiled, far slower, where the variable NUMBA_DISABLE_JIT is set: to follow it in a debugger,
and for the test that holds that both find the same.

What is kept on disk is renewed when the file of a function changes, not when another does. So what its file
takes from others is a part of what a function is known by: constants, named tuples, and the files of
compiled functions.
"""

import hashlib
import types
import warnings
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import ParamSpec, TypeVar, cast

import numba
import numpy as np
from numba.core.dispatcher import Dispatcher

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def compiled(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Compile a function of numbers, arrays and named tuples of these; it lets other threads run.

    Sums are made in the order in which they are written, so that every processor finds the same.
    """
    known = _with_constants(cast("types.FunctionType", function))
    try:
        made = numba.njit(known, nogil=True, error_model="numpy", cache=True)
    except RuntimeError:
        warnings.warn(
            "there is no folder where perception's compiled loops may be kept: every start compiles them "
            "anew, for a minute; set NUMBA_CACHE_DIR to a folder that can be written",
            stacklevel=2,
        )
        made = numba.njit(known, nogil=True, error_model="numpy")
    return cast("Callable[Arguments, Result]", made)


def _with_constants(function: types.FunctionType) -> types.FunctionType:
    """Return a function with what it takes from other files in a closure, by which Numba knows it.

    These are constants, and the files of compiled functions, with all that these take.
    """
    held = tuple(
        (name, _told(value))
        for name, value in sorted(function.__globals__.items())
        if name.upper() == name or (isinstance(value, type) and hasattr(value, "_fields"))
    )
    # Of a helper that the same file defines below nothing is known here: so all that the file imports.
    taken = tuple(
        (name, _file_digest(own.__code__.co_filename), own.__closure__[-1].cell_contents)
        for name, value in sorted(function.__globals__.items())
        if isinstance(value, Dispatcher)
        and (own := value.py_func).__code__.co_filename != function.__code__.co_filename
    )
    # Numba itself does not tell apart what it was asked for here.
    known = hashlib.sha256(repr((held, taken, _file_digest(__file__))).encode()).hexdigest()
    code = function.__code__
    code = code.replace(co_freevars=(*code.co_freevars, "constants"))
    closure = (*(function.__closure__ or ()), types.CellType(known))
    made = types.FunctionType(code, function.__globals__, function.__name__, function.__defaults__, closure)
    made.__doc__, made.__module__, made.__qualname__ = (
        function.__doc__,
        function.__module__,
        function.__qualname__,
    )
    made.__annotations__ = function.__annotations__
    return made


def _told(value: object) -> object:
    """Return what tells a constant, or a named tuple, from others."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    return value._fields if isinstance(value, type) and hasattr(value, "_fields") else value


@lru_cache(maxsize=64)
def _file_digest(path: str) -> str:
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()
