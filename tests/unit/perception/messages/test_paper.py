"""The paper's decoder: run lengths, windows, parity, votes; where it holds and where it does not."""

import numpy as np

from perception.messages.paper import PaperDecoder, decode_paper
from tests.unit.perception.messages.signals import Sent, any_packet, heard, pieces
from tests.unit.perception.simulation import random


def test_every_word_is_read_without_noise() -> None:
    """Clocks up to 1.5 % wrong; run lengths bear 4 %. All five frames vote."""
    rng = random(830)
    for word in range(128):
        sent = any_packet(rng, word)
        (message,) = decode_paper(heard(rng, [sent], 100.0))
        assert (message.word, message.frames, message.confidence) == (word, 5, 1.0)
        assert abs(message.start_s - sent.start_s) < 0.05
        assert abs(message.end_s - sent.end_s) < 0.1


def test_who_joins_midway_reads_rotated_words() -> None:
    """As the paper states it: a vote over repeats that are all rotated alike does not help."""
    rng = random(831)
    wrong = 0
    for word in range(128):
        begin_s = rng.uniform(0.1, 1.0)
        read = decode_paper(heard(rng, [Sent(word, 0.0)], 100.0, begin_s=begin_s, end_s=5.5))
        wrong += any(message.word != word for message in read)
    assert 20 < wrong < 80


def test_it_fails_at_amplitudes_at_which_the_other_does_not() -> None:
    """A/σ 10: all of 60; 3: the threshold at half the level errs once in 15 samples, and most packets fail."""
    rng = random(832)

    def received(snr: float) -> int:
        words = rng.integers(128, size=60)
        signals = [heard(rng, [any_packet(rng, int(word))], snr) for word in words]
        return sum(
            [message.word for message in decode_paper(signal)] == [word]
            for signal, word in zip(signals, words, strict=True)
        )

    assert received(10.0) == 60
    assert received(3.0) < 30


def test_in_pieces_it_says_the_same_at_the_end() -> None:
    rng = random(833)
    signal = heard(rng, [any_packet(rng, 64)], 20.0)
    decoder = PaperDecoder("r1", 1)
    assert [decoder.push(piece) for piece in pieces(signal, [40, 90])] == [(), (), ()]
    assert decoder.finish() == decode_paper(signal)
    assert decoder.finish() == ()


def test_what_is_hidden_counts_as_dark() -> None:
    rng = random(834)
    sent = any_packet(rng, 0x2A)
    signal = heard(rng, [sent], 50.0)
    hidden = (signal.time_s > sent.start_s - 0.5) & (signal.time_s < sent.start_s + 5.0)
    signal.sigma_lit[hidden] = np.inf
    assert all(message.word != 0x2A for message in decode_paper(signal))
