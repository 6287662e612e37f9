"""Brightness at predicted places, against frames made by brute force."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from perception.estimators import detect
from perception.photometry import Expected, Sample, expected_images, sample_at, sample_of_detection
from perception.types import Calibration, RawFrame
from tests.unit.perception.simulation import calibration, expected_e, expose, random

CAMERA = calibration(width_px=96, height_px=72, cx_px=47.5, cy_px=35.5)
EXPOSURE_S = 1e-4
DRAWS = 120


def _place(u_px: float, v_px: float, range_m: float) -> NDArray[np.float64]:
    """Return the place, in body axes, of what is seen at a pixel at a range."""
    towards = np.array([(u_px - CAMERA.cx_px) / CAMERA.fx_px, (v_px - CAMERA.cy_px) / CAMERA.fy_px, 1.0])
    towards *= range_m / np.linalg.norm(towards)
    return np.asarray(CAMERA.position_body_m + CAMERA.rotation_body_camera @ towards)


def _expected(u_px: float, v_px: float, range_m: float, sigma_m: float = 1e-3) -> Expected:
    frame = expose(np.zeros((CAMERA.height_px, CAMERA.width_px)), CAMERA, random(0), EXPOSURE_S)
    place_m, covariance_m2 = _place(u_px, v_px, range_m)[None, :], sigma_m**2 * np.eye(3)[None, :, :]
    (found,) = expected_images(place_m, covariance_m2, frame, CAMERA)
    assert found is not None
    return found


def _frame(sources: list[tuple[float, float, float]], *key: int, background_e: float = 5.0) -> RawFrame:
    return expose(expected_e(CAMERA, sources, EXPOSURE_S, background_e), CAMERA, random(*key), EXPOSURE_S)


def _sampled(
    expected: Expected, sources: list[tuple[float, float, float]], case: int, camera: Calibration = CAMERA
) -> list[Sample]:
    samples = []
    mean_e = expected_e(CAMERA, sources, EXPOSURE_S, 5.0)
    for draw in range(DRAWS):
        frame = expose(mean_e, CAMERA, random(case, draw), EXPOSURE_S)
        found = detect(frame, camera)
        one = sample_at(expected, found, frame, camera)
        assert one is not None
        samples.append(one)
    return samples


def test_a_source_is_expected_where_it_is_and_as_bright_as_it_is() -> None:
    expected = _expected(60.25, 20.75, 4.0)
    assert (expected.u_px, expected.v_px) == pytest.approx((60.25, 20.75), abs=1e-9)
    electrons = expected_e(CAMERA, [(60.25, 20.75, 4.0)], EXPOSURE_S).sum()
    assert expected.flux_dn == pytest.approx(electrons * CAMERA.system_gain_dn_per_e, rel=1e-6)
    # A millimetre across, 4 m away, is f / 4000 of a pixel.
    assert expected.sigma_px == pytest.approx(CAMERA.fx_px / 4000.0, rel=0.01)


def test_a_source_out_of_view_is_not_expected() -> None:
    frame = _frame([], 1)
    behind = CAMERA.position_body_m - np.array([1.0, 0.0, 0.0])
    places_m = np.array([behind, _place(96.0, 35.0, 4.0), _place(40.0, -1.0, 4.0), _place(40.0, 35.0, 4.0)])
    found = expected_images(places_m, np.tile(np.eye(3) * 1e-6, (4, 1, 1)), frame, CAMERA)
    assert [one is None for one in found] == [True, True, True, False]


@pytest.mark.parametrize("sigma_m", [1e-3, 1e-2])
@pytest.mark.parametrize("range_m", [1.0, 4.0, 9.0])
def test_a_dark_source_is_dark_with_a_sigma_that_is_true(range_m: float, sigma_m: float) -> None:
    expected = _expected(50.3, 30.7, range_m, sigma_m)
    samples = _sampled(expected, [], case=int(10 * range_m))
    pulls = np.array([one.level / one.sigma_dark for one in samples])
    assert abs(pulls.mean()) < 4.0 / np.sqrt(DRAWS)
    assert (pulls**2).mean() == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / DRAWS))


def test_a_dark_source_beside_a_bright_one_is_dark() -> None:
    expected = _expected(50.3, 30.7, 4.0)
    pulls = np.array([one.level / one.sigma_dark for one in _sampled(expected, [(53.3, 31.2, 3.0)], 2)])
    assert abs(pulls.mean()) < 0.5
    assert (pulls**2).mean() < 1.6


def test_nothing_is_said_where_a_flare_lies_upon_the_place() -> None:
    expected = _expected(50.3, 30.7, 4.0)
    frame = _frame([(50.35, 30.7, 3.0)], 3)
    found = detect(frame, CAMERA)
    assert len(found) == 1
    assert sample_at(expected, found, frame, CAMERA) is None


def test_a_place_that_is_not_known_well_is_dark_where_no_flare_is_near() -> None:
    expected = _expected(50.3, 30.7, 4.0, sigma_m=0.05)
    dark = _frame([], 4)
    one = sample_at(expected, [], dark, CAMERA)
    assert one is not None
    assert one.level == 0.0
    assert one.sigma_dark == pytest.approx(0.25, abs=0.01)
    other = _frame([(58.0, 30.0, 4.0)], 4)
    found = detect(other, CAMERA)
    # It may be the source, unless it is known to be another; then the source may stand upon it.
    assert sample_at(expected, found, other, CAMERA) is None
    beside = sample_at(expected, found, other, CAMERA, claimed=[True])
    assert beside is not None
    assert 0.25 < beside.sigma_dark < 0.5
    far = replace(expected, flux_dn=expected.flux_dn / 400.0)
    assert sample_at(far, [], dark, CAMERA) is None


def test_the_level_of_a_lit_source_is_its_flux_over_what_it_must_be() -> None:
    expected = _expected(50.3, 30.7, 9.0)
    levels, sigmas, darks = [], [], []
    mean_e = 0.6 * expected_e(CAMERA, [(50.3, 30.7, 9.0)], EXPOSURE_S) + 5.0
    for draw in range(DRAWS):
        frame = expose(mean_e, CAMERA, random(5, draw), EXPOSURE_S)
        (hit,) = detect(frame, CAMERA)
        one = sample_of_detection(hit, expected, frame, CAMERA)
        levels.append(one.level)
        sigmas.append(one.sigma_lit)
        darks.append(one.sigma_dark)
    assert np.mean(levels) == pytest.approx(0.6, abs=4.0 * np.std(levels) / np.sqrt(DRAWS) + 1e-3)
    # The lit one is blurred by its own shot noise, 2 % of what else is not known, and the dark one's.
    shot = np.sqrt(CAMERA.system_gain_dn_per_e / expected.flux_dn)
    assert np.mean(sigmas) == pytest.approx(np.sqrt(shot**2 + 0.02**2 + np.mean(darks) ** 2), rel=0.01)
    assert one.time_s == pytest.approx(0.25 + 0.5 * EXPOSURE_S)
