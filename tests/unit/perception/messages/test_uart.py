"""The wire: figures that anyone can count, and words there and back."""

import itertools

import numpy as np
import pytest

from perception.messages.hamming import hamming_command, hamming_word, hamming_words
from perception.messages.uart import (
    COMMANDS,
    aliases,
    encode,
    frame_bits,
    meaning,
    packet_levels,
    word_in,
    word_of,
)
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


def test_idle_of_eleven_bits_tells_and_no_packet_is_dark_for_longer_than_nine() -> None:
    runs = [
        (bit, len(list(run)))
        for word in range(128)
        for bit, run in itertools.groupby(np.tile(frame_bits(word), 5))
    ]
    assert max(length for bit, length in runs if bit) == 10
    assert max(length for bit, length in runs if not bit) == 9


def test_levels_of_exposures_are_those_of_many_short_ones() -> None:
    """Exposures of 0.1 to 150 ms against 20 000 instants: each edge is off by 1/20 000 of it at most."""
    rng = np.random.default_rng(4)
    bits = encode(0x55)
    begin_s = rng.uniform(-0.2, 6.0, 300)
    lasts_s = 10.0 ** rng.uniform(-4.0, -0.8, 300)
    found = packet_levels(begin_s, lasts_s, bits, 0.123, 0.1013)
    instants_s = begin_s[:, None] + lasts_s[:, None] * (np.arange(20_000) + 0.5) / 20_000
    place = np.floor((instants_s - 0.123) / 0.1013).astype(int)
    lit = np.where((place >= 0) & (place < 55), bits[np.clip(place, 0, 54)], 1)
    np.testing.assert_allclose(found, lit.mean(axis=1), atol=3e-4)
    assert ((found > 0.01) & (found < 0.99)).sum() > 40


def test_hamming_words_differ_in_three_bits_and_carry_their_command() -> None:
    words = hamming_words()
    assert min((a ^ b).bit_count() for a, b in itertools.combinations(words, 2)) == 3
    frames = [frame_bits(word) for word in words]
    assert min(int((a != b).sum()) for a, b in itertools.combinations(frames, 2)) == 4  # with the parity bit
    assert [hamming_command(hamming_word(command)) for command in range(16)] == list(range(16))
    assert sum(hamming_command(word) is not None for word in range(128)) == 16
    assert any(other in words for word in words for _, other in aliases(word))  # why they are refused too
    with pytest.raises(ValueError, match="command 16"):
        hamming_word(16)
