"""The sensor's noise and its converter, against the EMVA 1288 linear model."""

from typing import Any

import numpy as np
import pytest

from nir_render.camera.sensor import quantise, read_out, saturation_dn
from nir_render.randomness import generator
from tests.unit.camera.conftest import CameraMaker

SHAPE = (400, 500)


@pytest.mark.parametrize("mean_e", [0.0, 0.1, 10.0, 1000.0, 4000.0])
def test_mean_and_variance_are_those_of_emva_1288(camera_with: CameraMaker, mean_e: float) -> None:
    """μ_y = K μ_e + offset; σ_y² = K²(σ_d² + μ_e) + 1/12: both within 4 standard errors of 200 000 pixels.

    At 4000 e the mean is held to 0.013 % and the variance to 1.3 %: a truncating converter (half a count)
    or a gain that is off by 1 % fails.
    """
    sensor = camera_with().sensor
    counts_dn = read_out(np.full(SHAPE, mean_e), sensor, generator(1, "read_out", "test", 0)).astype(float)
    gain = sensor.system_gain_dn_per_e
    variance_dn2 = gain**2 * (sensor.read_noise_e**2 + mean_e) + 1.0 / 12.0
    assert counts_dn.mean() == pytest.approx(
        gain * mean_e + 64.0, abs=4.0 * np.sqrt(variance_dn2 / counts_dn.size)
    )
    assert counts_dn.var() == pytest.approx(variance_dn2, rel=4.0 * np.sqrt(2.0 / counts_dn.size))


def test_the_converter_rounds_to_the_nearest_count_and_clips(camera_with: CameraMaker) -> None:
    sensor = camera_with(sensor={"system_gain": "1 DN/e", "black_level": "10 DN"}).sensor
    assert quantise(np.array([0.4, 0.6, 1.5, 2.5, -30.0, 9999.0]), sensor).tolist() == [
        10,
        11,
        12,
        12,
        0,
        4095,
    ]


def test_the_full_well_clips_before_the_read_noise(camera_with: CameraMaker) -> None:
    """A well of 2000 e at 1 DN/e: clipped pixels spread by the read noise about 2064 DN, and count as clipped."""
    sensor = camera_with(sensor={"system_gain": "1 DN/e", "full_well": "2200 e"}).sensor
    counts_dn = read_out(np.full(SHAPE, 5000.0), sensor, generator(1, "read_out", "test", 0)).astype(float)
    assert counts_dn.mean() == pytest.approx(2264.0, abs=4 * 10.0 / np.sqrt(counts_dn.size))
    assert counts_dn.std() == pytest.approx(np.sqrt(100.0 + 1.0 / 12.0), rel=0.01)
    assert (counts_dn >= saturation_dn(sensor)).mean() > 0.9999


def test_noise_is_keyed_by_seed_stage_camera_and_frame() -> None:
    def draw(*key: Any) -> list[float]:
        return list(generator(*key).standard_normal(3))

    first = draw(1, "read_out", "r1.front", 0)
    assert draw(1, "read_out", "r1.front", 0) == first
    others = [
        (2, "read_out", "r1.front", 0),
        (1, "other", "r1.front", 0),
        (1, "read_out", "r1.left", 0),
        (1, "read_out", "r1.front", 1),
    ]
    assert all(draw(*key) != first for key in others)
