"""The sensor's noise and its converter, against the EMVA 1288 linear model."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from nir_render.camera.sensor.read_out import dark_variance_e2, quantise, read_out, saturation_dn
from nir_render.randomness import RandomKey, generator
from nir_render.scene.documents.camera import Camera
from tests.unit.camera.conftest import CameraMaker

SHAPE = (400, 500)
SIZE = {"rows": SHAPE[0], "columns": SHAPE[1]}
LINEAR = {**SIZE, "dsnu": "0 e", "prnu": 0, "dark_current": "0 e/s"}


def taken(
    camera: Camera,
    mean_e: float,
    *,
    exposure_s: float = 1e-3,
    frame: int = 0,
    name: str = "test",
    **more: Any,
) -> NDArray[np.float64]:
    """Return the counts of a frame of uniform light."""
    key = RandomKey(1, "read_out", name, frame)
    return read_out(np.full(SHAPE, mean_e), camera, exposure_s, key, **more).astype(np.float64)


@pytest.mark.parametrize("gain", [1.0, 3.0])
@pytest.mark.parametrize("mean_e", [0.0, 0.1, 10.0, 1000.0])
def test_mean_and_variance_are_those_of_emva_1288(
    camera_with: CameraMaker, mean_e: float, gain: float
) -> None:
    """μ_y = K μ_e + offset; σ_y² = K²(σ_d² + μ_e) + 1/12: both within 4 standard errors of 200 000 pixels.

    At 1000 e the mean is held to 0.03 % and the variance to 1.3 %: a truncating converter (half a count)
    or a gain that is off by 1 % fails.
    """
    camera = camera_with(sensor=LINEAR)
    sensor = camera.sensor
    counts_dn = taken(camera, mean_e, gain=gain)
    gain_dn_per_e = gain * sensor.system_gain_dn_per_e
    variance_dn2 = gain_dn_per_e**2 * (sensor.read_noise_e**2 + mean_e) + 1.0 / 12.0
    error_dn = np.sqrt(variance_dn2 / counts_dn.size)
    assert counts_dn.mean() == pytest.approx(gain_dn_per_e * mean_e + 64.0, abs=4.0 * error_dn)
    assert counts_dn.var() == pytest.approx(variance_dn2, rel=4.0 * np.sqrt(2.0 / counts_dn.size))


@pytest.mark.parametrize("read_noise", ["0 e", "10 e"])
@pytest.mark.parametrize("mean_e", [0.1, 10.0, 5000.0, 9000.0])
def test_noise_is_independent_between_pixels_frames_and_cameras(
    camera_with: CameraMaker, mean_e: float, read_noise: str
) -> None:
    """Correlations with the right and the lower neighbour, pixels a block of 131 072 apart, the next frame, another
    camera: none beyond 4/√N, with and without read noise; at 9000 e all pixels are clipped. Power: a correlation
    of 1.8 % between neighbours, frames and cameras, of 3 % between blocks, would be seen in 97.7 % of cases.
    """
    camera = camera_with(sensor={**LINEAR, "read_noise": read_noise})
    first, later, other = (
        taken(camera, mean_e),
        taken(camera, mean_e, frame=1),
        taken(camera, mean_e, name="other"),
    )
    if mean_e == 9000.0 and read_noise == "0 e":
        assert len({*first.ravel(), *later.ravel(), *other.ravel()}) == 1
        return
    pairs = {
        "right": (first[:, 1:], first[:, :-1]),
        "below": (first[1:], first[:-1]),
        "block": (first[262:], first[:-262]),
        "frame": (first, later),
        "camera": (first, other),
    }
    for what, (one, two) in pairs.items():
        bound = 4.0 / np.sqrt(one.size)
        assert bound < 0.016
        assert abs(np.corrcoef(one.ravel(), two.ravel())[0, 1]) < bound, what
        squares = np.corrcoef((one.ravel() - one.mean()) ** 2, (two.ravel() - two.mean()) ** 2)[0, 1]
        assert abs(squares) < 1.5 * bound, what


@pytest.mark.parametrize("mean_e", [0.0, 0.1, 10.0, 3000.0])
def test_counts_are_distributed_as_the_model_says(camera_with: CameraMaker, mean_e: float) -> None:
    """χ² of the counts against Poisson ⊗ Gauss, rounded; a read noise or gain off by 1 % fails (tried below).

    200 000 pixels; a width that is off by 1 % adds about 2 N 1e-4 = 40 to χ² of 40 to 400 classes, so four
    frames are put together: 160 against √(2k) of at most 28.
    """
    camera = camera_with(sensor=LINEAR)
    counts = np.concatenate([taken(camera, mean_e, frame=frame).ravel() for frame in range(4)]).astype(int)

    def chance(read_noise_e: float, gain: float) -> float:
        low, high = counts.min() - 3, counts.max() + 3
        electrons = np.arange(
            int(mean_e - 9 * np.sqrt(mean_e)) if mean_e > 100 else 0, int(mean_e + 9 * np.sqrt(mean_e) + 12)
        )
        edges = (np.arange(low, high + 2) - 0.5 - 64.0) / gain
        cumulative = stats.norm.cdf((edges[:, None] - electrons) / read_noise_e) @ stats.poisson.pmf(
            electrons, mean_e
        )
        expected = np.diff(cumulative) * counts.size
        observed = np.bincount(counts - low, minlength=len(expected))[: len(expected)]
        keep = expected >= 10.0
        statistic = ((observed[keep] - expected[keep]) ** 2 / expected[keep]).sum()
        return float(stats.chi2.sf(statistic, keep.sum() - 1))

    assert chance(10.0, 0.69) > 1e-4
    assert chance(10.0, 0.69 * 1.01) < 1e-4
    if mean_e < 100:  # shot noise hides read noise in bright light
        assert chance(10.0 * 1.01, 0.69) < 1e-4


def test_dark_current_doubles_with_the_temperature_and_adds_its_shot_noise(camera_with: CameraMaker) -> None:
    """100 e/s for 2 s at 14 K above the reference, doubled every 7 K: 800 e of mean and of variance."""
    camera = camera_with(
        sensor={
            **LINEAR,
            "dark_current": "100 e/s",
            "dark_current_doubling": "7 K",
            "temperature": "312.15 K",
        }
    )
    counts_dn = taken(camera, 0.0, exposure_s=2.0)
    gain = camera.sensor.system_gain_dn_per_e
    variance_dn2 = gain**2 * dark_variance_e2(camera.sensor, 2.0) + 1.0 / 12.0
    assert dark_variance_e2(camera.sensor, 2.0) == pytest.approx(900.0, rel=1e-9)
    assert counts_dn.mean() == pytest.approx(
        64.0 + gain * 800.0, abs=4.0 * np.sqrt(variance_dn2 / counts_dn.size)
    )
    assert counts_dn.var() == pytest.approx(variance_dn2, rel=4.0 * np.sqrt(2.0 / counts_dn.size))


def test_the_fixed_pattern_stays_from_frame_to_frame(camera_with: CameraMaker) -> None:
    """The covariance of two frames is the pattern's variance: K² (DSNU² + (PRNU μ)²); of two cameras, none."""
    camera = camera_with(sensor={**SIZE, "dsnu": "6 e", "prnu": "2 %"})
    dark_e = {"dark_current": "1000 e/s"}  # PRNU is of light alone
    warm = camera_with(sensor={**SIZE, **dark_e, "dsnu": "6 e", "prnu": "5 %", "full_well": "5800 e"})
    dark_one, dark_two = (taken(warm, 0.0, exposure_s=1.0, frame=frame) for frame in (0, 1))
    assert np.cov(dark_one.ravel(), dark_two.ravel())[0, 1] == pytest.approx(
        0.69**2 * 36.0, abs=4.0 * 0.69**2 * 1136.0 / np.sqrt(dark_one.size)
    )
    raised = camera_with(sensor={**SIZE, "dsnu": "6 e", "full_well": "5800 e", "black_level": "300 DN"})
    bright_one, bright_two = (taken(raised, 0.0, frame=frame, gain=4.0) for frame in (0, 1))
    assert np.cov(bright_one.ravel(), bright_two.ravel())[0, 1] == pytest.approx(
        (4.0 * 0.69) ** 2 * 36.0, abs=4.0 * (4.0 * 0.69) ** 2 * 136.0 / np.sqrt(dark_one.size)
    )
    one, two = taken(camera, 1000.0), taken(camera, 1000.0, frame=1)
    other = taken(camera, 1000.0, name="other")
    pattern_dn2 = camera.sensor.system_gain_dn_per_e**2 * (36.0 + 400.0)
    error_dn2 = 0.69**2 * 1536.0 / np.sqrt(one.size)
    assert np.cov(one.ravel(), two.ravel())[0, 1] == pytest.approx(pattern_dn2, abs=4.0 * error_dn2)
    assert np.cov(one.ravel(), other.ravel())[0, 1] == pytest.approx(0.0, abs=4.0 * error_dn2)
    named = camera.model_copy(update={"serial": "A17"})
    named_one, named_two = taken(named, 1000.0), taken(named, 1000.0, name="other")
    assert np.cov(named_one.ravel(), named_two.ravel())[0, 1] == pytest.approx(
        pattern_dn2, abs=4.0 * error_dn2
    )


def test_bad_pixels_read_as_bad_ones_do(camera_with: CameraMaker) -> None:
    """In bright light dead pixels read black and stuck ones full scale; in the dark hot ones read 0.5 s · 2000 e/s."""
    defects = {"dead": "1 %", "hot": "1 %", "stuck": "0.5 %", "hot_dark_current": "2000 e/s"}
    camera = camera_with(sensor={**LINEAR, "defects": defects})
    bright, dark = taken(camera, 2000.0, exposure_s=1e-6), taken(camera, 0.0, exposure_s=0.5)
    assert (np.abs(bright - 64.0) < 45.0).sum() == pytest.approx(2000, abs=15)  # some are hot or stuck, too
    assert (bright == 4095).sum() == 1000
    assert (np.abs(dark - 64.0 - 690.0) < 150.0).sum() == pytest.approx(2000, abs=15)


def test_bits_do_not_depend_on_workers_or_order(camera_with: CameraMaker) -> None:
    """One, two, five threads; frames taken forwards and backwards; with blooming, which works in two passes."""
    for blooming in (0.0, 0.3):
        camera = camera_with(sensor={**SIZE, "blooming": blooming})
        light = np.linspace(0.0, 9000.0, 200_000).reshape(SHAPE)
        frames = {
            (threads, index): read_out(
                light, camera, 1e-3, RandomKey(1, "read_out", "c", index), threads=threads
            )
            for threads, index in [(1, 0), (1, 1), (2, 1), (2, 0), (5, 0)]
        }
        assert np.array_equal(frames[1, 0], frames[2, 0])
        assert np.array_equal(frames[1, 0], frames[5, 0])
        assert np.array_equal(frames[1, 1], frames[2, 1])
        assert not np.array_equal(frames[1, 0], frames[1, 1])


def test_blooming_moves_charge_within_columns_and_keeps_it(camera_with: CameraMaker) -> None:
    """13 000 e in each well of a row that holds 4000: with a share of 1, 4500 e go up, which fill one row and
    500 e of the next, and as many down; no column is left out.
    """
    camera = camera_with(sensor={**LINEAR, "full_well": "4000 e", "system_gain": "1 DN/e", "blooming": 1.0})
    light = np.zeros(SHAPE)
    light[200] = 13000.0
    rows = read_out(light, camera, 1e-3, RandomKey(1, "read_out", "c", 0)).mean(axis=1) - 64.0
    assert rows[[199, 200, 201]] == pytest.approx([4000.0] * 3, abs=12.0)
    assert rows[[198, 202]] == pytest.approx([500.0] * 2, abs=20.0)
    assert rows[[197, 203]] == pytest.approx([0.0] * 2, abs=12.0)


def test_the_converter_rounds_to_the_nearest_count_and_clips(camera_with: CameraMaker) -> None:
    sensor = camera_with(
        sensor={"system_gain": "1 DN/e", "full_well": "4200 e", "black_level": "10 DN"}
    ).sensor
    electrons = np.array([0.4, 0.6, 1.5, 2.5, -30.0, 9999.0])
    assert quantise(electrons, sensor).tolist() == [10, 11, 12, 12, 0, 4095]


def test_the_full_well_clips_before_the_read_noise(camera_with: CameraMaker) -> None:
    """A well of 3960 e at 1 DN/e: clipped pixels spread by the read noise about 4024 DN, and count as clipped."""
    camera = camera_with(sensor={**LINEAR, "system_gain": "1 DN/e", "full_well": "3960 e"})
    counts_dn = taken(camera, 9000.0)
    assert counts_dn.mean() == pytest.approx(4024.0, abs=4 * 10.0 / np.sqrt(counts_dn.size))
    assert counts_dn.std() == pytest.approx(np.sqrt(100.0 + 1.0 / 12.0), rel=0.01)
    assert saturation_dn(camera.sensor) == 4024 - 40
    assert (counts_dn >= saturation_dn(camera.sensor)).mean() > 0.9999
    # At four times the gain the ADC clips long before the well.
    assert saturation_dn(camera.sensor, gain=4.0) == 4095
    assert (taken(camera, 1100.0, gain=4.0) == 4095).mean() > 0.98


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_converters_of_8_to_16_bits(camera_with: CameraMaker, bits: int) -> None:
    """Half of full scale and clipped light: the middle count to 0.1 %, full scale exactly."""
    full_dn = 2**bits - 1
    camera = camera_with(
        sensor={**LINEAR, "bit_depth": f"{bits} bit", "black_level": "2 DN", "full_well": "5600 e",
                "system_gain": f"{(full_dn - 2) / 5500.0} DN/e"}
    )  # fmt: skip
    middle_dn = taken(camera, 2750.0)
    assert middle_dn.mean() == pytest.approx(2.0 + (full_dn - 2) / 2, rel=1e-3)
    assert (taken(camera, 20000.0) == full_dn).mean() > 0.99


def test_noise_is_keyed_by_seed_stage_camera_and_frame() -> None:
    def draw(*key: Any) -> list[float]:
        return list(generator(*key).standard_normal(3)) + list(RandomKey(*key).words("a", 0, 3))

    keys = [
        (1, "read_out", "r1.front", 0),
        (2, "read_out", "r1.front", 0),
        (1, "other", "r1.front", 0),
        (1, "read_out", "r1.left", 0),
        (1, "read_out", "r1.front", 1),
    ]
    draws = [draw(*key) for key in keys]
    assert draw(*keys[0]) == draws[0]
    assert len({value for one in draws for value in one}) == 6 * len(keys)
    words = RandomKey(*keys[0])
    assert (
        len({int(word) for block in range(3) for part in "ab" for word in words.words(part, block, 4)}) == 24
    )
