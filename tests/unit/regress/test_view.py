"""Where the pixels of an indirect image look: seen without noise, whatever the scene shows."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nir_render as nr
from nir_render.camera.optics.lens import corner_directions
from nir_render.regress.stages.view import compare_view
from nir_render.scene.scene import Scene
from nir_render.transport.indirect import groups
from tests.unit.regress import cases

pytestmark = pytest.mark.mitsuba

FRONT = "robots.r1.rig.cameras.front"
FISHEYE = {f"{FRONT}.lens": {"model": "fisheye", "focal_length": "0.9 mm", "f_number": 2.0, "transmission": 0.9,
                             "distortion": [-0.02, 0.003, 0.0, 0.0]}}  # fmt: skip
TURNED = {
    "robots.r1.orientation": {"yaw": "30 deg", "pitch": "5 deg"},
    f"{FRONT}.orientation": {"yaw": "-20 deg", "roll": "3 deg"},
}


@pytest.mark.parametrize("change", [{}, TURNED, FISHEYE | TURNED], ids=["plain", "turned", "fisheye"])
def test_pixels_look_where_perception_sees_them(tmp_path: Path, change: dict[str, Any]) -> None:
    scene = cases.scene(tmp_path).with_(change)
    finding = compare_view(scene, 0.0, nr.calibration(scene, "r1.front"), "")
    assert (finding.verdict, finding.seen) == ("pass", "equal but for rounding")


@pytest.mark.parametrize("change", [{}, FISHEYE | TURNED], ids=["plain", "fisheye"])
def test_a_thousandth_of_a_pixel_in_the_rays_alone_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any]
) -> None:
    """All rays look 1e-3 px to the right of what they should: nothing else knows of it."""
    scene = cases.scene(tmp_path).with_(change)
    calibration = nr.calibration(scene, "r1.front")
    _spoil(monkeypatch, lambda corners: corners + 1e-3 / calibration.fx_px * np.array([1.0, 0.0, 0.0]))
    finding = compare_view(scene, 0.0, calibration, "")
    assert finding.verdict == "fail"
    assert finding.seen.startswith("off by 0.00")


def test_a_camera_elsewhere_is_found(tmp_path: Path) -> None:
    scene = cases.scene(tmp_path)
    calibration = nr.calibration(scene, "r1.front")
    moved: Scene = scene.with_({f"{FRONT}.position": "[0.0001, 0, 0.3] m"})
    assert compare_view(moved, 0.0, calibration, "").seen == "the lens is off by 0.1 mm"


def _spoil(monkeypatch: pytest.MonkeyPatch, fault: Callable[[Any], Any]) -> None:
    monkeypatch.setattr(groups, "corner_directions", lambda camera: fault(corner_directions(camera)))
