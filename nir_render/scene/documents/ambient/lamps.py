"""Models of lamps, and of the illuminance that a scene's lamps are scaled to."""

from typing import Annotated, Any, ClassVar, Literal, Self, get_args

from pydantic import AfterValidator, Field, field_validator, model_validator

from nir_render.errors import shown
from nir_render.scene.documents.base import (
    Direction,
    Document,
    Fraction,
    Illuminance,
    LuminousFlux,
    NotNegative,
    Position,
    Positive,
    Size2,
    Temperature,
    positive_extents,
    usable_direction,
)
from nir_render.scene.documents.curves import CurveDocument
from nir_render.scene.documents.files import PresetDocument
from nir_render.scene.documents.times.drives import FULL_DRIVE, Drive
from nir_render.spectra.illuminants import CIE_END_M, SILICON_M, VISIBLE_M, CieLamp, efficacy_lm_per_w

_LEAST_LM_PER_W = 0.1  # a black body of 950 K

_DIRECTIONS = {"up": (0.0, 0.0, 1.0), "down": (0.0, 0.0, -1.0)}


class Infrared(Document):
    """What a lamp sends from the end of its table to 1100 nm, as a share of its flux within the table.

    Over wavelength it is taken as flat. `least` and `most` bound what it may be where it was not measured:
    the render takes `share`, the manifest tells the interval.
    """

    example: ClassVar[str] = "{share: 0.002, least: 0, most: 0.004}"

    share: Annotated[Fraction, NotNegative]
    least: Annotated[Fraction, NotNegative]
    most: Annotated[Fraction, Field(ge=0, le=100)]

    @model_validator(mode="after")
    def _in_between(self) -> Self:
        if not self.least <= self.share <= self.most:
            raise ValueError(f"share {self.share:g} lies outside least {self.least:g} to most {self.most:g}")
        return self


class Lamp(PresetDocument):
    """A rectangular lamp that shines along `normal`, evenly after Lambert.

    Its spectrum is Planck's at `temperature`, or `illuminant`: a table of CIE 15 by its name, or one's own.
    Tables that end before 1100 nm leave open what is sent beyond: `infrared` has to tell. `luminous_flux` is
    that at full drive, and the mean of what flickers; `drive` is what it sends over time.
    """

    preset_folder: ClassVar[str] = "lamps"

    center_m: Position
    size_m: Annotated[Size2, AfterValidator(positive_extents)]
    normal: Direction = (0.0, 0.0, -1.0)
    luminous_flux_lm: Annotated[LuminousFlux, Positive]
    temperature_k: Annotated[Temperature, Field(ge=1000, le=20000)] | None = None
    illuminant: CieLamp | CurveDocument | None = None
    infrared: Infrared | None = None
    drive: Drive = FULL_DRIVE

    _direction = field_validator("normal")(usable_direction)

    @field_validator("illuminant", mode="before")
    @classmethod
    def _a_known_table(cls, illuminant: Any) -> Any:
        if isinstance(illuminant, str) and illuminant not in get_args(CieLamp):
            raise ValueError(
                f"there is no table {shown(illuminant)}; known are {', '.join(get_args(CieLamp))} (CIE 15), "
                "or 'points' or 'file' of one's own"
            )
        return illuminant

    @field_validator("illuminant")
    @classmethod
    def _a_table(cls, illuminant: CieLamp | CurveDocument | None) -> CieLamp | CurveDocument | None:
        if isinstance(illuminant, CurveDocument) and illuminant.points is None:
            raise ValueError("wanted the name of a table, 'points' or 'file'")
        if isinstance(illuminant, CurveDocument):
            assert illuminant.points is not None
            first_m, last_m = illuminant.points[0][0], illuminant.points[-1][0]
            if first_m > VISIBLE_M[0] + 1e-12 or last_m < VISIBLE_M[1] - 1e-12:
                raise ValueError(
                    f"the table covers {first_m * 1e9:.4g} to {last_m * 1e9:.4g} nm, but 'luminous_flux' is "
                    "what the eye sees of it: give values from 400 to 700 nm, 0 where nothing is sent (a "
                    "lamp of infrared alone has no lumens: write it among the 'beacons', by its 'flux')"
                )
            seen = efficacy_lm_per_w(illuminant.curve("the table"))
            if not seen >= _LEAST_LM_PER_W:
                raise ValueError(
                    f"the eye sees {seen:.2g} lm of a watt of this table: no 'luminous_flux' tells how much "
                    "it sends; write a lamp of infrared alone among the 'beacons', by its 'flux'"
                )
        return illuminant

    @model_validator(mode="after")
    def _one_spectrum(self) -> Self:
        if (self.temperature_k is None) == (self.illuminant is None):
            raise ValueError(
                "wanted one of 'temperature' (Planck's spectrum) and 'illuminant' (a table), such as "
                "temperature: 2856 K"
            )
        end_m = self.table_end_m
        if end_m is None and self.infrared is not None:
            raise ValueError("'infrared' tells of what a table leaves open; this spectrum reaches 1100 nm")
        if end_m is not None and self.infrared is None:
            raise ValueError(
                f"the table ends at {end_m * 1e9:.4g} nm, and what the lamp sends from there to 1100 nm is "
                f"unknown: write it, such as infrared: {Infrared.example}, the flux beyond over that within"
            )
        return self

    @property
    def table_end_m(self) -> float | None:
        """Where its table ends, None where it reaches all that silicon sees."""
        if self.illuminant is None:
            return None
        if isinstance(self.illuminant, str):
            return CIE_END_M
        assert self.illuminant.points is not None  # a lamp's own spectrum is a table
        end_m = self.illuminant.points[-1][0]
        return end_m if end_m < SILICON_M[1] else None


class IlluminanceDocument(Document):
    """The illuminance of a small plane at a point: all lamps are scaled by one factor to give it directly.

    Lamps that flicker or blink count with their mean; light off walls, and bodies in the way, do not.
    """

    example: ClassVar[str] = '{level: 500 lx, at: "[0, 0, 0.8] m", normal: up}'

    level_lx: Annotated[Illuminance, Positive]
    at_m: Position
    normal: Direction | Literal["up", "down"] = "up"

    @field_validator("normal")
    @classmethod
    def _direction(cls, normal: Direction | str) -> Direction | str:
        return normal if isinstance(normal, str) else usable_direction(normal)

    @property
    def facing(self) -> Direction:
        """Where the plane looks, of any length."""
        return _DIRECTIONS[self.normal] if isinstance(self.normal, str) else self.normal
