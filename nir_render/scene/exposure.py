"""The model of how a camera chooses its exposures."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from nir_render.scene.base import Document
from nir_render.scene.fields import Positive
from nir_render.scene.units import Fraction, Time


class AutoExposure(Document):
    """Exposure that brings the brightest pixel of the last frame to `target` of the range up to clipping."""

    target: Annotated[Fraction, Field(gt=0, lt=1)] = 0.7
    shortest_s: Annotated[Time, Positive]
    longest_s: Annotated[Time, Positive]

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.shortest_s > self.longest_s:
            raise ValueError(f"shortest, {self.shortest_s:g} s, is longer than longest, {self.longest_s:g} s")
        return self
