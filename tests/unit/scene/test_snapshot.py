"""The world at one time: made from a scene's motions, or by whoever moves robots himself."""

import numpy as np
import pytest

import nir_render as nr
from nir_render.scene.documents.times.drives import Drive
from tests.paths import SCENES


@pytest.fixture(scope="module")
def scene() -> nr.Scene:
    return nr.load_scene(SCENES / "one_source.yaml")


def test_what_a_scene_moves_stands_where_its_waypoints_say(scene: nr.Scene) -> None:
    moving = scene.with_(
        {
            "robots.r2": {
                "rig": "infra_swarm",
                "motion": [
                    {"time": "0 s", "position": "[1, 0, 0] m"},
                    {"time": "2 s", "position": "[3, 0, 0] m", "orientation": {"yaw": "90 deg"}},
                ],
            }
        }
    )
    world = moving.at(1.0)
    np.testing.assert_allclose(world.robots["r2"].pose.position_m, [2.0, 0.0, 0.0])
    # Half way through the turn, 45°, a source 1 m ahead of the robot's origin would stand to its front left.
    source = scene.sources()["r2.top"][1]
    half = np.sqrt(0.5)
    turned = np.array([[half, -half, 0.0], [half, half, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(
        world.sources["r2.top"].pose.position_m,
        [2.0, 0.0, 0.0] + turned @ np.array(source.position_m),
        atol=1e-12,
    )


def test_a_robot_moved_by_hand_stands_where_a_changed_scene_would_put_it(scene: nr.Scene) -> None:
    """To the bit: poses, sources, cameras."""
    changed = scene.with_(
        {
            "robots.r2": {
                "rig": "infra_swarm",
                "position": "[3, 0.5, 0.1] m",
                "orientation": {"yaw": "0.3 rad"},
            }
        }
    ).at(0.7)
    moved = scene.at(0.0).moved({"r2": nr.Pose.of((3.0, 0.5, 0.1), yaw_rad=0.3)}, time_s=0.7)
    assert moved.time_s == changed.time_s == 0.7
    for name, placed in changed.sources.items():
        assert (moved.sources[name].pose.position_m == placed.pose.position_m).all()
        assert (moved.sources[name].pose.rotation == placed.pose.rotation).all()
    for name in ("r2.front", "r2.left"):
        assert (moved.camera(name).pose.rotation == changed.camera(name).pose.rotation).all()
    assert (
        moved.camera("r1.front").pose.position_m == scene.at(0.0).camera("r1.front").pose.position_m
    ).all()


@pytest.mark.mitsuba
def test_a_world_can_be_made_without_any_file() -> None:
    world = nr.parse_scene(
        {
            "format": 1,
            "observe": ["r1"],
            "robots": {"r1": {"rig": "infra_swarm"}, "r2": {"rig": "infra_swarm"}},
        }
    ).at(0.0)
    world = world.moved({"r2": nr.Pose.of((2.0, 0.0, 0.0))})
    light = nr.render(world, "r1.front")
    (row,) = np.flatnonzero(light.direct.group == light.groups.index("r2.top"))
    assert light.direct.distance_m[row] == pytest.approx(
        float(
            np.linalg.norm(world.sources["r2.top"].pose.position_m - world.camera("r1.front").pose.position_m)
        )
    )


@pytest.mark.mitsuba
def test_what_a_source_sends_can_be_changed_by_hand(scene: nr.Scene) -> None:
    """Half its level, half its electrons; the same light serves both."""
    world = scene.at(0.0)
    dimmed = world.sending({"r2.top": Drive(constant=0.5)})
    light = nr.render(world, "r1.front", seed=1)
    full, half = (nr.expected_electrons(light, one, 1e-4) for one in (world, dimmed))
    np.testing.assert_allclose(half, 0.5 * full, rtol=1e-9)
    assert world.sources["r2.top"].source.drive.constant == 1.0


def test_who_does_not_exist_is_named_beside_who_does(scene: nr.Scene) -> None:
    world = scene.at(0.0)
    with pytest.raises(nr.InputError, match=r"no robot 'r9'; known: r1, r2"):
        world.moved({"r9": nr.Pose.of((0.0, 0.0, 0.0))})
    with pytest.raises(nr.InputError, match=r"no source 'r2.tip'; known: r1.top, r2.top"):
        world.sending({"r2.tip": Drive(constant=0.5)})
    with pytest.raises(nr.InputError, match=r"no camera 'r1.up'; known: r1.front"):
        world.camera("r1.up")
    with pytest.raises(nr.InputError, match=r"snapshot is of 0.0 s"):
        nr.render(world, "r1.front", time_s=1.0)


def test_the_origin_of_the_poses_of_a_snapshot(scene: nr.Scene) -> None:
    """Yaw turns about z, then pitch about the new y, then roll about the new x; x looks ahead."""
    pose = nr.Pose.of((0.0, 0.0, 0.0), yaw_rad=np.pi / 2, pitch_rad=np.pi / 6)
    np.testing.assert_allclose(pose.rotation @ [1.0, 0.0, 0.0], [0.0, np.sqrt(0.75), -0.5], atol=1e-15)
