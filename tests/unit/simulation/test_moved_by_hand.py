"""Worlds that are moved by hand: frames with truth and time, and what is refused."""

import dataclasses
import gc
import pickle
import weakref

import numpy as np
import pytest

import nir_render as nr
from nir_render.scene.motion import Velocity
from tests.paths import SCENES

pytestmark = pytest.mark.mitsuba

EXPOSURE_S = 2e-4


@pytest.fixture(scope="module")
def scene() -> nr.Scene:
    return nr.load_scene(SCENES / "one_source.yaml")


def test_a_frame_that_is_taken_is_that_of_the_clock(scene: nr.Scene) -> None:
    """To the bit: counts, truth, time; the world stands still at mid-exposure."""
    short = scene.with_({"clock.frames": 2, "clock.frame_rate": "0.4 Hz"})
    for shot in nr.simulate(short):
        taken = nr.take_frame(short.at(shot.light.time_s), "r1.front", shot.frame.index)
        assert taken.frame.data_dn.tobytes() == shot.frame.data_dn.tobytes()
        assert [row.range_m for row in taken.truth] == [row.range_m for row in shot.truth]
        assert taken.frame.time_s == pytest.approx(shot.frame.time_s, abs=1e-12)


def test_truth_follows_the_robot_that_is_moved(scene: nr.Scene) -> None:
    """3 m and 4 m ahead of where the camera is: the range is the distance between the two, to the millimetre."""
    world = scene.at(0.0)
    eye_m = world.camera("r1.front").pose.position_m
    for x_m in (3.0, 4.0):
        moved = world.moved({"r2": nr.Pose.of((x_m, 0.3, 0.0))}, time_s=x_m)
        (row,) = (row for row in nr.take_frame(moved, "r1.front", 0).truth if row.robot == "r2")
        assert row.range_m == pytest.approx(
            float(np.linalg.norm(moved.sources["r2.top"].pose.position_m - eye_m)), rel=1e-9
        )


def test_truth_says_how_far_a_flare_moves_within_an_exposure(scene: nr.Scene) -> None:
    """Across at 0.6 m/s, ahead on the axis of u: f v t / depth. Beside it the observer turns: f ω t / cos² θ.

    Both for 10 ms and 480 px; a turn to the left moves flares to the right. At rest it is 0.
    """
    slow = scene.with_({"robots.r1.rig.cameras.front.exposure": "10 ms"}).at(0.0)
    across = Velocity(np.array([0.0, -0.6, 0.0]), np.zeros(3))
    turning = Velocity(np.zeros(3), np.array([0.0, 0.0, 0.5]))
    cases: tuple[tuple[float, float, dict[str, Velocity]], ...] = (
        (3.0, 0.0, {"r2": across}),
        (3.0, 0.6, {"r1": turning}),
        (3.0, 0.0, {}),
    )
    for x_m, y_m, velocities in cases:
        poses = {"r2": nr.Pose.of((x_m, y_m, 0.0)), "r1": slow.robots["r1"].pose}
        world = slow.moved(poses, velocities=velocities)
        (row,) = (row for row in nr.take_frame(world, "r1.front", 0).truth if row.robot == "r2")
        assert row.depth_z_m is not None
        expected_px = 0.0
        if "r2" in velocities:
            expected_px = 480.0 * 0.6 * 0.01 / row.depth_z_m
        if "r1" in velocities:
            # The lens is carried around the robot's middle, 6 cm behind it, and so moves to the left.
            expected_px = 480.0 * 0.5 * 0.01 * (1.0 + (y_m / row.depth_z_m) ** 2 + 0.06 / row.depth_z_m)
        assert row.moved_u_px == pytest.approx(expected_px, rel=1e-3)


def test_a_light_of_another_place_is_refused(scene: nr.Scene) -> None:
    world = scene.at(0.0)
    light = nr.render(world, "r1.front")
    farther = world.moved({"r2": nr.Pose.of((5.0, 0.0, 0.0))})
    with pytest.raises(nr.InputError, match=r"r2.top stands .* m from where the light"):
        nr.expose(light, farther)
    turned = world.moved({"r1": nr.Pose.of((0.0, 0.0, 0.0), yaw_rad=0.01)})
    with pytest.raises(nr.InputError, match=r"r2.top stands"):
        nr.expected_electrons(light, turned)
    assert nr.expose(light, world.moved({}, time_s=7.0)).time_s == pytest.approx(7.0, abs=0.1)


def test_a_source_blinks_on_while_its_light_is_reused(scene: nr.Scene) -> None:
    """Bits of 0.1 s, 1, 0, 1: at 0.05, 0.15 and 0.25 s the flare is there, gone, there."""
    bits = {"bits": {"pattern": "101", "rate": "10 Hz"}}
    world = scene.at(0.0).sending({"r2.top": bits, "r1.top": 0.0})
    light = nr.render(world, "r1.front")
    sums = [
        float(nr.expose(light, world.moved({}, time_s=time_s), EXPOSURE_S).data_dn.astype(float).sum())
        for time_s in (0.05, 0.15, 0.25)
    ]
    dark = sums[1]
    assert min(sums[0], sums[2]) - dark > 1000.0


def test_each_world_gets_its_own_electrons_of_one_light(scene: nr.Scene) -> None:
    """Another flux, filter, drive, and the first again, all by one light: as if it were rendered for each."""
    light = nr.render(scene, "r1.front")
    source, camera = "robots.r2.rig.sources.top", "robots.r1.rig.cameras.front"
    for changes in (
        {},
        {f"{source}.flux": "0.1 W"},
        {f"{camera}.filter": None},
        {f"{source}.drive": 0.3},
        {},
    ):
        world = scene.with_(changes)
        fresh = nr.expected_electrons(dataclasses.replace(light), world, EXPOSURE_S)
        np.testing.assert_array_equal(nr.expected_electrons(light, world, EXPOSURE_S), fresh)


def test_what_a_light_keeps_goes_with_it(scene: nr.Scene) -> None:
    light = nr.render(scene, "r1.front")
    nr.expose(light, scene)
    gone = weakref.ref(light.kept["rates"][2]["windows"][0])
    assert gone() is not None
    gc.disable()
    try:
        dead = weakref.ref(light)
        del light
        assert dead() is None
        assert gone() is None
    finally:
        gc.enable()


def test_a_light_travels_without_what_follows_from_it(scene: nr.Scene) -> None:
    light = nr.render(scene, "r1.front")
    nr.expose(light, scene)
    arrived = pickle.loads(pickle.dumps(light))
    assert arrived.kept == {}
    assert not arrived.direct.direction.flags.writeable
    assert nr.expose(arrived, scene).data_dn.tobytes() == nr.expose(light, scene).data_dn.tobytes()


def test_a_snapshot_has_the_seed_and_the_calibration_of_its_scene(scene: nr.Scene) -> None:
    seeded = scene.with_({"seed": 5})
    world = seeded.at(0.0)
    assert nr.render(world, "r1.front").seed == nr.render(seeded, "r1.front").seed == 5
    known, again = nr.calibration(world, "r1.front"), nr.calibration(seeded, "r1.front")
    assert known.range_constant_dn_m2_per_s == again.range_constant_dn_m2_per_s


@pytest.mark.parametrize(
    ("pose", "said"),
    [
        (nr.Pose(np.eye(3), np.array([np.nan, 0.0, 0.0])), "its position is"),
        (nr.Pose(np.eye(3), np.array([1e300, 0.0, 0.0])), "its position is"),
        (nr.Pose(2.0 * np.eye(3), np.zeros(3)), "no rotation matrix"),
        (nr.Pose(np.diag([1.0, 1.0, -1.0]), np.zeros(3)), "no rotation matrix"),
        ((1.0, 2.0, 3.0), "wanted a Pose"),
    ],
)
def test_nobody_stands_nowhere(scene: nr.Scene, pose: nr.Pose, said: str) -> None:
    with pytest.raises(nr.InputError, match=said):
        scene.at(0.0).moved({"r2": pose})


def test_a_place_has_three_coordinates() -> None:
    with pytest.raises(nr.InputError, match="wanted three numbers"):
        nr.Pose.of((1.0, 2.0))  # type: ignore[arg-type]


@pytest.mark.parametrize("drive", [2.0, {"square": {"frequency": "1 kHz", "duty": 3}}, "bright", None])
def test_what_is_no_drive_is_refused_with_its_place(scene: nr.Scene, drive: object) -> None:
    with pytest.raises(nr.InputError, match=r"drive of r2.top"):
        scene.at(0.0).sending({"r2.top": drive})


def test_a_world_without_a_group_of_the_light_is_told(scene: nr.Scene) -> None:
    world = scene.at(0.0)
    light = nr.render(world, "r1.front")
    alone = dataclasses.replace(world, robots={"r1": world.robots["r1"]})
    with pytest.raises(nr.InputError, match=r"knows 'r2.top', which this world does not have"):
        nr.expose(light, alone)
