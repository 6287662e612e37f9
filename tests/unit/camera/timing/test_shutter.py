"""When rows collect light, and what of a drive they meet, in closed form."""

from typing import Any

import numpy as np
import pytest

from nir_render.camera.timing.shutter import (
    mid_exposure_s,
    on_fractions,
    row_profile,
    row_starts_s,
)
from nir_render.scene.documents.times.drives import FULL_DRIVE, Drive
from tests.unit.camera.conftest import CameraMaker

ROWS = 960
ROLLING = {"type": "rolling", "line_time": "20 us"}
LEAKY = {"type": "global", "line_time": "10 us", "parasitic_light_sensitivity": 1e-3}
ROW = np.arange(ROWS)


def _square(**changes: Any) -> Drive:
    return Drive.model_validate({"square": {"frequency": "250 Hz", "duty": 0.5, **changes}})


@pytest.mark.parametrize("shutter", [{"type": "global", "line_time": "10 us"}, ROLLING])
def test_even_light_is_collected_evenly_to_the_bit(camera_with: CameraMaker, shutter: dict[str, Any]) -> None:
    camera = camera_with(shutter=shutter)
    assert (row_profile(camera, FULL_DRIVE, 12.345, 3.3e-4) == 1.0).all()
    assert (row_profile(camera, Drive(constant=0.3), 12.345, 3.3e-4) == 0.3).all()


def test_rows_of_a_rolling_shutter_begin_one_after_the_other(camera_with: CameraMaker) -> None:
    camera = camera_with(shutter=ROLLING)
    np.testing.assert_allclose(row_starts_s(camera, 2.0), 2.0 + 20e-6 * ROW, rtol=1e-15)
    assert camera.shutter.row_delay_s == pytest.approx(20e-6)
    assert mid_exposure_s(camera, 1e-3) == pytest.approx(0.5e-3 + 0.5 * 959 * 20e-6)
    all_at_once = camera_with(shutter=LEAKY)
    assert (row_starts_s(all_at_once, 2.0) == 2.0).all()
    assert (all_at_once.shutter.row_delay_s, mid_exposure_s(all_at_once, 1e-3)) == (0.0, 0.5e-3)


def test_a_square_wave_shows_as_stripes_behind_a_rolling_shutter(camera_with: CameraMaker) -> None:
    """250 Hz, half on, from t = 0 on; 1 ms exposures, 20 µs apart: stripes of 200 rows.

    Rows 0 to 50 begin by 1 ms and end by 2 ms, all in light; then the level falls by 1/50 per row to 0 at row
    100, stays dark to row 150, rises to 1 at row 200.
    """
    profile = row_profile(camera_with(shutter=ROLLING), _square(), 0.0, 1e-3)
    phase = ROW % 200
    level = np.interp(phase, [0, 50, 100, 150, 200], [1.0, 1.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(profile, level, atol=1e-12)
    on = on_fractions(camera_with(shutter=ROLLING), _square(), 0.0, 1e-3)
    np.testing.assert_array_equal(on, profile)


def test_a_global_shutter_meets_the_same_light_in_all_rows(camera_with: CameraMaker) -> None:
    """From 1.5 ms to 2.5 ms half of the exposure is in light."""
    profile = row_profile(camera_with(shutter={"type": "global"}), _square(), 1.5e-3, 1e-3)
    np.testing.assert_allclose(profile, 0.5, atol=1e-12)


def test_rows_that_wait_collect_parasitic_light(camera_with: CameraMaker) -> None:
    """PLS 1e-3, 10 µs per row, exposure 1 ms of even light: 1 + 1e-3 · r · 10 µs / 1 ms, 0.96 % in the end."""
    camera = camera_with(shutter=LEAKY)
    profile = row_profile(camera, FULL_DRIVE, 0.0, 1e-3)
    np.testing.assert_allclose(profile, 1.0 + 1e-3 * ROW * 0.01, rtol=1e-14)
    assert profile[0] == 1.0
    assert (on_fractions(camera, FULL_DRIVE, 0.0, 1e-3) == 1.0).all()


def test_parasitic_light_is_that_of_the_time_of_waiting(camera_with: CameraMaker) -> None:
    """Dark during the exposure, then on from 2 ms after its end for 2 ms: rows 200 to 400 fill up.

    The last bits are 0 for 3 ms, 1 for 2 ms, then 0 for good; the exposure is the first of these 3 ms.
    """
    bits = {"pattern": "00011", "rate": "1 kHz", "idle": 0}
    profile = row_profile(camera_with(shutter=LEAKY), Drive.model_validate({"bits": bits}), 0.0, 1e-3)
    lit_ms = np.clip(0.01 * ROW - 2.0, 0.0, 2.0)
    np.testing.assert_allclose(profile, 1e-3 * lit_ms, atol=1e-15)
