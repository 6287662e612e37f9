"""Loops that are compiled, by one decorator.

NumPy's arrays are for what is done to many numbers at once; a fit that goes its own way in every window, or
a look at a pixel's neighbours, is a loop. Numba compiles it when it is first called and keeps the result on
disk, so that only the first call on a machine (`make setup` makes it) takes longer. The same code runs
without being compiled, far slower, where the variable NUMBA_DISABLE_JIT is set: to follow it in a debugger,
and for the test that holds that both find the same.

What is kept on disk is renewed when the file of a function changes, not when one does that it calls: so a
compiled function calls compiled functions of its own file alone (a test holds it).
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def compiled(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Compile a function of numbers, arrays and named tuples of these; it lets other threads run.

    Sums are made in the order in which they are written, so that every processor finds the same.
    """
    try:
        made = numba.njit(function, nogil=True, error_model="numpy", cache=True)
    except RuntimeError:  # there is no folder where it may be kept
        made = numba.njit(function, nogil=True, error_model="numpy")
    return cast("Callable[Arguments, Result]", made)
