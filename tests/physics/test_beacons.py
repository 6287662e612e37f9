"""What others let shine: closed forms in the frame, no target in the truth, the filter's leak at 850 nm."""

import math
from typing import Any

import numpy as np
import pytest

from nir_render import InputError, Scene, calibration, load_scene
from nir_render.camera.optics.response import response
from nir_render.scene.documents.emitters import Source
from nir_render.scene.emission import emission_units
from nir_render.simulation.lamps import lamp_truth
from nir_render.transport.world.pattern import pattern_of, relative_intensity
from tests.paths import SCENES

pytestmark = pytest.mark.mitsuba

# Mean watts: data sheets where they say.
MEAN_W = {
    "depth_camera_850": 0.36,
    "tof_camera_940": 0.18,
    "mocap_strobe_850": 0.3,
    "remote_control_940": 0.00957,
    "lidar_905": 16 * 0.2e-6 / 55.296e-6,  # lasers, their pulse, the time between two
}


def _facing(preset: str, **changes: Any) -> Scene:
    """Return a scene of a beacon 3 m ahead of the camera, at its height, that shines straight into it."""
    scene = load_scene(SCENES / "one_source.yaml")
    place = scene.at(0.0).camera("r1.front").pose.position_m + np.array([3.0, 0.0, 0.0])
    beacon = {
        "preset": preset, "position": f"{place.tolist()} m", "drive": 1,
        "orientation": {"yaw": "180 deg", "pitch": "90 deg"},
    }  # fmt: skip
    return scene.with_(
        {
            "beacons": {"one": {**beacon, **changes}},
            "robots.r2.motion": [],
            "robots.r2.position": "[9, 9, 9] m",
        }
    )


@pytest.mark.parametrize("preset", MEAN_W)
def test_presets_say_what_their_sheets_do(preset: str) -> None:
    shipped = Source.model_validate(preset)
    assert shipped.drive.mean is not None
    assert emission_units(shipped) * shipped.drive.mean == pytest.approx(MEAN_W[preset], rel=0.005)


def test_a_remote_control_has_the_sheet_s_intensity() -> None:
    """36 mW/sr on the axis, half of it 25° off it (TSAL4400)."""
    beacons = _facing("remote_control_940").document.beacons
    assert beacons is not None
    pattern = pattern_of(beacons["one"])
    assert pattern is not None
    angle = np.radians([0.0, 25.0])
    axes = np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=1)
    on_axis, beside = relative_intensity(pattern, axes) * beacons["one"].flux_w / (4.0 * math.pi)
    assert on_axis == pytest.approx(0.036, rel=0.01)
    assert beside / on_axis == pytest.approx(0.5, abs=0.01)


def test_a_filter_leaves_of_850_nm_its_leak_alone() -> None:
    """Of a line 2 nm wide, on the axis: 10^−OD at 850 nm; at 940 nm T₀/(1 + δ⁶) over the cone of f/2, by a sum.

    The cone's rays, even in tan² θ up to 1/16, meet the passband moved by √(1 − sin² θ/4).
    """
    _, camera = load_scene(SCENES / "one_source.yaml").camera("r1.front")
    plain = camera.model_copy(update={"filter": None})
    passed = []
    for preset in ("depth_camera_850", "tof_camera_940"):
        beacons = _facing(preset).document.beacons
        assert beacons is not None
        passed.append(float(response(camera, beacons["one"])(0.0) / response(plain, beacons["one"])(0.0)))
    assert camera.filter is not None
    assert camera.filter.blocking_od is not None
    assert passed[0] == pytest.approx(10.0**-camera.filter.blocking_od, rel=1e-6)
    tan2 = (np.arange(4000) + 0.5) / 4000 / 16.0
    centre_nm = 940.0 * np.sqrt(1.0 - tan2 / (1.0 + tan2) / 4.0)
    line_nm = 940.0 + np.linspace(-5.0, 5.0, 401)
    weight = np.exp(-4.0 * math.log(2.0) * ((line_nm - 940.0) / 2.0) ** 2)
    passband = 0.92 / (1.0 + ((line_nm[:, None] - centre_nm) / 5.0) ** 6)
    assert passed[1] == pytest.approx(float(weight @ passband.mean(axis=1) / weight.sum()), rel=0.002)


def test_a_beacon_is_no_robot() -> None:
    """Calibration, targets and drives know robots alone; its outline stands with those of lamps, 3 m ahead."""
    scene = _facing("tof_camera_940")
    snapshot = scene.at(0.0)
    assert snapshot.groups[-1] == "beacons.one"
    assert "beacons.one" not in snapshot.carried_sources
    assert "beacons.one" not in scene.sources()
    without = scene.with_({"beacons": None})
    known, plain = calibration(scene, "r1.front"), calibration(without, "r1.front")
    assert known.range_constant_dn_m2_per_s == plain.range_constant_dn_m2_per_s
    assert len(known.own_sources_body_m) == len(plain.own_sources_body_m)
    (outline,) = lamp_truth(snapshot, "r1.front", 0)
    assert outline.lamp == "beacons.one"
    assert np.array(outline.outline_px).mean(axis=0) == pytest.approx([639.5, 479.5], abs=0.1)
    with pytest.raises(InputError, match=r"there is no source 'beacons\.one'"):
        snapshot.sending({"beacons.one": 0.5})
