import math

import numpy as np
import pytest

from perception.model.ranging import angular_radius_rad, flux_at_one_metre_dn, range_from_flux
from tests.unit.perception.simulation import calibration, random


def test_range_follows_cosine_response_exposure_and_gain() -> None:
    """At 45° the flux is K t g cos 45° · 0.8 / d²."""
    camera = calibration(
        response_angle_rad=np.array([0.0, np.pi / 2]), response_relative=np.array([1.0, 0.6])
    )
    flux = camera.range_constant_dn_m2_per_s * 2e-3 * 1.5 * math.sqrt(0.5) * 0.8 / 3.0**2
    found = range_from_flux(flux, 0.0, 639.5, 479.5 + 480.0, 2e-3, 1.5, camera)
    assert found.range_m == pytest.approx(3.0, rel=1e-12)


def test_sigma_adds_flux_and_constant() -> None:
    camera = calibration()
    k = camera.range_constant_dn_m2_per_s
    camera = calibration(sigma={"range_constant_dn_m2_per_s": 0.03 * k})
    flux = k * 1e-3 / 16.0
    found = range_from_flux(flux, 0.04 * flux, 639.5, 479.5, 1e-3, 1.0, camera)
    assert found.range_sigma_m == pytest.approx(0.5 * found.range_m * 0.05, rel=1e-12)
    assert math.isnan(range_from_flux(flux, math.nan, 639.5, 479.5, 1e-3, 1.0, camera).range_sigma_m)


def test_noise_in_the_flux_leaves_no_bias() -> None:
    """20 % of flux noise would make ranges 1.5 % too long on average; 0.2 % remain (fourth order)."""
    camera = calibration()
    flux = camera.range_constant_dn_m2_per_s * 1e-3 / 25.0
    noisy = flux * (1.0 + 0.1 * random(4).standard_normal(20000))
    found = [range_from_flux(f, 0.1 * f, 639.5, 479.5, 1e-3, 1.0, camera).range_m for f in noisy]
    plain = 5.0 * np.mean(np.sqrt(flux / noisy))
    assert plain - 5.0 == pytest.approx(5.0 * 0.375 * 0.01, rel=0.15)
    assert abs(np.mean(found) - 5.0) < 0.15 * 5.0 * 0.375 * 0.01 + 4 * 0.25 / math.sqrt(20000)


@pytest.mark.parametrize("flux_dn", [0.0, -5.0, math.nan])
def test_no_flux_no_range(flux_dn: float) -> None:
    assert math.isnan(range_from_flux(flux_dn, 1.0, 600.0, 400.0, 1e-3, 1.0, calibration()).range_m)


def test_response_is_not_extrapolated() -> None:
    camera = calibration(response_angle_rad=np.array([0.0, 0.5]), response_relative=np.array([1.0, 0.9]))
    inside, outside = 639.5 + 480.0 * math.tan(0.49), 639.5 + 480.0 * math.tan(0.51)
    assert flux_at_one_metre_dn(inside, 479.5, 1e-3, 1.0, camera) > 0.0
    assert math.isnan(flux_at_one_metre_dn(outside, 479.5, 1e-3, 1.0, camera))
    assert math.isnan(range_from_flux(100.0, 1.0, outside, 479.5, 1e-3, 1.0, camera).range_m)


def test_angular_radius() -> None:
    assert angular_radius_rad(0.02, 0.01) == pytest.approx(math.pi / 6, rel=1e-14)
    assert angular_radius_rad(1.0, 0.0) == 0.0
    assert angular_radius_rad(0.001, 0.01) < math.pi / 2
