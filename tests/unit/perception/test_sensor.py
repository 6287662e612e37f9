from dataclasses import replace

import numpy as np
import pytest

from perception.sensor import at_gain, check_frame, clip_level_e, electrons, noise_floor_e2, saturation_dn
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
    ],
)
def test_frames_that_do_not_match(changes: dict[str, object], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        check_frame(frame(**changes), CAMERA)
