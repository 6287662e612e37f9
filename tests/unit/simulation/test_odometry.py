"""What a robot believes of its motion: exact without errors, and as far astray as it says with them."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nir_render import parse_scene
from nir_render.simulation.odometry import observers_astir, odometry_of, pose_records


def _scene(frames: int, **odometry: str) -> Any:
    motion = [
        {"time": "0 s", "position": "[1, 2, 0] m", "orientation": {"yaw": "90 deg"}},
        {"time": "10 s", "position": "[1, 4, 0] m", "orientation": {"yaw": "180 deg"}},
    ]
    rig: dict[str, Any] = {"preset": "infra_swarm"}
    if odometry:
        rig["odometry"] = odometry
    return parse_scene(
        {
            "format": 1, "name": "odometry", "seed": 1, "clock": {"frames": frames, "frame_rate": "10 Hz"},
            "observe": ["r1.front"],
            "robots": {"r1": {"rig": rig, "motion": motion}, "r2": {"rig": "infra_swarm"}},
        }
    )  # fmt: skip


def test_without_errors_it_is_the_motion_seen_from_where_it_began() -> None:
    lines = odometry_of(_scene(101), "r1", 1)
    assert len(lines) == 102
    np.testing.assert_allclose(lines[0].position_m, 0.0, atol=1e-12)
    np.testing.assert_allclose(lines[0].rotation, np.eye(3), atol=1e-12)
    # Two metres along the world's y, which lay ahead; half of the quarter turn to the left.
    np.testing.assert_allclose(lines[50].position_m, [1.0, 0.0, 0.0], atol=1e-12)
    yaw_deg = Rotation.from_matrix(lines[50].rotation).as_euler("ZYX", degrees=True)[0]
    assert yaw_deg == pytest.approx(45.0, abs=1e-9)


def test_errors_are_as_large_as_they_say() -> None:
    errors = {
        "position_noise": "2 mm", "rotation_noise": "0.2 deg", "position_walk": "1 cm", "rotation_walk": "0.5 deg",
    }  # fmt: skip
    runs = [odometry_of(_scene(41, **errors), "r1", seed) for seed in range(60)]
    true = odometry_of(_scene(41), "r1", 1)
    last, first = true[-1], true[0]
    assert (runs[0][3].position_sigma_m, runs[0][3].position_walk_m_per_sqrt_s) == (2e-3, 1e-2)
    # Where it is by its own account, had it not turned astray: upwards nothing bends.
    off_m = np.array([(run[-1].position_m - last.position_m)[2] for run in runs])
    turned = [Rotation.from_matrix(last.rotation.T @ run[-1].rotation).as_rotvec() for run in runs]
    slack = 4.0 / np.sqrt(2 * len(runs))
    seconds = last.time_s - first.time_s
    assert off_m.std() == pytest.approx(np.hypot(2e-3, 1e-2 * np.sqrt(seconds)), rel=slack)
    expected_rad = np.radians(np.hypot(0.2, 0.5 * np.sqrt(seconds)))
    assert np.array(turned).std() == pytest.approx(expected_rad, rel=slack)
    at_once_m = np.array([run[0].position_m for run in runs]).ravel()
    assert at_once_m.std() == pytest.approx(2e-3, rel=slack)


def test_the_same_seed_believes_the_same() -> None:
    one, other = (odometry_of(_scene(5, position_walk="1 cm"), "r1", 3) for _ in range(2))
    assert all((a.position_m == b.position_m).all() for a, b in zip(one, other, strict=True))


def test_who_stands_still_and_says_nothing_of_odometry_has_none() -> None:
    scene = _scene(3).with_({"robots.r1": {"rig": "infra_swarm"}})
    assert observers_astir(scene) == []
    assert observers_astir(_scene(3)) == ["r1"]


def test_poses_are_the_worlds() -> None:
    rows = [row for row in pose_records(_scene(51)) if row["robot"] == "r1"]
    assert rows[50]["position_m"] == pytest.approx([1.0, 3.0, 0.0])
    assert Rotation.from_quat(rows[50]["quaternion_xyzw"]).as_euler("ZYX", degrees=True)[0] == pytest.approx(
        135.0
    )
