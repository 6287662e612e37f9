"""Flat frames: the response against that of frames made by hand."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from perception import RawFrame, RecordingError, calibrate_flat
from perception.calibration.veil import Glare, veil_of
from perception.model.sensor import without_response
from tests.unit.perception.simulation import calibration, random

ROWS, COLUMNS, FOCAL_PX = 180, 240, 150.0
CAMERA = calibration(
    width_px=COLUMNS, height_px=ROWS, fx_px=FOCAL_PX, fy_px=FOCAL_PX, cx_px=119.5, cy_px=89.5, prnu=0.0
)
GAIN = CAMERA.system_gain_dn_per_e
V, U = np.mgrid[0:ROWS, 0:COLUMNS]
THETA = np.arctan(np.hypot(U - CAMERA.cx_px, V - CAMERA.cy_px) / FOCAL_PX)
PIXEL, ROW, COLUMN = 0.01, 0.002, 0.004


def _response(theta: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.cos(theta) * (1.0 - 0.3 * theta**2))


def _frames(
    seed: int, count: int = 8, level_e: float = 3000.0, tilt: float = 0.0
) -> tuple[list[RawFrame], NDArray[np.float64]]:
    """Frames of a surface, and the pixels' own responses: cos⁴ θ of geometry times that of the camera."""
    draw = random(seed, 7)
    own = 1.0 + draw.normal(0.0, PIXEL, (ROWS, COLUMNS)) + draw.normal(0.0, ROW, (ROWS, 1))
    own += draw.normal(0.0, COLUMN, (1, COLUMNS))
    mean_e = level_e * np.cos(THETA) ** 4 * _response(THETA) * (1.0 + tilt * (U / COLUMNS - 0.5))
    frames = []
    for index in range(count):
        noisy_e = draw.poisson(mean_e * own) + draw.normal(0.0, CAMERA.read_noise_e, mean_e.shape)
        counts = np.clip(np.rint(64.0 + GAIN * noisy_e), 0, 4095).astype(np.uint16)
        frames.append(RawFrame("r1.front", index, 0.1 * index, 1e-3, counts, 64.0))
    return frames, own


def test_intervals_hold_the_truth() -> None:
    """20 cameras: errors over σ spread by 1 at every angle; PRNU is that of the pixels, rows, columns drawn."""
    errors = []
    for seed in range(20):
        frames, own = _frames(seed)
        found = calibrate_flat(frames, CAMERA)
        inner = slice(1, -1)  # the axis is 1 by definition, beyond the corner it is held
        truth = _response(found.angle_rad) / _response(np.zeros(1))
        errors.append(((found.response - truth) / np.maximum(found.response_sigma, 1e-12))[inner])
        assert found.prnu == pytest.approx(np.std(own), abs=4.0 * found.prnu_sigma)
        assert found.uneven < 0.005
    spread = np.sqrt(np.mean(np.square(errors), axis=0))
    assert 0.6 < spread.min() < spread.max() < 1.6
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1.0, abs=0.25)


def test_pixels_are_told_apart_as_far_as_noise_allows() -> None:
    """Of 1 % of PRNU, and rows and columns, what 8 frames of 3000 e leave: 1/√(1/0.01² + 8 · 3000) = 0.54 %."""
    frames, own = _frames(5)
    found = calibrate_flat(frames, CAMERA)
    left = own / found.pixel_response
    middle = np.hypot(U - COLUMNS / 2, V - ROWS / 2) < 30
    assert np.std(own[middle]) > 0.010
    assert found.unknown_prnu == pytest.approx(np.std(left), rel=0.03)
    assert np.std(left[middle]) == pytest.approx((0.01**-2 + 8 * 3000) ** -0.5, rel=0.06)
    assert np.mean(left) == pytest.approx(1.0, abs=1e-3)
    columns = own.mean(axis=0) - own.mean()
    assert np.corrcoef(columns, found.pixel_response.mean(axis=0))[0, 1] > 0.98


def test_an_evened_frame_keeps_what_is_clipped() -> None:
    frames, _ = _frames(5)
    found = calibrate_flat(frames, CAMERA)
    counts = frames[0].data_dn.copy()
    counts[10, 20] = 4095
    even = without_response(replace(frames[0], data_dn=counts), CAMERA, found.pixel_response)
    assert even.data_dn[10, 20] == 4095
    assert even.data_dn.max() < 4095 or np.sum(even.data_dn == 4095) == 1
    expected = (counts[30, 40] - 64.0) / found.pixel_response[30, 40] + 64.0
    assert even.data_dn[30, 40] == round(expected)


def test_columns_of_one_response_count_as_one() -> None:
    """Were each pixel's response its own, the σ would be a third of what it is: the columns make it."""
    frames, _ = _frames(3)
    sigma = calibrate_flat(frames, CAMERA).response_sigma
    alone = PIXEL / np.sqrt(ROWS * COLUMNS / 12.0)
    assert sigma[20:60].min() > 1.5 * alone


def test_glare_is_divided_out() -> None:
    """5 % of glare brings light from the middle to the corner; told of it, the fit finds what is there."""
    image_e = 3000.0 * np.cos(THETA) ** 4 * _response(THETA)
    glare = Glare(0.05, 12.0, 2.0, np.zeros((3, 3)))
    by_hand = np.zeros_like(image_e)
    for row, column in ((0, 0), (90, 120), (170, 30)):
        away2 = (V - row) ** 2 + (U - column) ** 2
        density = (2.0 - 1.0) / (np.pi * 144.0) * (1.0 + away2 / 144.0) ** -2.0
        by_hand[row, column] = 0.05 * float((density * image_e).sum())
        assert veil_of(image_e, glare)[row, column] == pytest.approx(by_hand[row, column], rel=0.02)
    veiled = np.rint(64.0 + GAIN * (0.95 * image_e + veil_of(image_e, glare))).astype(np.uint16)
    frames = [RawFrame("r1.front", 0, 0.0, 1e-3, veiled, 64.0)]
    truth = _response(calibrate_flat(frames, CAMERA).angle_rad)
    unsure = replace(glare, covariance=np.diag([1e-4, 0.0, 0.0]))
    plain, told, wide = (calibrate_flat(frames, CAMERA, glare=one) for one in (None, glare, unsure))
    assert np.abs(told.response / truth - 1.0)[:-1].max() < 1e-3
    in_corner = abs(plain.response / truth - 1.0)[-2]
    assert in_corner > 5e-3
    # A share off by a fifth is off by a fifth of what the glare does to the corner.
    of_share = np.sqrt(wide.response_sigma**2 - told.response_sigma**2)[-2]
    assert of_share == pytest.approx(0.2 * in_corner, rel=0.15)


def test_frames_that_clip_are_left_out_and_all_that_clip_refused() -> None:
    frames, _ = _frames(1)
    clipped = [
        replace(frame, data_dn=np.minimum(frame.data_dn * np.uint16(3), 4095).astype(np.uint16))
        for frame in frames
    ]
    found = calibrate_flat([*frames[:4], *clipped[4:]], CAMERA)
    assert (found.frames, found.clipped) == (4, 4)
    with pytest.raises(
        RecordingError,
        match=r"r1.front: all of its 8 flat frames clip \(at 4095 DN, in up to .*dim the surface",
    ):
        calibrate_flat(clipped, CAMERA)


def test_what_is_too_dark_or_uneven_is_refused() -> None:
    with pytest.raises(RecordingError, match=r"hold \d+ e in the median pixel, wanted 100 or more: brighten"):
        calibrate_flat(_frames(2, level_e=90.0)[0], CAMERA)
    with pytest.raises(
        RecordingError, match=r"brighter by 9\.\d% at one edge than at the other: hold it square"
    ):
        calibrate_flat(_frames(2, tilt=0.1)[0], CAMERA)
