"""A reflectance that varies over a surface: a picture of it at 940 nm."""

from typing import Annotated, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, field_validator, model_validator

from nir_render.errors import shown
from nir_render.scene.documents.base import Document, Fraction
from nir_render.scene.documents.files import resolve_file
from nir_render.scene.documents.matter.picture import read_grey

_Ends = tuple[Annotated[Fraction, Field(ge=0, le=1)], Annotated[Fraction, Field(ge=0, le=1)]]


class TextureDocument(Document):
    """A grey PNG of 8 or 16 bit, whose values count as they are stored; black is `of[0]`, white is `of[1]`.

    It covers a rectangle once, upright as seen from the front; on a mesh it lies by the file's uv coordinates
    and repeats. Between its pixels it is interpolated.
    """

    example: ClassVar[str] = "{texture: wall_940nm.png, of: [0, 1]}"

    texture: str
    of: _Ends

    @field_validator("texture")
    @classmethod
    def _find(cls, name: str, info: ValidationInfo) -> str:
        if not name.lower().endswith(".png"):
            raise ValueError(f"{shown(name)} is no .png; export the picture as a grey PNG of 8 or 16 bit")
        return str(resolve_file(name, info))

    @model_validator(mode="after")
    def _look_inside(self) -> Self:
        read_grey(self.texture)
        return self

    def reflectance(self) -> NDArray[np.float64]:
        """Return the reflectance in each pixel, shape (rows, columns), the top row first.

        Raises
        ------
        ValueError
            The file has changed since the scene was loaded, and cannot be read.
        """
        black, white = self.of
        return np.asarray(black + (white - black) * read_grey(self.texture))
