"""What the goniometer leaves: a source that loads, tables that others read, figures, a memory of what it did."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from nir_render import InputError
from nir_render.run.goniometer import measure_into as stage
from nir_render.run.goniometer.formats import ies_text, pattern_csv
from nir_render.scene.documents.built.source import BuiltSource
from nir_render.scene.documents.emitters import PatternDocument, Source
from nir_render.scene.load import load_built
from nir_render.transport.goniometer import measure as measuring
from nir_render.transport.goniometer.goniogram import Goniogram, variation
from nir_render.transport.goniometer.measure import Settings, measure
from tests.system.command import nir_render

TILTED = """
flux: 100 mW
spectrum: {gaussian: {centroid: 940 nm, fwhm: 42 nm}}
dies:
  - {half_angle: 40 deg, direction: [1, 0, 1], position: "[1, 0, 0] mm", radius: 0.3 mm, share: 2}
  - {half_angle: 40 deg, direction: [0, -1, 1]}
board: {radius: 8 mm, reflectance: 0.5}
"""


@pytest.fixture(autouse=True)
def _memory_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stage, "KEPT", tmp_path / "kept" / "goniometer.json")


def _tilted(folder: Path) -> Path:
    file = folder / "tilted.yaml"
    file.write_text(TILTED, encoding="utf-8")
    return file


def test_it_leaves_a_source_that_scenes_use(tmp_path: Path) -> None:
    """Pattern, table and preset are one: the values of each are those that were counted."""
    file = _tilted(tmp_path)
    settings = Settings(photons=200_000, azimuths=12)
    figures = stage.measure_into(str(file), tmp_path / "out", settings)
    gram = measure(load_built(str(file)), settings)
    source = Source.model_validate(yaml.safe_load((tmp_path / "out" / "source.yaml").read_text("utf-8")))
    assert source.flux_w == pytest.approx(0.1 * gram.left / gram.photons, rel=1e-5)
    assert source.radius_m == pytest.approx(1.3e-3)
    by_file = PatternDocument.model_validate({"file": "pattern.csv"}, context={"folder": tmp_path / "out"})
    assert source.pattern is not None
    assert source.pattern.grid is not None
    assert by_file.grid == source.pattern.grid
    values = np.array(source.pattern.grid.values)
    assert values == pytest.approx(gram.intensity_per_sr / gram.intensity_per_sr.max(), rel=1e-4)
    assert values[9, 0] > 1.5 * values[9, 9] > 3.0 * values[9, 4]  # towards x, −y, and neither
    assert figures == json.loads((tmp_path / "out" / "goniometer.json").read_text("utf-8"))
    assert sum(figures["shares"].values()) == pytest.approx(1.0, abs=1e-5)
    assert figures["azimuthal_spread"] > 0.5
    assert (tmp_path / "out" / "polar.png").read_bytes().startswith(b"\x89PNG")


def test_the_photometric_file_says_what_was_measured(tmp_path: Path) -> None:
    """LM-63-2002, type C: counts of angles, then as many values, whose integral over the sphere is the flux."""
    built = load_built(str(_tilted(tmp_path)))
    gram = measure(built, Settings(photons=200_000, azimuths=12))
    lines = ies_text("tilted", built, gram, "2026-01-01").split("\r\n")
    assert lines[0] == "IESNA:LM-63-2002"
    assert max(map(len, lines)) <= 256
    numbers = [float(word) for line in lines[lines.index("TILT=NONE") + 1 :] for word in line.split()]
    _, lumens, _, vertical, horizontal, kind, unit = numbers[:7]
    assert (lumens, vertical, horizontal, kind, unit) == (-1, 37, 13, 1, 2)
    numbers = numbers[13:]
    assert numbers[:37] == [5.0 * step for step in range(37)]
    assert numbers[37:50] == [30.0 * step for step in range(13)]
    values = np.array(numbers[50:]).reshape(13, 37)
    assert (values[0] == values[12]).all()
    weights = np.sin(np.radians(numbers[:37])) * math.radians(5.0) * math.radians(30.0)
    leaving_mw = 100.0 * gram.left / gram.photons
    assert leaving_mw < 99.5  # the board takes some
    assert (values[:12] @ weights).sum() == pytest.approx(leaving_mw, rel=0.003)  # a sum at nodes


def test_counts_are_kept_and_found_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = tmp_path / "kept.json"
    built, settings = load_built("bare"), Settings(photons=60_000)
    first = measure(built, settings, cache=kept)
    monkeypatch.setattr("nir_render.transport.goniometer.photons.trace", None)  # nothing is traced again
    again = measure(built.model_copy(update={"flux_w": 3.0}), settings, cache=kept)
    assert (first.near == again.near).all()
    assert first.left == again.left
    with pytest.raises(TypeError):
        measure(built, Settings(photons=60_001), cache=kept)
    kept.write_text("{", encoding="utf-8")
    with pytest.raises(TypeError):
        measure(built, settings, cache=kept)


def test_threads_and_batches_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    built, settings = load_built("diffused"), Settings(photons=2_000)
    whole = measure(built, settings)
    monkeypatch.setattr(measuring, "_BATCH", 300)
    parts = measure(built, settings)
    assert (whole.near == parts.near).all()
    assert (whole.far == parts.far).all()


def _flat(counts: list[int]) -> Goniogram:
    near = np.array(counts)[:, None]
    return Goniogram(near, near, 1.0, int(near.sum()), 0, 0, 0)


def test_the_two_figures_of_a_pattern_that_is_known() -> None:
    """Even light varies by nothing; 1 + cos θ by what it has lost at 85°, in all three ways of saying so."""
    edges = np.clip((np.arange(38) - 0.5) * np.pi / 36, 0.0, np.pi)
    cosine = np.cos(edges)
    even = variation(_flat([round(1e12 * share) for share in (cosine[:-1] - cosine[1:]) / 2]))
    assert (even.peak_to_peak, even.plus_minus, even.about_mean) == pytest.approx((0, 0, 0), abs=1e-6)
    half = 0.5 * (cosine + 0.5 * cosine**2)
    falls = variation(_flat([round(1e12 * share) for share in half[:-1] - half[1:]]))
    edge = 0.5 * (1.0 + math.cos(math.radians(85.0)))
    turned = 0.5 * (1.0 + np.cos(np.radians(np.arange(-85, 86, 5))))
    assert falls.edge == pytest.approx(edge, rel=1e-3)
    assert falls.peak_to_peak == pytest.approx(1.0 - edge, abs=1e-3)
    assert falls.plus_minus == pytest.approx((1.0 - edge) / (1.0 + edge), abs=1e-3)
    assert falls.about_mean == pytest.approx(1.0 - edge / turned.mean(), abs=1e-3)


def test_the_value_at_a_pole_has_the_error_that_it_says() -> None:
    """Of 200 measurements of even light, each by counts of its own: spread and σ agree, and nothing is off."""
    random = np.random.default_rng(11)
    cosine = np.cos(np.clip((np.arange(38) - 0.5) * np.pi / 36, 0.0, np.pi))
    shares = (cosine[:-1] - cosine[1:]) / 2
    grams = [_flat(list(random.multinomial(2_000_000, shares))) for _ in range(200)]
    poles = np.array([gram.intensity_per_sr[0, 0] for gram in grams]) * 4.0 * np.pi
    sigma = np.mean([gram.sigma_per_sr[0, 0] for gram in grams]) * 4.0 * np.pi
    assert poles.mean() == pytest.approx(1.0, abs=4.0 * sigma / math.sqrt(200))
    assert poles.std() == pytest.approx(sigma, rel=0.2)
    raw = math.sqrt(1.0 / (2_000_000 * shares[0]))
    assert sigma == pytest.approx(0.43 * raw, rel=0.05)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cover": {"height": "9.5 mm"}}, "cover: height: the inside of the cover does not meet the board"),
        ({"cover": {"thickness": "0 mm"}}, "cover: thickness: wanted above 0 of a translucent cover"),
        ({"board": {"radius": "5 mm"}}, "board: wanted one that closes the cover, of 6 mm or more"),
        (
            {"dies": [{"half_angle": "60 deg", "position": "[0, 11, 3] mm"}]},
            "dies.0: is not inside the cover",
        ),
        ({"dies": [{}]}, "dies.0: wanted 'half_angle' or 'pattern', one of both"),
        (
            {"dies": [{"half_angle": "60 deg", "position": "[0, 0, -1] mm"}]},
            "dies.0: position: is below the board",
        ),
        (
            {"cover": {"material": {"scattering_length": "1 um"}}},
            "cover: scattering_length: the wall is more than 300",
        ),
        (
            {"cover": {"material": {"type": "diffuse_sheet", "transmittance": 0.9, "reflectance": 0.2}}},
            "cover.material: transmittance + reflectance is more than 1",
        ),
    ],
)
def test_what_cannot_be_built_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(yaml.safe_dump({"preset": "diffused", **change}), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        load_built(str(file))
    assert message in str(refused.value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nothing",), "there is no preset 'nothing' in built"),
        (("bare", "--step", "7"), "--step 7: wanted degrees that divide 180 evenly"),
        (("bare", "--distance", "0.01"), "distance 0.01 m: is too near"),
        (("bare", "--azimuths", "5"), "azimuths: 5 do not do; wanted an even number"),
        (("bare", "--azimuths", "1000000000000"), "wanted an even number from 2 to 3600"),
        (("missing.yaml",), "missing.yaml"),
    ],
)
def test_the_command_refuses(tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    done = nir_render("goniometer", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr


def test_the_command_prints_its_figures(tmp_path: Path) -> None:
    done = nir_render("goniometer", "bare", "--photons", "50000", "--json", cwd=tmp_path)
    assert done.returncode == 0
    figures = json.loads(done.stdout)
    assert figures["folder"] == "outputs/bare"
    assert figures["flux_w"] == 0.2
    again = nir_render("goniometer", "bare", "--photons", "50000", cwd=tmp_path)
    assert (again.returncode, "holds another run" in again.stderr) == (2, True)
    shown = nir_render("goniometer", "bare", "--photons", "50000", "--overwrite", cwd=tmp_path)
    assert "flux that leaves" in shown.stdout
    assert f"{100 * figures['variation']['peak_to_peak']:.1f} %" in shown.stdout


def test_a_source_that_is_the_same_all_around_has_one_column() -> None:
    built = load_built("bare")
    assert pattern_csv(measure(built, Settings(photons=1000))).count("\n") == 39
    moved = {"dies": (built.dies[0].model_copy(update={"position_m": (1e-3, 0.0, 0.0)}),)}
    aside: BuiltSource = built.model_copy(update=moved)
    assert measure(aside, Settings(photons=1000)).near.shape == (37, 24)


def test_noise_alone_varies_by_what_is_told() -> None:
    """300 000 photons of an even source, counted 200 times."""
    edges = np.clip((np.arange(38) - 0.5) * np.pi / 36, 0.0, np.pi)
    shares = (np.cos(edges)[:-1] - np.cos(edges)[1:]) / 2
    random = np.random.default_rng(5)
    found = [variation(_flat(list(random.multinomial(300_000, shares)))) for _ in range(200)]
    told = np.array([one.noise_alone for one in found])
    varied = np.array([one.peak_to_peak for one in found])
    error = varied.std() / math.sqrt(len(varied))
    assert told.mean() == pytest.approx(varied.mean(), abs=3.0 * error + 0.02 * varied.mean())
    assert 0.02 < varied.mean() < 0.1
