"""The model of a camera's lens."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from nir_render.scene.base import PresetDocument
from nir_render.scene.fields import Positive
from nir_render.scene.units import Fraction, Length


class Lens(PresetDocument):
    """A rectilinear lens, focused, without vignetting other than the tilt of its aperture."""

    preset_folder: ClassVar[str] = "lenses"

    model: Literal["rectilinear"] = "rectilinear"
    focal_length_m: Annotated[Length, Positive]
    f_number: Annotated[float, Positive]
    transmission: Annotated[Fraction, Field(gt=0, le=1)]
