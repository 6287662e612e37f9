"""The wheel carries all that the packages read from beside their code."""

import tomllib
import zipfile
from email import message_from_bytes
from pathlib import Path

import yaml
from hatchling.builders.wheel import WheelBuilder

from tests.paths import ROOT


def test_the_wheel_carries_templates_presets_and_examples(tmp_path: Path) -> None:
    (wheel,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    with zipfile.ZipFile(wheel) as packed:
        names = set(packed.namelist())
        (about,) = (packed.read(name) for name in names if name.endswith(".dist-info/METADATA"))
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
    for example in (ROOT / "scenes").rglob("*.yaml"):
        assert f"nir_render/data/{example.relative_to(ROOT).as_posix()}" in names
    assert {"nir_render/data/scenes/my_estimator.py", "nir_render/data/scenes/pallet.obj"} < names
    assert {"sun", "export", "cluster", "s3", "test"} <= set(
        message_from_bytes(about).get_all("Provides-Extra", [])
    )


def test_who_cites_the_package_names_its_version_and_licence() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert (cited["version"], cited["license"]) == (project["version"], project["license"])
