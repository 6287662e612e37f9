"""Where robots are at each frame, and where they take themselves to be: dead reckoning with its errors."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from nir_render.randomness import generator
from nir_render.scene.documents.times.clocks import OdometryNoise
from nir_render.scene.motion import robot_pose, robot_velocity
from nir_render.scene.pose import Pose
from nir_render.scene.scene import Scene
from nir_render.simulation.frame_times import frame_span_s
from nir_render.truth.poses import PoseTruth
from perception.types import Odometry

Array = NDArray[np.float64]

_SLACK = 1e-6  # of a period, by which a frame on the scene's clock may seem off it


def odometry_by_robot(scene: Scene) -> dict[str, list[Odometry]]:
    """Return what robots that take frames know of their own way: those that move, or may believe they do."""
    names = dict.fromkeys(name.partition(".")[0] for name in scene.cameras())
    robots, seed = scene.document.robots, scene.document.seed
    return {
        name: odometry_of(scene, name, seed)
        for name in names
        if robots[name].moves or robots[name].rig.odometry is not None
    }


def pose_times_s(scene: Scene) -> Array:
    """Return when poses are told of: at each frame of the scene's clock, and one period after the last.

    Where a camera's own clock takes frames before or after that, it goes on at this pace until it is past
    them: who moves must be known wherever it looks.
    """
    clock = scene.document.clock
    planned_s = np.array(scene.document.frame_times_s())
    earliest, latest = 0, clock.frames
    for name in scene.cameras():
        first_s, last_s = frame_span_s(scene.camera(name)[1].clock, planned_s)
        earliest = min(earliest, math.floor((first_s - clock.start_s) * clock.frame_rate_hz + _SLACK))
        latest = max(latest, math.ceil((last_s - clock.start_s) * clock.frame_rate_hz + 1.0 - _SLACK))
    before, after = np.arange(earliest, 0), np.arange(clock.frames + 1, latest + 1)
    beyond_s = planned_s[-1] + 1.0 / clock.frame_rate_hz
    return np.concatenate([
        clock.start_s + before / clock.frame_rate_hz, planned_s, [beyond_s],
        clock.start_s + after / clock.frame_rate_hz,
    ])  # fmt: skip


def true_poses(scene: Scene) -> Iterator[PoseTruth]:
    """Yield the true pose and velocity of every robot in the world, by time: lines of `poses.jsonl`."""
    from scipy.spatial.transform import Rotation

    for time_s in pose_times_s(scene):
        for name, robot in scene.document.robots.items():
            pose, velocity = robot_pose(robot, float(time_s)), robot_velocity(robot, float(time_s))
            still = np.zeros(3)
            quaternion = Rotation.from_matrix(pose.rotation).as_quat(canonical=True)
            yield PoseTruth(
                name,
                float(time_s),
                tuple(pose.position_m.tolist()),
                tuple(quaternion.tolist()),
                tuple((still if velocity is None else velocity.linear_m_per_s).tolist()),
                tuple((still if velocity is None else velocity.angular_rad_per_s).tolist()),
            )


class DeadReckoning:
    """What a robot knows of its own way, record by record, in a frame that is its body's axes at the first.

    Each step is the true one, in the axes that the robot takes itself to have, and a normal error of the walk
    times the root of its time on top, per axis: a heading that is off bends what follows. Errors of each
    record by itself are laid over it and do not add up. All are in body axes, keyed by seed, robot and step.
    """

    def __init__(self, robot: str, noise: OdometryNoise, seed: int) -> None:
        self._robot, self._noise, self._seed = robot, noise, seed
        self._position_m, self._rotation = np.zeros(3), np.eye(3)
        self._before: tuple[float, Pose] | None = None
        self._index = 0

    def record(self, time_s: float, pose: Pose) -> Odometry:
        """Return the next record, of a robot that is truly at a pose."""
        from scipy.spatial.transform import Rotation

        noise = self._noise
        random = generator(self._seed, "odometry", self._robot, self._index)
        walked, turned, shaken, tilted = random.standard_normal((4, 3))
        if self._before is not None:
            before_s, before = self._before
            root_s = float(np.sqrt(time_s - before_s))
            step_m = before.rotation.T @ (pose.position_m - before.position_m)
            position_m = self._position_m
            self._position_m = position_m + self._rotation @ (
                step_m + noise.position_walk_m * root_s * walked
            )
            turn = Rotation.from_rotvec(noise.rotation_walk_rad * root_s * turned).as_matrix()
            self._rotation = self._rotation @ before.rotation.T @ pose.rotation @ turn
        self._before, self._index = (time_s, pose), self._index + 1
        tilt = Rotation.from_rotvec(noise.rotation_noise_rad * tilted).as_matrix()
        return Odometry(
            robot=self._robot,
            time_s=time_s,
            position_m=self._position_m + self._rotation @ (noise.position_noise_m * shaken),
            rotation=self._rotation @ tilt,
            position_sigma_m=noise.position_noise_m,
            rotation_sigma_rad=noise.rotation_noise_rad,
            position_walk_m_per_sqrt_s=noise.position_walk_m,
            rotation_walk_rad_per_sqrt_s=noise.rotation_walk_rad,
        )


def odometry_of(scene: Scene, robot: str, seed: int) -> list[Odometry]:
    """Return what a robot knows of its own way, at the times of poses (`DeadReckoning`)."""
    known = scene.document.robots[robot]
    reckoned = DeadReckoning(robot, known.rig.odometry or OdometryNoise(), seed)
    return [
        reckoned.record(float(time_s), robot_pose(known, float(time_s))) for time_s in pose_times_s(scene)
    ]
