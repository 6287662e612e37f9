"""The wire of the optical language: frames of eleven bits, packets of five frames, and what words mean.

A frame is a start bit 0, seven data bits, an even parity bit and two stop bits 1; a packet repeats it five
times; an idle source is lit (Infra-Swarm, Exp. 4). As on every UART the least significant bit goes first.

Inside a packet the frame comes round again and again, so whoever did not see it begin may start to read at
any bit: an even number of ones stays even, and wherever a 0 follows two 1s a frame seems to begin. Such
rotated readings are the `aliases` of a word.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Bits = NDArray[np.int8]

FRAME_BITS = 11
REPEATS = 5
WORDS = 128
RATE_HZ = 10.0

COMMANDS = (
    "stop", "forward", "backward", "left", "right", "turn_left", "turn_right", "disperse",
    "aggregate", "recover", "follow", "hold", "lead", "circle", "home", "ready",
)  # fmt: skip
"""What the words 0 to 15 order; none of them has an alias among them. The first three that are of the paper's
own experiment are disperse, aggregate and recover; the others are ours."""

_FIRST_CHARACTER, _LAST_CHARACTER = 32, 126


def frame_bits(word: int) -> Bits:
    """Return the eleven bits of a word, in the order in which they are sent.

    >>> frame_bits(5).tolist()
    [0, 1, 0, 1, 0, 0, 0, 0, 0, 1, 1]

    Raises
    ------
    ValueError
        The word is no whole number from 0 to 127.
    """
    if isinstance(word, bool) or not isinstance(word, int | np.integer) or not 0 <= word < WORDS:
        raise ValueError(f"{word!r} is no word; wanted a whole number from 0 to {WORDS - 1}")
    data = [(int(word) >> k) & 1 for k in range(7)]
    return np.array([0, *data, sum(data) % 2, 1, 1], dtype=np.int8)


def packet_bits(word: int, repeats: int = REPEATS) -> Bits:
    """Return the bits of a packet: the frame of a word, `repeats` times."""
    return np.tile(frame_bits(word), repeats)


def word_of_frame(bits: NDArray[np.integer]) -> int | None:
    """Return the word of eleven bits; None where start, parity or stop bits are wrong."""
    start, data, parity, stop = bits[0], bits[1:8], bits[8], bits[9:11]
    if start != 0 or int(data.sum() + parity) % 2 or stop.sum() != 2:
        return None
    return int(data @ (1 << np.arange(7)))


@lru_cache(maxsize=1)
def frames() -> Bits:
    """Return the bits of all words, shape (128, 11)."""
    table = np.stack([frame_bits(word) for word in range(WORDS)])
    table.setflags(write=False)
    return table


@lru_cache(maxsize=WORDS)
def aliases(word: int) -> tuple[tuple[int, int], ...]:
    """Return how else a frame that repeats can be read: by how many bits later, and as which other word."""
    bits = frame_bits(word)
    read = ((shift, word_of_frame(np.roll(bits, -shift))) for shift in range(1, FRAME_BITS))
    return tuple((shift, other) for shift, other in read if other is not None and other != word)


def meaning(word: int) -> str:
    """Return what a word says: a command for 0 to 15, an ASCII character for 32 to 126, or its number.

    >>> meaning(8), meaning(65), meaning(20)
    ('aggregate', 'A', '20')
    """
    if 0 <= word < len(COMMANDS):
        return COMMANDS[word]
    return chr(word) if _FIRST_CHARACTER <= word <= _LAST_CHARACTER else str(word)


def word_of(said: str | int) -> int:
    """Return the word for a command, an ASCII character, or a number from 0 to 127.

    >>> word_of("aggregate"), word_of("A"), word_of(20)
    (8, 65, 20)

    Raises
    ------
    ValueError
        It is none of them.
    """
    if isinstance(said, str):
        if said in COMMANDS:
            return COMMANDS.index(said)
        if len(said) == 1 and _FIRST_CHARACTER <= ord(said) <= _LAST_CHARACTER:
            return ord(said)
        raise ValueError(
            f"{said!r} is no command; wanted one of {', '.join(COMMANDS)}, one ASCII character, or a number "
            f"from 0 to {WORDS - 1}"
        )
    frame_bits(said)
    return said


_GENERATOR = np.array([[1, 1, 1, 0, 0, 0, 0], [1, 0, 0, 1, 1, 0, 0], [0, 1, 0, 1, 0, 1, 0], [1, 1, 0, 1, 0, 0, 1]])
"""Hamming (7, 4), parity bits at the places 1, 2 and 4 (Bell Syst. Tech. J. 29, 147, 1950)."""


def hamming_word(command: int) -> int:
    """Return the word that carries four bits in the Hamming (7, 4) code: any two differ in three bits.

    Raises
    ------
    ValueError
        The command is no whole number from 0 to 15.
    """
    if isinstance(command, bool) or not isinstance(command, int | np.integer) or not 0 <= command < 16:
        raise ValueError(f"{command!r} is no command of four bits; wanted a whole number from 0 to 15")
    bits = (np.array([(int(command) >> k) & 1 for k in range(4)]) @ _GENERATOR) % 2
    return int(bits @ (1 << np.arange(7)))


HAMMING_WORDS = tuple(hamming_word(command) for command in range(16))
"""The words of `hamming_word`, by command: a decoder that knows that no others are sent errs less."""
