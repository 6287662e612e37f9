"""Models of the bodies that stand in a scene."""

from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, Field, ValidationInfo, field_validator

from nir_render.errors import shown
from nir_render.scene.documents.base import (
    Angle,
    Direction,
    Length,
    Orientation,
    Position,
    Positive,
    Size2,
    Size3,
    positive_extents,
    typed,
    usable_direction,
)
from nir_render.scene.documents.files import resolve_file
from nir_render.scene.documents.times.motion import Moving


class _Shape(Moving):
    """What all shapes have: the name of a material of the scene, or of a preset; and how they move.

    What moves is written as it is in a frame that a motion carries: the hinge of a door, the feet of one who
    walks. Robots' bodies move with their robots.
    """

    material: str


class Rectangle(_Shape):
    """A flat rectangle that faces along `normal`; both sides are of its material.

    `size` is width × height: width runs horizontally (along world x where the normal is vertical), turned
    about the normal by `rotation`.
    """

    example: ClassVar[str] = '{type: rectangle, center: "[3, 0, 0] m", size: "[2, 2] m", material: black}'

    type: Literal["rectangle"]
    center_m: Position
    size_m: Annotated[Size2, AfterValidator(positive_extents)]
    normal: Direction = (0.0, 0.0, 1.0)
    rotation_rad: Angle = 0.0

    _direction = field_validator("normal")(usable_direction)


class Box(_Shape):
    """A closed box; `size` is its extent along its own x, y and z."""

    example: ClassVar[str] = '{type: box, center: "[3, 0, 0] m", size: "[1, 1, 1] m", material: black}'

    type: Literal["box"]
    center_m: Position
    size_m: Annotated[Size3, AfterValidator(positive_extents)]
    orientation: Orientation = Orientation()


class Sphere(_Shape):
    """A closed sphere."""

    example: ClassVar[str] = '{type: sphere, center: "[1, 0, 0] m", radius: 0.1 m, material: black}'

    type: Literal["sphere"]
    center_m: Position
    radius_m: Annotated[Length, Positive]


class Cylinder(_Shape):
    """A closed cylinder between the centres of its two ends."""

    example: ClassVar[str] = (
        '{type: cylinder, start: "[1, 0, 0] m", end: "[1, 0, 1] m", radius: 0.1 m, material: black}'
    )

    type: Literal["cylinder"]
    start_m: Position
    end_m: Position
    radius_m: Annotated[Length, Positive]


class Mesh(_Shape):
    """A triangle mesh from a PLY or OBJ file in metres, scaled, turned and moved."""

    example: ClassVar[str] = "{type: mesh, file: body.ply, material: black}"

    type: Literal["mesh"]
    file: str
    scale: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    position_m: Position = (0.0, 0.0, 0.0)
    orientation: Orientation = Orientation()

    @field_validator("file")
    @classmethod
    def _find(cls, name: str, info: ValidationInfo) -> str:
        if not name.lower().endswith((".ply", ".obj")):
            raise ValueError(f"{shown(name)} is neither a .ply nor an .obj file; write the name of one")
        return str(resolve_file(name, info))


ShapeDocument = Annotated[
    Rectangle | Box | Sphere | Cylinder | Mesh,
    Field(discriminator="type"),
    typed(
        Rectangle.example,
        Rectangle, Box, Sphere, Cylinder, Mesh,
    ),
]  # fmt: skip
