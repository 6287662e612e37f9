"""Models of a cover that spreads light: its shape, and what it is made of."""

import math
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Field, model_validator

from nir_render.scene.documents.base import Document, Fraction, Length, NotNegative, Positive, typed

Share = Annotated[Fraction, Field(ge=0, le=1)]
_MOST_SCATTERINGS = 300.0  # of a photon straight through a wall: more take hours, and no light comes out


class Translucent(Document):
    """A solid of refractive index `index`, with GGX-rough faces, in which light scatters and is absorbed.

    `scattering_length` is the mean way between scatterings (null: clear), of which each takes the share
    1 − `albedo`, and `g` the mean cosine of their angle (Henyey and Greenstein).
    """

    example: ClassVar[str] = "{type: translucent, index: 1.49, scattering_length: 0.2 mm, g: 0.5}"

    type: Literal["translucent"]
    index: Annotated[float, Field(ge=1, le=4)]
    roughness: Annotated[Fraction, Field(ge=0, le=1)] = 0.0
    scattering_length_m: Annotated[Length, Positive] | None = None
    albedo: Annotated[Fraction, Field(gt=0, le=1)] = 1.0
    g: Annotated[Fraction, Field(gt=-1, lt=1)] = 0.0


class DiffuseSheet(Document):
    """A thin sheet that sends on the share `transmittance` and sends back `reflectance`, both evenly."""

    example: ClassVar[str] = "{type: diffuse_sheet, transmittance: 0.5, reflectance: 0.4}"

    type: Literal["diffuse_sheet"]
    transmittance: Share
    reflectance: Share

    @model_validator(mode="after")
    def _no_more_than_there_is(self) -> Self:
        if self.transmittance + self.reflectance > 1.0 + 1e-12:
            raise ValueError("transmittance + reflectance is more than 1; the rest to 1 is absorbed")
        return self


CoverMaterial = Annotated[
    Translucent | DiffuseSheet,
    Field(discriminator="type"),
    typed(Translucent.example, Translucent, DiffuseSheet),
]


class Cover(Document):
    """What of a spherical shell is above the board; `height` is that of the sphere's centre.

    0 is a hemisphere, more a globe on a neck, less a flat dome. `radius` is the outer one; a `thickness` of
    the whole radius is a solid in which the dies are cast. A `diffuse_sheet` has none.
    """

    example: ClassVar[str] = (
        "{radius: 10 mm, thickness: 1 mm, height: 8 mm, material: {type: translucent, index: 1.49, "
        "scattering_length: 0.2 mm}}"
    )

    radius_m: Annotated[Length, Positive]
    thickness_m: Annotated[Length, NotNegative] = 0.0
    height_m: Length = 0.0
    material: CoverMaterial

    @model_validator(mode="after")
    def _is_a_shell_on_the_board(self) -> Self:
        if (self.thickness_m == 0.0) != isinstance(self.material, DiffuseSheet):
            raise ValueError("thickness: wanted above 0 of a translucent cover, and none of a diffuse_sheet")
        if self.thickness_m > self.radius_m:
            raise ValueError("thickness: is more than the radius")
        if not -self.radius_m < self.height_m < self.radius_m:
            raise ValueError("height: the sphere misses the board; wanted less than the radius either way")
        solid = self.thickness_m == self.radius_m
        if not solid and abs(self.height_m) >= self.radius_m - self.thickness_m:
            raise ValueError(
                "height: the inside of the cover does not meet the board, so there is no room for dies; "
                "wanted less than radius − thickness either way"
            )
        scattering_m = getattr(self.material, "scattering_length_m", None)
        if scattering_m is not None and self.thickness_m > _MOST_SCATTERINGS * scattering_m:
            raise ValueError(
                f"scattering_length: the wall is more than {_MOST_SCATTERINGS:g} of it thick; raise it and "
                "'g' towards 0: (1 − g) / scattering_length is what counts in thick walls"
            )
        return self

    @property
    def neck_m(self) -> float:
        """The radius at which its outer face stands on the board."""
        return math.sqrt(self.radius_m**2 - self.height_m**2)
