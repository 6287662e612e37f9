"""The goniometer against closed forms: lobes, sheets, faces and slabs whose light is known without it."""

import math
from typing import Any

import numpy as np
import pytest
from scipy import stats

from nir_render.scene.documents.built.source import BuiltSource
from nir_render.transport.goniometer.goniogram import Goniogram, variation
from nir_render.transport.goniometer.measure import Settings, measure
from nir_render.transport.goniometer.photons import _met

SPECTRUM = {"gaussian": {"centroid": "940 nm", "fwhm": "42 nm"}}
UPWARDS = {"points": [["0 deg", 1], ["90 deg", 1], ["90.001 deg", 0], ["180 deg", 0]]}
BLACK = {"radius": "10 mm", "reflectance": 0}


def _built(**keys: Any) -> BuiltSource:
    return BuiltSource.model_validate(
        {"flux": "1 W", "spectrum": SPECTRUM, "dies": [{"half_angle": "60 deg"}], **keys}
    )


def _measured(photons: int, polar_steps: int = 36, **keys: Any) -> Goniogram:
    return measure(_built(**keys), Settings(photons=photons, seed=5, polar_steps=polar_steps))


def _edges_rad(gram: Goniogram) -> np.ndarray[Any, Any]:
    """Where the rings of cells end, shape (n_polar + 1,)."""
    steps = len(gram.near) - 1
    return np.clip((np.arange(steps + 2) - 0.5) * np.pi / steps, 0.0, np.pi)


def _chi2(counts: Any, share: Any) -> float:
    """The probability of counts as far as these from their expected shares, among those of at least 10."""
    expected = share * counts.sum()
    kept = expected >= 10.0
    square = float(((counts[kept] - expected[kept]) ** 2 / expected[kept]).sum())
    return float(stats.chi2.sf(square, int(kept.sum()) - 1))


@pytest.mark.parametrize("half_angle_deg", [60.0, 20.0, 85.0])
def test_a_die_alone_has_its_lobe(half_angle_deg: float) -> None:
    """cos^n with n = ln ½ / ln cos: a ring from a to b gets cos^(n+1) a − cos^(n+1) b of the flux."""
    gram = _measured(1_000_000, dies=[{"half_angle": f"{half_angle_deg} deg"}])
    power = math.log(0.5) / math.log(math.cos(math.radians(half_angle_deg))) + 1.0
    passed = np.clip(np.cos(_edges_rad(gram)), 0.0, 1.0) ** power
    assert _chi2(gram.far.sum(axis=1), passed[:-1] - passed[1:]) > 1e-3
    assert (gram.far == gram.near).all()  # the die is a point, at the middle
    assert gram.left == gram.photons


def test_a_lobe_by_points_and_dies_beside_each_other() -> None:
    """Two dies, one along z and one along −x with three times its share: their shares, and where they are."""
    points = [["0 deg", 1], ["10 deg", 1], ["20 deg", 0], ["180 deg", 0]]
    dies = [
        {"pattern": {"points": points}},
        {"pattern": {"points": points}, "direction": [-1, 0, 0], "share": 3, "position": "[0, 0, 1] mm"},
    ]
    gram = _measured(400_000, polar_steps=180, dies=dies)
    up, aside = gram.far[:25].sum(), gram.far[65:116].sum()
    assert up + aside == gram.photons
    assert up / gram.photons == pytest.approx(0.25, abs=4.0 * math.sqrt(0.25 * 0.75 / gram.photons))
    assert gram.far[90].argmax() == gram.far.shape[1] // 2
    fine = np.radians(np.linspace(0.0, 20.0, 200_001))
    flux = np.interp(fine, np.radians([10.0, 20.0]), [1.0, 0.0]) * np.sin(fine)
    summed = np.interp(_edges_rad(gram), fine, np.concatenate([[0.0], np.cumsum(flux[1:])]) / flux[1:].sum())
    assert _chi2(gram.far[:22].sum(axis=1), np.diff(summed)[:22]) > 1e-3


def test_a_sheet_over_a_hemisphere_is_seen_by_its_projected_area() -> None:
    """Lit evenly from its centre each part of it shines as Lambert has it: I = Φ (1 + cos θ) / 4π, 0.54 at 85°."""
    cover = {"radius": "10 mm", "material": {"type": "diffuse_sheet", "transmittance": 1, "reflectance": 0}}
    gram = _measured(1_000_000, dies=[{"pattern": UPWARDS}], board=BLACK, cover=cover)
    cosine = np.cos(_edges_rad(gram))
    known = 0.5 * (cosine + 0.5 * cosine**2)
    assert _chi2(gram.far.sum(axis=1), known[:-1] - known[1:]) > 1e-3
    assert variation(gram).edge == pytest.approx(0.5 * (1.0 + math.cos(math.radians(85.0))), abs=0.01)


def test_light_between_a_sheet_and_the_board_is_a_sum_of_bounces() -> None:
    """Half of what any point of a hemisphere sends evenly meets its floor: Φ_sheet = 1 / (1 − R (1 + ρ) / 2)."""
    passed, back, board = 0.3, 0.6, 0.7
    material = {"type": "diffuse_sheet", "transmittance": passed, "reflectance": back}
    gram = _measured(
        1_000_000,
        dies=[{"pattern": UPWARDS}],
        board={"radius": "10 mm", "reflectance": board},
        cover={"radius": "10 mm", "material": material},
    )
    on_sheet = 1.0 / (1.0 - 0.5 * back * (1.0 + board))
    shares = np.array([gram.left, gram.in_cover, gram.in_board]) / gram.photons
    known = np.array([passed, 1.0 - passed - back, 0.5 * back * (1.0 - board)]) * on_sheet
    assert known.sum() == pytest.approx(1.0)
    assert shares == pytest.approx(known, abs=4.0 * math.sqrt(0.25 / gram.photons))


def test_a_clear_shell_passes_what_two_faces_leave() -> None:
    """From its centre all light meets it straight: (1 − r) / (1 + r), and goes on as it was."""
    cover = {"radius": "10 mm", "thickness": "1 mm", "material": {"type": "translucent", "index": 1.6}}
    gram = _measured(400_000, board=BLACK, cover=cover)
    one_face = (0.6 / 2.6) ** 2
    known = (1.0 - one_face) / (1.0 + one_face)
    assert gram.left / gram.photons == pytest.approx(known, abs=4.0 * math.sqrt(known / gram.photons / 8.0))
    passed = np.clip(np.cos(_edges_rad(gram)), 0.0, 1.0) ** 2
    assert _chi2(gram.far.sum(axis=1), passed[:-1] - passed[1:]) > 1e-3


def test_a_slab_passes_and_returns_what_van_de_hulst_tabulates() -> None:
    """μ_a 10 /cm, μ_s 90 /cm, g 0.75, 0.2 mm, no faces, a thin beam: T 0.66096, R 0.09739.

    (van de Hulst 1980, as quoted by Wang, Jacques and Zheng 1995 for MCML.) The slab is the top of a
    sphere of 10 m radius, 1.8 mm above a black board that takes all that comes back.
    """
    material = {
        "type": "translucent",
        "index": 1,
        "scattering_length": "0.111111111 mm",
        "albedo": 0.9,
        "g": 0.75,
    }
    cover = {"radius": "10 m", "thickness": "0.2 mm", "height": "-9.998 m", "material": material}
    beam = {"half_angle": "0.1 deg"}
    gram = measure(
        _built(dies=[beam], board={"radius": "0.21 m", "reflectance": 0}, cover=cover),
        Settings(photons=1_000_000, seed=5, distance_m=100.0),
    )
    sigma = 0.5 / math.sqrt(gram.photons)
    assert gram.left / gram.photons == pytest.approx(0.66096, abs=4.0 * sigma)
    assert gram.in_board / gram.photons == pytest.approx(0.09739, abs=3.0 * sigma)
    assert gram.lost == 0


def _passed(ratio: float, roughness: float, count: int) -> float:
    """The share of even light that passes a face."""
    random = np.array([97], dtype=np.uint64)
    draws = np.random.default_rng(3).random((count, 2))
    sine, turn = np.sqrt(draws[:, 0]), 2.0 * np.pi * draws[:, 1]
    ways = np.stack([sine * np.cos(turn), sine * np.sin(turn), -np.sqrt(1.0 - draws[:, 0])], axis=1)
    hits = [_met(tuple(way), (0.0, 0.0, 1.0), ratio, roughness, random)[1] for way in ways.tolist()]
    return float(np.mean(hits))


@pytest.mark.parametrize("roughness", [0.0, 0.1, 0.6])
def test_a_face_passes_even_light_n_squared_times_better_inwards(roughness: float) -> None:
    """By reciprocity, whatever its roughness; of a smooth one with n = 1.5 it is 0.9082 (Walsh's formula)."""
    count, index = 60_000, 1.5
    inwards, outwards = _passed(index, roughness, count), _passed(1.0 / index, roughness, count)
    sigma = math.sqrt((0.1 * 0.9 + index**4 * 0.4 * 0.6) / count)
    assert inwards == pytest.approx(index**2 * outwards, abs=3.5 * sigma)
    if roughness == 0.0:
        assert inwards == pytest.approx(0.9082, abs=3.5 * math.sqrt(0.09 / count))


@pytest.mark.parametrize("roughness", [0.0, 0.3])
@pytest.mark.parametrize("height_mm", [0.0, 7.0])
def test_where_nothing_absorbs_all_light_leaves(roughness: float, height_mm: float) -> None:
    material = {
        "type": "translucent",
        "index": 1.5,
        "roughness": roughness,
        "scattering_length": "0.3 mm",
        "g": 0.3,
    }
    cover = {"radius": "10 mm", "thickness": "1 mm", "height": f"{height_mm} mm", "material": material}
    gram = _measured(20_000, board={"radius": "15 mm", "reflectance": 1}, cover=cover)
    assert gram.left == gram.photons == gram.far.sum() == gram.near.sum()


def test_near_by_a_source_beside_the_middle_is_seen_from_where_it_is() -> None:
    """A Lambertian die 0.1 m above the middle, on a sphere of 1 m: E = cos α cos β / (π r²)."""
    gram = _measured(2_000_000, dies=[{"half_angle": "60 deg", "position": "[0, 0, 0.1] m"}])
    polar_rad = gram.polar_rad[1:17]
    across, up = np.sin(polar_rad), np.cos(polar_rad) - 0.1
    r = np.hypot(across, up)
    known = (up / r) * ((across * np.sin(polar_rad) + up * np.cos(polar_rad)) / r) / (np.pi * r**2)
    away = (gram.intensity_per_sr[1:17, 0] - known) / gram.sigma_per_sr[1:17, 0]
    curved = 0.1  # of σ: a cell's mean is not its middle
    assert np.abs(away).max() < 3.5 + curved
    assert gram.intensity_per_sr[0, 0] == pytest.approx(1.0 / (np.pi * 0.81), rel=0.01)
    assert gram.difference_from_afar > 0.1
