"""Eye safety by hand, from fluxes, radii and the limits of IEC 62471."""

import math

import numpy as np
import pytest

from nir_render.budget.eye_safety import eye_safety, retinal_weight
from nir_render.scene.documents.emitters import Source

R_940 = 10.0 ** (-240.0 / 500.0)


def _source(**changes: object) -> Source:
    return Source.model_validate({"preset": "infra_swarm", **changes})


def test_an_even_source_of_0_2_watts() -> None:
    """0.2 W/(4π 0.04 m²) = 0.398 W/m²; a 10 mm sphere fills 0.1 rad: 0.2/(4π² r²) = 50.7 W/m²/sr against 60 000."""
    found = eye_safety(["r2.top"], _source(spectrum={"gaussian": {"centroid": "940 nm", "fwhm": "1 nm"}}))
    assert found.cornea_w_per_m2 == pytest.approx(0.39789, rel=1e-4)
    assert found.retina_w_per_m2_sr == pytest.approx(50.661 * R_940, rel=1e-4)
    assert found.angle_rad == pytest.approx(0.1)
    assert found.retina_limit_w_per_m2_sr == pytest.approx(60_000.0)
    assert found.exempt_lit
    assert found.exempt_as_driven
    assert found.narrow_spectrum
    assert found.cornea_limit_at_m == pytest.approx(math.sqrt(0.2 / (4.0 * math.pi) / 100.0), rel=1e-4)


def test_a_wide_spectrum_weighs_as_its_wavelengths_do() -> None:
    """The mean of a Gaussian's 10^(−λ/500 nm): exp(½ (σ ln 10/500 nm)²) more than at its middle."""
    found = eye_safety(["r2.top"], _source())
    sigma_nm = 42.0 / (2.0 * math.sqrt(2.0 * math.log(2.0)))
    more = math.exp(0.5 * (sigma_nm * math.log(10.0) / 500.0) ** 2)
    assert found.retina_w_per_m2_sr == pytest.approx(50.661 * R_940 * more, rel=2e-3)
    assert not found.narrow_spectrum


def test_a_small_source_is_seen_in_a_field_of_11_mrad() -> None:
    """A radius of 0.5 mm fills 5 mrad: its radiance counts by (5/11)² of itself, against 6000/0.011."""
    found = eye_safety(["r2.top"], _source(radius="0.5 mm"))
    large = eye_safety(["r2.top"], _source())
    ratio = (10.0 / 0.5) ** 2 * (5.0 / 11.0) ** 2
    assert found.retina_w_per_m2_sr / large.retina_w_per_m2_sr == pytest.approx(ratio, rel=1e-9)
    assert found.retina_limit_w_per_m2_sr == pytest.approx(6000.0 / 0.011)


def test_pulses_count_with_their_mean() -> None:
    """The motion-capture strobe, 5 W in a lobe, 6 % of the time: above the limit if lit, exempt as it pulses."""
    strobe = Source.model_validate({"preset": "mocap_strobe_850"})
    found = eye_safety(["strobe"], strobe)
    assert found.mean_cornea_w_per_m2 == pytest.approx(0.06 * found.cornea_w_per_m2)
    assert (found.exempt_lit, found.exempt_as_driven) == (False, True)
    # ∫ of the lobe's points over the sphere, linear between them.
    assert strobe.pattern is not None
    polar_rad, value = np.array(strobe.pattern.points).T
    fine = np.linspace(0.0, math.pi, 200_001)
    lobe = np.interp(fine, polar_rad, value) * 2.0 * math.pi * np.sin(fine)
    intensity = 5.0 / float(lobe.sum() * (fine[1] - fine[0]))
    assert found.intensity_w_per_sr == pytest.approx(intensity, rel=2e-3)
    assert found.cornea_w_per_m2 == pytest.approx(intensity / 0.04, rel=2e-3)


def test_a_long_pulse_is_held_against_its_own_limit() -> None:
    """700 W/m² for 100 s of each 1000: 70 in the mean, but one pulse may have 18 000 · 100^(−3/4) = 569."""
    pulses = {"square": {"frequency": "1 mHz", "duty": 0.1}}
    found = eye_safety(
        ["r2.top"], _source(flux=f"{700.0 * 4.0 * math.pi * 0.04} W", radius="0.1 m", drive=pulses)
    )
    assert found.pulse_s == pytest.approx(100.0)
    assert found.mean_cornea_w_per_m2 == pytest.approx(70.0, rel=1e-4)
    assert found.pulse_of_limit == pytest.approx(700.0 / (18_000.0 * 100.0**-0.75), rel=1e-4)
    assert not found.exempt_as_driven


def test_a_short_pulse_meets_the_retinas_limit_first() -> None:
    """0.1 ms of a disc that fills 5 mrad: 0.2/(4π² r²) W/m²/sr, weighted, against 50 000/(0.005 · 0.1)."""
    pulses = {"square": {"frequency": "1 kHz", "duty": 0.1}}
    spectrum = {"gaussian": {"centroid": "940 nm", "fwhm": "1 nm"}}
    found = eye_safety(["r2.top"], _source(radius="0.5 mm", drive=pulses, spectrum=spectrum))
    radiance = 0.2 / (4.0 * math.pi**2 * 0.5e-3**2) * R_940
    assert found.pulse_of_limit == pytest.approx(radiance * 0.005 / (50_000.0 * 1e-4**-0.25), rel=1e-4)
    assert eye_safety(["r2.top"], _source()).pulse_of_limit is None


def test_an_eye_that_moves_spreads_a_pulse() -> None:
    """1 s of the same: by then the least angle is 1.7 mrad √(1/0.25) = 3.4 mrad; at 10 s it is 11."""
    spectrum = {"gaussian": {"centroid": "940 nm", "fwhm": "1 nm"}}
    radiance = 0.2 / (4.0 * math.pi**2 * 0.1e-3**2) * R_940
    for frequency_hz, duty, least_rad in ((0.1, 0.1, 3.4e-3), (2.0, 0.4, 1.7e-3), (0.01, 0.4, 11e-3)):
        pulses = {"square": {"frequency": f"{frequency_hz} Hz", "duty": duty}}
        found = eye_safety(["r2.top"], _source(radius="0.1 mm", drive=pulses, spectrum=spectrum))
        pulse_s = duty / frequency_hz
        limit = 50_000.0 / least_rad * min(pulse_s, 10.0) ** -0.25
        assert found.pulse_s == pytest.approx(pulse_s)
        assert found.pulse_of_limit == pytest.approx(radiance * (1e-3 / least_rad) ** 2 / limit, rel=1e-4)


def test_weights_of_the_retina() -> None:
    weights = retinal_weight(np.array([700e-9, 940e-9, 1050e-9, 1100e-9, 1175e-9, 1300e-9]))
    expected = [1.0, R_940, 0.1995, 0.2, 0.2 * 10.0**-0.5, 0.02]
    assert weights == pytest.approx(expected, rel=1e-3)
