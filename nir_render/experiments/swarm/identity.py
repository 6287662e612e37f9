"""Who says it: a robot's number in a word of the paper's language, in two where there are more than 128."""

WORDS = 128
_HIGH = 32
"""Of two words the first is one of the first 32, the second one of the other 96: which is which is seen."""

MOST = _HIGH * (WORDS - _HIGH)


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
