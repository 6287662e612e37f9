"""Droplets by Mie theory: against a second program, against published figures, and their tables against both."""

import math

import miepython
import numpy as np
import pytest

from nir_render import InputError
from nir_render.scattering.mie import cloud_of, coefficients
from nir_render.scattering.optics import ANGLE_RAD, VISIBLE_M, Particles, computed, mean_cosine
from nir_render.scattering.sizes import Lognormal, ModifiedGamma, size_nodes
from nir_render.scene.documents.ambient.droplets import Droplets
from nir_render.scene.documents.files import preset_names
from nir_render.transport.world.phase import henyey_greenstein, phase_table
from tests.unit.scattering.bohren_huffman import sphere_sums

# a, d, c of n(r) = c r^a exp(-d r) per m³ and µm; σ/km, g, albedo, visibility m and σ(940)/σ(550) as published tables and two
# other programs have them (docs/physics.md, Fog).
FOGS = {
    "advection_heavy": (3, 0.3, 2.7e4, 29.1, 0.868, 0.9994, 136.0, 1.012),
    "advection_moderate": (3, 0.375, 6.592e4, 18.8, 0.864, 0.9995, 212.0, 1.014),
    "radiation_heavy": (6, 1.5, 2.373e6, 17.1, 0.840, 0.9998, 235.0, 1.028),
    "radiation_moderate": (6, 3.0, 6.075e8, 9.0, 0.800, 0.9999, 454.0, 1.043),
}
WATER = complex(1.3264, 2.19e-6)


@pytest.mark.parametrize("name", FOGS)
def test_fogs_have_the_figures_that_are_known_of_them(name: str) -> None:
    """σ and g to 0.5 %, 1 − albedo to 15 %, each beyond the last digit that the figures are given with."""
    power, slope, c, sigma_per_km, g, albedo, visibility_m, ratio = FOGS[name]
    optics = Droplets.model_validate(name).optics
    assert optics.name == name
    number_per_m3 = c * math.gamma(power + 1.0) / slope ** (power + 1.0)
    assert abs(1e3 * number_per_m3 * optics.extinction_m2 - sigma_per_km) < 0.005 * sigma_per_km + 0.05
    assert abs(3.912 / (number_per_m3 * optics.visible_m2) - visibility_m) < 0.005 * visibility_m
    assert optics.asymmetry == pytest.approx(g, rel=0.005)
    assert abs(optics.absorbed_share - (1.0 - albedo)) < 0.15 * (1.0 - albedo) + 0.5e-4
    assert optics.ratio == pytest.approx(ratio, abs=0.0015)


@pytest.mark.parametrize("name", FOGS)
def test_a_second_program_finds_the_same_of_the_same_spheres(name: str) -> None:
    """60 sizes of a fog, summed by the book, sphere by sphere: all cross-sections, g, and the phase function at each angle."""
    power, slope = FOGS[name][:2]
    sizes = ModifiedGamma(power, 1e6 * slope)
    radius_m, number = size_nodes(sizes, 60)
    angle = np.radians([0.0, 0.2, 0.7, 1.5, 4.0, 11.0, 33.0, 77.0, 120.0, 141.0, 160.0, 178.0, 180.0])
    q_ext, q_sca, q_forward, intensity = sphere_sums(WATER, 2.0 * math.pi * radius_m / 940e-9, np.cos(angle))
    area_m2 = number * math.pi * radius_m**2
    cloud = cloud_of(sizes, WATER.conjugate(), 940e-9, angle, nodes=60)
    assert cloud.extinction_m2 == pytest.approx(area_m2 @ q_ext, rel=1e-9)
    assert cloud.scattering_m2 == pytest.approx(area_m2 @ q_sca, rel=1e-9)
    assert cloud.asymmetry == pytest.approx((area_m2 @ q_forward) / (area_m2 @ q_sca), rel=1e-9)
    wave_per_m = 2.0 * math.pi / 940e-9
    per_sr = number @ intensity / (wave_per_m**2 * (area_m2 @ q_sca))
    np.testing.assert_allclose(cloud.phase_per_sr, per_sr, rtol=1e-7)


@pytest.mark.parametrize("index", [1.33 - 2e-6j, 1.51 - 0.021j, 1.9 - 0.7j, 5.0 - 10.0j])
def test_coefficients_are_miepythons(index: complex) -> None:
    """From a thousandth of a wave to spheres of 0.2 mm, of which small ones rest while the largest goes on."""
    x = np.array([0.01, 0.5, 3.0, 50.0, 400.0, 1500.0])
    a, b = coefficients(index, x)
    for column, one in enumerate(x.tolist()):
        for ours, theirs in zip((a, b), miepython.coefficients(index, one), strict=True):
            count = min(len(ours), len(theirs))
            np.testing.assert_allclose(ours[:count, column], theirs[:count], rtol=1e-8, atol=1e-9)
            assert abs(ours[count:, column]).max(initial=0.0) < 1e-6


def test_one_sphere_is_that_of_the_book() -> None:
    """Bohren and Huffman's own example (appendix A): n = 1.55, x = 2π 0.525/0.6328: Q = 3.10543."""
    x = np.array([2.0 * math.pi * 0.525 / 0.6328])
    q_ext, q_sca, q_forward, _ = sphere_sums(1.55 + 0j, x, np.array([1.0]))
    assert q_ext[0] == pytest.approx(3.10543, abs=1e-5)
    assert q_sca[0] == pytest.approx(3.10543, abs=1e-5)
    assert q_forward[0] / q_sca[0] == pytest.approx(0.63314, abs=1e-5)


@pytest.mark.parametrize("index", [1.33 - 0j, 1.51 - 0.021j, 1.9 - 0.7j])
def test_small_and_large_spheres_are_rayleighs_and_twice_their_area(index: complex) -> None:
    """Much smaller than a wave: C_sca = 8/3 π k⁴ r⁶ |(m²−1)/(m²+2)|², phase 3 (1 + cos²)/16π. Large: C_ext = 2 π r²."""
    angles = np.radians([0.0, 60.0, 90.0, 180.0])
    tiny = cloud_of(Lognormal(1e-9, 1.02), index, 940e-9, angles)
    wave = 2.0 * math.pi / 940e-9
    polarised = (index**2 - 1.0) / (index**2 + 2.0)
    sixth_m6 = 1e-54 * math.exp(18.0 * math.log(1.02) ** 2)
    assert tiny.scattering_m2 == pytest.approx(
        8.0 / 3.0 * math.pi * wave**4 * sixth_m6 * abs(polarised) ** 2, rel=1e-3
    )
    np.testing.assert_allclose(
        tiny.phase_per_sr, 3.0 * (1.0 + np.cos(angles) ** 2) / (16.0 * math.pi), rtol=1e-3
    )
    if index.imag:
        large = cloud_of(Lognormal(200e-6, 1.02), index, 940e-9, angles[:0], nodes=20)
        x = 2.0 * math.pi * 200e-6 / 940e-9  # 2 (1 + 0.9 x^(−2/3)), Nussenzveig and Wiscombe 1980
        area_m2 = math.pi * (200e-6) ** 2 * math.exp(2.0 * math.log(1.02) ** 2)
        assert large.extinction_m2 / area_m2 == pytest.approx(2.0 + 1.99239 * x ** (-2.0 / 3.0), rel=2e-3)


@pytest.mark.parametrize("name", ["radiation_moderate", "smoke"])
def test_the_tables_are_what_is_computed_anew(name: str) -> None:
    """At 2400 sizes where the tables were made with 8000."""
    droplets = Droplets.model_validate(name)
    kept = droplets.optics
    again = computed(Particles(droplets.sizes.sizes(), droplets.index.value, droplets.index_550.value))
    assert kept.name == name
    assert again.extinction_m2 == pytest.approx(kept.extinction_m2, rel=0.002)
    assert again.visible_m2 == pytest.approx(kept.visible_m2, rel=0.002)
    assert again.asymmetry == pytest.approx(kept.asymmetry, rel=0.002)
    assert again.absorbed_share == pytest.approx(kept.absorbed_share, rel=0.03)
    ahead = np.degrees(ANGLE_RAD) < 90.0
    np.testing.assert_allclose(again.phase_per_sr[ahead], kept.phase_per_sr[ahead], rtol=0.01)


@pytest.mark.parametrize("name", preset_names("droplets"))
def test_every_preset_has_its_table_and_it_is_a_phase_function(name: str) -> None:
    """Integral 1 and mean cosine g to 0.2 % over the table's own angles: these resolve the forward peak, drizzle's too."""
    optics = Droplets.model_validate(name).optics
    assert optics.name == name, "run: tools/droplet_tables.py"
    versine = 2.0 * np.sin(0.5 * ANGLE_RAD) ** 2
    whole = 2.0 * math.pi * np.trapezoid(optics.phase_per_sr, versine)
    assert whole == pytest.approx(1.0, abs=2e-3)
    assert mean_cosine(ANGLE_RAD, optics.phase_per_sr) == pytest.approx(optics.asymmetry, abs=2e-3)


def test_angles_of_tables_are_those_that_the_kernel_reads() -> None:
    np.testing.assert_array_equal(phase_table(henyey_greenstein(0.5)).angle_rad, ANGLE_RAD)


def test_mean_cosine_of_a_coarse_table() -> None:
    """Linear from 1 to 0 over the half turn: ∫ (1 − θ/π) sin θ cos θ = π/4π = ¼, over ∫ (1 − θ/π) sin θ = 1."""
    assert mean_cosine(np.array([0.0, math.pi]), np.array([1.0, 0.0])) == pytest.approx(0.25, rel=1e-3)


@pytest.mark.parametrize("sizes", [ModifiedGamma(3.0, 3e5), ModifiedGamma(0.0, 1.5e4), Lognormal(1e-7, 2.0)])
def test_sizes_cover_volume_and_area(sizes: ModifiedGamma | Lognormal) -> None:
    """By moments in closed form; the volume, whose tail is longer, to 1e-5."""
    radius_m, number = size_nodes(sizes, 1000)
    if isinstance(sizes, ModifiedGamma):
        second_m2 = (sizes.power + 1.0) * (sizes.power + 2.0) / sizes.slope_per_m**2
    else:
        second_m2 = sizes.median_m**2 * math.exp(2.0 * math.log(sizes.spread) ** 2)
    assert float(number @ radius_m**2) == pytest.approx(second_m2, rel=1e-6)
    assert 4.0 / 3.0 * math.pi * float(number @ radius_m**3) == pytest.approx(
        sizes.mean_volume_m3(), rel=1e-5
    )


def test_what_is_too_large_is_refused() -> None:
    with pytest.raises(InputError, match="mm in radius count here; wanted at most"):
        cloud_of(ModifiedGamma(6.0, 5e4), 1.33, VISIBLE_M, np.zeros(0))
