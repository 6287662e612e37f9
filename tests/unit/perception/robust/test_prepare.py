"""What a frame is prepared to: its background, and the level that noise does not pass."""

import numpy as np
import pytest
from scipy.stats import norm, poisson

from perception.robust.prepare import (
    FALSE_ALARMS_PER_PIXEL,
    background_mesh_e,
    detection_limit_e,
    matched_filter,
    point_kernel,
    spread_mesh,
)
from tests.unit.perception.simulation import calibration, expose, random


@pytest.mark.parametrize("level_e", [0.0, 0.6, 40.0, 2000.0])
def test_flat_background(level_e: float) -> None:
    """Within 5 standard errors (with 3 σ clipping) of truth over 12 cells, also where Poisson is skewed."""
    camera = calibration(width_px=256, height_px=192, read_noise_e=2.0)
    frame = expose(np.full((192, 256), level_e), camera, random(21))
    mesh = background_mesh_e(frame, camera)
    assert mesh.shape == (3, 4)
    sigma = np.sqrt(level_e + 4.0 + 0.15)
    assert abs(mesh.mean() - level_e) < 5.0 * sigma / np.sqrt(12 * 1024) + 0.02 * sigma


def test_flares_do_not_lift_the_background() -> None:
    """Bright discs on a quarter of a cell move its level by less than 0.3 σ."""
    camera = calibration(width_px=320, height_px=320)
    mean = np.full((320, 320), 20.0)
    mean[140:172, 140:172] += 3000.0
    mesh = background_mesh_e(expose(mean, camera, random(22)), camera)
    assert abs(mesh[2, 2] - 20.0) < 0.3 * np.sqrt(120.0)


def test_a_ramp_stays_where_it_is() -> None:
    """A slope across the frame, 0.25 e per px: half a cell of shift would be 8 e."""
    camera = calibration(width_px=640, height_px=480, read_noise_e=3.0)
    mean = np.broadcast_to(50.0 + 0.25 * np.arange(640.0), (480, 640))
    full = spread_mesh(background_mesh_e(expose(mean, camera, random(23)), camera), camera)
    inner = np.s_[100:-100, 100:-100]
    assert np.abs((full - mean)[inner]).max() < 2.5
    assert abs((full - mean)[inner].mean()) < 0.2


@pytest.mark.parametrize(("width", "height"), [(1, 1), (5, 3), (100, 31), (65, 700)])
def test_any_size(width: int, height: int) -> None:
    camera = calibration(width_px=width, height_px=height)
    frame = expose(np.full((height, width), 10.0), camera, random(24))
    assert spread_mesh(background_mesh_e(frame, camera), camera).shape == (height, width)


def test_kernel_is_the_pixel_integrated_psf() -> None:
    kernel = point_kernel(0.7)
    middle = norm.cdf(0.5 / 0.7) - norm.cdf(-0.5 / 0.7)
    assert kernel.sum() == pytest.approx(1.0, rel=1e-14)
    assert kernel.max() == pytest.approx(middle, rel=1e-3)
    assert kernel.size == 7


def test_gaussian_limit_is_six_sigma() -> None:
    """One false alarm in a thousand frames of 1280 × 960: Q(t) = 8.1e-10, t = 6.03."""
    kernel = point_kernel(0.7)
    limit = detection_limit_e(np.array([0.0]), 100.0, kernel)[0] / (10.0 * np.sum(kernel**2))
    assert limit == pytest.approx(norm.isf(FALSE_ALARMS_PER_PIXEL), rel=1e-6)
    assert limit == pytest.approx(6.03, abs=0.01)


@pytest.mark.parametrize(("background_e", "floor_e2"), [(0.5, 1.0), (0.05, 4.0), (20.0, 5.0)])
def test_poisson_tail_against_exact_sums(background_e: float, floor_e2: float) -> None:
    """One pixel alone: the tail of Poisson plus Gaussian, summed exactly, is met within 15 %.

    The Gaussian limit would be passed a hundred times as often at 0.5 electrons.
    """
    limit = detection_limit_e(np.array([background_e]), floor_e2, np.array([1.0]))[0]
    n = np.arange(200)
    tail = np.sum(poisson.pmf(n, background_e) * norm.sf((limit + background_e - n) / np.sqrt(floor_e2)))
    assert tail == pytest.approx(FALSE_ALARMS_PER_PIXEL, rel=0.15)
    if background_e == 0.5:
        gaussian = 6.03 * np.sqrt(background_e + floor_e2)
        short = np.sum(
            poisson.pmf(n, background_e) * norm.sf((gaussian + background_e - n) / np.sqrt(floor_e2))
        )
        assert short > 50.0 * FALSE_ALARMS_PER_PIXEL


@pytest.mark.parametrize(("background_e", "read_e"), [(0.3, 0.5), (5.0, 10.0)])
def test_tail_of_filtered_noise(background_e: float, read_e: float) -> None:
    """At 1e-4 per pixel, noise passes as often as asked: 4e6 pixels, within 5 standard errors."""
    kernel = point_kernel(0.7)
    rng = random(31, int(10 * read_e))
    noise = rng.poisson(background_e, (2000, 2000)) - background_e + rng.normal(0, read_e, (2000, 2000))
    limit = detection_limit_e(np.array([background_e]), read_e**2, kernel, 1e-4)[0]
    passed = int((matched_filter(noise.astype(np.float32), kernel) > limit).sum())
    # Neighbours pass together, about three at a time.
    assert abs(passed - 400) < 5.0 * np.sqrt(3.0 * 400)


def test_filter_keeps_the_place_and_is_quiet_at_the_border() -> None:
    image = np.zeros((20, 30), np.float32)
    image[7, 11] = 1.0
    kernel = point_kernel(0.7)
    filtered = matched_filter(image, kernel)
    assert filtered.argmax() == 7 * 30 + 11
    assert filtered.max() == pytest.approx(kernel.max() ** 2, rel=1e-6)
    ones = matched_filter(np.ones((20, 30), np.float32), kernel)
    assert ones[0, 0] < 0.7 < ones[10, 10] == pytest.approx(1.0, rel=1e-6)
