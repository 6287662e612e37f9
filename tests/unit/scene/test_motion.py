"""Poses: the axes of a camera on a robot, and robots that move."""

import numpy as np
import pytest

from nir_render.scene.documents.base import Orientation
from nir_render.scene.documents.document import Robot, Waypoint
from nir_render.scene.motion import robot_pose
from nir_render.scene.pose import Pose, rotation_of

QUARTER = {"yaw": "90 deg"}


def _robot(**parts: object) -> Robot:
    return Robot.model_validate({"rig": {}, **parts})


def test_yaw_is_to_the_left_and_pitch_is_nose_down() -> None:
    ahead = np.array([1.0, 0.0, 0.0])
    np.testing.assert_allclose(
        rotation_of(Orientation.model_validate(QUARTER)) @ ahead, [0, 1, 0], atol=1e-15
    )
    down = rotation_of(Orientation.model_validate({"pitch": "90 deg"}))
    np.testing.assert_allclose(down @ ahead, [0, 0, -1], atol=1e-15)
    # Yaw first, pitch about the turned axis: the nose ends below the left side.
    both = rotation_of(Orientation.model_validate({"yaw": "90 deg", "pitch": "30 deg"}))
    np.testing.assert_allclose(both @ ahead, [0, np.sqrt(0.75), -0.5], atol=1e-15)


def test_poses_nest() -> None:
    robot = Pose(rotation_of(Orientation.model_validate(QUARTER)), np.array([1.0, 2.0, 3.0]))
    inner = Pose(np.eye(3), np.array([0.1, 0.0, 0.0]))
    np.testing.assert_allclose((robot @ inner).position_m, [1.0, 2.1, 3.0])
    np.testing.assert_allclose((robot @ inner).to_local(np.array([1.0, 2.1, 3.0])), 0.0, atol=1e-15)


def test_a_robot_moves_evenly_between_waypoints_and_rests_beyond_them() -> None:
    robot = _robot(
        motion=[
            {"time": "1 s", "position": "[0, 0, 0] m"},
            {"time": "3 s", "position": "[4, 2, 0] m", "orientation": QUARTER},
        ]
    )
    assert isinstance(robot.motion[0], Waypoint)
    np.testing.assert_allclose(robot_pose(robot, 1.5).position_m, [1.0, 0.5, 0.0])
    np.testing.assert_allclose(robot_pose(robot, 0.0).position_m, [0.0, 0.0, 0.0])
    np.testing.assert_allclose(robot_pose(robot, 9.0).position_m, [4.0, 2.0, 0.0])
    turned = robot_pose(robot, 2.0).rotation @ np.array([1.0, 0.0, 0.0])
    assert np.degrees(np.arctan2(turned[1], turned[0])) == pytest.approx(45.0)


def test_a_robot_stands_still_while_it_holds() -> None:
    robot = _robot(
        motion=[
            {"time": "0 s", "position": "[0, 0, 0] m", "hold": "2 s"},
            {"time": "3 s", "position": "[1, 0, 0] m", "hold": "1 s"},
        ]
    )
    x_m = [float(robot_pose(robot, time_s).position_m[0]) for time_s in (-1.0, 0.0, 1.9, 2.5, 3.0, 3.9, 9.0)]
    assert x_m == pytest.approx([0.0, 0.0, 0.0, 0.5, 1.0, 1.0, 1.0])
    with pytest.raises(ValueError, match=r"3 s is not after 0 s and its hold of 3 s"):
        _robot(
            motion=[
                {"time": "0 s", "position": "[0, 0, 0] m", "hold": "3 s"},
                {"time": "3 s", "position": "[1, 0, 0] m"},
            ]
        )


def test_times_of_waypoints_increase() -> None:
    with pytest.raises(ValueError, match="must increase"):
        _robot(motion=[{"time": "1 s", "position": "[0, 0, 0] m"}] * 2)
