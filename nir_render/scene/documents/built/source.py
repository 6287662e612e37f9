"""Models of a source as it is built: dies on a board, under a cover that spreads their light."""

import math
from typing import Annotated, ClassVar, Self

from pydantic import Field, field_validator, model_validator

from nir_render.scene.documents.base import (
    Angle,
    Direction,
    Document,
    Fraction,
    Length,
    NotNegative,
    Position,
    Positive,
    Power,
    usable_direction,
)
from nir_render.scene.documents.built.cover import Cover, Share
from nir_render.scene.documents.emitters import PatternDocument
from nir_render.scene.documents.files import PresetDocument
from nir_render.scene.documents.spectral.led import SpectrumDocument

_NARROWEST_RAD = math.radians(0.1)


class Die(Document):
    """A flat round die that sends `share` of the flux (of any scale, beside the others') along `direction`.

    Its lobe is cos^n of the polar angle, half as strong at `half_angle` as on the axis (60 deg: Lambertian);
    or a `pattern` of points, the same all around. The board is z = 0, the cover's axis is z. The die's body
    hides nothing.
    """

    example: ClassVar[str] = '{position: "[0, 0, 0] mm", half_angle: 60 deg}'

    position_m: Position = (0.0, 0.0, 0.0)
    direction: Direction = (0.0, 0.0, 1.0)
    radius_m: Annotated[Length, NotNegative] = 0.0
    share: Annotated[Fraction, Positive] = 1.0
    half_angle_rad: Annotated[Angle, Field(ge=_NARROWEST_RAD, lt=0.5 * math.pi)] | None = None
    pattern: PatternDocument | None = None

    _direction = field_validator("direction")(usable_direction)

    @model_validator(mode="after")
    def _one_lobe(self) -> Self:
        if (self.half_angle_rad is None) == (self.pattern is None):
            raise ValueError("wanted 'half_angle' or 'pattern', one of both; set the other to null")
        if self.pattern is not None and self.pattern.points is None:
            raise ValueError("pattern: a die's lobe is the same all around; wanted 'points'")
        if self.position_m[2] < 0.0:
            raise ValueError("position: is below the board, which is z = 0; wanted z of 0 or more")
        return self

    @property
    def round_the_axis(self) -> bool:
        """Whether it sends its light the same all around the cover's axis."""
        return self.position_m[:2] == (0.0, 0.0) == self.direction[:2]


class Board(Document):
    """A flat disc at z = 0 that reflects the share `reflectance` evenly, from both sides."""

    example: ClassVar[str] = "{radius: 12 mm, reflectance: 0.5}"

    radius_m: Annotated[Length, Positive]
    reflectance: Share


class BuiltSource(PresetDocument):
    """A source as it is built. `flux` is what its dies send together, `spectrum` that of all of them.

    Without a `board` and a `cover` there are only dies.
    """

    preset_folder: ClassVar[str] = "built"

    flux_w: Annotated[Power, Positive]
    spectrum: SpectrumDocument
    dies: Annotated[tuple[Die, ...], Field(min_length=1, max_length=256)]
    board: Board | None = None
    cover: Cover | None = None

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        cover = self.cover
        if cover is None:
            return self
        if self.board is None or self.board.radius_m < cover.neck_m:
            raise ValueError(
                f"board: wanted one that closes the cover, of {cover.neck_m * 1e3:.4g} mm or more in radius"
            )
        for number, die in enumerate(self.dies):
            x, y, z = die.position_m
            reach_m = math.hypot(math.hypot(x, y) + die.radius_m, z - cover.height_m)
            if reach_m >= cover.radius_m:
                raise ValueError(f"dies.{number}: is not inside the cover; move it, or raise the radius")
        return self

    @property
    def round_the_axis(self) -> bool:
        """Whether it shines the same all around its axis."""
        return all(die.round_the_axis for die in self.dies)

    @property
    def origin_m(self) -> float:
        """The height of its middle above the board, from which directions count: the centre of its cover."""
        return 0.0 if self.cover is None else self.cover.height_m

    @property
    def radius_m(self) -> float:
        """The radius of the sphere that stands for it in a scene: its cover, or what its dies reach."""
        if self.cover is not None:
            return self.cover.radius_m
        return max(math.dist(die.position_m, (0.0, 0.0, 0.0)) + die.radius_m for die in self.dies)
