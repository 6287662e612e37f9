"""Robots with two and three LEDs in a simulator of its own: numpy alone, bounds by numerical derivatives."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from perception.rig.measure_set import measure_set
from perception.types import Calibration, Detection, Layout, Odometry, PoseHypothesis, RobotPose
from tests.unit.perception.rig.world import detection, frame_without_pixels, rig, seen_by

Array = NDArray[np.float64]

PX, RELATIVE, COMMON = 0.02, 0.005, 0.001
"""Of each detection: pixels, range by itself, range by K (whose σ is 0.2 % in this rig)."""

ALIKE = Layout("pair", ((0.06, 0.0, 0.28), (-0.06, 0.0, 0.28)), (1.0, 1.0))
UNLIKE = replace(ALIKE, relative_flux=(1.0, 0.5))
THREE = Layout("three", ((0.06, 0.0, 0.28), (-0.06, 0.0, 0.28), (0.02, 0.04, 0.28)), (1.0, 1.0, 1.0))


def turned(heading_rad: float) -> Array:
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def between(angle_rad: float, turn: float = 2.0 * math.pi) -> float:
    """Return an angle modulo a turn, around 0."""
    return (angle_rad + 0.5 * turn) % turn - 0.5 * turn


def bound_rad(cameras: dict[str, Calibration], layout: Layout, pose: Array) -> float:
    """Return the least σ of a heading: Fisher's information of x, y, z, heading and K's error, by differences."""

    def seen(unknown: Array) -> Array:
        told = []
        for camera in cameras.values():
            for place in layout.places_body_m:
                hit = seen_by(camera, unknown[:3] + turned(unknown[3]) @ np.array(place), -1.0)
                was = seen_by(camera, pose[:3] + turned(pose[3]) @ np.array(place))
                if hit is not None and was is not None:
                    logarithm = (math.log(hit[2]) + COMMON * unknown[4]) / RELATIVE
                    told += [hit[0] / PX, hit[1] / PX, logarithm]
        return np.array(told)

    at, step = np.append(pose, 0.0), 1e-5
    slopes = np.column_stack(
        [(seen(at + step * axis) - seen(at - step * axis)) / (2.0 * step) for axis in np.eye(5)]
    )
    information = slopes.T @ slopes
    information[4, 4] += 1.0
    return math.sqrt(np.linalg.inv(information)[3, 3])


def sighted(
    cameras: dict[str, Calibration],
    robots: Sequence[tuple[Layout, Array]],
    rng: np.random.Generator,
    hidden: Sequence[tuple[int, int]] = (),
) -> list[list[Detection]]:
    """Return what each camera says of robots at poses x, y, z, heading; without the hidden (robot, source)."""
    errors = rng.normal(size=len(robots))
    return [
        [
            hit
            for k, (layout, pose) in enumerate(robots)
            for n, place in enumerate(layout.places_body_m)
            if (k, n) not in hidden
            for hit in (
                detection(
                    camera, pose[:3] + turned(pose[3]) @ np.array(place), rng, px=PX, relative=RELATIVE,
                    common=COMMON, common_error=errors[k], factor=layout.relative_flux[n] ** -0.5,
                ),
            )
            if hit is not None
        ]
        for camera in cameras.values()
    ]  # fmt: skip


def told(cameras: dict[str, Calibration], detections: Sequence[Sequence[Detection]]) -> tuple[RobotPose, ...]:
    frames = [frame_without_pixels(camera) for camera in cameras.values()]
    return measure_set(frames, detections, cameras).robots


@dataclass
class Figures:
    """Of one robot in many poses: error of the best hypothesis' heading (rad, modulo symmetry), its σ, bound.

    `right` tells how probable the stack held the hypothesis nearest to truth; `odds` that of the best.
    """

    error: Array
    sigma: Array
    bound: Array
    right: Array
    odds: Array
    pulls2: Array
    lost: int


def figures(layout: Layout, poses: int, turn: float = 2.0 * math.pi, seed: int = 5) -> Figures:
    cameras = {name: replace(camera, layouts=(layout,)) for name, camera in rig().items()}
    rng = np.random.default_rng(seed)
    rows, lost = [], 0
    for _ in range(poses):
        range_m, bearing, heading = rng.uniform(1, 5), rng.uniform(-np.pi, np.pi), rng.uniform(-np.pi, np.pi)
        pose = np.array(
            [range_m * np.cos(bearing), range_m * np.sin(bearing), rng.uniform(-0.1, 0.1), heading]
        )
        robots = told(cameras, sighted(cameras, [(layout, pose)], rng))
        if len(robots) != 1 or len(robots[0].flares) != len(layout.places_body_m):
            lost += 1
            continue
        best = robots[0].hypotheses[0]
        off = np.array(
            [*(np.array(best.position_body_m) - pose[:3]), between(best.heading_rad - heading, turn)]
        )
        pull2 = float(off @ np.linalg.solve(best.covariance, off))
        right = sum(each.odds for each in robots[0].hypotheses if is_at(each, heading))
        rows.append((
            off[3], math.sqrt(best.covariance[3, 3]), bound_rad(cameras, layout, pose), right, best.odds, pull2,
        ))  # fmt: skip
    error, sigma, bound, right, odds, pulls2 = np.array(rows).T
    return Figures(error, sigma, bound, right, odds, pulls2, lost)


def is_at(hypothesis: PoseHypothesis, heading_rad: float) -> bool:
    """Return whether a hypothesis is that of the true heading: within 5 σ of it."""
    off = between(hypothesis.heading_rad - heading_rad)
    return abs(off) < 5.0 * math.sqrt(hypothesis.covariance[3, 3])


def against_bound(found: Figures) -> tuple[float, float, float]:
    """Return RMSE over the bound where that is at most 10°, coverage of 95 % elsewhere, mean NEES per dimension."""
    close = found.bound <= math.radians(10.0)
    ratio = math.sqrt(float(np.mean((found.error[close] / found.bound[close]) ** 2)))
    within = np.abs(found.error[~close]) < 1.96 * found.sigma[~close]
    return ratio, float(within.mean()) if within.size else math.nan, float(found.pulls2.mean()) / 4.0


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
