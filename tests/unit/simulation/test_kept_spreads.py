"""What a rail has told of a point spread is kept on disk, and what needs no rail is known without it."""

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from nir_render import load_scene
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.emitters import Source
from nir_render.simulation import flare_spread as rail
from nir_render.simulation.calibration import calibration, calibration_without_rail
from nir_render.simulation.flare_spread import FlareSpread, flare_spread
from tests.paths import SCENES

GLARE = {
    "robots.r1.rig.cameras.front.point_spread.glare": {"share": "3 %", "core_radius": "3 px", "exponent": 2.5}
}
FOUND = FlareSpread(0.1 + 0.2, 1.0 / 3.0, 1e-3 / 7.0)


class Rail:
    """Stands in for the measuring: what was found is known, and how often it was asked."""

    def __init__(self) -> None:
        self.asked = 0

    def __call__(self, camera: Camera, source: Source, progress: rail.Progress | None) -> FlareSpread:
        self.asked += 1
        if progress is not None:
            progress(1, 1)
        return FOUND


@pytest.fixture
def measuring(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rail]:
    stand_in = Rail()
    monkeypatch.setattr(rail, "_measured", stand_in)
    monkeypatch.setattr(rail, "cache_file", lambda name: tmp_path / "cache" / name)
    rail._measurement.cache_clear()
    yield stand_in
    rail._measurement.cache_clear()


def devices(flux: str = "100 mW") -> tuple[Camera, Source]:
    scene = load_scene(SCENES / "one_source.yaml", GLARE | {"robots.r2.rig.sources.top.flux": flux})
    return scene.camera("r1.front")[1], scene.sources()["r2.top"][1]


def test_a_later_run_measures_nothing_and_has_the_same_bits(measuring: Rail, tmp_path: Path) -> None:
    """Three runs of one scene measure once; another source, or a damaged file, once more each."""
    told = []
    for _ in range(3):
        rail._measurement.cache_clear()  # as a new process has it
        assert flare_spread(*devices(), progress=lambda *step: told.append(step)) == FOUND
    assert (measuring.asked, told) == (1, [(1, 1)])
    flare_spread(*devices("50 mW"))
    assert measuring.asked == 2
    (file,) = (tmp_path / "cache").iterdir()
    for content in (file.read_text()[:-20], file.read_text().replace('"share"', '"colour"')):
        file.write_text(content)
        rail._measurement.cache_clear()
        assert flare_spread(*devices()) == FOUND
    assert measuring.asked == 4


def test_without_the_rail_all_but_three_numbers_are_known() -> None:
    scene = load_scene(SCENES / "one_source.yaml")
    whole, part = calibration(scene, "r1.front"), calibration_without_rail(scene, "r1.front")
    unknown = ["psf_sigma_px", "range_constant_dn_m2_per_s", "range_constant_paper_dn_m2_per_s"]
    for field in dataclasses.fields(whole):
        value, same = getattr(part, field.name), getattr(whole, field.name)
        if field.name in unknown:
            assert math.isnan(value)
            assert same > 0.0
        else:
            assert np.array_equal(value, same)
