"""What a robot knows of its own motion: the true one, seen from where it began, with its rig's errors."""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.randomness import generator
from nir_render.scene.documents.camera import OdometryErrors
from nir_render.scene.motion import robot_pose
from nir_render.scene.scene import Scene
from perception.types import Odometry


def observers_astir(scene: Scene) -> list[str]:
    """Return the robots that take frames and have odometry: those that move, or may believe they do."""
    names = dict.fromkeys(name.partition(".")[0] for name in scene.cameras())
    robots = scene.document.robots
    return [name for name in names if robots[name].motion or robots[name].rig.odometry is not None]


def pose_records(scene: Scene) -> Iterator[dict[str, Any]]:
    """Yield the lines of `poses.jsonl`: where each robot is at each time of the clock, in the world."""
    from scipy.spatial.transform import Rotation

    for time_s in scene.document.frame_times_s():
        for name, robot in scene.document.robots.items():
            pose = robot_pose(robot, time_s)
            yield {
                "format": 1,
                "robot": name,
                "time_s": time_s,
                "position_m": pose.position_m.tolist(),
                "quaternion_xyzw": Rotation.from_matrix(pose.rotation).as_quat(canonical=True).tolist(),
            }


def odometry_of(scene: Scene, robot: str, seed: int | None = None) -> Iterator[Odometry]:
    """Yield what a robot believes of its pose at each time of the clock, and once after the last.

    The frame is that of its own body at the first time, axes and all. Each step is the true one and a step of
    a random walk, position in the frame's axes and rotation about the body's; each record has its own noise
    on top, keyed by (seed, robot, record).
    """
    from scipy.spatial.transform import Rotation

    run_seed = scene.document.seed if seed is None else seed
    errors = scene.document.robots[robot].rig.odometry or OdometryErrors()
    times_s = scene.document.frame_times_s()
    times_s = [*times_s, times_s[-1] + 1.0 / scene.document.clock.frame_rate_hz]
    first = robot_pose(scene.document.robots[robot], times_s[0])
    astray_m, astray = np.zeros(3), np.eye(3)
    before_s = times_s[0]
    for record, time_s in enumerate(times_s):
        pose = robot_pose(scene.document.robots[robot], time_s)
        draws = generator(run_seed, "odometry", robot, record).standard_normal((4, 3))
        root_s = math.sqrt(time_s - before_s)
        before_s = time_s
        astray_m = astray_m + errors.position_walk_m * root_s * draws[0]
        astray = astray @ Rotation.from_rotvec(errors.rotation_walk_rad * root_s * draws[1]).as_matrix()
        noise = Rotation.from_rotvec(errors.rotation_noise_rad * draws[3]).as_matrix()
        yield Odometry(
            robot=robot,
            time_s=time_s,
            position_m=first.rotation.T @ (pose.position_m - first.position_m)
            + astray_m
            + errors.position_noise_m * draws[2],
            rotation=_rotation(first.rotation.T @ pose.rotation @ astray @ noise),
            position_sigma_m=errors.position_noise_m,
            rotation_sigma_rad=errors.rotation_noise_rad,
            position_walk_m_per_sqrt_s=errors.position_walk_m,
            rotation_walk_rad_per_sqrt_s=errors.rotation_walk_rad,
        )


def _rotation(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a product of rotations without the rounding that piles up."""
    u, _, v = np.linalg.svd(matrix)
    return np.asarray(u @ v)
