"""Filters as tables and as figures: the shift by its formula, integrals by adaptive quadrature."""

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy import constants, integrate

import nir_render as nr
from nir_render.camera.optics.response import response
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.spectral.bandpass import Bandpass
from nir_render.scene.emission import Emitter, emission_spectrum
from tests.paths import SCENES

# A measured-looking passband: neither flat nor symmetric, with a leak to the blue.
TABLE = {
    300: 1e-4, 700: 1e-4, 705: 4e-3, 712: 4e-3, 717: 1e-4, 928: 1e-4, 932: 0.02, 934.5: 0.4, 936: 0.85, 939: 0.93,
    942: 0.9, 944: 0.83, 945.2: 0.4, 948: 0.03, 952: 1e-4, 1100: 1e-4,
}  # fmt: skip
POINTS = [[f"{nm} nm", value] for nm, value in TABLE.items()]
FIGURES = {"centre": "940 nm", "fwhm": "10 nm", "peak_transmission": 0.9, "blocking_od": 4.0}
KNOWN: dict[str, dict[str, Any]] = {
    "table": {"table": {"points": POINTS}, "blocking_od": 4.0},
    "figures": FIGURES,
    "edge": {**FIGURES, "edge": "1.5 nm"},
}


def bandpass(**figures: Any) -> Bandpass:
    return Bandpass.model_validate({"placement": "in_front_of_lens", "effective_index": 1.9, **figures})


def crossings_nm(of: Bandpass, cosine: float) -> tuple[float, float]:
    nm = np.linspace(850.0, 1000.0, 150_001)
    passed = of.transmission(nm * 1e-9, cosine)
    above = nm[passed >= 0.5 * passed.max()]
    return float(above[0]), float(above[-1])


@pytest.mark.parametrize("kind", list(KNOWN))
@pytest.mark.parametrize("angle_deg", [5.0, 15.0, 30.0, 45.0])
def test_both_edges_move_by_the_formula_to_0_05_nm(kind: str, angle_deg: float) -> None:
    of = bandpass(**KNOWN[kind])
    factor = math.sqrt(1.0 - (math.sin(math.radians(angle_deg)) / 1.9) ** 2)
    moved = crossings_nm(of, math.cos(math.radians(angle_deg)))
    if kind == "table":
        expected = [edge * factor for edge in crossings_nm(of, 1.0)]  # all wavelengths shrink alike
    else:
        expected = [940.0 * factor - 5.0, 940.0 * factor + 5.0]  # the width stays
    assert moved == pytest.approx(expected, abs=0.05)


@pytest.mark.parametrize("kind", list(KNOWN))
def test_heat_moves_the_passband(kind: str) -> None:
    cold = crossings_nm(bandpass(**KNOWN[kind]), 1.0)
    hot = bandpass(**KNOWN[kind], wavelength_shift="0.1 nm/K", temperature="328.15 K")
    assert crossings_nm(hot, 1.0) == pytest.approx([edge + 3.0 for edge in cold], abs=2e-3)


def test_an_edge_is_from_90_to_10_percent() -> None:
    of = bandpass(**KNOWN["edge"])
    nm = np.linspace(940.0, 960.0, 200_001)
    passed = of.transmission(nm * 1e-9, 1.0) / 0.9
    assert nm[passed >= 0.1][-1] - nm[passed >= 0.9][-1] == pytest.approx(1.5, abs=1e-3)
    assert nm[passed >= 0.5][-1] == pytest.approx(945.0, abs=1e-3)


def camera_and_emitters(filter_: Any, efficiency: Any) -> tuple[Camera, dict[str, Emitter]]:
    front = "robots.r1.rig.cameras.front"
    scene = nr.load_scene(
        SCENES / "one_source.yaml",
        {
            f"{front}.filter": filter_, f"{front}.sensor.quantum_efficiency": efficiency,
            "robots.r2.rig.sources.top.spectrum": {"led": "sfh_4545"},
            "lamps": {"lamp": {"preset": "halogen", "center": "[3, 0, 2] m"}},
            "sun": {"azimuth": "30 deg", "elevation": "40 deg", "irradiance": "0.305 W/m^2/nm"},
        },
    )  # fmt: skip
    emitters = scene.emitters()
    return scene.camera("r1.front")[1], {name: emitters[name] for name in ("r2.top", "lamps.lamp", "sun")}


def density_per_nm(name: str) -> Callable[[float], float]:
    """Spectra of unit flux by their formulas: half Gaussians, Planck's law at 2856 K, an even one."""
    if name == "sun":
        return lambda nm: 1.0 / 800.0
    if name == "r2.top":
        short, long = (42.0 / math.sqrt(8.0 * math.log(2.0)) * (1.0 + sign * 0.351) for sign in (1.0, -1.0))
        peak = 940.0 + math.sqrt(2.0 / math.pi) * (short - long)
        total = math.sqrt(0.5 * math.pi) * (short + long)
        return lambda nm: math.exp(-0.5 * ((nm - peak) / (short if nm < peak else long)) ** 2) / total

    def planck(nm: float) -> float:
        return nm**-5 / math.expm1(constants.h * constants.c / (constants.k * 2856.0 * nm * 1e-9))

    whole = integrate.quad(planck, 300.0, 1100.0)[0]
    return lambda nm: planck(nm) / whole


def quadrature(camera: Camera, name: str, emitter: Emitter, angle_rad: float) -> float:
    """C by adaptive quadrature over wavelength, in pieces between the bends, and over the pupil on the axis."""
    spectrum, efficiency, density = (
        emission_spectrum(emitter),
        camera.sensor.efficiency(),
        density_per_nm(name),
    )
    of = camera.filter
    assert of is not None

    def of_wavelength(cosine: float) -> float:
        factor = math.sqrt(1.0 - (1.0 - cosine**2) / of.effective_index**2)
        middle = 940.0 * factor
        bends = (
            [nm * factor for nm in TABLE]
            if of.table is not None
            else [middle + x for x in (-30, -8, -5, -2, 2, 5, 8, 30)]
        )
        bends += [nm * 1e9 for nm in efficiency.wavelength_m]
        low, high = spectrum.low_m * 1e9, spectrum.high_m * 1e9
        cuts = [low, *sorted(nm for nm in set(bends) if low < nm < high), high]

        def integrand(nm: float) -> float:
            here_m = nm * 1e-9
            passed = float(of.transmission(here_m, cosine))
            return density(nm) * float(efficiency(here_m)) * passed * here_m / (constants.h * constants.c)

        return sum(
            integrate.quad(integrand, a, b, epsabs=1e11, epsrel=1e-7, limit=400)[0]
            for a, b in itertools.pairwise(cuts)
        )

    if of.placement == "in_front_of_lens":
        whole = of_wavelength(math.cos(angle_rad))
    else:  # on the axis the mean over the pupil's area is over one radius

        def ring(area: float) -> float:
            return of_wavelength(1.0 / math.sqrt(1.0 + area / (2.0 * camera.lens.f_number) ** 2))

        whole = integrate.fixed_quad(np.vectorize(ring), 0.0, 1.0, n=9)[0]
    return camera.lens.transmission * whole


@pytest.mark.parametrize("kind", list(KNOWN))
@pytest.mark.parametrize("placement", ["in_front_of_lens", "behind_lens"])
def test_photon_integrals_agree_with_adaptive_quadrature_to_0_1_percent(kind: str, placement: str) -> None:
    filter_ = {
        "placement": placement,
        "effective_index": 1.9,
        **KNOWN[kind],
        "chief_ray_angle_at_corner": "12 deg",
    }
    curve = {
        "points": [["300 nm", 0.2], ["525 nm", 0.76], ["850 nm", 0.2], ["940 nm", 0.077], ["1100 nm", 0.001]]
    }
    camera, emitters = camera_and_emitters(filter_, curve)
    angle_rad = math.radians(14.0) if placement == "in_front_of_lens" else 0.0
    for name, emitter in emitters.items():
        found = float(response(camera, emitter)(angle_rad))
        assert found == pytest.approx(quadrature(camera, name, emitter, angle_rad), rel=1e-3), name


@pytest.mark.parametrize(
    ("figures", "said"),
    [
        ({"table": {"points": POINTS}, "centre": "940 nm"}, "centre: a 'table' tells it"),
        ({"table": 0.5}, "wanted 'points' or 'file'"),
        ({"table": {"points": [["900 nm", 92], ["950 nm", 0]]}}, "write 92 % as 0.92"),
        ({"centre": "940 nm", "fwhm": "10 nm", "blocking_od": 4}, "peak_transmission: this key is missing"),
    ],
)
def test_filters_without_sense_are_refused(figures: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        bandpass(**figures)


def test_beyond_a_table_only_the_blocking_is_known() -> None:
    short = [[f"{nm} nm", value] for nm, value in TABLE.items() if 700 < nm < 1000]
    blocked = bandpass(table={"points": short}, blocking_od=3.0)
    assert blocked.transmission([500e-9, 939e-9], 1.0) == pytest.approx([1e-3, 0.93])
    assert [part[0] for part in blocked.bounds([500e-9], 1.0)] == pytest.approx([0.0, 1e-3])
    assert [part[0] for part in bandpass(table={"points": short}).bounds([500e-9], 1.0)] == [0.0, 1.0]
    assert [part[0] for part in bandpass(**FIGURES).bounds([500e-9], 1.0)] == pytest.approx(
        [0.0, 1e-4], abs=1e-8
    )
