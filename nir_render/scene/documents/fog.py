"""Models of fog: how much it takes from light on its way, how it scatters, and where it lies."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, field_serializer, field_validator, model_validator

from nir_render.errors import shown
from nir_render.scene.documents.base import Document, Extinction, Fraction, Length, Position, Size3, typed
from nir_render.scene.documents.curves import Points, one_form, parse_half_turn, read_curve, write_points
from nir_render.scene.documents.files import resolve_file
from nir_render.scene.text.units import ANGLE, EXTINCTION, VISIBILITY, format_quantity, parse_quantity

# Koschmieder: an extinction of σ dims a contrast to 2 % over a distance of −ln 0.02 / σ = 3.912/σ.
_VISIBILITY_TIMES_EXTINCTION = 3.912


class HenyeyGreenstein(Document):
    """The phase function of Henyey & Greenstein; `g` is its mean cosine, 1 straight on.

    The default is that of heavy fog near 940 nm by Mie theory (0.84 to 0.87); assumed.
    """

    type: Literal["henyey_greenstein"]
    g: Annotated[float, Field(ge=-0.99, le=0.99)] = 0.85


class TabulatedPhase(Document):
    """A phase function as [angle, relative value] points, linear between them; 0 deg is straight on.

    `file` is a CSV with the header `angle_deg,value`; it becomes points when the scene is loaded. The angles
    go from exactly 0 to exactly 180 deg, in steps of any size.
    """

    read_keys: ClassVar[tuple[str, ...]] = ("file",)

    type: Literal["table"]
    points: Points

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, Mapping):
            return data
        cls.check_keys(data)
        one_form(data, ("points", "file"))
        if data.get("file") is None:
            return data
        rows = read_curve(resolve_file(str(data["file"]), info), "angle_deg,value")
        others = {key: value for key, value in data.items() if key != "file"}
        return {**others, "points": [(f"{angle_deg!r} deg", value) for angle_deg, value in rows]}

    @field_validator("points", mode="before")
    @classmethod
    def _parse_points(cls, points: Any) -> Points:
        return parse_half_turn(points, "angles")

    @field_serializer("points")
    def _write_points(self, points: Points) -> list[list[Any]] | None:
        return write_points(points, ANGLE)


PhaseDocument = Annotated[
    HenyeyGreenstein | TabulatedPhase,
    Field(discriminator="type"),
    typed("{type: henyey_greenstein, g: 0.85}", HenyeyGreenstein, TabulatedPhase),
]


class Fog(Document):
    """Fog of one density: everywhere, below z = `top`, or in a box of `size` about `center`.

    `extinction` is σ_t in light lost per metre; or `visibility`, 3.912/σ_t, which becomes the extinction when
    the scene is loaded; 0 /m is clear air. `albedo` is the share of what is lost that is scattered, and not
    absorbed.
    """

    example: ClassVar[str] = "{visibility: 50 m}"
    read_keys: ClassVar[tuple[str, ...]] = ("visibility",)

    extinction_per_m: Annotated[Extinction, Field(ge=0)]
    albedo: Annotated[Fraction, Field(ge=0, le=1)] = 0.9995
    phase: PhaseDocument = HenyeyGreenstein(type="henyey_greenstein")
    top_m: Length | None = None
    center_m: Position | None = None
    size_m: Size3 | None = None

    @model_validator(mode="before")
    @classmethod
    def _read_visibility(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        cls.check_keys(data)
        one_form(data, ("extinction", "visibility"))
        others = {key: value for key, value in data.items() if key != "visibility"}
        if data.get("visibility") is None:
            return others
        try:
            visibility_m = parse_quantity(data["visibility"], VISIBILITY)
        except ValueError as error:
            raise ValueError(f"visibility: {error}") from None
        if visibility_m <= 0.0:
            raise ValueError(
                f"visibility: {shown(data['visibility'])} is not greater than 0; write one such as '50 m'"
            )
        per_m = _VISIBILITY_TIMES_EXTINCTION / visibility_m
        if per_m > EXTINCTION.most:
            raise ValueError(
                f"visibility: {shown(data['visibility'])} is too short: its extinction is beyond "
                f"{EXTINCTION.most:g} 1/m; check number and unit"
            )
        return {**others, "extinction": format_quantity(per_m, EXTINCTION)}

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.center_m is None) != (self.size_m is None):
            raise ValueError("a fog bank needs both 'center' and 'size'")
        if self.top_m is not None and self.center_m is not None:
            raise ValueError(
                "wanted either 'top' (all below it) or 'center' and 'size' (a bank of fog), not both"
            )
        if self.size_m is not None and min(self.size_m) <= 0.0:
            raise ValueError("size: each extent must be greater than 0")
        return self

    def region_m(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the lowest and highest corner of the box that the fog fills, shape (3,); ±inf where open."""
        low_m, high_m = np.full(3, -np.inf), np.full(3, np.inf)
        if self.top_m is not None:
            high_m[2] = self.top_m
        if self.center_m is not None and self.size_m is not None:
            center_m, half_m = np.array(self.center_m), 0.5 * np.array(self.size_m)
            low_m, high_m = center_m - half_m, center_m + half_m
        return low_m, high_m
