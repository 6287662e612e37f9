"""Dark frames: black level, read noise and offsets against those that the frames were made of."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from perception import RawFrame, RecordingError, calibrate_dark
from perception.model.sensor import without_offsets
from tests.unit.perception.simulation import calibration, random

SHAPE = (120, 160)
CAMERA = calibration(
    width_px=160, height_px=120, cx_px=79.5, cy_px=59.5, black_level_dn=60.0, read_noise_e=7.0
)
GAIN = CAMERA.system_gain_dn_per_e
READ_E, DSNU_E, ROW_E, COLUMN_E, BLACK_DN = 9.0, 4.0, 0.8, 1.5, 71.3


def _offsets_e(seed: int) -> NDArray[np.float64]:
    draw = random(seed, 1)
    drawn = draw.normal(0.0, DSNU_E, SHAPE) + draw.normal(0.0, ROW_E, (SHAPE[0], 1))
    drawn += draw.normal(0.0, COLUMN_E, (1, SHAPE[1]))
    return np.asarray(drawn - drawn.mean())


def _frames(seed: int, count: int, offset_e: NDArray[np.float64], drift_dn: float = 0.0) -> list[RawFrame]:
    draw = random(seed, 2)
    frames = []
    for index in range(count):
        black_dn = BLACK_DN + drift_dn * draw.standard_normal()
        counts = np.rint(black_dn + GAIN * (offset_e + draw.normal(0.0, READ_E, SHAPE)))
        data = np.clip(counts, 0, 4095).astype(np.uint16)
        frames.append(RawFrame("r1.front", index, 0.1 * index, 1e-3, data, CAMERA.black_level_dn))
    return frames


def test_intervals_hold_the_truth_and_are_as_narrow_as_can_be() -> None:
    """40 cameras of 8 frames: errors over σ have the spread 1 (to 11 %); σ are Cramér–Rao's, by hand."""
    pixels, black, read, scatter = SHAPE[0] * SHAPE[1], [], [], []
    noise_dn2 = (GAIN * READ_E) ** 2 + 1.0 / 12.0
    for seed in range(40):
        offset_e = _offsets_e(seed)
        found = calibrate_dark(_frames(seed, 8, offset_e), CAMERA)
        assert found.black_level_sigma_dn == pytest.approx(np.sqrt(noise_dn2 / (8 * pixels)), rel=0.03)
        # Of a variance, with the pixels' means unknown: 2 σ⁴ / (n − 1).
        of_variance_dn2 = noise_dn2 * np.sqrt(2.0 / (7 * pixels))
        assert found.read_noise_sigma_e == pytest.approx(of_variance_dn2 / (2.0 * GAIN**2 * READ_E), rel=0.03)
        black.append((found.black_level_dn - BLACK_DN) / found.black_level_sigma_dn)
        read.append((found.read_noise_e - READ_E) / found.read_noise_sigma_e)
        # The least mean square error, 1 / (1/σ_s² + n/σ_t²), of pixels; means of rows and columns only have noise.
        seen_e2 = noise_dn2 / (8.0 * GAIN**2)
        least_e2 = 1.0 / (1.0 / DSNU_E**2 + 1.0 / seen_e2) + seen_e2 / SHAPE[0] + seen_e2 / SHAPE[1]
        assert found.offset_sigma_e == pytest.approx(np.sqrt(least_e2), rel=0.02)
        left_e = found.offset_e - offset_e
        scatter.append(np.std(left_e) / found.offset_sigma_e)
        assert found.dsnu_e == pytest.approx(np.std(offset_e), abs=5.0 * found.dsnu_sigma_e)
        # What the offsets leave of columns is no longer coherent: their means scatter as single pixels' do.
        assert np.std(left_e.mean(axis=0)) < 1.5 * found.offset_sigma_e / np.sqrt(SHAPE[0])
    assert np.mean(scatter) == pytest.approx(1.0, abs=0.01)
    for errors in (black, read):
        assert abs(np.mean(errors)) < 3.5 / np.sqrt(40)
        assert np.std(errors) == pytest.approx(1.0, abs=0.4)


def test_what_is_known_of_offsets_is_taken_off() -> None:
    """Another frame then scatters over pixels by read noise, by what the offsets leave, and by rounding."""
    offset_e = _offsets_e(3)
    known = calibrate_dark(_frames(3, 16, offset_e), CAMERA).calibration
    (frame,) = _frames(4, 1, offset_e)
    spread_e = np.std(without_offsets(frame, known).data_dn.astype(float)) / GAIN
    rounding_e2 = 1.0 / (12.0 * GAIN**2)
    assert spread_e == pytest.approx(np.sqrt(READ_E**2 + known.dsnu_e**2 + rounding_e2), rel=0.02)
    assert known.dsnu_e < 0.6 * DSNU_E
    assert np.std(frame.data_dn.astype(float)) / GAIN > 1.05 * spread_e


def test_clipped_pixels_stay_clipped_and_others_are_not() -> None:
    known = replace(CAMERA, saturation_dn=1000, offset_dn=np.full(SHAPE, -5, dtype=np.int16))
    data = np.full(SHAPE, 998, dtype=np.uint16)
    data[0, 0], data[0, 1] = 1000, 3
    counts = without_offsets(RawFrame("r1.front", 0, 0.0, 1e-3, data, 64.0), known).data_dn
    assert (counts[0, 0], counts[0, 1], counts[5, 5]) == (1000, 8, 999)
    doubled = without_offsets(RawFrame("r1.front", 0, 0.0, 1e-3, data, 64.0, gain=2.0), known).data_dn
    assert doubled[0, 1] == 13


def test_a_black_level_that_drifts_is_known_no_better_than_that() -> None:
    found = calibrate_dark(_frames(1, 16, _offsets_e(1), drift_dn=0.5), CAMERA)
    assert found.black_level_sigma_dn == pytest.approx(0.5 / 4.0, rel=0.5)
    assert abs(found.black_level_dn - BLACK_DN) < 4.0 * found.black_level_sigma_dn


def test_hot_pixels_are_left_out() -> None:
    frames = _frames(2, 8, _offsets_e(2))
    for frame in frames:
        frame.data_dn[::40, ::40] = 3000
    found = calibrate_dark(frames, CAMERA)
    assert found.defects == 12
    assert abs(found.black_level_dn - BLACK_DN) < 4.0 * found.black_level_sigma_dn


def test_frames_that_tell_nothing_are_refused() -> None:
    frames = _frames(5, 4, _offsets_e(5))
    with pytest.raises(RecordingError, match=r"r1\.front: 1 dark frame, wanted 2 or more"):
        calibrate_dark(frames[:1], CAMERA)
    with pytest.raises(RecordingError, match=r"have the gains 1, 2; take them.*at one gain"):
        calibrate_dark([frames[0], replace(frames[1], gain=2.0)], CAMERA)
    low = [replace(frame, data_dn=np.maximum(frame.data_dn, 70) - np.uint16(70)) for frame in frames]
    with pytest.raises(
        RecordingError, match=r"read 0: the black level is cut off.*raise the sensor's black level"
    ):
        calibrate_dark(low, CAMERA)
    leak = np.linspace(0.0, 12.0, SHAPE[1]).astype(np.uint16)
    with pytest.raises(
        RecordingError, match=r"brighter by .* DN in one part than in another: light comes in"
    ):
        calibrate_dark([replace(frame, data_dn=frame.data_dn + leak) for frame in frames], CAMERA)
