"""Bodies that are carried: a shape as a document writes it, in a frame, becomes one in the world."""

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from nir_render.geometry import rectangle_frame
from nir_render.scene.documents.base import Orientation
from nir_render.scene.documents.shapes import (
    Box,
    Cylinder,
    Mesh,
    Rectangle,
    ShapeDocument,
    Sphere,
    by_material,
)
from nir_render.scene.motion import frame_pose
from nir_render.scene.pose import Pose, rotation_of

Array = NDArray[np.float64]
Solid = Sphere | Box | Cylinder
"""A shape that has an inside."""

BODY = ".body."
"""Part of the name, `robot.body.shape`, of a shape that a robot carries."""


def carried(shape: ShapeDocument, pose: Pose) -> ShapeDocument:
    """Return a shape that is written in a frame's axes, as it stands in the world when the frame is there."""
    match shape:
        case Rectangle():
            changed = {
                "center_m": _outer(pose, shape.center_m),
                "normal": _vector(pose.rotation @ np.array(shape.normal)),
            }
            return shape.model_copy(
                update={**_at_rest(), **changed, "rotation_rad": _rotation_rad(shape, pose)}
            )
        case Box():
            changed = {"center_m": _outer(pose, shape.center_m)}
            return shape.model_copy(
                update={**_at_rest(), **changed, "orientation": _turned(shape.orientation, pose)}
            )
        case Sphere():
            return shape.model_copy(update={**_at_rest(), "center_m": _outer(pose, shape.center_m)})
        case Cylinder():
            ends = {"start_m": _outer(pose, shape.start_m), "end_m": _outer(pose, shape.end_m)}
            return shape.model_copy(update={**_at_rest(), **ends})
        case Mesh():
            changed = {"position_m": _outer(pose, shape.position_m)}
            return shape.model_copy(
                update={**_at_rest(), **changed, "orientation": _turned(shape.orientation, pose)}
            )


def shapes_at(shapes: Mapping[str, ShapeDocument], time_s: float) -> dict[str, ShapeDocument]:
    """Return the scene's own shapes where their motions have brought them; what stands still is as it was."""
    return by_material(
        {
            name: carried(shape, frame_pose(shape, time_s)) if shape.moves else shape
            for name, shape in shapes.items()
        }
    )


def body_shapes(robot: str, body: Mapping[str, ShapeDocument], pose: Pose) -> dict[str, ShapeDocument]:
    """Return the shapes of a robot's body in the world, by `robot.body.shape`."""
    return by_material({f"{robot}{BODY}{name}": carried(shape, pose) for name, shape in body.items()})


def place_of_shape(name: str) -> str:
    """Return where a document has a shape of a snapshot: `shapes.wall`, `robots.r1.rig.body.hull`."""
    robot, _, own = name.partition(BODY)
    return f"robots.{robot}.rig.body.{own}" if own else f"shapes.{name}"


def _at_rest() -> dict[str, object]:
    return {"motion": (), "path": None}


def _outer(pose: Pose, point_m: tuple[float, float, float]) -> tuple[float, ...]:
    return _vector(pose.rotation @ np.array(point_m) + pose.position_m)


def _vector(values: NDArray[np.float64]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _turned(orientation: Orientation, pose: Pose) -> Orientation:
    from scipy.spatial.transform import Rotation

    matrix = pose.rotation @ rotation_of(orientation)
    # At a pitch of ±90° one of the other two angles is free; scipy takes 0 for it, and would warn.
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yaw, pitch, roll = (float(angle) for angle in Rotation.from_matrix(matrix).as_euler("ZYX"))
    return orientation.model_copy(update={"yaw_rad": yaw, "pitch_rad": pitch, "roll_rad": roll})


def _rotation_rad(shape: Rectangle, pose: Pose) -> float:
    """Return the rotation about its turned normal that a turned rectangle has."""
    across = pose.rotation @ rectangle_frame(shape.normal, (2.0, 2.0), shape.rotation_rad)[:, 0]
    plain = rectangle_frame(_vector(pose.rotation @ np.array(shape.normal)), (2.0, 2.0), 0.0)
    return float(np.arctan2(across @ plain[:, 1], across @ plain[:, 0]))


def bounding_sphere(body: Solid) -> tuple[Array, float]:
    """Return centre and radius of a sphere around a body."""
    match body:
        case Sphere():
            return np.array(body.center_m), body.radius_m
        case Box():
            return np.array(body.center_m), 0.5 * float(np.linalg.norm(body.size_m))
        case Cylinder():
            start_m, end_m = np.array(body.start_m), np.array(body.end_m)
            half_m = 0.5 * float(np.linalg.norm(end_m - start_m))
            return 0.5 * (start_m + end_m), math.hypot(half_m, body.radius_m)


def solid_around(shapes: Mapping[str, ShapeDocument], point_m: NDArray[np.float64]) -> str | None:
    """Return the name of a closed shape that holds a point, or None. Meshes are tested when built."""
    return next((name for name, body in solids(shapes).items() if contains(body, point_m)), None)


def solids(shapes: Mapping[str, ShapeDocument]) -> dict[str, Solid]:
    """Return the closed shapes; meshes are tested when built."""
    return {name: body for name, body in shapes.items() if isinstance(body, Sphere | Box | Cylinder)}


def contains(body: Solid, points_m: Array) -> NDArray[np.bool_]:
    """Tell which points, shape (..., 3), are in a body, shape (...)."""
    match body:
        case Sphere():
            return np.asarray(np.linalg.norm(points_m - body.center_m, axis=-1) < body.radius_m)
        case Box():
            local_m = (points_m - body.center_m) @ rotation_of(body.orientation)
            return np.asarray((np.abs(local_m) < 0.5 * np.array(body.size_m)).all(axis=-1))
        case Cylinder():
            axis = np.subtract(body.end_m, body.start_m)
            along = (points_m - body.start_m) @ axis / (axis @ axis)
            off_m = np.linalg.norm(points_m - body.start_m - along[..., None] * axis, axis=-1)
            return np.asarray((along > 0.0) & (along < 1.0) & (off_m < body.radius_m))
