"""Incandescent lamps: from lumens to watts near 940 nm."""

import numpy as np
import pytest

from nir_render.spectra.illuminants import incandescent_flux_w, incandescent_spectrum, planck_shape


def test_plancks_spectrum_peaks_where_wien_says() -> None:
    wavelength_m = np.linspace(300e-9, 3000e-9, 200_001)
    for temperature_k in (2000.0, 2856.0, 6500.0):
        peak_m = wavelength_m[planck_shape(wavelength_m, temperature_k).argmax()]
        assert peak_m * temperature_k == pytest.approx(2.897771955e-3, rel=1e-4)


# CIE 1924 photopic luminous efficiency, 380 to 770 nm in steps of 10 nm, from the published table.
V_LAMBDA = (
    0.00004, 0.00012, 0.0004, 0.0012, 0.0040, 0.0116, 0.0230, 0.0380, 0.0600, 0.0910, 0.1390, 0.2080, 0.3230, 0.5030,
    0.7100, 0.8620, 0.9540, 0.9950, 0.9950, 0.9520, 0.8700, 0.7570, 0.6310, 0.5030, 0.3810, 0.2650, 0.1750, 0.1070,
    0.0610, 0.0320, 0.0170, 0.0082, 0.0041, 0.0021, 0.00105, 0.00052, 0.00025, 0.00012, 0.00006, 0.00003,
)  # fmt: skip


@pytest.mark.parametrize("temperature_k", [2000.0, 2856.0, 3200.0])
def test_lumens_become_watts(temperature_k: float) -> None:
    """Φ_v = 683 lm/W ∫ V(λ) Φ_λ dλ, here with the table in steps of 10 nm: within 0.2 %."""
    seen_m = np.linspace(380e-9, 770e-9, 40)
    part_m = np.linspace(300e-9, 1100e-9, 20_001)
    lumens = 683.0 * float(np.sum(np.array(V_LAMBDA) * planck_shape(seen_m, temperature_k)) * 10e-9)
    watts = float(np.trapezoid(planck_shape(part_m, temperature_k), part_m))
    assert incandescent_flux_w(1000.0, temperature_k) == pytest.approx(1000.0 * watts / lumens, rel=0.002)


def test_the_spectrum_has_unit_flux() -> None:
    assert incandescent_spectrum(2856.0, "lamp").integral() == pytest.approx(1.0, rel=1e-12)
