"""The package as a whole: its face, the examples in its docstrings, and what importing it loads."""

import doctest
import importlib
import pkgutil
import subprocess
import sys

import numpy as np
import pytest

import perception

MODULES = ["perception", *(found.name for found in pkgutil.walk_packages(perception.__path__, "perception."))]


def test_public_face() -> None:
    assert all(hasattr(perception, name) for name in perception.__all__)


@pytest.mark.parametrize("name", MODULES)
def test_examples_in_docstrings_run(name: str) -> None:
    with np.printoptions(legacy=False):  # another test's library may have changed how arrays are shown
        assert doctest.testmod(importlib.import_module(name)).failed == 0


def test_there_are_examples() -> None:
    shown = {name for name in MODULES if doctest.testmod(importlib.import_module(name)).attempted}
    assert shown >= {"perception", "perception.estimators", "perception.model.lens"}


def test_importing_it_loads_nothing_heavy() -> None:
    """What a robot pays at start: NumPy and Numba. OpenCV and most of SciPy come with the first frame."""
    code = (
        "import sys, perception; print({'cv2', 'scipy.special', 'matplotlib'} & {*sys.modules} or 'nothing')"
    )
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == "nothing"
