"""The paper's optical language: frames of 11 bits in packets of five, and what the words mean.

A frame is that of a UART with seven data bits, even parity and two stop bits: start 0, payload, parity, 1 1.
The paper calls it a customised UART framing (Exp. 4) and does not say in which order the payload travels; it
is sent least significant bit first, as every UART does (TIA/EIA-232 with ITU-T T.50, the V.4 order of bits).
1 is lit, 0 dark; between packets the source stays lit.
"""

from collections.abc import Iterable
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

Bits = NDArray[np.uint8]

RATE_HZ: Final = 10.0
"""Bits per second (paper, Exp. 4)."""
FRAME_BITS: Final = 11
REPEATS: Final = 5
"""Identical frames in a packet (paper, Exp. 4)."""
WORDS: Final = 128
IDLE_BITS: Final = 11
"""Lit bits in a row that no packet holds: inside one at most ten follow each other."""
COMMANDS: Final = (
    "stop",
    "forward",
    "backward",
    "left",
    "right",
    "up",
    "down",
    "turn_left",
    "turn_right",
    "disperse",
    "aggregate",
    "recover",
    "follow",
    "hold",
    "faster",
    "slower",
)
"""The commands of words 0 to 15, of which none can be read as another by a wrong phase."""


def frame_bits(word: int) -> Bits:
    """Return the frame of a word: start 0, payload, even parity, two stop bits, shape (11,).

    Raises
    ------
    ValueError
        The word is not from 0 to 127.
    """
    if not 0 <= word < WORDS:
        raise ValueError(f"word {word}: a payload has seven bits; wanted 0 to {WORDS - 1}")
    payload = [word >> place & 1 for place in range(7)]
    return np.array([0, *payload, sum(payload) % 2, 1, 1], np.uint8)


def encode(word: int, repeats: int = REPEATS) -> Bits:
    """Return the packet of a word: its frame `repeats` times, shape (11 · repeats,)."""
    return np.tile(frame_bits(word), repeats)


def encode_text(text: str, repeats: int = REPEATS) -> tuple[Bits, ...]:
    """Return one packet for each character of a text.

    Raises
    ------
    ValueError
        A character is none of ASCII's printable ones, 32 to 126.
    """
    return tuple(encode(_character(character), repeats) for character in text)


@cache
def frames_of_words() -> Bits:
    """Return the frames of all words, shape (128, 11)."""
    frames = np.array([frame_bits(word) for word in range(WORDS)])
    frames.flags.writeable = False
    return frames


def word_in(bits: Iterable[int]) -> int | None:
    """Return the word of eleven bits; None where start, parity or stop bits are not as they should be."""
    start, *payload, parity, first_stop, second_stop = (int(bit) for bit in bits)
    if len(payload) != 7:
        raise ValueError(f"{len(payload) + 4} bits: a frame has {FRAME_BITS}")
    if (start, first_stop, second_stop) != (0, 1, 1) or sum(payload) % 2 != parity:
        return None
    return sum(bit << place for place, bit in enumerate(payload))


def meaning(word: int) -> str:
    """Return what a word means: a command (0 to 15), a character (32 to 126), or `word 17`."""
    if not 0 <= word < WORDS:
        raise ValueError(f"word {word}: wanted 0 to {WORDS - 1}")
    if word < len(COMMANDS):
        return COMMANDS[word]
    return chr(word) if 32 <= word <= 126 else f"word {word}"


def word_of(text: str) -> int:
    """Return the word of a command, of a single character, or of `word 17`.

    Raises
    ------
    ValueError
        It is none of these.
    """
    if text in COMMANDS:
        return COMMANDS.index(text)
    if text.startswith("word ") and text[5:].isdecimal() and int(text[5:]) < WORDS:
        return int(text[5:])
    if len(text) == 1:
        return _character(text)
    raise ValueError(
        f"{text[:40]!r} is no command; wanted one of {', '.join(COMMANDS)}, one ASCII character, or 'word 17'"
    )


@cache
def aliases(word: int) -> tuple[tuple[int, int], ...]:
    """Return how a word's frames can be read at a wrong phase, as (shift in bits, word read).

    Inside a packet frames follow each other without a gap, so a frame that is read `shift` bits late is a
    rotation of the frame sent; it holds an even number of ones, so that each rotation that starts 0 and ends
    1 1 passes parity. A shift that reads the same word again counts too.
    """
    frame = frame_bits(word)
    read = ((shift, word_in(np.roll(frame, -shift))) for shift in range(1, FRAME_BITS))
    return tuple((shift, alias) for shift, alias in read if alias is not None)


@cache
def could_be_rotated(words: tuple[int, ...]) -> tuple[bool, ...]:
    """Return of each of some words whether it could be another of them, read at a wrong phase."""
    return tuple(any(other in words and other != word for _, other in aliases(word)) for word in words)


def packet_levels(
    start_s: NDArray[np.float64],
    duration_s: NDArray[np.float64],
    bits: Bits,
    packet_start_s: float,
    bit_s: float = 1.0 / RATE_HZ,
) -> NDArray[np.float64]:
    """Return the share of each stretch of time in which a packet's source is lit, any shape; lit outside it.

    Stretches last longer than 0. The closed form: dark time up to each end, subtracted.
    """
    dark_s = np.concatenate([[0.0], np.cumsum(1.0 - bits)]) * bit_s
    edges_s = packet_start_s + bit_s * np.arange(len(bits) + 1)
    dark = np.interp(start_s + duration_s, edges_s, dark_s) - np.interp(start_s, edges_s, dark_s)
    return np.asarray(np.clip(1.0 - dark / duration_s, 0.0, 1.0))


def _character(character: str) -> int:
    if not 32 <= ord(character) <= 126:
        raise ValueError(f"{character!r} is no printable ASCII character (32 to 126); take one")
    return ord(character)
