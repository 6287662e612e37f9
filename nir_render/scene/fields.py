"""Small pieces that models of several rooms share: names, bounds, an orientation."""

from typing import Annotated, ClassVar

from pydantic import Field

from nir_render.scene.base import Document
from nir_render.scene.units import Angle

Positive = Field(gt=0)
NotNegative = Field(ge=0)
# Names become parts of dotted paths and of file names.
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_-]*$")]


class Orientation(Document):
    """A rotation by yaw about z (to the left), then pitch about the new y (nose down), then roll about x."""

    example: ClassVar[str] = "{yaw: 90 deg}"

    yaw_rad: Angle = 0.0
    pitch_rad: Angle = 0.0
    roll_rad: Angle = 0.0
