"""Examples in public docstrings are true: they run."""

import doctest
import importlib

import numpy as np
import pytest

from tests.paths import ROOT

SHOWING = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for path in sorted((ROOT / "nir_render").rglob("*.py"))
    if ">>> " in path.read_text(encoding="utf-8")
]


@pytest.mark.mitsuba
@pytest.mark.parametrize("module", SHOWING)
def test_examples_run(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)  # examples load scenes/
    with np.printoptions(legacy=False):  # another test's library may have changed how arrays are shown
        done = doctest.testmod(importlib.import_module(module))
    assert done.attempted > 0
    assert done.failed == 0


def test_the_ways_into_the_program_have_examples() -> None:
    assert {"nir_render.scene.scene", "nir_render.scene.snapshot", "nir_render.simulation.clock"} <= set(
        SHOWING
    )
