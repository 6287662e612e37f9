"""What a frame is prepared to: its background, and the level that noise does not pass."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import correlate1d, gaussian_filter
from scipy.stats import norm, poisson

from perception.robust.search.background import background_mesh_e, cell_means, cell_scatter, spread_mesh
from perception.robust.search.frame import Pixels, above, exceeding, filtered, without
from perception.robust.search.limit import FALSE_ALARMS_PER_PIXEL, detection_limit_e, in_threes, point_kernel
from perception.robust.search.prepare import prepare
from perception.types import Calibration
from tests.unit.perception.simulation import calibration, expected_e, expose, random


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
    passed = int((correlate(noise, kernel) > limit).sum())
    # Neighbours pass together, about three at a time.
    assert abs(passed - 400) < 5.0 * np.sqrt(3.0 * 400)


def correlate(image: NDArray[np.floating], kernel: NDArray[np.float64]) -> NDArray[np.float64]:
    """Correlate along both axes, zero beyond the border: scipy's."""
    once = correlate1d(image, kernel, axis=0, mode="constant")
    return np.asarray(correlate1d(once, kernel, axis=1, mode="constant"))


def slope_of(camera: Calibration) -> tuple[Pixels, NDArray[np.float64]]:
    """Random counts on a background that rises from row to row of the mesh, and what exceeds it in electrons."""
    counts = random(25).integers(60, 4000, (camera.height_px, camera.width_px)).astype(np.uint16)
    mesh_e = np.array([[3.0], [50.0], [20.0]], dtype=np.float32).repeat(3, axis=1)
    wide_e = mesh_e[:, :1].repeat(camera.width_px, axis=1)
    excess_e = (counts - 64.0) / 0.74 - spread_mesh(mesh_e, camera)
    return Pixels(counts, 64.0, 1.0 / 0.74, wide_e), np.asarray(excess_e, dtype=np.float64)


@pytest.mark.parametrize("psf_sigma_px", [0.5, 0.7, 1.3])
def test_filtered_electrons_are_those_of_another_library(psf_sigma_px: float) -> None:
    """The whole frame up to its borders, and a part of it, against scipy's correlation; one pixel is bad."""
    camera = calibration(width_px=150, height_px=90)
    pixels, excess_e = slope_of(camera)
    kernel, bad_at = point_kernel(psf_sigma_px), np.array([40 * 150 + 70])
    expected = correlate(excess_e, kernel)
    whole = filtered(pixels, in_threes(kernel), np.empty(0, dtype=np.int64), (0, 0, 90, 150))
    np.testing.assert_allclose(whole, expected, atol=0.02)
    excess_e[40, 70] = 0.0
    part = filtered(pixels, in_threes(kernel), bad_at, (30, 55, 25, 40))
    np.testing.assert_allclose(part, correlate(excess_e, kernel)[30:55, 55:95], atol=0.02)
    places = np.arange(150 * 90)
    values = whole.ravel().copy()
    without(places, values, pixels, in_threes(kernel), bad_at)
    np.testing.assert_allclose(values.reshape(90, 150), correlate(excess_e, kernel), atol=0.02)


def test_what_exceeds_the_limit_is_found_in_order() -> None:
    """With a limit that jumps from one mesh row to the next, where rows below it take part in sums above it."""
    camera = calibration(width_px=150, height_px=90)
    pixels, _ = slope_of(camera)
    kernel = in_threes(point_kernel(0.7))
    limit_e = np.array([[2300.0], [3000.0], [2600.0]], dtype=np.float32).repeat(150, axis=1)
    sample_of = np.full(90, -1)
    sample_of[[5, 50]] = (0, 1)
    sampled = np.array([0, 77, 149])
    places, values, samples = exceeding(pixels, kernel, limit_e, sample_of, sampled)
    image = filtered(pixels, kernel, np.empty(0, dtype=np.int64), (0, 0, 90, 150))
    limit = np.interp(np.arange(90), [14.5, 44.5, 74.5], limit_e[:, 0])
    assert places.tolist() == np.flatnonzero(image > limit[:, None]).tolist()
    assert len(places) > 500
    np.testing.assert_allclose(values, image.ravel()[places], rtol=1e-5)
    np.testing.assert_allclose(samples, image[np.ix_(np.array([5, 50]), sampled)], rtol=1e-4, atol=0.01)
    kept = above(places, values, limit_e + np.float32(200.0), 90)
    assert places[kept].tolist() == np.flatnonzero(image > limit[:, None] + 200.0).tolist()


def test_scatter_of_cells_against_sorting() -> None:
    """Narrow, as noise, and 20 times as wide, beyond the histogram: within its step of the sorted samples'."""
    for width in (1.0, 20.0):
        samples = random(27, int(width)).normal(0.0, 3.0 * width, (64, 80)).astype(np.float32)
        found = cell_scatter(
            samples, np.full((1, 2), 3.0, dtype=np.float32), np.full((1, 2), np.inf, dtype=np.float32)
        )
        for cell, part in enumerate((samples[:, :40], samples[:, 40:])):
            ordered = np.sort(part.ravel())
            low, high = round(0.1587 * (ordered.size - 1)), round(0.8413 * (ordered.size - 1))
            assert found[0, cell] == pytest.approx((ordered[high] - ordered[low]) / 6.0, abs=0.01)


def test_means_of_cells_against_sorting() -> None:
    """A fifth of a cell lies in bright light: the clipped mean is that of samples sorted and cut in three rounds."""
    counts = random(28).poisson(30.0, (64, 64)).astype(np.uint16) + np.uint16(64)
    counts[:, :13] += np.uint16(40)
    at = np.arange(64).reshape(1, 64)
    seen = np.sort(counts.ravel()).astype(np.float64)
    kept = seen
    for _ in range(3):
        median = kept[(kept.size - 1) // 2]
        kept = seen[abs(seen - median) <= 3.0 * np.sqrt(max(median - 64.0, 0.0) + 4.0)]
    assert cell_means(counts, at, at, 64.0, 1.0, 4.0, 65535)[0, 0] == pytest.approx(kept.mean(), rel=1e-12)


def test_filter_keeps_the_place_and_is_quiet_at_the_border() -> None:
    image, none, box = np.zeros((20, 30), np.uint16), np.empty(0, dtype=np.int64), (0, 0, 20, 30)
    image[7, 11] = 1000
    kernel, ground = in_threes(point_kernel(0.7)), np.zeros((1, 30), np.float32)
    response = filtered(Pixels(image, 0.0, 1e-3, ground), kernel, none, box)
    assert response.argmax() == 7 * 30 + 11
    assert response.max() == pytest.approx(kernel.max() ** 2, rel=1e-6)
    ones = filtered(Pixels(np.full((20, 30), 1000, np.uint16), 0.0, 1e-3, ground), kernel, none, box)
    assert ones[0, 0] < 0.7 < ones[10, 10] == pytest.approx(1.0, rel=1e-6)


def test_clipped_pixels_are_no_background() -> None:
    """A patch of 200 px clips: beneath it the ground is that around it, and all of it is lit."""
    camera = calibration(width_px=640, height_px=480, cx_px=319.5, cy_px=239.5)
    mean = np.full((480, 640), 30.0)
    mean[150:350, 220:420] = 1e5
    frame = expose(mean, camera, random(29))
    mesh = background_mesh_e(frame, camera)
    assert abs(mesh - 30.0).max() < 1.0
    prepared = prepare(frame, camera)
    assert np.bincount(prepared.lit_at // 640, minlength=480)[160:340].min() >= 200


def test_discs_of_near_sources_are_no_structure_of_even_ground() -> None:
    """Sixty balls of 4 to 13 px cover a tenth of the frame: nine cells of ten counted as uneven."""
    camera = calibration(width_px=640, height_px=480, cx_px=319.5, cy_px=239.5)
    number = random(30).random((60, 3))
    places = [(20.0 + 600.0 * a, 20.0 + 440.0 * b, 0.35 * 3.0**c) for a, b, c in number]
    frame = expose(expected_e(camera, places, 1e-4, 3.0), camera, random(31), 1e-4)
    texture_e = prepare(frame, camera).texture_e
    assert texture_e is None or np.mean(texture_e > 0.0) < 0.05


@pytest.mark.parametrize("correlation_px", [4.0, 8.0])
def test_ground_as_bright_as_half_of_full_scale_keeps_its_structure(correlation_px: float) -> None:
    """Sunlit, 3 600 e and a fifth of that up and down: its hills are as bright as half of what clips above it."""
    camera = calibration(width_px=384, height_px=384, cx_px=191.5, cy_px=191.5)
    hills = gaussian_filter(random(32).normal(size=(384, 384)), correlation_px, mode="wrap")
    frame = expose(3600.0 * (1.0 + 0.2 * hills / hills.std()), camera, random(33))
    texture_e = prepare(frame, camera).texture_e
    assert texture_e is not None
    assert np.mean(texture_e > 0.0) > 0.95
