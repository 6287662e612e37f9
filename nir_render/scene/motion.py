"""Motion: where what moves in a scene file, and what it carries, stands at a time, and how fast it goes.

Before its first and after its last knot everything stands still; a circle never ends.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.document import Robot
from nir_render.scene.documents.times.motion import Between, Circle, Moving, Recorded, Waypoint
from nir_render.scene.documents.times.recorded import scene_times_s, trajectory_of
from nir_render.scene.pose import Pose, rotation_of
from nir_render.scene.splines import Spline, along, spline_of

Array = NDArray[np.float64]

_HALF_STEP_S = 5e-4


@dataclass(frozen=True, eq=False)
class Velocity:
    """How a pose changes, in the world's axes: its origin in m/s, and about it in rad/s, shape (3,)."""

    linear_m_per_s: Array
    angular_rad_per_s: Array


def robot_pose(robot: Robot, time_s: float) -> Pose:
    """Return the robot's pose in the world; before its first and after its last waypoint it stands still."""
    if not robot.moves:
        return Pose(rotation_of(robot.orientation), np.array(robot.position_m))
    return frame_pose(robot, time_s)


def frame_pose(moving: Moving, time_s: float) -> Pose:
    """Return the pose of the frame that a motion or a path carries; without either, the world's own."""
    if not moving.moves:
        return Pose(np.eye(3), np.zeros(3))
    times_s = np.array([time_s])
    return Pose(frame_rotations(moving, times_s)[0], frame_positions_m(moving, times_s)[0])


def robot_velocity(robot: Robot, time_s: float) -> Velocity | None:
    """Return how fast a robot goes, by its poses 0.5 ms about the time; None where it has no motion.

    At a knot between two speeds that is the mean of both.
    """
    if not robot.moves:
        return None
    from scipy.spatial.transform import Rotation

    before, after = (robot_pose(robot, time_s + off_s) for off_s in (-_HALF_STEP_S, _HALF_STEP_S))
    turned = Rotation.from_matrix(after.rotation @ before.rotation.T).as_rotvec()
    moved_m = after.position_m - before.position_m
    return Velocity(moved_m / (2.0 * _HALF_STEP_S), np.asarray(turned) / (2.0 * _HALF_STEP_S))


def robot_positions_m(robot: Robot, times_s: Array) -> Array:
    """Return where a robot is at times, shape (n,), in the world, shape (n, 3), without its orientation."""
    if not robot.moves:
        return np.broadcast_to(np.array(robot.position_m), (len(times_s), 3))
    return frame_positions_m(robot, times_s)


def robot_rotations(robot: Robot, times_s: Array) -> Array:
    """Return how a robot is turned at times, shape (n,), in the world, shape (n, 3, 3)."""
    if not robot.moves:
        return np.broadcast_to(rotation_of(robot.orientation), (len(times_s), 3, 3))
    return frame_rotations(robot, times_s)


def camera_positions_m(robot: Robot, camera: Camera, times_s: Array) -> Array:
    """Return where a camera is at times, shape (n,), in the world, shape (n, 3)."""
    offsets_m = robot_rotations(robot, times_s) @ np.array(camera.position_m)
    return np.asarray(robot_positions_m(robot, times_s) + offsets_m)


def frame_positions_m(moving: Moving, times_s: Array) -> Array:
    """Return where the frame of what moves is at times, shape (n,), in the world, shape (n, 3)."""
    if isinstance(moving.path, Circle):
        circle = moving.path
        angle_rad = _angles_rad(circle, times_s)
        around = np.stack([np.cos(angle_rad), np.sin(angle_rad), np.zeros_like(angle_rad)], axis=-1)
        return np.asarray(circle.center_m + circle.radius_m * around)
    knots = _knots_of(moving)
    if knots.splines:
        return _by_spline(knots.splines, times_s, lambda spline, at_s: spline.positions_m(at_s))
    return np.stack(
        [np.interp(times_s, knots.times_s, knots.positions_m[:, axis]) for axis in range(3)], axis=-1
    )


def frame_rotations(moving: Moving, times_s: Array) -> Array:
    """Return how the frame of what moves is turned at times, shape (n,), in the world, shape (n, 3, 3)."""
    from scipy.spatial.transform import Rotation, Slerp

    if isinstance(moving.path, Circle):
        circle = moving.path
        own = rotation_of(circle.orientation)
        if circle.heading == "fixed":
            return np.broadcast_to(own, (len(times_s), 3, 3))
        quarter_rad = 0.5 * np.pi if circle.turn == "left" else -0.5 * np.pi
        yaw = Rotation.from_euler("Z", (_angles_rad(circle, times_s) + quarter_rad)[:, None])
        return np.asarray(yaw.as_matrix() @ own)
    knots = _knots_of(moving)
    if len(knots.times_s) == 1:
        return np.broadcast_to(knots.rotations[0], (len(times_s), 3, 3))
    if knots.splines:
        return _by_spline(knots.splines, times_s, lambda spline, at_s: spline.rotations(at_s))
    now_s = np.clip(times_s, knots.times_s[0], knots.times_s[-1])
    return np.asarray(Slerp(knots.times_s, Rotation.from_matrix(knots.rotations))(now_s).as_matrix())


def _by_spline(splines: tuple[Spline, ...], times_s: Array, value: Callable[[Spline, Array], Array]) -> Array:
    """Return what splines say at times, each of the part of them that is its own."""
    which = along(splines, times_s)
    parts = {int(number): value(splines[number], times_s[which == number]) for number in np.unique(which)}
    shape = next(iter(parts.values())).shape[1:] if parts else ()
    found = np.empty((len(times_s), *shape))
    for number, values in parts.items():
        found[which == number] = values
    return found


def _angles_rad(circle: Circle, times_s: Array) -> Array:
    side = 1.0 if circle.turn == "left" else -1.0
    return np.asarray(circle.phase_rad + side * 2.0 * np.pi * times_s / circle.period_s)


@dataclass(frozen=True, eq=False)
class _Knots:
    """What is interpolated: times, shape (n,), positions, (n, 3), rotations, (n, 3, 3); splines if smooth."""

    times_s: Array
    positions_m: Array
    rotations: Array
    splines: tuple[Spline, ...]


def _knots_of(moving: Moving) -> _Knots:
    if isinstance(moving.path, Recorded):
        rows = trajectory_of(moving.path.file)
        return _knots_of_rows(moving.path, rows.tobytes())
    return _knots_of_ways(moving.motion, moving.between)


@lru_cache(maxsize=256)
def _knots_of_rows(path: Recorded, data: bytes) -> _Knots:
    from scipy.spatial.transform import Rotation

    rows = np.frombuffer(data).reshape(-1, 8)
    times_s, positions_m = scene_times_s(rows[:, 0], path.delay_s, path.start_s), rows[:, 1:4]
    rotations = np.asarray(Rotation.from_quat(rows[:, 4:]).as_matrix())
    smooth = path.between == "smooth" and len(rows) > 1
    splines = (spline_of(times_s, positions_m, rotations, rests=False),) if smooth else ()
    return _Knots(times_s, positions_m, rotations, splines)


@lru_cache(maxsize=256)
def _knots_of_ways(ways: tuple[Waypoint, ...], between: Between | None) -> _Knots:
    """Return the knots of waypoints: one is two where it holds, its arrival and the end; times increase."""
    stops: list[tuple[float, Waypoint]] = [(way.time_s, way) for way in ways]
    stops += [(way.time_s + way.hold_s, way) for way in ways if way.hold_s > 0.0]
    stops.sort(key=lambda stop: stop[0])
    times_s = np.array([time_s for time_s, _ in stops])
    positions_m = np.array([way.position_m for _, way in stops])
    rotations = np.array([rotation_of(way.orientation) for _, way in stops])
    if between != "smooth" or len(stops) == 1:
        return _Knots(times_s, positions_m, rotations, ())
    holds = [index for index in range(len(stops) - 1) if stops[index][1] is stops[index + 1][1]]
    ends = [*holds, len(stops) - 1]
    starts = [0, *(index + 1 for index in holds)]
    parts = [slice(start, end + 1) for start, end in zip(starts, ends, strict=True)]
    splines = tuple(
        spline_of(times_s[part], positions_m[part], rotations[part], rests=True) for part in parts
    )
    return _Knots(times_s, positions_m, rotations, splines)
