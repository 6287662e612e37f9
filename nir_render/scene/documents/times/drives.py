"""Models of what an emitter sends over time: a number, a square wave, bits, messages."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from nir_render.errors import shown
from nir_render.scene.documents.base import Document, Fraction, Frequency, Positive, Time
from nir_render.scene.documents.curves import one_form
from perception.messages.uart import FRAME_BITS, REPEATS, word_of

_DRIVE_FORMS = ("constant", "square", "bits", "sends")
_DRIVE_EXAMPLE = (
    "0.5, {square: {frequency: 1 kHz, duty: 0.5}}, {bits: {pattern: '0101101111', rate: 10 Hz}} or "
    "{sends: [{at: 1 s, command: forward}]}"
)

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
            raise ValueError(f"{shown(pattern)} is no text; write the bits in quotes, such as '0101101111'")
        if not pattern or set(pattern) - {"0", "1"}:
            raise ValueError(f"{shown(pattern)} is no string of the bits 0 and 1, such as '0101101111'")
        return pattern


class Packet(Document):
    """What is said once: `command` is one of the language's commands, an ASCII character, or 'word 17'.

    It begins `at` a time of the sender's own clock: its frame, `repeats` times.
    """

    example: ClassVar[str] = "{at: 1 s, command: forward}"

    at_s: Time
    command: str
    repeats: Annotated[int, Field(ge=1, le=1000)] = REPEATS

    @field_validator("command", mode="before")
    @classmethod
    def _known(cls, command: Any) -> Any:
        if isinstance(command, int) and not isinstance(command, bool) and 0 <= command <= 9:
            return str(command)  # a digit is a character, which YAML reads as a number
        if not isinstance(command, str):
            raise ValueError(f"{shown(command)} is no text; write a command such as forward, or 'word 17'")
        word_of(command)
        return command


class Sending(Document):
    """Packets of the optical language at `rate`; between them it is idle, which is lit.

    A list of packets may stand for it. The sender's clock is `clock_offset` behind the scene's, and slow by
    `clock_drift`: its time t is the scene's offset + (1 + drift) t, and its bits last as much longer.
    """

    example: ClassVar[str] = "{packets: [{at: 1 s, command: forward}], clock_drift: 0.5 %}"

    packets: Annotated[tuple[Packet, ...], Field(min_length=1, max_length=100_000)]
    rate_hz: Annotated[Frequency, Positive] = 10.0
    clock_offset_s: Time = 0.0
    clock_drift: Annotated[Fraction, Field(ge=-0.1, le=0.1)] = 0.0

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any) -> Any:
        if isinstance(data, Sequence) and not isinstance(data, str):
            return {"packets": data}
        return data

    @model_validator(mode="after")
    def _one_after_the_other(self) -> Self:
        for k, (packet, after) in enumerate(zip(self.packets, self.packets[1:], strict=False)):
            end_s = packet.at_s + packet.repeats * FRAME_BITS / self.rate_hz
            if after.at_s < end_s - 1e-9:
                raise ValueError(
                    f"packet {k + 1} begins at {after.at_s:g} s, before packet {k} ends at {end_s:g} s; send "
                    "them one after the other"
                )
        return self


class Drive(Document):
    """What an emitter sends over time, as a share of its full power: one of these."""

    constant: Level | None = None
    square: SquareWave | None = None
    bits: BitString | None = None
    sends: Sending | None = None

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any) -> Any:
        if isinstance(data, Drive):
            return data
        if isinstance(data, int | float | str) and not isinstance(data, bool):
            return {"constant": data}
        if not isinstance(data, Mapping):
            raise ValueError(f"{shown(data)} is no drive; wanted {_DRIVE_EXAMPLE}")
        cls.check_keys(data)
        one_form(data, _DRIVE_FORMS)
        return data


FULL_DRIVE = Drive(constant=1.0)
