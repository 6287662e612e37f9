import math

import numpy as np
import pytest

from perception.model.fisher import covariance, flare_limit
from tests.unit.perception.simulation import calibration


@pytest.mark.parametrize(
    ("flux_e", "position_px", "range_sigma_m"),
    [(1e3, 0.053, 0.21), (1e4, 0.012, 0.053), (1e5, 0.0034, 0.016)],
)
def test_figures_of_the_physics_page(flux_e: float, position_px: float, range_sigma_m: float) -> None:
    """PSF σ = 1 px, variance 41 e⁻² per pixel in all, a point source at 10 m."""
    camera = calibration(
        psf_sigma_px=1.0,
        source_radius_m=0.0,
        system_gain_dn_per_e=100.0,
        read_noise_e=5.0,
        saturation_dn=10**9,
    )
    limit = flare_limit(camera, 639.5, 479.5, 10.0, flux_e, background_e=16.0)
    assert limit.u_sigma_px == pytest.approx(position_px, rel=0.03)
    assert limit.v_sigma_px == pytest.approx(limit.u_sigma_px, rel=1e-9)
    assert limit.range_sigma_m == pytest.approx(range_sigma_m, rel=0.03)


def test_bright_point_reaches_the_shot_noise_limit() -> None:
    """Without read noise or background, σ_F = √F and σ_u = σ_psf / √F (the pixel widens it by 1/24 σ²)."""
    camera = calibration(
        psf_sigma_px=2.0, source_radius_m=0.0, read_noise_e=0.0, system_gain_dn_per_e=1e4, saturation_dn=10**9
    )
    limit = flare_limit(camera, 639.7, 479.2, 5.0, 1e6, background_e=0.0)
    assert limit.flux_sigma_e == pytest.approx(1e3, rel=0.01)
    assert limit.u_sigma_px == pytest.approx(math.sqrt(4.0 + 1 / 12) / 1e3, rel=0.01)


def test_clipped_pixels_tell_nothing() -> None:
    camera = calibration()
    clipped = flare_limit(camera, 639.5, 479.5, 3.0, 1e5, 2.0)
    unclipped = flare_limit(camera, 639.5, 479.5, 3.0, 1e5, 2.0, clipped_tell_nothing=False)
    assert clipped.flux_sigma_e > 1.25 * unclipped.flux_sigma_e
    everywhere = flare_limit(camera, 639.5, 479.5, 3.0, 1e5, 6000.0)
    assert everywhere.range_sigma_m == math.inf


def test_outside_the_frame_nothing_is_known() -> None:
    assert flare_limit(calibration(), -100.0, 50.0, 3.0, 1e4, 2.0).u_sigma_px == math.inf
    with pytest.raises(ValueError, match="positive"):
        flare_limit(calibration(), 100.0, 50.0, 3.0, 0.0, 2.0)


def test_covariance_of_badly_scaled_information() -> None:
    information = np.array([[1e12, 5e5], [5e5, 1.0]])
    inverse = covariance(information)
    assert inverse is not None
    np.testing.assert_allclose(inverse @ information, np.eye(2), atol=1e-9)
    assert covariance(np.array([[1.0, 1.0], [1.0, 1.0]])) is None
