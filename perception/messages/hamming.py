"""A Hamming code on the same wire: sixteen words of the payload's 128 that differ in three bits or more.

Payload and frame stay as they are; with the parity bit the words differ in four bits of each frame. What is
lost is the other 112 words.
"""

from functools import cache
from typing import Final

# Bits 0 to 3 are the command's; bits 4 to 6 the parities of three of them each (Hamming 1950, [7, 4]).
_CHECKS: Final = (0b1011, 0b1101, 0b1110)


def hamming_word(command: int) -> int:
    """Return the word that carries a command.

    Raises
    ------
    ValueError
        The command is not from 0 to 15.
    """
    if not 0 <= command < 16:
        raise ValueError(f"command {command}: a Hamming word carries 0 to 15")
    return command | sum(
        ((command & mask).bit_count() % 2) << 4 + place for place, mask in enumerate(_CHECKS)
    )


@cache
def hamming_words() -> tuple[int, ...]:
    """Return the words of all sixteen commands, to be the `words` of `DecoderSettings`."""
    return tuple(map(hamming_word, range(16)))


def hamming_command(word: int) -> int | None:
    """Return the command of a word; None where it is no Hamming word.

    The decoder picks the most likely of all Hamming words by itself, so that nothing is corrected here.
    """
    command = word & 0b1111
    return command if hamming_word(command) == word else None
