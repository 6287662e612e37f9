"""The wheel carries all that the packages read from beside their code."""

import zipfile
from pathlib import Path

from hatchling.builders.wheel import WheelBuilder

from tests.paths import ROOT


def test_the_wheel_carries_templates_presets_and_examples(tmp_path: Path) -> None:
    (wheel,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    with zipfile.ZipFile(wheel) as packed:
        names = set(packed.namelist())
    beside = {
        file.relative_to(ROOT).as_posix()
        for package in ("nir_render", "perception")
        for file in (ROOT / package).rglob("*")
        if file.is_file() and file.suffix != "" and "__pycache__" not in file.parts
    }
    assert {
        "nir_render/report/base.html",
        "nir_render/stress/page/page.html",
        "nir_render/regress/check.html",
    } < beside
    assert beside <= names
    assert "nir_render/data/scenes/empty.yaml" in names
