"""Incandescent lamps: from lumens to watts near 940 nm."""

import numpy as np
import pytest

from nir_render.spectra.illuminants import incandescent_flux_w, incandescent_spectrum, planck_shape


def test_plancks_spectrum_peaks_where_wien_says() -> None:
    wavelength_m = np.linspace(300e-9, 3000e-9, 200_001)
    for temperature_k in (2000.0, 2856.0, 6500.0):
        peak_m = wavelength_m[planck_shape(wavelength_m, temperature_k).argmax()]
        assert peak_m * temperature_k == pytest.approx(2.897771955e-3, rel=1e-4)


def test_illuminant_a_has_its_known_luminous_efficacy() -> None:
    """Lumens per watt of a black body of 2856 K, with V(λ) ≈ 1.019 exp(−285.4 (λ/µm − 0.559)²) for the eye.

    Our flux counts 300 to 1100 nm only, the share f of the whole. That V(λ) is good to 1 % of the integral.
    """
    temperature_k = 2856.0
    whole_m = np.geomspace(200e-9, 200e-6, 400_001)
    part_m = np.linspace(300e-9, 1100e-9, 20_001)
    share = np.trapezoid(planck_shape(part_m, temperature_k), part_m) / np.trapezoid(
        planck_shape(whole_m, temperature_k), whole_m
    )
    whole = planck_shape(whole_m, temperature_k)
    eye = 1.019 * np.exp(-285.4 * (whole_m * 1e6 - 0.559) ** 2)
    efficacy_lm_per_w = 683.0 * np.trapezoid(eye * whole, whole_m) / np.trapezoid(whole, whole_m)
    assert efficacy_lm_per_w == pytest.approx(16.4, abs=0.3)
    ours_lm_per_w = 1000.0 / incandescent_flux_w(1000.0, temperature_k) * share
    assert ours_lm_per_w == pytest.approx(efficacy_lm_per_w, rel=0.01)


def test_the_spectrum_has_unit_flux() -> None:
    assert incandescent_spectrum(2856.0, "lamp").integral() == pytest.approx(1.0, rel=1e-12)
