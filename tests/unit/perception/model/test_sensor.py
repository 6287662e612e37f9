from dataclasses import replace

import numpy as np
import pytest

from perception.model.sensor import (
    at_gain,
    check_frame,
    clip_level_e,
    electrons,
    noise_floor_e2,
    pixel_variance_e2,
    saturation_dn,
)
from perception.types import RawFrame
from tests.unit.perception.simulation import calibration

CAMERA = calibration(width_px=3, height_px=2)


def frame(**changes: object) -> RawFrame:
    base = RawFrame("r1.front", 7, 0.0, 1e-3, np.array([[64, 138, 4095], [0, 64, 64]], np.uint16), 64.0)
    return replace(base, **changes)  # type: ignore[arg-type]


def test_electrons_use_gain_and_black_level_of_the_frame() -> None:
    np.testing.assert_allclose(electrons(frame(), CAMERA)[0, 1], 100.0, rtol=1e-6)
    np.testing.assert_allclose(
        electrons(frame(gain=2.0, black_level_dn=0.0), CAMERA)[0, 1], 138 / 1.48, rtol=1e-6
    )


def test_noise_floor_and_clip_level() -> None:
    assert noise_floor_e2(calibration(read_noise_e=2.0, system_gain_dn_per_e=0.25)) == pytest.approx(
        4 + 16 / 12
    )
    assert noise_floor_e2(
        calibration(read_noise_e=2.0, system_gain_dn_per_e=0.25), gain=2.0
    ) == pytest.approx(4 + 4 / 12)
    assert clip_level_e(CAMERA, 64.0, 2.0) == pytest.approx(4031 / 1.48)


def test_fixed_offsets_add_their_variance_to_a_dark_pixel_at_any_gain() -> None:
    """3² + 4² e², and rounding, which alone depends on the gain: 16/12 e² at 1/4 DN/e, 4/12 e² at 1/2."""
    camera = calibration(read_noise_e=3.0, dsnu_e=4.0, system_gain_dn_per_e=0.25)
    assert noise_floor_e2(camera) == pytest.approx(25.0 + 16.0 / 12.0, rel=1e-12)
    assert noise_floor_e2(camera, gain=2.0) == pytest.approx(25.0 + 4.0 / 12.0, rel=1e-12)
    assert noise_floor_e2(at_gain(camera, 2.0)) == pytest.approx(25.0 + 4.0 / 12.0, rel=1e-12)


def test_the_spread_of_responses_grows_with_the_light_and_needs_some() -> None:
    """2 %: of 10 000 e it is 200 e, four times the shot noise's variance; below black level there is neither."""
    variance_e2 = pixel_variance_e2(np.array([-50.0, 0.0, 100.0, 1e4]), 25.0, 0.02)
    np.testing.assert_allclose(variance_e2, [25.0, 25.0, 25.0 + 100.0 + 4.0, 25.0 + 1e4 + 4e4], rtol=1e-12)


def test_the_well_clips_at_more_counts_with_gain_up_to_full_scale() -> None:
    """A well that clips at 2 064 DN, 2 000 above black: at gain 1.5 at 3 064 DN, at gain 3 the ADC is first."""
    camera = calibration(saturation_dn=2064)
    assert [saturation_dn(camera, gain) for gain in (1.0, 1.5, 3.0)] == [2064, 3064, 4095]
    assert [saturation_dn(CAMERA, gain) for gain in (1.0, 1.5, 64.0)] == [4095] * 3
    assert clip_level_e(camera, 64.0, 1.5) == pytest.approx(2000 / 0.74)
    assert clip_level_e(camera, 64.0, 3.0) == pytest.approx(4031 / 3.0 / 0.74)
    for_good = at_gain(camera, 1.5)
    assert for_good.saturation_dn == 3064
    assert for_good.system_gain_dn_per_e == pytest.approx(1.11)
    assert clip_level_e(for_good, 64.0) == pytest.approx(2000 / 0.74)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"data_dn": np.zeros((2, 3), np.uint8)}, "uint8"),
        ({"data_dn": np.zeros((3, 2), np.uint16)}, r"\(3, 2\)"),
        ({"camera": "r2.left"}, "r2.left"),
        ({"exposure_s": 0.0}, "exposure_s"),
        ({"gain": -1.0}, "gain"),
        ({"gain": np.inf}, "gain"),
        ({"black_level_dn": np.nan}, "black_level_dn"),
    ],
)
def test_frames_that_do_not_match(changes: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        check_frame(frame(**changes), CAMERA)
