"""The model of a camera's shutter: which rows expose when."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from nir_render.scene.base import Document, typed
from nir_render.scene.fields import NotNegative, Positive
from nir_render.scene.units import Fraction, Time


class GlobalShutter(Document):
    """All rows expose at once; then they are read from the top, one every `line_time`.

    While a row waits, light still adds to it: `parasitic_light_sensitivity` times what it would add in an
    exposure, the inverse of what data sheets call shutter ratio or shutter efficiency.
    """

    type: Literal["global"] = "global"
    line_time_s: Annotated[Time, NotNegative] = 0.0
    parasitic_light_sensitivity: Annotated[Fraction, Field(ge=0, lt=1)] = 0.0

    @model_validator(mode="after")
    def _rows_wait(self) -> Self:
        if self.parasitic_light_sensitivity > 0.0 and self.line_time_s == 0.0:
            raise ValueError(
                "parasitic light adds up while rows wait to be read; write 'line_time' too, such as 10 us"
            )
        return self


class RollingShutter(Document):
    """Rows expose one after the other from the top, each `line_time` later than the one above."""

    type: Literal["rolling"]
    line_time_s: Annotated[Time, Positive]


Shutter = Annotated[
    GlobalShutter | RollingShutter,
    Field(discriminator="type"),
    typed("{type: rolling, line_time: 10 us}", GlobalShutter, RollingShutter),
]
