"""Compiled loops: kept on disk by file, and the same without the compiler."""

import importlib
import json
import os
import pkgutil
import subprocess
import sys

import pytest
from numba.core.dispatcher import Dispatcher

import perception

MODULES = [info.name for info in pkgutil.walk_packages(perception.__path__, "perception.")]

DETECT = """
import json
import perception
from tests.unit.perception.simulation import calibration, expected_e, expose, random

small = calibration(width_px=56, height_px=40, cx_px=20.0, cy_px=20.0, sigma={"psf_sigma_px": 0.01})
sources = [(12.2, 10.7, 14.0), (13.9, 11.8, 15.0), (40.3, 20.6, 12.0), (55.4, 32.0, 16.0)]
frame = expose(expected_e(small, sources, 3e-3, 4.0), small, random(71), 3e-3)
frame.data_dn[33, 20] = 4095
hits = perception.detect(frame, small)
print(json.dumps([[h.u_px, h.v_px, h.flux_dn, h.range_m, h.range_sigma_m, h.saturated] for h in hits]))
"""


def _detected(**variables: str) -> list[list[float]]:
    done = subprocess.run(
        [sys.executable, "-c", DETECT],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **variables},
    )
    return list(json.loads(done.stdout))


def test_a_frame_is_read_alike_without_the_compiler() -> None:
    """A clipped flare, two that overlap, one at the edge, a stuck pixel: to a millionth."""
    compiled, plain = _detected(), _detected(NUMBA_DISABLE_JIT="1")
    assert len(compiled) >= 4
    assert [hit[:5] for hit in compiled] == [pytest.approx(hit[:5], rel=1e-6, nan_ok=True) for hit in plain]
    assert [hit[5] for hit in compiled] == [hit[5] for hit in plain]


@pytest.mark.parametrize("name", MODULES)
def test_compiled_functions_call_those_of_their_own_file(name: str) -> None:
    """What is kept of a function on disk does not know when another file changes."""
    functions = [
        each for each in vars(importlib.import_module(name)).values() if isinstance(each, Dispatcher)
    ]
    for function in functions:
        code, known = function.py_func.__code__, function.py_func.__globals__
        called = [known[each] for each in code.co_names if isinstance(known.get(each), Dispatcher)]
        strangers = [
            each.py_func.__name__ for each in called if each.py_func.__module__ != function.py_func.__module__
        ]
        assert not strangers, f"{function.py_func.__name__} calls {strangers}"
