"""Adaptive exposure on frames whose brightest pixel is known."""

from pathlib import Path

import numpy as np
import pytest

from nir_render import load_scene, simulate
from nir_render.camera.exposure_control import next_exposure_s
from nir_render.camera.sensor import saturation_dn
from nir_render.scene.exposure import AutoExposure
from tests.unit.camera.conftest import CameraMaker

CONTROL = AutoExposure.model_validate({"target": 0.7, "shortest": "20 us", "longest": "5 ms"})


def _frame(peak_dn: int) -> np.ndarray:
    frame = np.full((8, 8), 64, dtype=np.uint16)
    frame[3, 3] = peak_dn
    return frame


@pytest.mark.parametrize(
    ("peak_dn", "exposure_ms", "next_ms"),
    [
        (64 + 2000, 1.0, 0.7 * 4031 / 2000),  # below the target: longer in proportion
        (64 + 3500, 1.0, 0.7 * 4031 / 3500),  # above it: shorter in proportion
        (64 + 10, 1.0, 4.0),  # far below: one step of 4 at most
        (4095, 1.0, 0.25),  # clipped: a whole step down
        (64 + 10, 3.0, 5.0),  # never beyond the longest
        (4095, 0.05, 0.02),  # nor below the shortest
    ],
)
def test_the_brightest_pixel_goes_to_the_target(
    camera_with: CameraMaker, peak_dn: int, exposure_ms: float, next_ms: float
) -> None:
    """A well of 6000 e clips nowhere below full scale: the range is 64 to 4095 DN, 4031 counts."""
    sensor = camera_with(sensor={"full_well": "6000 e"}).sensor
    assert saturation_dn(sensor) == 4095
    found_s = next_exposure_s(CONTROL, sensor, _frame(peak_dn), 1e-3 * exposure_ms)
    assert found_s == pytest.approx(1e-3 * next_ms, rel=1e-9)


@pytest.mark.mitsuba
def test_a_camera_has_settled_before_its_first_frame_and_follows_a_source_that_leaves() -> None:
    """From 50 ms, 200 times too long, the first frame's peak is within 15 % of the target; then it keeps up."""
    scene = load_scene(Path(__file__).parents[3] / "scenes" / "one_source.yaml").with_(
        {
            "robots.r1.rig.cameras.front.exposure": "50 ms",
            "robots.r1.rig.cameras.front.auto_exposure": {"shortest": "20 us", "longest": "10 ms"},
        }
    )
    frames = [shot.frame for shot in simulate(scene)]
    levels = [(float(frame.data_dn.max()) - 64.0) / 4000.0 for frame in frames]
    assert levels[0] == pytest.approx(0.7, rel=0.15)
    exposures_s = [frame.exposure_s for frame in frames]
    # Where the disc is unresolved the exposure grows with the square of the range, one frame late.
    assert exposures_s[9] / exposures_s[7] == pytest.approx((9.179 / 7.139) ** 2, rel=0.12)
    assert max(levels) < 0.85
