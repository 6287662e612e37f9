"""The models of how a camera chooses its exposures."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from nir_render.scene.base import Document
from nir_render.scene.fields import NotNegative, Positive
from nir_render.scene.units import Fraction, Time

MOST_GAIN = 64.0

Gain = Annotated[float, Field(ge=1, le=MOST_GAIN)]
Bracket = Annotated[tuple[Annotated[Time, Positive], ...], Field(min_length=2, max_length=1024)]


class AutoExposure(Document):
    """Exposure that brings the brightest pixel to `target` of the range up to clipping.

    Pixels that stand out alone, hot or stuck ones, do not count. A choice takes effect `latency` frames after
    the frame that it follows from; 1 is the next one. With `most_gain`, gain rises above the camera's own
    where the longest exposure is too short. The brightest frame of the time `hold` counts, not only the last:
    for sources that blink it should be as long as their dark runs. A step is at most a factor of 4; it is a
    whole one after a frame that clipped.
    """

    target: Annotated[Fraction, Field(gt=0, lt=1)] = 0.7
    shortest_s: Annotated[Time, Positive]
    longest_s: Annotated[Time, Positive]
    latency: Annotated[int, Field(ge=1, le=16)] = 1
    most_gain: Gain | None = None
    hold_s: Annotated[Time, NotNegative] = 0.0

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.shortest_s > self.longest_s:
            raise ValueError(f"shortest, {self.shortest_s:g} s, is longer than longest, {self.longest_s:g} s")
        return self
