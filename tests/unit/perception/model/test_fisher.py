import math
from collections.abc import Mapping
from dataclasses import asdict, replace

import numpy as np
import pytest

from perception.model.fisher import (
    censored_weight,
    covariance,
    fixed_influence,
    flare_limit,
    flare_limits,
    range_causes,
)
from perception.types import Calibration
from tests.unit.perception.simulation import calibration, random


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
        sigma={},
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


def test_two_on_one_bearing_know_less_than_one() -> None:
    """Points 1 px apart: each is ranged 3 times worse than alone; 20 px apart they do not know of each other."""
    camera = calibration(source_radius_m=0.0, sigma={})
    alone = flare_limit(camera, 640.0, 480.0, 9.0, 1e4, 2.0).range_sigma_m
    near, _ = flare_limits(camera, [(640.0, 480.0, 9.0, 1e4), (641.0, 480.0, 9.5, 9e3)], 2.0)
    far, _ = flare_limits(camera, [(640.0, 480.0, 9.0, 1e4), (660.0, 480.0, 9.5, 9e3)], 2.0)
    assert near.range_sigma_m > 3.0 * alone
    assert far.range_sigma_m == pytest.approx(alone, rel=0.01)
    same, _ = flare_limits(camera, [(640.0, 480.0, 9.0, 1e4), (640.0, 480.0, 9.0, 1e4)], 2.0)
    assert same.range_sigma_m == math.inf


def test_a_censored_pixel_keeps_what_its_score_varies_by() -> None:
    """Against the mean square of the score of 10⁶ drawn pixels, clipped at z = -1, 0, 1."""
    noise = random(31).normal(size=1_000_000)
    for z in (-1.0, 0.0, 1.0):
        mills = math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi) / (0.5 * math.erfc(z / math.sqrt(2.0)))
        score = np.where(noise < z, noise, mills)
        kept = float(censored_weight(np.zeros(1), np.ones(1), z)[0])
        assert kept == pytest.approx(float(np.mean(score**2)), rel=0.005)


def test_clipped_pixels_tell_nothing() -> None:
    camera = calibration(source_radius_m=0.0)
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


_SIGMAS = {"range_constant_dn_m2_per_s": 0.05, "source_radius_m": 0.02, "psf_sigma_px": 0.03}  # of the values


def _with_sigmas(camera: Calibration, factors: Mapping[str, float]) -> Calibration:
    sigma = {name: share * getattr(camera, name) * factors.get(name, 1.0) for name, share in _SIGMAS.items()}
    return replace(camera, sigma=sigma)


@pytest.mark.parametrize("range_m", [0.05, 0.5, 3.0, 10.0])
@pytest.mark.parametrize("exact", [True, False])
def test_causes_add_up_to_the_limit_and_each_is_its_slope(range_m: float, exact: bool) -> None:
    """The bound's square is homogeneous in all variances, so a cause's share is its variance times the slope."""
    # Dark as it is no pixel clips: what clipping hides depends on the noise in another way.
    camera = calibration(prnu=0.0, dsnu_e=3.0, saturation_dn=10**9, sigma={})
    camera = camera if exact else _with_sigmas(camera, {})
    flux_e, background_e = 4e4 / range_m**2, 30.0

    def square(changed: Calibration, background: float = background_e) -> float:
        return flare_limit(changed, 640.0, 480.0, range_m, flux_e, background).range_sigma_m ** 2

    found = range_causes(camera, 640.0, 480.0, range_m, flux_e, background_e)
    assert found is not None
    causes_m = asdict(found)
    assert math.hypot(*causes_m.values()) == pytest.approx(math.sqrt(square(camera)), rel=1e-9)
    step = 1e-3  # of a variance: half of it of a σ

    def slope(more: Calibration, less: Calibration, of: tuple[float, float] = (background_e,) * 2) -> float:
        return (square(more, of[0]) - square(less, of[1])) / (2.0 * step)

    for cause, field in (("read_noise_m", "read_noise_e"), ("dsnu_m", "dsnu_e")):
        more, less = (
            replace(camera, **{field: getattr(camera, field) * math.sqrt(1.0 + sign * step)})
            for sign in (1, -1)
        )
        assert causes_m[cause] ** 2 == pytest.approx(slope(more, less), rel=2e-3, abs=1e-7 * square(camera))
    around = (background_e * (1.0 + step), background_e * (1.0 - step))
    assert causes_m["background_m"] ** 2 == pytest.approx(
        slope(camera, camera, around), rel=2e-3, abs=1e-7 * square(camera)
    )
    if exact:
        return
    names = {
        "range_constant_m": "range_constant_dn_m2_per_s",
        "source_radius_m": "source_radius_m",
        "point_spread_m": "psf_sigma_px",
    }
    for cause, field in names.items():
        more, less = (_with_sigmas(camera, {field: math.sqrt(1.0 + sign * step)}) for sign in (1, -1))
        assert causes_m[cause] ** 2 == pytest.approx(slope(more, less), rel=5e-3, abs=1e-6 * square(camera))


def test_causes_of_a_bright_point_are_its_own_light() -> None:
    """σ_d = d/2 √F/F of its own light alone; with a PRNU of 1 % another 0.005 d √(Σ S²)."""
    camera = calibration(
        psf_sigma_px=2.0, source_radius_m=0.0, read_noise_e=0.0, system_gain_dn_per_e=1e4, saturation_dn=10**9,
        prnu=0.0, dsnu_e=0.0, sigma={},
    )  # fmt: skip
    found = range_causes(camera, 639.7, 479.2, 5.0, 1e6, background_e=0.0)
    assert found is not None
    assert found.own_light_m == pytest.approx(2.5e-3, rel=0.01)
    assert (found.background_m, found.prnu_m, found.read_noise_m) == (0.0, 0.0, 0.0)


def test_nothing_has_no_causes() -> None:
    assert range_causes(calibration(), 639.5, 479.5, 3.0, 1e5, 6000.0) is None
    assert range_causes(calibration(), -100.0, 50.0, 3.0, 1e4, 2.0) is None


def test_what_is_fixed_about_pixels_changes_the_flux_by_their_weights() -> None:
    """All responses by 1 % more change the flux by 1 %; unlike ones as `prnu_m` and `dsnu_m` say, by 2 σ_d/d."""
    camera = replace(calibration(prnu=0.009, dsnu_e=2.0), sigma={"source_radius_m": 1.0})
    place = (639.7, 479.2, 3.0, 1e4, 20.0)
    found, causes = fixed_influence(camera, *place), range_causes(camera, *place)
    assert found is not None
    assert causes is not None
    box, of_response, of_offset = found
    assert of_response.shape == of_offset.shape == (box.height, box.width)
    assert of_response.sum() == pytest.approx(1.0, abs=1e-6)
    assert of_offset.sum() == pytest.approx(0.0, abs=1e-9)  # an even offset is background
    assert 0.009 * np.sqrt((of_response**2).sum()) == pytest.approx(2.0 * causes.prnu_m / 3.0, rel=1e-6)
    assert 2.0 * np.sqrt((of_offset**2).sum()) == pytest.approx(2.0 * causes.dsnu_m / 3.0, rel=1e-6)


def test_what_cannot_be_ranged_has_no_influence() -> None:
    assert fixed_influence(calibration(), -100.0, 50.0, 3.0, 1e4, 2.0) is None
    assert fixed_influence(calibration(), 639.5, 479.5, 0.05, 1e6, 2.0) is None  # larger than 64 px
