"""Motion: where the robots of a scene file, and what they carry, stand at a time."""

import numpy as np
from numpy.typing import NDArray

from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.document import Robot, Waypoint
from nir_render.scene.pose import Pose, rotation_of


def robot_pose(robot: Robot, time_s: float) -> Pose:
    """Return the robot's pose in the world; before its first and after its last waypoint it stands still."""
    if not robot.motion:
        return Pose(rotation_of(robot.orientation), np.array(robot.position_m))
    from scipy.spatial.transform import Rotation, Slerp

    stops = _stops(robot)
    times_s = np.array([time for time, _ in stops])
    now_s = float(np.clip(time_s, times_s[0], times_s[-1]))
    positions_m = np.array([way.position_m for _, way in stops])
    position_m = np.array([np.interp(now_s, times_s, positions_m[:, axis]) for axis in range(3)])
    rotations = [rotation_of(way.orientation) for _, way in stops]
    if len(rotations) == 1:
        return Pose(rotations[0], position_m)
    return Pose(Slerp(times_s, Rotation.from_matrix(np.array(rotations)))(now_s).as_matrix(), position_m)


def _stops(robot: Robot) -> list[tuple[float, Waypoint]]:
    """Return the knots of a motion: a waypoint is two, its arrival and the end of its hold; they increase."""
    stops = [(way.time_s, way) for way in robot.motion]
    stops += [(way.time_s + way.hold_s, way) for way in robot.motion if way.hold_s > 0.0]
    return sorted(stops, key=lambda stop: stop[0])


def robot_positions_m(robot: Robot, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where a robot is at times, shape (n,), in the world, shape (n, 3), without its orientation."""
    if not robot.motion:
        return np.broadcast_to(np.array(robot.position_m), (len(times_s), 3))
    knots_s, ways = zip(*_stops(robot), strict=True)
    knots_m = np.array([way.position_m for way in ways])
    return np.stack([np.interp(times_s, knots_s, knots_m[:, axis]) for axis in range(3)], axis=-1)


def camera_positions_m(robot: Robot, camera: Camera, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return where a camera is at times, shape (n,), in the world, shape (n, 3)."""
    from scipy.spatial.transform import Rotation, Slerp

    ground_m = robot_positions_m(robot, times_s)
    if not robot.motion:
        return ground_m + rotation_of(robot.orientation) @ camera.position_m
    knots_s, ways = zip(*_stops(robot), strict=True)
    turns = Rotation.from_matrix(np.array([rotation_of(way.orientation) for way in ways]))
    if len(turns) > 1:
        turns = Slerp(knots_s, turns)(np.clip(times_s, knots_s[0], knots_s[-1]))
    return np.asarray(ground_m + turns.apply(camera.position_m))
