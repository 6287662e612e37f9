"""Models of the bodies that stand in a scene."""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

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
from nir_render.scene.documents.files import ReadOnceDocument, resolve_file
from nir_render.scene.documents.times.motion import Moving
from nir_render.scene.meshes.mesh import MeshPart
from nir_render.scene.meshes.read import SUFFIXES, read_mesh

_FARTHEST_M = 10_000.0


class _Shape(ReadOnceDocument, Moving):
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
    """A mesh from a PLY, OBJ, STL or glTF file, or the shapes of a Mitsuba scene, in metres once scaled.

    Slots, the names of materials in the file, may have `materials` of their own; `material` is that of all
    others. `up` is the file's axis that stands upright: y for glTF, z for all others where not said.
    Flat triangles stay flat; where the file has normals the surface is shaded as they say.
    """

    example: ClassVar[str] = "{type: mesh, file: body.ply, material: black}"

    type: Literal["mesh"]
    file: str
    scale: Annotated[float, Field(gt=0, le=1e6)] = 1.0
    up: Literal["y", "z"] | None = None
    position_m: Position = (0.0, 0.0, 0.0)
    orientation: Orientation = Orientation()
    materials: dict[str, str] | None = None
    slot: str | None = None

    @field_validator("file")
    @classmethod
    def _find(cls, name: str, info: ValidationInfo) -> str:
        if not name.lower().endswith(SUFFIXES):
            raise ValueError(
                f"{shown(name)} is none of {', '.join(SUFFIXES)}; export the mesh as one of these"
            )
        return str(resolve_file(name, info))

    @model_validator(mode="after")
    def _look_inside(self) -> Self:
        parts = read_mesh(self.file, self.up)
        slots = [part.slot for part in parts]
        for key, named in (
            ("materials", [*(self.materials or {})]),
            ("slot", [self.slot] * (self.slot is not None)),
        ):
            for name in named:
                if name not in slots:
                    known = ", ".join(map(repr, filter(None, slots))) or "none"
                    raise ValueError(f"{key}: {self.file} has no slot {shown(name)}; known: {known}")
        extent_m = self.scale * max(float(np.abs(part.vertices).max()) for part in parts)
        if extent_m > _FARTHEST_M:
            raise ValueError(
                f"{self.file}: reaches {extent_m:.3g} m from its origin; files are in metres: write "
                "'scale: 0.001' for one in millimetres"
            )
        return self

    def parts(self) -> tuple[MeshPart, ...]:
        """Return what it is of the file: one slot, or all.

        Raises
        ------
        ValueError
            The file has changed since the scene was loaded, and cannot be read.
        """
        parts = read_mesh(self.file, self.up)
        return parts if self.slot is None else tuple(part for part in parts if part.slot == self.slot)


ShapeDocument = Annotated[
    Rectangle | Box | Sphere | Cylinder | Mesh,
    Field(discriminator="type"),
    typed(
        Rectangle.example,
        Rectangle, Box, Sphere, Cylinder, Mesh,
    ),
]  # fmt: skip


def by_material(shapes: Mapping[str, ShapeDocument]) -> dict[str, ShapeDocument]:
    """Return shapes of one material each, by name: of a mesh with `materials`, one for each slot."""
    found: dict[str, ShapeDocument] = {}
    for name, shape in shapes.items():
        if not isinstance(shape, Mesh) or not shape.materials:
            found[name] = shape
            continue
        if shape.slot is not None:
            of_slot = shape.materials.get(shape.slot, shape.material)
            found[name] = shape.model_copy(update={"material": of_slot, "materials": None})
            continue
        for part in shape.parts():
            own = {
                "slot": part.slot,
                "material": shape.materials.get(part.slot, shape.material),
                "materials": None,
            }
            found[f"{name}.{part.slot}" if part.slot else name] = shape.model_copy(update=own)
    return found
