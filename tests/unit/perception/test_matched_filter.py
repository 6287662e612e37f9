import numpy as np
import pytest
from scipy.stats import norm, poisson

from perception.matched_filter import FALSE_ALARMS_PER_PIXEL, detection_limit_e, matched_filter, point_kernel
from tests.unit.perception.simulation import random


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
