"""Models of what an emitter sends over time: a level, a square wave, flicker, bits, packets of a language."""

import itertools
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, Field, field_validator, model_validator

from nir_render.errors import shown
from nir_render.scene.documents.base import Document, Fraction, Frequency, Positive, Time
from nir_render.scene.documents.curves import one_form
from perception.messages.uart import FRAME_BITS, RATE_HZ, REPEATS, word_of

_DRIVE_FORMS = ("constant", "square", "flicker", "bits", "packets")
_DRIVE_EXAMPLE = (
    "0.5, {square: {frequency: 1 kHz, duty: 0.5}}, {bits: {pattern: '0101101111', rate: 10 Hz}} "
    "or {packets: {sends: [{at: 1 s, command: forward}]}}"
)

Level = Annotated[Fraction, Field(ge=0, le=1)]


class SquareWave(Document):
    """On for the share `duty` of each period, off for the rest; at `phase` a period begins."""

    example: ClassVar[str] = "{frequency: 1 kHz, duty: 0.5}"

    frequency_hz: Annotated[Frequency, Positive]
    duty: Level = 0.5
    phase_s: Time = 0.0


class Flicker(Document):
    """Light of a lamp on the mains, at twice their frequency: 1 + modulation · sin(4π · mains · (t − phase)).

    Its mean is 1: a lamp's flux is rated so. `modulation` is (highest − lowest)/(highest + lowest).
    """

    example: ClassVar[str] = "{mains: 50 Hz, modulation: 0.1}"

    mains_hz: Annotated[Frequency, Positive]
    modulation: Level
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


class Send(Document):
    """What is sent at a time of the sender's clock: a `command`, a `text` of ASCII, or `word`, a number.

    A command is one of the sixteen; each character of a text is a packet, one right after the other.
    """

    example: ClassVar[str] = "{at: 1 s, command: forward}"

    at_s: Time
    command: str | None = None
    text: Annotated[str, Field(min_length=1)] | None = None
    word: Annotated[int, Field(ge=0, le=127)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _one_of_them(cls, data: Any) -> Any:
        if not isinstance(data, Send):
            cls.check_keys(data)
            one_form(data, ("command", "text", "word"))
        return data

    @field_validator("command")
    @classmethod
    def _known(cls, command: str | None) -> str | None:
        if command is not None:
            word_of(command)
        return command

    @field_validator("text")
    @classmethod
    def _printable(cls, text: str | None) -> str | None:
        for character in text or "":
            word_of(character)
        return text

    @property
    def words(self) -> tuple[int, ...]:
        """The words that it is made of, each a packet."""
        if self.word is not None:
            return (self.word,)
        return (word_of(self.command),) if self.command is not None else tuple(map(word_of, self.text or ""))


class Packets(Document):
    """Packets of the optical language: five frames of eleven bits each, lit in between.

    What the sender's clock calls `at` is at `offset` + at · (1 + `drift`) in the world: with a drift above 0
    it is slow, and its bits are as much longer.
    """

    example: ClassVar[str] = "{sends: [{at: 1 s, command: forward}]}"

    sends: Annotated[tuple[Send, ...], Field(min_length=1)]
    rate_hz: Annotated[Frequency, Positive] = RATE_HZ
    offset_s: Time = 0.0
    drift: Annotated[Fraction, Field(ge=-0.1, le=0.1)] = 0.0

    @model_validator(mode="after")
    def _one_after_the_other(self) -> Self:
        packet_s = FRAME_BITS * REPEATS / self.rate_hz
        in_order = sorted(self.sends, key=lambda send: send.at_s)
        for one, later in itertools.pairwise(in_order):
            end_s = one.at_s + packet_s * len(one.words)
            if later.at_s < end_s - 1e-9:
                raise ValueError(
                    f"what is sent at {later.at_s:g} s begins before what is sent at {one.at_s:g} s has "
                    f"ended, at {end_s:g} s: a packet takes {packet_s:g} s; send it later"
                )
        return self

    @property
    def starts_s(self) -> tuple[tuple[float, int], ...]:
        """When each packet starts in the world, and its word, in order of time."""
        packet_s = FRAME_BITS * REPEATS / self.rate_hz
        ats = sorted(
            (send.at_s + number * packet_s, word)
            for send in self.sends
            for number, word in enumerate(send.words)
        )
        return tuple((self.offset_s + at_s * (1.0 + self.drift), word) for at_s, word in ats)

    @property
    def bit_s(self) -> float:
        """How long a bit takes in the world."""
        return (1.0 + self.drift) / self.rate_hz


class Drive(Document):
    """What an emitter sends over time, as a share of full power: a number, a square wave, bits or packets.

    Lamps may flicker too.
    """

    constant: Level | None = None
    square: SquareWave | None = None
    flicker: Flicker | None = None
    bits: BitString | None = None
    packets: Packets | None = None

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

    @property
    def mean(self) -> float | None:
        """The mean level over all time; None of what sends messages."""
        if self.square is not None:
            return self.square.duty
        return 1.0 if self.flicker is not None else self.constant


FULL_DRIVE = Drive(constant=1.0)


def _no_flicker(drive: Drive) -> Drive:
    if drive.flicker is not None:
        raise ValueError("lamps on the mains flicker; a robot's source does not: write 'square' for a share")
    return drive


SourceDrive = Annotated[Drive, AfterValidator(_no_flicker)]
