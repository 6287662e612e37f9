import math
from dataclasses import replace

import numpy as np
import pytest

from perception.model.fisher import flare_limit
from perception.model.flare import PixelBox, flare_image
from perception.model.ranging import angular_radius_rad
from perception.model.sensor import noise_floor_e2
from perception.robust.fit import aperture_flux, core_goodness, fit_flare
from tests.unit.perception.simulation import calibration, random

TRIALS = 400


def test_aperture_counts_all_of_a_noiseless_flare() -> None:
    camera = calibration()
    window = PixelBox.around(300.3, 400.6, 20.0, camera)
    image = 5e4 * flare_image(300.3, 400.6, 0.002, window, camera).fraction + 7.0
    measured = aperture_flux(image, 300.3 - window.left, 400.6 - window.top, 6.0, 8.0, 14.0)
    assert measured.flux == pytest.approx(5e4, rel=1e-5)
    assert measured.background == pytest.approx(7.0, abs=1e-6)
    assert measured.flux_sigma == pytest.approx(math.sqrt(5e4), rel=1e-3)


def test_aperture_sigma_is_that_of_repeated_measurements() -> None:
    rng = random(11)
    camera = calibration()
    window = PixelBox(380, 280, 41, 41)
    mean = 3e3 * flare_image(300.0, 400.0, 0.0, window, camera).fraction + 30.0
    found = [
        aperture_flux(rng.poisson(mean) + rng.normal(0, 10.0, mean.shape), 20.0, 20.0, 5.0, 6.0, 9.0)
        for _ in range(TRIALS)
    ]
    scatter = np.std([f.flux for f in found], ddof=1)
    assert scatter == pytest.approx(np.mean([f.flux_sigma for f in found]), rel=4 / math.sqrt(2 * TRIALS))


def test_aperture_radii() -> None:
    with pytest.raises(ValueError, match="ring_outer_px"):
        aperture_flux(np.zeros((5, 5)), 2.0, 2.0, 3.0, 2.0, 4.0)


@pytest.mark.parametrize(
    ("range_m", "flux_e", "background_e"), [(10.0, 1.9e4, 5.0), (10.0, 3e3, 0.2), (1.0, 3.4e5, 50.0)]
)
def test_fit_is_unbiased_and_efficient(range_m: float, flux_e: float, background_e: float) -> None:
    """400 flares: mean within 4 standard errors of truth, scatter and claim within 4 of the bound.

    The mean flux is so known to 0.01–0.15 %: a gain that is 1 % off would not pass (checked below).
    """
    camera = calibration()
    rng = random(1, int(range_m), int(flux_e))
    u_px, v_px = 900.3, 320.8
    window = PixelBox.around(u_px, v_px, 14.0, camera)
    radius = angular_radius_rad(range_m, camera.source_radius_m)
    mean = flux_e * flare_image(u_px, v_px, radius, window, camera).fraction + background_e
    usable = np.ones(mean.shape, dtype=bool)
    gain = camera.system_gain_dn_per_e
    estimates, claims, chi2 = [], [], []
    for _ in range(TRIALS):
        electrons = rng.poisson(mean) + rng.normal(0.0, camera.read_noise_e, mean.shape)
        counts = np.rint(electrons * gain + 64.0)
        fit = fit_flare(
            (counts - 64.0) / gain,
            usable,
            window,
            camera,
            start=(u_px + 0.4, v_px - 0.3, 0.7 * flux_e, 0.0),
            angular_radius_rad=radius,
        )
        assert fit.converged
        estimates.append([fit.u_px, fit.v_px, fit.flux_e, fit.background_e])
        claims.append(np.sqrt(np.diagonal(fit.covariance)))
        chi2.append(fit.reduced_chi2)
    found = np.array(estimates)
    scatter = found.std(axis=0, ddof=1)
    error = np.abs(found.mean(axis=0) - [u_px, v_px, flux_e, background_e]) / (scatter / math.sqrt(TRIALS))
    assert np.all(error < 4.0), error
    assert 0.01 * flux_e > 5.0 * scatter[2] / math.sqrt(TRIALS), "1 % of gain would go unnoticed"

    limit = flare_limit(camera, u_px, v_px, range_m, flux_e, background_e)
    bound = np.array([limit.u_sigma_px, limit.v_sigma_px, limit.flux_sigma_e])
    tolerance = 4.0 / math.sqrt(2 * TRIALS)
    np.testing.assert_allclose(scatter[:3], bound, rtol=tolerance)
    np.testing.assert_allclose(np.mean(claims, axis=0)[:3], bound, rtol=0.03)
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(("flux_e", "background_e"), [(500.0, 2.0), (6e4, 50.0)])
def test_the_claim_holds_over_fixed_patterns(flux_e: float, background_e: float) -> None:
    """Each of 400 flares lies on other pixels: offsets of 6 e, responses of 2 %, and little read noise, 2 e.

    Offsets rule over the faint flare, responses over the bright one. Claim and limit match the scatter within
    4 standard errors of it; those of a camera that is taken to have no fixed patterns are too small by more.
    """
    camera = calibration(psf_sigma_px=1.5, read_noise_e=2.0, dsnu_e=6.0, prnu=0.02)
    unaware = replace(camera, dsnu_e=0.0, prnu=0.0)
    rng = random(5, int(flux_e))
    window = PixelBox.around(900.3, 320.8, 14.0, camera)
    radius = angular_radius_rad(5.0, camera.source_radius_m)
    mean = flux_e * flare_image(900.3, 320.8, radius, window, camera).fraction + background_e
    usable = np.ones(mean.shape, dtype=bool)
    gain = camera.system_gain_dn_per_e
    fluxes_e: dict[bool, list[float]] = {True: [], False: []}
    claims_e: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(TRIALS):
        charge_e = rng.poisson(mean * (1.0 + rng.normal(0.0, 0.02, mean.shape)))
        read_e = charge_e + rng.normal(0.0, 6.0, mean.shape) + rng.normal(0.0, 2.0, mean.shape)
        image_e = (np.rint(read_e * gain + 64.0) - 64.0) / gain
        for aware in (True, False):
            fit = fit_flare(
                image_e,
                usable,
                window,
                camera if aware else unaware,
                start=(900.3, 320.8, flux_e, background_e),
                angular_radius_rad=radius,
            )
            assert fit.converged
            fluxes_e[aware].append(fit.flux_e)
            claims_e[aware].append(fit.flux_sigma_e)
    tolerance = 4.0 / math.sqrt(2 * TRIALS)
    claim_e, scatter_e = np.mean(claims_e[True]), np.std(fluxes_e[True], ddof=1)
    assert claim_e == pytest.approx(scatter_e, rel=tolerance)
    assert np.mean(claims_e[False]) < (1.0 - tolerance) * np.std(fluxes_e[False], ddof=1)
    limit = flare_limit(camera, 900.3, 320.8, 5.0, flux_e, background_e)
    assert claim_e == pytest.approx(limit.flux_sigma_e, rel=0.03)
    assert abs(np.mean(fluxes_e[True]) - flux_e) < 4.0 * scatter_e / math.sqrt(TRIALS)


def test_fit_of_unclipped_wings_is_unbiased() -> None:
    """The peak is masked where the model comes within 3 σ of the clip level."""
    camera = calibration()
    rng = random(2)
    window = PixelBox.around(700.2, 500.4, 12.0, camera)
    mean = 8e4 * flare_image(700.2, 500.4, 0.002, window, camera).fraction + 3.0
    clip_e = (4095 - 64) / 0.74
    usable = mean < clip_e - 3.0 * np.sqrt(mean + 100.0)
    assert 4 < (~usable).sum() < 16
    fits = []
    for _ in range(200):
        data = rng.poisson(mean) + rng.normal(0.0, 10.0, mean.shape)
        fits.append(
            fit_flare(
                np.minimum(data, clip_e),
                usable,
                window,
                camera,
                start=(700.0, 500.0, 4e4, 0.0),
                angular_radius_rad=0.002,
            )
        )
    flux = np.array([fit.flux_e for fit in fits])
    assert abs(flux.mean() - 8e4) < 4.0 * flux.std() / math.sqrt(flux.size)
    assert flux.std(ddof=1) == pytest.approx(np.mean([f.flux_sigma_e for f in fits]), rel=0.2)


def test_a_fit_that_nothing_determines() -> None:
    camera = calibration()
    window = PixelBox(100, 100, 9, 9)
    usable = np.zeros((9, 9), dtype=bool)
    usable[4, 4:6] = True
    fit = fit_flare(
        np.full((9, 9), 5.0), usable, window, camera, start=(104.0, 104.0, 1e3, 0.0), angular_radius_rad=0.0
    )
    assert not fit.converged
    assert np.isnan(fit.covariance).all()
    with pytest.raises(ValueError, match="match"):
        fit_flare(
            np.zeros((3, 3)), usable, window, camera, start=(104.0, 104.0, 1.0, 0.0), angular_radius_rad=0.0
        )


def test_goodness_tells_two_flares_from_one() -> None:
    camera = calibration()
    rng = random(3)
    window = PixelBox.around(600.0, 400.0, 12.0, camera)
    one = 2e4 * flare_image(600.0, 400.0, 0.001, window, camera).fraction
    two = one + 1.5e4 * flare_image(601.6, 400.0, 0.001, window, camera).fraction
    probabilities = []
    for mean in (one, two):
        data = rng.poisson(mean + 2.0) + rng.normal(0.0, 10.0, mean.shape)
        fit = fit_flare(
            data,
            np.ones(mean.shape, dtype=bool),
            window,
            camera,
            start=(600.5, 400.0, 2e4, 2.0),
            angular_radius_rad=0.001,
        )
        probabilities.append(
            core_goodness(
                data, fit.expected_e, fit.background_e, fit.used, noise_floor_e2(camera), 0.05
            ).probability
        )
    assert probabilities[0] > 1e-3
    assert probabilities[1] < 1e-9
