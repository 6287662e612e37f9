"""Bodies that are carried: a shape as a document writes it, in a frame, becomes one in the world."""

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
