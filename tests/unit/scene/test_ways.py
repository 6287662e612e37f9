"""Ways: speeds, circles, splines and recorded trajectories; what is wrong with them, and how it is told."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from nir_render.errors import InputError
from nir_render.scene.documents.document import Robot
from nir_render.scene.motion import robot_pose, robot_velocity
from nir_render.scene.scene import Scene, parse_scene

AHEAD = np.array([1.0, 0.0, 0.0])


def _robot(**parts: object) -> Robot:
    return Robot.model_validate({"rig": {}, **parts}, context={"folder": Path()})


def _scene(robot: dict[str, object], folder: Path = Path(), **parts: object) -> Scene:
    robots = {"r1": {"rig": "infra_swarm"}, "r2": {"rig": "infra_swarm", **robot}}
    return parse_scene({"format": 1, "observe": ["r1"], "robots": robots, **parts}, folder)


def test_a_speed_says_when_a_waypoint_is_reached() -> None:
    robot = _robot(
        motion=[
            {"time": "1 s", "hold": "2 s", "position": "[0, 0, 0] m"},
            {"speed": "0.5 m/s", "position": "[3, 4, 0] m"},
            {"speed": "10 cm/s", "position": "[3, 4.2, 0] m"},
        ]
    )
    assert [way.time_s for way in robot.motion] == pytest.approx([1.0, 13.0, 15.0])
    velocity = robot_velocity(robot, 8.0)
    assert velocity is not None
    np.testing.assert_allclose(velocity.linear_m_per_s, [0.3, 0.4, 0.0], atol=1e-10)


@pytest.mark.parametrize(
    ("turn", "place", "heading"),
    [("left", [1.0, 4.0], [-1.0, 0.0]), ("right", [1.0, 0.0], [-1.0, 0.0])],
)
def test_a_circle_goes_round(turn: str, place: list[float], heading: list[float]) -> None:
    """A quarter of a round from the east: to the north or the south, heading west either way."""
    path = {"type": "circle", "center": "[1, 2, 0.1] m", "radius": "2 m", "speed": "0.5 m/s", "turn": turn}
    quarter_s = 0.25 * 2.0 * np.pi * 2.0 / 0.5
    robot = _robot(path=path)
    pose, velocity = robot_pose(robot, quarter_s), robot_velocity(robot, quarter_s)
    np.testing.assert_allclose(pose.position_m, [*place, 0.1], atol=1e-12)
    np.testing.assert_allclose((pose.rotation @ AHEAD)[:2], heading, atol=1e-12)
    assert velocity is not None
    np.testing.assert_allclose(velocity.linear_m_per_s[:2], 0.5 * np.array(heading), atol=1e-7)
    side = 1.0 if turn == "left" else -1.0
    np.testing.assert_allclose(velocity.angular_rad_per_s, [0.0, 0.0, side * 0.25], atol=1e-9)
    fixed = robot_pose(_robot(path={**path, "heading": "fixed"}), quarter_s)
    np.testing.assert_allclose(fixed.rotation, np.eye(3), atol=1e-15)


def test_a_smooth_way_meets_its_waypoints_at_rest_where_it_holds() -> None:
    """Positions and velocities are continuous at the knots; at both ends and at the hold it stands still."""
    robot = _robot(
        between="smooth",
        motion=[
            {"time": "0 s", "position": "[0, 0, 0] m"},
            {"time": "2 s", "position": "[2, 1, 0] m", "orientation": {"yaw": "60 deg"}},
            {"time": "4 s", "position": "[4, 0, 0] m", "hold": "1 s"},
            {"time": "7 s", "position": "[4, 2, 0] m"},
        ],
    )
    for way in robot.motion:
        np.testing.assert_allclose(robot_pose(robot, way.time_s).position_m, way.position_m, atol=1e-12)
    speeds = []
    for time_s in (1.999, 2.001, 4.5, 0.0, 7.0):
        velocity = robot_velocity(robot, time_s)
        assert velocity is not None
        speeds.append(np.linalg.norm(velocity.linear_m_per_s))
    assert speeds[0] == pytest.approx(speeds[1], rel=2e-3)
    assert speeds[0] > 0.5
    assert speeds[2:] == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)
    # Clamped cubic from rest to rest over 2 s: half way after half the time, at 1.5 times the mean speed.
    np.testing.assert_allclose(robot_pose(robot, 6.0).position_m, [4.0, 1.0, 0.0], atol=1e-12)
    halfway = robot_velocity(robot, 6.0)
    assert halfway is not None
    assert halfway.linear_m_per_s[1] == pytest.approx(1.5, rel=1e-5)


def test_a_smooth_turn_comes_to_rest_too() -> None:
    """A quarter turn in 2 s between two rests: yaw 90° (3 x² − 2 x³), its rate 0 at both ends, 67.5°/s midway."""
    quarter = [
        {"time": "1 s", "position": "[1, 0, 0] m"},
        {"time": "3 s", "position": "[1, 0, 0] m", "orientation": {"yaw": "90 deg"}},
    ]
    robot = _scene({"between": "smooth", "motion": quarter}).document.robots["r2"]
    for share in (0.0, 0.25, 0.5, 0.75, 1.0):
        ahead = robot_pose(robot, 1.0 + 2.0 * share).rotation @ AHEAD
        yaw_deg = np.degrees(np.arctan2(ahead[1], ahead[0]))
        assert yaw_deg == pytest.approx(90.0 * (3.0 * share**2 - 2.0 * share**3), abs=1e-4)
    for time_s, rate_deg in ((1.001, 0.135), (2.0, 67.5), (2.999, 0.135)):
        velocity = robot_velocity(robot, time_s)
        assert velocity is not None
        assert np.degrees(velocity.angular_rad_per_s[2]) == pytest.approx(rate_deg, rel=2e-3)


ROWS = [(0.0, 0, 0, 0, 0, 0, 0, 1), (2.0, 1, 2, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5))]


@pytest.mark.parametrize("kind", ["csv", "tum"])
def test_recorded_trajectories_are_read_and_interpolated(tmp_path: Path, kind: str) -> None:
    """A quarter turn in 2 s: after 1 s at half the way, turned by 45°; the delay shifts it all."""
    if kind == "csv":
        lines = ["time_s,x_m,y_m,z_m,qx,qy,qz,qw", *(",".join(map(str, row)) for row in ROWS)]
    else:
        lines = ["# time x y z qx qy qz qw", *(" ".join(map(str, row)) for row in ROWS)]
    (tmp_path / f"way.{kind}").write_text("\n".join(lines) + "\n")
    scene = _scene({"path": {"type": "recorded", "file": f"way.{kind}", "delay": "3 s"}}, tmp_path)
    pose = robot_pose(scene.document.robots["r2"], 4.0)
    np.testing.assert_allclose(pose.position_m, [0.5, 1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(pose.rotation @ AHEAD, [np.sqrt(0.5), np.sqrt(0.5), 0.0], atol=1e-12)
    np.testing.assert_allclose(robot_pose(scene.document.robots["r2"], 9.0).position_m, [1, 2, 0])
    again = parse_scene(yaml.safe_load(scene.resolved_yaml()))
    assert again.document == scene.document


def test_a_recording_that_counts_from_1970_starts_when_the_scene_says(tmp_path: Path) -> None:
    """Half a second after its start it is a quarter of the way through its 2 s, to 0.24 µs of its clock."""
    rows = [(1.7e9 + row[0], *row[1:]) for row in ROWS]
    (tmp_path / "way.tum").write_text("\n".join(" ".join(map(repr, map(float, row))) for row in rows))
    path = {"type": "recorded", "file": "way.tum"}
    scene = _scene({"path": {**path, "start": "3 s"}}, tmp_path)
    np.testing.assert_allclose(
        robot_pose(scene.document.robots["r2"], 3.5).position_m, [0.25, 0.5, 0.0], atol=1e-6
    )
    for given, told in (({}, "times since 1970"), ({"start": "0 s", "delay": "1 s"}, "'delay' or 'start'")):
        with pytest.raises(InputError, match=told):
            _scene({"path": {**path, **given}}, tmp_path)


@pytest.mark.parametrize(
    ("robot", "told"),
    [
        ({"motion": [{"speed": "1 m/s", "position": "[0, 0, 0] m"}]}, "the first waypoint has none before it"),
        (
            {
                "motion": [
                    {"time": "0 s", "position": "[0, 0, 0] m"},
                    {"time": "1 s", "speed": "1 m/s", "position": "[1, 0, 0] m"},
                ]
            },
            "write either 'time' or 'speed'",
        ),
        (
            {
                "motion": [
                    {"time": "0 s", "position": "[0, 0, 0] m"},
                    {"speed": "1 m", "position": "[1, 0, 0] m"},
                ]
            },
            "motion.1.speed: '1 m' is a length",
        ),
        (
            {"motion": [{"time": "0 s"}, {"speed": "1 m/s", "position": "[1, 0, 0] m"}]},
            "motion.1.speed: of the waypoint before it",
        ),
        (
            {
                "path": {
                    "type": "circle", "center": "[0, 0, 0] m", "radius": "1 m",
                    "period": "1 s", "speed": "1 m/s",
                }
            },
            "either 'period' or 'speed'",
        ),
        ({"path": {"type": "recorded", "file": "none.tum"}}, "there is no file 'none.tum'"),
    ],
)  # fmt: skip
def test_ways_that_cannot_be_gone_are_refused(robot: dict[str, object], told: str) -> None:
    with pytest.raises(InputError) as raised:
        _scene(robot)
    assert told in str(raised.value)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("0 0 0 0 0 0 0 1\n0 1 0 0 0 0 0 1\n", "line 2: its time is not after"),
        ("0 0 0 0 0 0 0 2\n", "line 1: its quaternion is not of length 1"),
        ("0 0 0 0 0 0 1\n", "line 1: wanted eight finite numbers"),
        ("# nothing\n", "holds no rows"),
    ],
)
def test_broken_trajectories_are_refused_by_line(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "way.tum").write_text(text)
    with pytest.raises(InputError) as raised:
        _scene({"path": {"type": "recorded", "file": "way.tum"}}, tmp_path)
    assert told in str(raised.value)
