"""Compiled loops: kept on disk by file, and the same without the compiler."""

import importlib
import json
import os
import pkgutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

import perception
from perception.compiled import _file_digest, _with_constants
from perception.types import RawFrame
from tests.unit.perception.simulation import calibration, random

MODULES = [info.name for info in pkgutil.walk_packages(perception.__path__, "perception.")]

DETECT = """
import json
import perception
from tests.unit.perception.simulation import calibration, expected_e, expose, random

small = calibration(width_px=44, height_px=36, cx_px=20.0, cy_px=20.0, sigma={"psf_sigma_px": 0.01})
sources = [(12.2, 10.7, 14.0), (13.9, 11.8, 15.0), (30.3, 20.6, 12.0)]
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
    """A clipped flare, two that overlap, a stuck pixel: to a millionth."""
    compiled, plain = _detected(), _detected(NUMBA_DISABLE_JIT="1")
    assert len(compiled) == 3
    assert [hit[:5] for hit in compiled] == [pytest.approx(hit[:5], rel=1e-6, nan_ok=True) for hit in plain]
    assert [hit[5] for hit in compiled] == [hit[5] for hit in plain]


def _functions() -> list[Dispatcher]:
    files = [vars(importlib.import_module(name)).values() for name in MODULES]
    return [each for file in files for each in file if isinstance(each, Dispatcher)]


def test_after_warming_up_no_frame_waits_for_the_compiler() -> None:
    """Frames that may not be written, as of a message, flipped ones, and calibrations of whole numbers or lists."""
    perception.warm_up()
    known = sum(len(function.signatures) for function in _functions())
    counts = np.frombuffer(random(72).poisson(80.0, (96, 128)).astype(np.uint16).tobytes(), np.uint16)
    rich = calibration(width_px=128, height_px=96, cx_px=60.0, cy_px=50.0)
    plain = replace(rich, psf_sigma_px=1, prnu=0, response_angle_rad=[0, 1.1], response_relative=[1, 1])  # type: ignore[arg-type]
    bent = replace(rich, lens_model="brown_conrady", distortion=(-0.1, 0, 0, 0))
    for data in (
        counts.reshape(96, 128),
        counts.reshape(96, 128)[::-1],
        np.asfortranarray(counts.reshape(96, 128)),
    ):
        brighter = np.array(data)
        brighter[40:44, 60:64] += 900
        brighter.setflags(write=False)
        for shown in (data, brighter):
            for one in (rich, plain, bent):
                perception.detect(RawFrame(rich.camera, 0, 0.0, 1e-3, shown, 64.0), one)
    assert sum(len(function.signatures) for function in _functions()) == known


def test_constants_of_other_files_tell_compiled_functions_apart() -> None:
    """What is kept of a function on disk is not used where a constant that its file imports has changed."""
    plain = {"np": np, "LIMIT": 3.0, "__name__": "loops"}
    source = "def clipped(x):\n    return min(x, LIMIT)\n"
    held = []
    for limit in (3.0, 3.0, 4.0):
        names = {**plain, "LIMIT": limit}
        exec(source, names)
        held.append(_with_constants(names["clipped"]).__closure__)  # type: ignore[arg-type]
    contents = [tuple(cell.cell_contents for cell in cells) for cells in held if cells is not None]
    assert contents[0] == contents[1] != contents[2]


def test_a_compiled_function_is_known_by_the_files_of_those_that_it_calls(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is kept of it is not used where one of these has changed, or one that they call themselves.

    Also where they are called by a helper that its own file defines below it.
    """
    monkeypatch.syspath_prepend(tmp_path)
    text = "from perception.compiled import compiled\n{}\n@compiled\ndef {}(x):\n    return {}\n"
    (tmp_path / "middle.py").write_text(text.format("from inner import inner", "middle", "inner(x)"))
    helper = "\n@compiled\ndef helper(x):\n    return middle(x)\n"
    outer_text = text.format("from middle import middle", "outer", "helper(x)") + helper
    (tmp_path / "outer.py").write_text(outer_text)
    held, found = [], []
    for factor in (2.0, 2.0, 3.25):  # of another length, or Python itself may take the old file
        (tmp_path / "inner.py").write_text(text.format("", "inner", f"{factor} * x"))
        _file_digest.cache_clear()
        importlib.invalidate_caches()
        for name in ("inner", "middle", "outer"):
            monkeypatch.delitem(sys.modules, name, raising=False)
        outer = importlib.import_module("outer").outer
        held.append(outer.py_func.__closure__[-1].cell_contents)
        found.append(outer(1.0))
    assert held[0] == held[1] != held[2]
    assert found == [2.0, 2.0, 3.25]
