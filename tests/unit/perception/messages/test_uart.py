"""The wire: figures that anyone can count, and words there and back."""

import numpy as np
import pytest

from perception.messages.uart import COMMANDS, aliases, encode, frame_bits, meaning, word_in, word_of
from tests.unit.perception.messages.wire import bits_of


def test_frames_by_hand() -> None:
    assert frame_bits(0b1000001).tolist() == [0, 1, 0, 0, 0, 0, 0, 1, 0, 1, 1]
    assert all(frame_bits(word).tolist() == bits_of(word) for word in range(128))
    assert encode(19).tolist() == bits_of(19) * 5
    with pytest.raises(ValueError, match="0 to 127"):
        frame_bits(128)


def test_frames_are_read_and_broken_ones_are_not() -> None:
    for word in range(128):
        bits = frame_bits(word)
        assert word_in(bits) == word
        for place in (0, 3, 8, 9, 10):
            broken = bits.copy()
            broken[place] ^= 1
            assert word_in(broken) is None


def test_how_many_words_can_be_read_rotated() -> None:
    """84 of 128; of the misaligned windows that begin at a falling edge 43 % pass."""
    assert sum(any(other != word for _, other in aliases(word)) for word in range(128)) == 84
    edges = passed = 0
    for word in range(128):
        for shift in range(1, 11):
            turned = np.roll(frame_bits(word), -shift)
            if turned[0] == 0 and turned[-1] == 1:
                edges += 1
                passed += word_in(turned) is not None
    assert (passed, edges) == (96, 224)
    among = {other for word in range(16) for _, other in aliases(word) if other != word}
    assert not among & set(range(16))


def test_words_mean_what_they_say() -> None:
    assert len(set(COMMANDS)) == 16
    assert {"disperse", "aggregate", "recover"} < set(COMMANDS)
    for word in range(128):
        assert word_of(meaning(word)) == word
    with pytest.raises(ValueError, match="no command"):
        word_of("fly")
