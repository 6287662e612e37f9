"""Benchmarks are run by their path, where their own folder comes first of what Python imports."""

from tests.paths import ROOT


def test_no_benchmark_hides_a_package() -> None:
    """Beside `benchmarks/perception.py`, `python benchmarks/camera.py` found no package `perception`."""
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert {"nir_render", "perception"} <= packages
    assert not packages & {path.stem for path in (ROOT / "benchmarks").glob("*.py")}
