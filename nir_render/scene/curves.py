"""The model of a value against wavelength."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Self

from pydantic import ValidationInfo, field_serializer, field_validator, model_validator

from nir_render.scene.base import Document, resolve_file
from nir_render.scene.fields import NotNegative, Positive
from nir_render.scene.points import Points, parse_points, read_csv, write_points
from nir_render.scene.units import LENGTH, Fraction, Length

_CURVE_FORMS = ("constant", "gaussian", "points", "file")


class Gaussian(Document):
    """A bell curve over wavelength."""

    centroid_m: Annotated[Length, Positive]
    fwhm_m: Annotated[Length, Positive]


class CurveDocument(Document):
    """A value against wavelength: a number (the same at every wavelength), points, or a CSV file.

    The CSV file has the header `wavelength_nm,value`; it becomes points when the scene is loaded.
    """

    read_keys: ClassVar[tuple[str, ...]] = ("file",)

    constant: Annotated[Fraction, NotNegative] | None = None
    gaussian: Gaussian | None = None
    points: Points | None = None

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any, info: ValidationInfo) -> Any:
        if isinstance(data, int | float | str) and not isinstance(data, bool):
            return {"constant": data}
        if not isinstance(data, Mapping):
            raise ValueError("wanted a number, or 'points', 'file' or 'gaussian'")
        forms = sorted(form for form in _CURVE_FORMS if data.get(form) is not None)
        if len(forms) > 1:
            raise ValueError(f"wanted one of 'constant', 'gaussian', 'points' and 'file', not {forms}")
        if "file" in data:
            points = read_csv(resolve_file(str(data["file"]), info), "wavelength_nm,value")
            others = {key: value for key, value in data.items() if key != "file"}
            return {**others, "points": [(f"{nm!r} nm", value) for nm, value in points]}
        return data

    @field_validator("points", mode="before")
    @classmethod
    def _parse_points(cls, points: Any) -> Any:
        return None if points is None else parse_points(points, LENGTH, "wavelength", "['940 nm', 0.15]")

    @field_serializer("points")
    def _write_points(self, points: Points | None) -> list[list[Any]] | None:
        return write_points(points, LENGTH)

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        if self.constant is None and self.gaussian is None and self.points is None:
            raise ValueError("wanted a number, or 'points', 'file' or 'gaussian'")
        return self
