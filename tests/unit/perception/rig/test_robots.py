"""Robots with two and three LEDs: their headings against the bound, and who is told to be whom."""

import math
from dataclasses import replace

import numpy as np
import pytest

from perception.rig.measure_set import measure_set
from perception.rig.pose.sights import symmetries
from perception.types import Layout, Odometry, RobotPose
from tests.unit.perception.rig.poses import (
    ALIKE,
    THREE,
    UNLIKE,
    against_bound,
    between,
    figures,
    is_at,
    sighted,
    told,
    turned,
)
from tests.unit.perception.rig.world import frame_without_pixels, rig


def test_two_leds_alike_tell_the_heading_modulo_half_a_turn() -> None:
    found = figures(ALIKE, 80, math.pi)
    ratio, _, nees = against_bound(found)
    assert found.lost == 0
    assert ratio < 1.25
    assert nees == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / (4.0 * 80)))
    assert (found.odds <= 0.5 + 1e-6).all()
    assert (found.right > 0.0).all()


@pytest.mark.verify
@pytest.mark.parametrize("layout", [UNLIKE, THREE], ids=["unlike", "three"])
def test_unlike_leds_or_three_tell_the_whole_heading(layout: Layout) -> None:
    found = figures(layout, 500)
    ratio, _, nees = against_bound(found)
    assert found.lost == 0
    assert ratio < 1.25
    assert nees == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / (4.0 * 500)))
    assert (found.right < 0.5).mean() <= 0.01
    assert (found.right > 0.0).all()


def test_two_robots_beside_each_other_are_told_apart_with_a_source_hidden() -> None:
    """Four of five flares: each robot gets its own, the heading of both is among the hypotheses."""
    pair = replace(ALIKE, kind="pair")
    cameras = {name: replace(camera, layouts=(pair, THREE)) for name, camera in rig().items()}
    rng = np.random.default_rng(3)
    for _ in range(10):
        near, far = rng.uniform(-np.pi, np.pi, 2)
        poses = [np.array([1.5, 0.2, 0.0, near]), np.array([1.6, -0.3, 0.0, far])]
        robots = told(cameras, sighted(cameras, [(pair, poses[0]), (THREE, poses[1])], rng, hidden=[(1, 2)]))
        assert len(robots) == 2
        for robot in robots:
            own = min(poses, key=lambda pose: np.linalg.norm(pose[:3] - robot.hypotheses[0].position_body_m))
            assert sum(each.odds for each in robot.hypotheses) == pytest.approx(1.0, abs=1e-4)
            assert any(is_at(each, own[3]) for each in robot.hypotheses)


def test_of_two_narrow_valleys_beside_each_other_both_are_found() -> None:
    """Near broadside, 1 m away: the true heading is 8° from another that suits, and each is 0.3° wide."""
    found = figures(UNLIKE, 97, seed=2)
    assert (found.named > 0.0).all()


def test_a_flare_without_a_range_is_of_the_robot_whose_flares_are_beside_its_ray() -> None:
    """Of three and three LEDs each robot has one that was not ranged; both are whole, and head as they do."""
    cameras = {name: replace(camera, layouts=(THREE,)) for name, camera in rig().items()}
    poses = [np.array([1.5, 0.2, 0.0, 0.4]), np.array([2.5, -0.9, 0.0, -2.0])]
    seen = sighted(cameras, [(THREE, pose) for pose in poses], np.random.default_rng(15))
    unranged = [
        [
            replace(hit, range_m=math.nan, range_sigma_m=math.nan, range_sigma_common_m=math.nan)
            if k % 3 == 1
            else hit
            for k, hit in enumerate(each)
        ]
        for each in seen
    ]
    robots = told(cameras, unranged)
    assert [len(robot.flares) for robot in robots] == [3, 3]
    for robot in robots:
        own = min(poses, key=lambda pose: np.linalg.norm(pose[:3] - robot.hypotheses[0].position_body_m))
        assert any(is_at(each, own[3]) for each in robot.hypotheses)


def test_what_looks_alike_is_reckoned_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two like LEDs, and an equilateral triangle: hypotheses are those of reckoning each naming by itself."""
    corners = [0.3 + k * 2.0 * math.pi / 3.0 for k in range(3)]
    places = tuple((0.07 * math.cos(corner), 0.07 * math.sin(corner), 0.28) for corner in corners)
    triangle = Layout("triangle", places, (1.0, 1.0, 1.0))
    assert len(symmetries(ALIKE)) == 1
    assert len(symmetries(triangle)) == 2
    assert symmetries(UNLIKE) == symmetries(THREE) == ()
    rng = np.random.default_rng(16)
    for layout in (ALIKE, triangle):
        cameras = {name: replace(camera, layouts=(layout,)) for name, camera in rig().items()}
        for _ in range(5):
            pose = np.array([2.0, 0.3, 0.0, rng.uniform(-np.pi, np.pi)])
            hits = sighted(cameras, [(layout, pose)], rng)
            (once,) = told(cameras, hits)
            with monkeypatch.context() as patch:
                patch.setattr("perception.rig.robots.symmetries", lambda _: ())
                (each,) = told(cameras, hits)

            def said(robot: RobotPose) -> list[tuple[tuple[int, ...], float, float, float]]:
                return sorted(
                    (one.sources, round(one.heading_rad % (2.0 * math.pi), 6), one.odds, one.covariance[3, 3])
                    for one in robot.hypotheses
                    if one.odds > 1e-3
                )

            assert [one[0] for one in said(once)] == [one[0] for one in said(each)]
            assert np.array([one[1:] for one in said(once)]) == pytest.approx(
                np.array([one[1:] for one in said(each)]), rel=2e-2
            )


def test_a_merged_flare_is_not_taken_at_its_word() -> None:
    """Two of three LEDs are one flare, 12 % too near: by its own σ the other two would head elsewhere."""
    cameras = {name: replace(camera, layouts=(THREE,)) for name, camera in rig().items()}
    rng = np.random.default_rng(17)
    told_robots, said = 0, 0
    for _ in range(40):
        pose = np.array([4.0, 0.3, 0.0, rng.uniform(-np.pi, np.pi)])
        hits = sighted(cameras, [(THREE, pose)], rng, hidden=[(0, 0)])
        off = [
            [
                replace(hit, merged=True, u_px=hit.u_px + 0.6, range_m=0.88 * hit.range_m, bearing_body=(math.nan,) * 3)
                if k == 1
                else hit
                for k, hit in enumerate(each)
            ]
            for each in hits
        ]  # fmt: skip
        robots = told(cameras, off)
        told_robots += len(robots)
        said += any(is_at(each, pose[3]) for robot in robots for each in robot.hypotheses)
    assert told_robots >= 36
    assert said == told_robots


def test_one_led_alone_is_no_robot() -> None:
    cameras = {name: replace(camera, layouts=(ALIKE,)) for name, camera in rig().items()}
    pose = np.array([2.0, 0.3, 0.0, 1.0])
    hits = sighted(cameras, [(ALIKE, pose)], np.random.default_rng(1), hidden=[(0, 1)])
    assert told(cameras, hits) == ()


def test_a_mast_tells_no_heading_and_is_left_alone() -> None:
    """Sources straight above each other look alike from all sides, but for one that lies beside them."""
    mast = Layout("mast", ((0.0, 0.0, 0.2), (0.0, 0.0, 0.3)), (1.0, 1.0))
    beside = Layout("beside", ((0.0, 0.0, 0.2), (0.0, 0.0, 0.3), (0.08, 0.0, 0.25)), (1.0, 1.0, 1.0))
    rng, pose = np.random.default_rng(11), np.array([1.5, 0.4, 0.0, 0.7])
    for layout, count in ((mast, 0), (beside, 1)):
        cameras = {name: replace(camera, layouts=(layout,)) for name, camera in rig().items()}
        robots = told(cameras, sighted(cameras, [(layout, pose)], rng))
        assert len(robots) == count
    assert is_at(robots[0].hypotheses[0], 0.7)


def test_an_observer_that_turns_between_its_cameras_tells_robots_at_a_seam() -> None:
    """At half a radian per second, front and left 10 ms apart: 5 mrad, a hundred times what flares are worth."""
    rate, late_s = 0.5, {"r1.left": 10e-3}
    cameras = {name: replace(camera, layouts=(THREE,)) for name, camera in rig().items()}
    rng = np.random.default_rng(12)

    def at(yaw_rad: float, time_s: float) -> Odometry:
        return Odometry("r1", time_s, np.zeros(3), turned(yaw_rad), 1e-5, 1e-5)

    records = [at(rate * (0.01 * k - 0.25), 0.01 * k) for k in range(20, 31)]
    pulls2 = []
    for _ in range(20):
        range_m, heading = rng.uniform(1.0, 3.0), rng.uniform(-np.pi, np.pi)
        bearing = 0.25 * np.pi + rng.uniform(-0.02, 0.02)
        place_m = np.array([range_m * np.cos(bearing), range_m * np.sin(bearing), 0.0])
        frames, found = [], []
        for name, camera in cameras.items():
            time_s = 0.25 + late_s.get(name, 0.0)
            yaw = rate * (time_s - 0.25)
            pose = np.append(turned(-yaw) @ place_m, heading - yaw)
            frames.append(replace(frame_without_pixels(camera), time_s=time_s - 0.5e-3))
            found += sighted({name: camera}, [(THREE, pose)], np.random.default_rng(rng.integers(2**32)))
        robots = measure_set(frames, found, cameras, odometry=records).robots
        assert [len(robot.flares) for robot in robots] == [3]
        best, yaw = robots[0].hypotheses[0], rate * (robots[0].time_s - 0.25)
        off = np.append(
            turned(-yaw) @ place_m - best.position_body_m, between(heading - yaw - best.heading_rad)
        )
        pulls2.append(float(off @ np.linalg.solve(best.covariance, off)) / 4.0)
    assert np.mean(pulls2) < 1.0 + 4.0 * math.sqrt(0.5 / len(pulls2))


def test_who_claims_no_range_is_told_no_robot() -> None:
    cameras = {name: replace(camera, layouts=(THREE,)) for name, camera in rig().items()}
    rng = np.random.default_rng(13)
    found = sighted(cameras, [(THREE, np.array([1.5, 0.4, 0.0, 0.7]))], rng)
    unclaimed = [[replace(hit, range_sigma_m=math.nan) for hit in each] for each in found]
    assert len(told(cameras, found)) == 1
    assert told(cameras, unclaimed) == ()


def test_one_camera_that_knows_the_layout_is_enough() -> None:
    cameras = dict(rig())
    last = list(cameras)[-1]
    cameras[last] = replace(cameras[last], layouts=(THREE,))
    found = sighted(cameras, [(THREE, np.array([1.5, 0.4, 0.0, 0.7]))], np.random.default_rng(14))
    assert len(told(cameras, found)) == 1
