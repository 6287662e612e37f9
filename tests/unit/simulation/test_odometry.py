"""Odometry: exact without noise, dead reckoning with the errors that it says."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nir_render.scene.motion import robot_pose
from nir_render.scene.scene import Scene, parse_scene
from nir_render.simulation.odometry import odometry_of, pose_times_s, true_poses

CIRCLE = {"type": "circle", "center": "[1, 2, 0] m", "radius": "1 m", "period": "7 s"}


def _scene(
    odometry: dict[str, str],
    path: dict[str, str] | None = None,
    frames: int = 300,
    camera_clock: dict[str, object] | None = None,
) -> Scene:
    cameras = {"front": {"clock": camera_clock}} if camera_clock else {}
    rig = {"preset": "infra_swarm", "odometry": odometry, "cameras": cameras}
    robot = {"rig": rig, **({"path": path} if path else {})}
    clock = {"frames": frames, "frame_rate": "30 Hz"}
    return parse_scene({"format": 1, "observe": ["r1.front"], "clock": clock, "robots": {"r1": robot}})


def test_without_noise_it_is_the_way_in_the_first_pose() -> None:
    scene = _scene({}, CIRCLE)
    records = odometry_of(scene, "r1", 1)
    first, last = (robot_pose(scene.document.robots["r1"], records[k].time_s) for k in (0, -1))
    np.testing.assert_allclose(records[0].position_m, 0.0, atol=1e-15)
    np.testing.assert_allclose(records[-1].position_m, first.to_local(last.position_m), atol=1e-9)
    np.testing.assert_allclose(records[-1].rotation, first.rotation.T @ last.rotation, atol=1e-9)
    assert [record.time_s for record in records] == pose_times_s(scene).tolist()
    poses = list(true_poses(scene))
    assert poses[150].position_m == pytest.approx(robot_pose(scene.document.robots["r1"], 5.0).position_m)
    assert np.linalg.norm(poses[150].velocity_m_per_s) == pytest.approx(2.0 * np.pi / 7.0, rel=1e-6)


def test_errors_are_as_large_as_they_say() -> None:
    """A robot at rest, 300 steps of 1/30 s, three axes: a mean square of 900 is right to 4.7 % (1 σ)."""
    walk = odometry_of(_scene({"position_walk": "2 cm", "rotation_walk": "0.5 deg"}), "r1", 3)
    steps_m = np.diff([record.position_m for record in walk], axis=0)
    assert np.mean(steps_m**2) * 30.0 == pytest.approx(0.02**2, rel=4 * 0.047)
    turns = [one.rotation.T @ other.rotation for one, other in itertools.pairwise(walk)]
    angles_rad = Rotation.from_matrix(np.array(turns)).as_rotvec()
    assert np.mean(angles_rad**2) * 30.0 == pytest.approx(np.radians(0.5) ** 2, rel=4 * 0.047)
    white = odometry_of(_scene({"position_noise": "1 mm", "rotation_noise": "0.1 deg"}), "r1", 3)
    assert np.mean([record.position_m**2 for record in white]) == pytest.approx(1e-6, rel=4 * 0.047)
    tilts_rad = Rotation.from_matrix(np.array([record.rotation for record in white])).as_rotvec()
    assert np.mean(tilts_rad**2) == pytest.approx(np.radians(0.1) ** 2, rel=4 * 0.047)
    assert (white[0].position_sigma_m, walk[0].rotation_walk_rad_per_sqrt_s) == (0.001, np.radians(0.5))


def test_a_heading_that_is_off_bends_what_follows() -> None:
    """Straight on for 10 m with a walk of heading alone: each step has its true length."""
    scene = _scene({"rotation_walk": "2 deg"}, {**CIRCLE, "radius": "500 m", "period": "3000 s"})
    records = odometry_of(scene, "r1", 5)
    steps_m = np.linalg.norm(np.diff([record.position_m for record in records], axis=0), axis=1)
    np.testing.assert_allclose(steps_m, 2.0 * np.pi * 500.0 / 3000.0 / 30.0, rtol=1e-6)
    assert np.linalg.norm(records[-1].position_m[1:]) > 0.05


def test_it_reaches_as_far_as_the_cameras_own_clocks() -> None:
    """300 frames at 30 Hz, 2 s late, 1 % slow, jitter to 3 ms: the last begins at 2 + 1.01 · 299/30 + 0.003 s at most."""
    clock = {"offset": "2 s", "drift": 0.01, "jitter": "1 ms"}
    times_s = pose_times_s(_scene({}, CIRCLE, camera_clock=clock))
    last_s = 2.0 + 1.01 * 299 / 30 + 0.003
    assert times_s[0] == 0.0
    assert last_s + 1.0 / 30.0 <= times_s[-1] < last_s + 2.0 / 30.0
    early_s = pose_times_s(_scene({}, CIRCLE, camera_clock={"offset": "-0.1 s"}))
    np.testing.assert_allclose(early_s, np.arange(-3, 301) / 30.0, atol=1e-12)
    np.testing.assert_array_equal(
        pose_times_s(_scene({})), np.append(np.arange(300) / 30.0, 299 / 30.0 + 1 / 30.0)
    )
