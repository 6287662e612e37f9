"""A decoder of one's own, `file.py:function`."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from perception.messages.uart import WORDS
from perception.own_code import error_line, kind_of, load_function
from perception.types import Calibration, Message, Signal

DECODERS = ("sound", "paper")
"""Names that one's own function cannot have: they are built in."""


class DecoderError(ValueError):
    """A decoder cannot be loaded, or failed on a signal."""


@dataclass(frozen=True)
class OwnDecoder:
    """A decoder of the user's own.

    The function is called once for each track, when it has ended, with its whole signal and the calibrations
    of the observer's cameras by name, and returns messages.

    Attributes
    ----------
    name, reference, path
        The function's name; what the user wrote, for error texts; the file that holds it.
    """

    name: str
    reference: str
    path: Path
    function: Callable[..., Iterable[Message]]

    def decode(self, signal: Signal, calibrations: Mapping[str, Calibration]) -> tuple[Message, ...]:
        """Hand a signal to the function, and return its messages.

        Raises
        ------
        DecoderError
            If the function raises, or returns anything but messages of words from 0 to 127.
        """
        where = f"{self.reference}: track {signal.track} of {signal.robot}"
        try:
            found = self.function(signal, calibrations)
            listed = tuple(found) if isinstance(found, Iterable) else None
        except Exception as error:
            raise DecoderError(f"{where}: {error_line(error, self.path)}") from error
        if listed is None:
            raise DecoderError(f"{where}: returned {kind_of(found)}; wanted a list of messages")
        return tuple(_checked(message, signal, where) for message in listed)


class OwnReader:
    """Gathers the signal of one track for a decoder of one's own, in the place of a `Decoder`."""

    def __init__(self, decoder: OwnDecoder, calibrations: Mapping[str, Calibration]) -> None:
        self._decoder, self._calibrations = decoder, calibrations
        self._parts: list[Signal] = []

    def push(self, signal: Signal) -> tuple[Message, ...]:
        """Take further samples; nothing is said before the end."""
        self._parts.append(signal)
        return ()

    def finish(self) -> tuple[Message, ...]:
        """Return what the decoder makes of all of them."""
        if not self._parts:
            return ()
        first = self._parts[0]
        rows = np.concatenate(
            [
                [part.time_s, part.exposure_s, part.level, part.sigma_dark, part.sigma_lit]
                for part in self._parts
            ],
            axis=1,
        )
        return self._decoder.decode(Signal(first.robot, first.track, *rows), self._calibrations)


def load_decoder(reference: str) -> OwnDecoder:
    """Load the function that `file.py:function` names.

    Parameters
    ----------
    reference
        Path of a Python file, a colon, and the name of a function in it that takes a signal and the
        calibrations of the cameras, in this order, and returns messages.

    Raises
    ------
    DecoderError
        If there is no such file or function, it cannot be called, or the file raises while it is imported.
    """
    name, path, function = load_function(
        reference, "decoder", "my_decoder.py:majority", DECODERS, DecoderError
    )
    return OwnDecoder(name, reference, path, function)


def _checked(message: Any, signal: Signal, where: str) -> Message:
    """Return a message of a signal's track, or say what about it is wrong."""
    if not isinstance(message, Message):
        raise DecoderError(f"{where}: returned {kind_of(message)} among its messages; wanted a Message")
    if isinstance(message.word, bool) or not isinstance(message.word, int | np.integer):
        raise DecoderError(f"{where}: word of a message is {message.word!r}; wanted a whole number")
    if not 0 <= message.word < WORDS:
        raise DecoderError(f"{where}: word of a message is {message.word}; wanted 0 to {WORDS - 1}")
    numbers = (message.start_s, message.end_s, message.confidence, message.frames)
    if not all(isinstance(one, int | float | np.number) for one in numbers):
        raise DecoderError(f"{where}: start_s, end_s, confidence and frames of a message are {numbers}")
    if not (0.0 <= message.confidence <= 1.0 and np.isfinite(numbers).all()):
        raise DecoderError(
            f"{where}: a message goes from {message.start_s} to {message.end_s} s with confidence "
            f"{message.confidence}; wanted finite times and a probability"
        )
    return dataclasses.replace(
        message,
        robot=signal.robot,
        track=signal.track,
        word=int(message.word),
        start_s=float(message.start_s),
        end_s=float(message.end_s),
        confidence=float(message.confidence),
        frames=int(message.frames),
    )
