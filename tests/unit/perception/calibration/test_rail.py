"""A rail made by brute force: places from 1 m to 4 m, frames at two gains, exposures as one would set them."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from perception.calibration.rail import calibrate_rail
from perception.calibration.result import IDEAL_MAE, RailCalibration, faults
from perception.files.fields import RecordingError
from perception.types import RawFrame
from tests.unit.perception.simulation import calibration, expected_e, expose, random

CAMERA = calibration(width_px=200, height_px=160, cx_px=99.5, cy_px=79.5)
K = CAMERA.range_constant_dn_m2_per_s
PLACES = 12
FRAMES_AT_EACH = 4
RANGES_M = {
    index: 1.0 + 3.0 * (index // FRAMES_AT_EACH) / (PLACES - 1) for index in range(PLACES * FRAMES_AT_EACH)
}


def exposure_s_of(index: int) -> float:
    return 2.0e-4 / gain_of(index) * (1.0 + 0.02 * RANGES_M[index] ** 2)


def gain_of(index: int) -> float:
    """Every second frame is read out at twice the gain, and exposed half as long."""
    return 1.0 + index % 2


@cache
def flare_e(index: int) -> NDArray[np.float64]:
    u_px, v_px = 110.0 + 7.3 / RANGES_M[index], 60.0 + 15.1 / RANGES_M[index]
    return expected_e(CAMERA, [(u_px, v_px, RANGES_M[index])], exposure_s_of(index))


def take(index: int, gain_fault: float = 1.0) -> RawFrame:
    gain, exposure_s = gain_of(index), exposure_s_of(index)
    mean_e = 1.0 + gain_fault * flare_e(index)
    at_gain = replace(CAMERA, system_gain_dn_per_e=gain * CAMERA.system_gain_dn_per_e)
    frame = expose(mean_e, at_gain, random(61, index), exposure_s)
    return replace(frame, index=index, gain=gain)


def recorded(fault: Callable[[int], float] = lambda _index: 1.0) -> Callable[[int], RawFrame]:
    frames = {index: take(index, fault(index)) for index in RANGES_M}
    return frames.__getitem__


def _is_held_out(index: int) -> bool:
    return (index // FRAMES_AT_EACH) % 2 == 1


@pytest.fixture(scope="module")
def sound() -> Callable[[int], RawFrame]:
    return recorded()


@pytest.fixture(scope="module")
def from_guess(sound: Callable[[int], RawFrame]) -> Callable[[float], RailCalibration]:
    """Calibrate with the range constant guessed as so many times the true one, once for each guess."""
    return cache(
        lambda guess: calibrate_rail(RANGES_M, sound, replace(CAMERA, range_constant_dn_m2_per_s=guess * K))
    )


@pytest.mark.parametrize("first_guess", [1.0, 1.3, 0.6])
def test_the_constant_is_found_from_any_guess(
    from_guess: Callable[[float], RailCalibration], first_guess: float
) -> None:
    result = from_guess(first_guess)
    fit = result.fit
    assert fit.range_constant_sigma_dn_m2_per_s < 0.002 * K
    assert fit.range_constant_dn_m2_per_s == pytest.approx(K, abs=4 * fit.range_constant_sigma_dn_m2_per_s)
    assert faults(result) == []
    assert (result.places_fitted, result.places_held_out) == (6, 6)
    assert (result.frames_fitted, result.frames_held_out, result.robust.found) == (24, 24, 24)
    assert fit.measurements == 24
    # 24 errors: their mean absolute value is known to 0.75 / √24 = 15 %.
    assert result.robust.range_mae_m == pytest.approx(IDEAL_MAE * result.range_limit_m, rel=0.6)
    assert abs(result.robust.range_bias_m) < 4 * result.range_limit_m / math.sqrt(24)
    assert result.calibration.range_constant_dn_m2_per_s == fit.range_constant_dn_m2_per_s
    assert result.calibration.sigma["range_constant_dn_m2_per_s"] == fit.range_constant_sigma_dn_m2_per_s


def test_the_guess_does_not_show_in_the_result(from_guess: Callable[[float], RailCalibration]) -> None:
    near, far = (from_guess(guess).fit for guess in (1.0, 1.3))
    assert far.range_constant_dn_m2_per_s == pytest.approx(
        near.range_constant_dn_m2_per_s, abs=0.1 * near.range_constant_sigma_dn_m2_per_s
    )


def test_the_paper_is_calibrated_and_judged_too(from_guess: Callable[[float], RailCalibration]) -> None:
    result = from_guess(1.0)
    assert result.paper is not None
    assert result.calibration.range_constant_paper_dn_m2_per_s == result.paper.slope_dn_m2_per_s
    assert abs(result.paper.intercept_dn_per_s) > 5 * result.paper.intercept_sigma_dn_per_s
    assert result.paper_held_out.found > 0
    assert result.paper_held_out.range_mae_m > 10 * result.robust.range_mae_m
    assert math.isnan(result.paper_held_out.reduced_chi2)


def test_one_percent_of_gain_shows_in_the_constant() -> None:
    result = calibrate_rail(RANGES_M, recorded(lambda _index: 1.01), CAMERA)
    sigma = result.fit.range_constant_sigma_dn_m2_per_s
    assert result.fit.range_constant_dn_m2_per_s == pytest.approx(1.01 * K, abs=4 * sigma)
    assert result.fit.range_constant_dn_m2_per_s - K > 5 * sigma


def test_one_percent_of_gain_in_the_frames_held_out_is_a_fault() -> None:
    result = calibrate_rail(RANGES_M, recorded(lambda index: 1.01 if _is_held_out(index) else 1.0), CAMERA)
    (said,) = faults(result)
    assert "errors held out have a reduced χ²" in said


def test_ranges_that_count_from_the_wrong_place_are_a_fault(sound: Callable[[int], RawFrame]) -> None:
    result = calibrate_rail({i: range_m + 0.03 for i, range_m in RANGES_M.items()}, sound, CAMERA)
    assert any("the intercept" in said and "is not zero" in said for said in faults(result))


def test_a_wrong_point_spread_is_a_fault(sound: Callable[[int], RawFrame]) -> None:
    """The sigmas widen as far as the flares do not fit, so χ² alone would not tell."""
    result = calibrate_rail(RANGES_M, sound, replace(CAMERA, psf_sigma_px=1.2))
    assert any("does not look like one source" in said for said in faults(result))


def test_frames_without_the_source_are_a_fault(sound: Callable[[int], RawFrame]) -> None:
    def covered(index: int) -> RawFrame:
        frame = sound(index)
        return replace(frame, data_dn=np.full_like(frame.data_dn, 64)) if index == FRAMES_AT_EACH else frame

    assert faults(calibrate_rail(RANGES_M, covered, CAMERA)) == [
        "the source was ranged in only 23 of 24 frames held out"
    ]


def test_bad_rails_are_refused(sound: Callable[[int], RawFrame]) -> None:
    few = {index: range_m for index, range_m in RANGES_M.items() if index < 5 * FRAMES_AT_EACH}
    with pytest.raises(RecordingError, match=r"5 different ranges are known\. Record at least 6"):
        calibrate_rail(few, sound, CAMERA)
    with pytest.raises(RecordingError, match=r"in 0 of 24 frames to fit.*within a factor of 2\?"):
        calibrate_rail(RANGES_M, sound, replace(CAMERA, range_constant_dn_m2_per_s=0.0))


def test_progress_tells_each_pass(sound: Callable[[int], RawFrame]) -> None:
    told: list[tuple[int, int]] = []
    calibrate_rail(RANGES_M, sound, CAMERA, lambda done, total: told.append((done, total)))
    assert told[:24] == [(done, 24) for done in range(1, 25)]
