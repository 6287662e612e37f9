"""LEDs against their data sheets' figures, worked out apart from the code."""

import math
from typing import Any

import numpy as np
import pytest
from scipy import integrate

import nir_render as nr
from nir_render.scene.documents.emitters import Source
from nir_render.scene.emission import emission_spectrum, emission_units
from nir_render.spectra.led import led_spectrum, power_at_current, skew_of_peak
from tests.paths import SCENES

SPECTRUM = "robots.r2.rig.sources.top.spectrum"


def source(led: Any, **more: Any) -> Source:
    changes = {f"robots.r2.rig.sources.top.{key}": value for key, value in more.items()}
    scene = nr.load_scene(SCENES / "one_source.yaml", {SPECTRUM: {"led": led}, **changes})
    return scene.sources()["r2.top"][1]


def centroid_nm(of: Source) -> float:
    spectrum = emission_spectrum(of)
    finely_m = np.linspace(spectrum.low_m, spectrum.high_m, 200_001)
    return float(np.trapezoid(spectrum(finely_m) * finely_m, finely_m)) * 1e9


@pytest.mark.parametrize("skew", [-0.6, 0.0, 0.35])
def test_centroid_and_width_are_those_asked_for_and_the_flux_is_one(skew: float) -> None:
    """Against adaptive quadrature of the two half Gaussians, written down anew."""
    led = led_spectrum(940e-9, 42e-9, skew, "LED")
    peak_nm = led.wavelength_m[led.value.argmax()] * 1e9
    short, long = (42.0 / 2.354820045 * (1.0 + sign * skew) for sign in (-1.0, 1.0))

    def density(nm: float) -> float:
        return math.exp(-0.5 * ((nm - peak_nm) / (short if nm < peak_nm else long)) ** 2)

    total = integrate.quad(density, 700, 1200, points=[peak_nm], epsabs=1e-10)[0]
    mean = integrate.quad(lambda nm: nm * density(nm), 700, 1200, points=[peak_nm])[0] / total
    assert mean == pytest.approx(940.0, abs=1e-3)
    assert led.integral() == pytest.approx(1.0, rel=1e-12)
    nm = np.array([910.0, 930.0, 945.0, 970.0])
    np.testing.assert_allclose(led(nm * 1e-9) * 1e-9, [density(x) / total for x in nm], rtol=1e-4)
    edges = [peak_nm - short * math.sqrt(2 * math.log(2)), peak_nm + long * math.sqrt(2 * math.log(2))]
    assert edges[1] - edges[0] == pytest.approx(42.0, abs=1e-6)


def test_the_sfh_4545_has_its_data_sheets_centroid_peak_and_width() -> None:
    led = emission_spectrum(source("sfh_4545"))
    peak_nm = led.wavelength_m[led.value.argmax()] * 1e9
    above = led.wavelength_m[led.value >= 0.5 * led.value.max()] * 1e9
    assert centroid_nm(source("sfh_4545")) == pytest.approx(940.0, abs=0.01)
    assert peak_nm == pytest.approx(950.0, abs=0.05)
    assert above[-1] - above[0] == pytest.approx(42.0, abs=0.4)
    assert skew_of_peak(940e-9, 42e-9, peak_nm * 1e-9) == pytest.approx(-0.351, abs=1e-3)


def test_heat_shifts_centroid_and_flux_by_the_data_sheets_coefficients() -> None:
    hot = source({"preset": "sfh_4545", "junction_temperature": "338.15 K"})
    assert centroid_nm(hot) == pytest.approx(940.0 + 0.3 * 40.0, abs=0.01)
    assert emission_units(hot) == pytest.approx(0.2 * (1.0 - 0.005 * 40.0), rel=1e-12)


def test_current_heats_the_junction_through_its_thermal_resistance() -> None:
    """450 K/W × 1.5 V × 100 mA = 67.5 K; at a tenth of the time 6.75 K."""
    driven = {"preset": "sfh_4545", "ambient_temperature": "298.15 K", "current": "100 mA"}
    assert centroid_nm(source(driven)) == pytest.approx(940.0 + 0.3 * 67.5, abs=0.01)
    assert emission_units(source(driven)) == pytest.approx(0.2 * (1.0 - 0.005 * 67.5), rel=1e-12)
    assert centroid_nm(source({**driven, "duty": 0.1})) == pytest.approx(940.0 + 0.3 * 6.75, abs=0.01)


def test_a_higher_current_heats_by_its_own_voltage() -> None:
    """1 A at 2.3 V, a twentieth of the time: 450 K/W × 2.3 V × 50 mA = 51.75 K, not 33.75 K by 1.5 V."""
    led = {"preset": "sfh_4545", "ambient_temperature": "298.15 K", "current": "1 A", "duty": 0.05}
    assert centroid_nm(source(led)) == pytest.approx(940.0 + 0.3 * 51.75, abs=0.01)
    assert emission_units(source(led)) == pytest.approx(0.2 * 7.64 * (1.0 - 0.005 * 51.75), rel=1e-12)
    half = {**led, "current": "550 mA"}  # midway between the points
    assert centroid_nm(source(half)) == pytest.approx(940.0 + 0.3 * 450.0 * 1.9 * 0.0275, abs=0.01)


def test_current_drives_the_flux_along_the_data_sheets_points() -> None:
    """4200 mW/sr at 1 A over 550 at 100 mA; between them a power law."""
    share = emission_units(source({"preset": "sfh_4545", "current": "300 mA"})) / 0.2
    assert share == pytest.approx(3.0 ** math.log10(7.64), rel=1e-9)
    assert power_at_current(1.0, ((0.1, 1.0), (1.0, 7.64))) == pytest.approx(7.64)


@pytest.mark.parametrize(
    ("led", "said"),
    [
        ({"preset": "sfh_4545", "current": "20 mA"}, "outside the 0.1 to 1 A of 'power_at_current'"),
        ({"preset": "vsmy2940", "current": "20 mA"}, "what it does to the flux is not known"),
        ({"preset": "sfh_4545", "junction_temperature": "400 K"}, "outside the 233.15 to 373.15 K"),
        ({"preset": "sfh_4545", "ambient_temperature": "320 K"}, "the junction is at 387.5 K"),
        ({"preset": "infra_swarm", "ambient_temperature": "300 K"}, "give them, or 'junction_temperature'"),
        (
            {
                "preset": "sfh_4545",
                "ambient_temperature": "298.15 K",
                "current": "1 A",
                "duty": 0.05,
                "forward_voltage": "1.5 V",
                "voltage_at_current": None,
            },
            "what it is at 1 A is not known, and so neither is the heat",
        ),
        (
            {"preset": "sfh_4545", "ambient_temperature": "298.15 K", "forward_voltage": "1.5 V"},
            "write either 'forward_voltage' or 'voltage_at_current'",
        ),
        ({"centroid": "940 nm"}, "wanted 'centroid' and 'fwhm'"),
        (
            {"preset": "sfh_4545", "wavelength_shift": "0.3 nm"},
            "wanted a wavelength shift such as '0.3 nm/K'",
        ),
    ],
)
def test_what_is_not_known_of_an_led_is_refused(led: Any, said: str) -> None:
    with pytest.raises(nr.InputError, match=said):
        source(led)


def test_a_table_moves_as_a_whole() -> None:
    points = [["900 nm", 0], ["930 nm", 1], ["990 nm", 0]]
    led = {"table": {"points": points}, "wavelength_shift": "0.25 nm/K", "junction_temperature": "318.15 K"}
    assert centroid_nm(source(led)) == pytest.approx((900.0 + 930.0 + 990.0) / 3.0 + 5.0, abs=1e-6)


def test_a_unit_differs_from_its_type_and_its_calibration_does_not_know() -> None:
    unit = {"flux": 1.2, "wavelength": "6 nm"}
    odd = source("sfh_4545", unit=unit)
    assert centroid_nm(odd) == pytest.approx(946.0, abs=0.01)
    assert emission_units(odd) == pytest.approx(0.24, rel=1e-12)
    constants = []
    for changes in ({}, {"robots.r2.rig.sources.top.unit": unit}):
        scene = nr.load_scene(SCENES / "one_source.yaml", changes)
        constants.append(nr.calibration(scene, "r1.front").range_constant_dn_m2_per_s)
    assert constants[0] == constants[1]
