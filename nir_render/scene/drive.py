"""The model of what an emitter sends over time: its drive."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, field_validator, model_validator

from nir_render.scene.base import Document
from nir_render.scene.fields import Positive
from nir_render.scene.points import one_form
from nir_render.scene.units import Fraction, Frequency, Time

_FORMS = ("constant", "square", "bits")
_EXAMPLE = "0.5, {square: {frequency: 1 kHz, duty: 0.5}} or {bits: {pattern: '0101101111', rate: 10 Hz}}"

Level = Annotated[Fraction, Field(ge=0, le=1)]


class SquareWave(Document):
    """On for the share `duty` of each period, off for the rest; at `phase` a period begins."""

    example: ClassVar[str] = "{frequency: 1 kHz, duty: 0.5}"

    frequency_hz: Annotated[Frequency, Positive]
    duty: Level = 0.5
    phase_s: Time = 0.0


class BitString(Document):
    """Bits, one after the other at `rate` from `start` on: 1 is lit, 0 dark.

    Before, and after the last of `repeat` repetitions (a number, or `forever`), it sends the level `idle`;
    the paper's language is lit when idle.
    """

    example: ClassVar[str] = "{pattern: '0101101111', rate: 10 Hz}"

    pattern: str
    rate_hz: Annotated[Frequency, Positive]
    start_s: Time = 0.0
    repeat: Annotated[int, Field(ge=1)] | Literal["forever"] = 1
    idle: Level = 1.0

    @field_validator("pattern", mode="before")
    @classmethod
    def _bits(cls, pattern: Any) -> Any:
        if not isinstance(pattern, str):  # YAML reads 0101 as a number, in octal
            raise ValueError(f"{pattern!r} is no text; write the bits in quotes, such as '0101101111'")
        if not pattern or set(pattern) - {"0", "1"}:
            raise ValueError(f"{pattern!r} is no string of the bits 0 and 1, such as '0101101111'")
        return pattern


class Drive(Document):
    """What an emitter sends over time, as a share of its full power: a number, a square wave or bits."""

    constant: Level | None = None
    square: SquareWave | None = None
    bits: BitString | None = None

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any) -> Any:
        if isinstance(data, Drive):
            return data
        if isinstance(data, int | float | str) and not isinstance(data, bool):
            return {"constant": data}
        if not isinstance(data, Mapping):
            raise ValueError(f"{data!r} is no drive; wanted {_EXAMPLE}")
        cls.check_keys(data)
        one_form(data, _FORMS)
        return data


FULL_DRIVE = Drive(constant=1.0)
