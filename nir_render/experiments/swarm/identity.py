"""Who says it: a robot's number in a word of the paper's language, in two where there are more than 128."""

from collections import defaultdict
from collections.abc import Iterable

from perception import Message

WORDS = 128
_HIGH = 32
"""Of two words the first is one of the first 32, the second one of the other 96: which is which is seen."""

MOST = _HIGH * (WORDS - _HIGH)

_PAIR_S = 9.0  # the second word of a robot begins 6.65 s after the first


def words_of(number: int, robots: int) -> tuple[int, ...]:
    """Return what a robot says to tell its number, 0 to `robots` − 1.

    >>> words_of(5, 128), words_of(5, 129), words_of(1000, 1001)
    ((5,), (0, 37), (10, 72))

    Raises
    ------
    ValueError
        There is no such robot, or there are more than two words tell apart, 3 072.
    """
    if not 0 <= number < robots <= MOST:
        raise ValueError(f"robot {number} of {robots}: two words tell {MOST} robots apart")
    if robots <= WORDS:
        return (number,)
    high, low = divmod(number, WORDS - _HIGH)
    return high, _HIGH + low


def number_of(words: tuple[int, ...], robots: int) -> int | None:
    """Return whose words these are; None where they are nobody's.

    >>> number_of((10, 72), 1001), number_of((72, 10), 1001), number_of((10,), 1001)
    (1000, None, None)
    """
    if robots <= WORDS:
        number = words[0] if len(words) == 1 else robots
    elif len(words) == 2 and words[0] < _HIGH <= words[1]:
        number = words[0] * (WORDS - _HIGH) + words[1] - _HIGH
    else:
        number = robots
    return number if number < robots else None


def numbers_told(words: Iterable[Message], robots: int) -> list[tuple[int, tuple[Message, ...]]]:
    """Return the numbers that tracks tell, each with the words by which it is told.

    A track's two words are one robot's where they follow each other as a robot sends them. A word that may be
    another track's tells nobody's number.
    """
    by_track: dict[int, list[Message]] = defaultdict(list)
    for word in words:
        if word.ambiguous_with is None:
            by_track[word.track].append(word)
    length = len(words_of(0, robots))
    found = []
    for said in by_track.values():
        in_time = sorted(said, key=lambda word: word.start_s)
        for first in range(len(in_time) - length + 1):
            some = tuple(in_time[first : first + length])
            number = number_of(tuple(word.word for word in some), robots)
            if number is not None and some[-1].start_s - some[0].start_s <= _PAIR_S * (length - 1):
                found.append((number, some))
    return found
