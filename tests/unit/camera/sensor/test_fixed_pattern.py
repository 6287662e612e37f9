"""Offsets, responses and bad pixels: their sizes, and that they belong to the serial number."""

import numpy as np
import pytest

from nir_render.camera.sensor.fixed_pattern import fixed_pattern
from nir_render.scene.documents.sensor import Sensor
from tests.unit.camera.conftest import CameraMaker

PARTS = {"pixel": "4 e", "row": "2 e", "column": "3 e"}


def sensor_with(camera_with: CameraMaker, **changes: object) -> Sensor:
    return camera_with(sensor={"rows": 960, "columns": 1280, **changes}).sensor


def test_parts_of_rows_columns_and_pixels_have_their_sizes(camera_with: CameraMaker) -> None:
    """Means over rows and columns take the map apart, as EMVA 1288 does; each within 4 standard errors."""
    offset_e = fixed_pattern(sensor_with(camera_with, dsnu=PARTS), "a").offset_e
    assert offset_e is not None
    rows, columns = offset_e.mean(axis=1), offset_e.mean(axis=0)
    rest = offset_e - rows[:, None] - columns + offset_e.mean()
    assert rows.std() == pytest.approx(np.sqrt(4.0 + 16.0 / 1280), rel=4.0 / np.sqrt(2 * 960))
    assert columns.std() == pytest.approx(np.sqrt(9.0 + 16.0 / 960), rel=4.0 / np.sqrt(2 * 1280))
    assert rest.std() == pytest.approx(4.0, rel=4.0 / np.sqrt(2 * rest.size))


def test_parts_of_the_response_have_their_sizes(camera_with: CameraMaker) -> None:
    """PRNU of 1 % pixels, 0.5 % rows, 0.8 % columns: means over rows and columns tell them apart."""
    response = fixed_pattern(
        sensor_with(camera_with, prnu={"pixel": "1 %", "row": "0.5 %", "column": "0.8 %"}), "a"
    ).response
    assert response is not None
    rows, columns = response.mean(axis=1), response.mean(axis=0)
    assert rows.std() == pytest.approx(np.sqrt(0.005**2 + 0.01**2 / 1280), rel=4.0 / np.sqrt(2 * 960))
    assert columns.std() == pytest.approx(np.sqrt(0.008**2 + 0.01**2 / 960), rel=4.0 / np.sqrt(2 * 1280))


def test_responses_have_mean_one_and_the_spread_of_the_sheet(camera_with: CameraMaker) -> None:
    response = fixed_pattern(sensor_with(camera_with, prnu="1 %"), "a").response
    assert response is not None
    assert response.mean() == pytest.approx(1.0, abs=4.0 * 0.01 / np.sqrt(response.size))
    assert response.std() == pytest.approx(0.01, rel=4.0 / np.sqrt(2 * response.size))


def test_patterns_belong_to_the_serial_number(camera_with: CameraMaker) -> None:
    """Same number, same bits; another number, nothing in common; offsets and responses neither."""
    sensor = sensor_with(camera_with, dsnu="4 e", prnu="1 %")
    first, again, other = (fixed_pattern(sensor, serial) for serial in ("a", "a", "b"))
    assert first.offset_e is not None
    assert other.offset_e is not None
    assert first.response is not None
    assert again.offset_e is first.offset_e
    bound = 4.0 / np.sqrt(first.offset_e.size)
    assert abs(np.corrcoef(first.offset_e.ravel(), other.offset_e.ravel())[0, 1]) < bound
    assert abs(np.corrcoef(first.offset_e.ravel(), first.response.ravel())[0, 1]) < bound


def test_the_pattern_scales_and_stays(camera_with: CameraMaker) -> None:
    """Half the DSNU on a data sheet is the same pattern at half its size."""
    large = fixed_pattern(sensor_with(camera_with, dsnu="4 e"), "a").offset_e
    small = fixed_pattern(sensor_with(camera_with, dsnu="2 e"), "a").offset_e
    assert large is not None
    assert small is not None
    np.testing.assert_allclose(small, 0.5 * large, rtol=1e-6)


def test_bad_pixels_are_as_many_as_asked_for(camera_with: CameraMaker) -> None:
    """0.1 % dead, 0.2 % hot at 5000 e/s, 0.01 % stuck of 1 228 800 pixels; 7 K warmer, twice as hot."""
    defects = {"dead": "0.1 %", "hot": "0.2 %", "stuck": "0.01 %", "hot_dark_current": "5000 e/s"}
    pattern = fixed_pattern(sensor_with(camera_with, prnu=0, dsnu="0 e", defects=defects), "a")
    assert pattern.response is not None
    assert pattern.hot_e_per_s is not None
    assert (pattern.response == 0.0).sum() == 1229
    assert (pattern.hot_e_per_s == 5000.0).sum() == 2458
    assert len(np.unique(pattern.stuck)) == 123
    warm = fixed_pattern(sensor_with(camera_with, defects=defects, temperature="305.15 K"), "a")
    assert warm.hot_e_per_s is not None
    np.testing.assert_allclose(warm.hot_e_per_s, 2.0 * pattern.hot_e_per_s, rtol=1e-6)


def test_a_clean_sensor_has_no_pattern(camera_with: CameraMaker) -> None:
    pattern = fixed_pattern(sensor_with(camera_with, dsnu="0 e", prnu=0), "a")
    assert pattern.response is None
    assert pattern.offset_e is None
    assert pattern.hot_e_per_s is None
    assert pattern.stuck.size == 0
