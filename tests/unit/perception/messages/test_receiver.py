"""The maximum-likelihood decoder: every word, odd clocks, holes, rotations, streams that are no packets."""

from dataclasses import replace

import numpy as np
import pytest

from perception.messages.decoder import Decoder, decode
from perception.messages.hamming import hamming_words
from perception.messages.settings import DecoderSettings
from perception.messages.uart import aliases, encode, packet_levels
from perception.types import Message, Signal
from tests.unit.perception.messages.signals import (
    Sent,
    any_packet,
    frame_times,
    heard,
    pieces,
    shares,
    signal_of,
)
from tests.unit.perception.simulation import random


def _words(messages: tuple[Message, ...]) -> list[int]:
    return [message.word for message in messages]


@pytest.mark.parametrize(("fps", "exposure_s"), [(30.0, 5e-5), (30.0, 0.02), (100.0, 0.005)])
def test_every_word_is_read_when_it_was_sent(fps: float, exposure_s: float) -> None:
    """Words of all kinds, on clocks up to 1.5 % wrong: starts and ends within a quarter of a bit."""
    rng = random(801, round(fps), round(1e6 * exposure_s))
    for word in range(0, 128, 3 if exposure_s < 1e-3 else 7):
        sent = any_packet(rng, word)
        signal = heard(rng, [sent], 8.0, fps=fps, exposure_s=exposure_s, scale=rng.uniform(0.85, 1.15))
        (message,) = decode(signal)
        assert (message.word, message.frames) == (word, 5)
        assert message.confidence > 0.999
        assert message.start_s == pytest.approx(sent.start_s, abs=0.025)
        assert message.end_s == pytest.approx(sent.end_s, abs=0.025)


def test_packets_back_to_back_and_after_idle() -> None:
    rng = random(802)
    sent = [Sent(word, at_s, 0.01) for word, at_s in ((49, 2.0), (3, 7.555), (99, 13.11), (27, 25.0))]
    assert _words(decode(heard(rng, sent, 6.0))) == [49, 3, 99, 27]


def test_a_stream_says_what_the_whole_says() -> None:
    """Pieces of 1 to 60 samples, and single samples: the same messages to the bit, each said once it can be."""
    rng = random(803)
    sent = [Sent(77, 1.7, -0.012), Sent(11, 9.0, -0.012)]
    signal = heard(rng, sent, 4.0, drops=0.03)
    whole = decode(signal)
    assert _words(whole) == [77, 11]
    for ends in (np.cumsum(rng.integers(1, 60, 12)), np.arange(1, len(signal.time_s))):
        decoder = Decoder("r1", 1)
        said = [(piece.time_s[-1], decoder.push(piece)) for piece in pieces(signal, list(ends))]
        assert tuple(message for _, messages in said for message in messages) + decoder.finish() == whole
    told_s = next(time_s for time_s, messages in said if messages)
    assert told_s - sent[0].end_s < 0.8  # idle was seen before it: nothing to wait for


def test_memory_does_not_grow() -> None:
    rng = random(804)
    times_s = frame_times(rng, 0.0, 120.0, 30.0, 0.0)
    signal = signal_of(times_s, shares(times_s, [Sent(5, 20.0 * n) for n in range(1, 6)], 1e-3), 0.1, rng)
    decoder, sizes, words = Decoder("r1", 1), [], []
    for piece in pieces(signal, list(range(100, len(times_s), 100))):
        words += _words(decoder.push(piece))
        held = [each for each in vars(decoder).values() if isinstance(each, np.ndarray)]
        sizes.append(sum(each.size for each in held) + sum(each.size for each in decoder._waiting))
    assert words == [5] * 5
    assert max(sizes) < sizes[0] + 5 * 120  # the samples of one block, five numbers each


@pytest.mark.parametrize("step", [7, pytest.param(1, marks=pytest.mark.verify)])
def test_who_joins_midway_never_reads_a_rotated_word(step: int) -> None:
    """All words, joined at any time, at A/σ 100 and 6; cut off inside the packet, at its end, or after idle.

    Without idle nothing is said of a word that has an alias; with 1.5 s of it the phase is known, and
    what shows two frames and more is read: fewer may be of a sender at another rate.
    """
    rng = random(805)
    read, whole = 0, 0
    for word in range(0, 128, step):
        sent = Sent(word, 0.0, rng.uniform(-0.015, 0.015))
        begin_s = rng.uniform(0.02, 4.2)
        ways = ((100.0, -0.3), (100.0, 0.05), (6.0, 0.4), (6.0, 1.6))
        for snr, more_s in (ways[word % 3], ways[3]):
            messages = decode(heard(rng, [sent], snr, begin_s=begin_s, end_s=sent.end_s + more_s))
            assert set(_words(messages)) <= {word}
            if more_s < 1.0 and aliases(word):
                assert messages == ()
            elif more_s > 1.0 and begin_s < 3.0:
                whole += 1
                read += len(messages)
    assert read / whole > 0.9


@pytest.mark.verify
def test_four_thousand_recordings_that_start_inside_a_packet() -> None:
    rng = random(806)
    for run in range(4_000):
        sent = Sent(run % 128, 0.0, rng.uniform(-0.015, 0.015))
        end_s = sent.end_s + float(rng.choice([-0.5, 0.0, 0.3, 1.2, 2.5]))
        begin_s = rng.uniform(0.01, min(5.4, end_s - 0.5))
        snr = float(rng.choice([4.0, 8.0, 20.0, 100.0]))
        assert set(_words(decode(heard(rng, [sent], snr, begin_s=begin_s, end_s=end_s)))) <= {sent.word}


def test_hamming_words_are_not_read_rotated_either() -> None:
    rng = random(807)
    settings = DecoderSettings(words=hamming_words())
    for word in hamming_words():
        sent = any_packet(rng, word)
        assert _words(decode(heard(rng, [sent], 5.0), settings)) == [word]
        inside = heard(rng, [sent], 5.0, begin_s=sent.start_s + 0.7, end_s=sent.end_s)
        assert set(_words(decode(inside, settings))) <= {word}


def test_low_amplitudes_and_dropped_frames() -> None:
    """A/σ 3 with 5 % of the frames dropped: all commands but one of 32, none wrong."""
    rng = random(808)
    settings = DecoderSettings(words=tuple(range(16)))
    read = [
        (run % 16, _words(decode(heard(rng, [any_packet(rng, run % 16)], 3.0, drops=0.05), settings)))
        for run in range(32)
    ]
    assert all(set(words) <= {word} for word, words in read)
    assert sum(words == [word] for word, words in read) >= 31


@pytest.mark.verify
def test_wrong_words_of_merges_that_were_told() -> None:
    """Another's light falls in for up to 3 s, marked as merged: none of 1 500 is read wrong."""
    rng = random(823)
    for run in range(1_500):
        sent = any_packet(rng, run % 128)
        other = any_packet(rng, int(rng.integers(128)), start_s=rng.uniform(-4.0, 6.0))
        times_s = frame_times(rng, 0.0, sent.end_s + 1.5, 30.0, 0.0)
        begin_s = rng.uniform(0.0, 7.0)
        merged = (times_s > begin_s) & (times_s < begin_s + rng.uniform(0.1, 3.0))
        level = shares(times_s, [sent], 1e-3)
        level = level + merged * rng.uniform(0.2, 2.0) * shares(times_s, [other], 1e-3)
        signal = signal_of(times_s, level, 0.1, rng)
        signal.sigma_dark[merged] = signal.sigma_lit[merged] = np.inf
        assert set(_words(decode(signal))) <= {sent.word}


def test_light_that_falls_in_untold_is_left_out() -> None:
    """Another's light for 2 s of a packet, as bright as its own: the word is read from the rest, and once."""
    rng = random(824)
    sent = [any_packet(rng, 37), Sent(101, 7.2)]
    times_s = frame_times(rng, 0.0, sent[1].end_s + 1.5, 30.0, 0.0)
    level = shares(times_s, sent, 1e-3)
    level[(times_s > sent[0].start_s + 1.0) & (times_s < sent[0].start_s + 3.0)] += 1.0
    signal = signal_of(times_s, level, 0.1, rng)
    assert _words(decode(signal)) == [37, 101]
    decoder = Decoder("r1", 1)
    said = [message for piece in pieces(signal, range(1, len(times_s))) for message in decoder.push(piece)]
    assert _words((*said, *decoder.finish())) == [37, 101]


@pytest.mark.parametrize("runs", [24, pytest.param(1_000, marks=pytest.mark.verify)])
def test_merges_that_nobody_told(runs: int) -> None:
    """Another's packets fall in for up to 3 s, 0.2 to 2 times as bright: most are read, and none wrong."""
    read = 0
    for run in range(runs):
        rng = random(825, run)
        sent = any_packet(rng, run % 128)
        other = any_packet(rng, int(rng.integers(128)), start_s=rng.uniform(-4.0, 6.0))
        times_s = frame_times(rng, 0.0, sent.end_s + 1.5, 30.0, 0.0)
        begin_s = rng.uniform(0.0, 7.0)
        merged = (times_s > begin_s) & (times_s < begin_s + rng.uniform(0.1, 3.0))
        level = shares(times_s, [sent], 1e-3)
        level = level + merged * rng.uniform(0.2, 2.0) * shares(times_s, [other], 1e-3)
        words = _words(decode(signal_of(times_s, level, 0.1, rng)))
        assert words in ([], [sent.word])
        read += len(words)
    assert read > 0.85 * runs


@pytest.mark.parametrize("rate_hz", [5.0, 7.0, 15.0, 20.0, 25.0])
def test_senders_at_other_rates_say_nothing(rate_hz: float) -> None:
    """One to three packets, heard from their beginning or from amidst them, at A/σ 4 to 30."""
    for run in range(10):
        rng = random(826, round(rate_hz), run)
        times_s = frame_times(rng, 0.0, 14.0, 30.0, 0.0)
        start_s, lit = rng.uniform(-4.0, 2.0), np.ones(len(times_s))
        for _ in range(int(rng.integers(1, 4))):
            bits = encode(int(rng.integers(128)))
            lit = np.minimum(
                lit, packet_levels(times_s, np.full(len(lit), 1e-3), bits, start_s, 1.0 / rate_hz)
            )
            start_s += len(bits) / rate_hz + float(rng.choice([0.0, rng.uniform(0.0, 3.0)]))
        assert decode(signal_of(times_s, lit, 1.0 / float(rng.choice([4.0, 10.0, 30.0])), rng)) == ()


def test_what_is_hidden_is_no_darkness() -> None:
    """Half of a packet hidden, and its levels nonsense: read from the rest, with fewer frames."""
    rng = random(809)
    sent = any_packet(rng, 42)
    signal = heard(rng, [sent], 10.0)
    hidden = (signal.time_s > sent.start_s + 1.0) & (signal.time_s < sent.start_s + 3.7)
    for array in (signal.sigma_dark, signal.sigma_lit):
        array[hidden] = np.inf
    signal.level[hidden] = rng.choice([0.0, np.nan, 5.0], hidden.sum())
    (message,) = decode(signal)
    assert (message.word, message.frames) == (42, 1)


@pytest.mark.parametrize("kind", ["idle", "dark", "lamp", "beating lamp", "noise", "random bits", "square"])
def test_what_sends_nothing_says_nothing(kind: str) -> None:
    """Two minutes each; the lamp of 100 Hz is seen at 10 Hz, that of 120 Hz beats slowly."""
    rng = random(820)
    times_s = frame_times(rng, 0.0, 120.0, 30.003, 0.0)
    levels = {
        "idle": np.ones(len(times_s)),
        "dark": np.zeros(len(times_s)),
        "lamp": 0.5 + 0.5 * np.sin(200.0 * np.pi * times_s),
        "beating lamp": 0.5 + 0.5 * np.sin(240.0 * np.pi * times_s),
        "noise": rng.uniform(0.0, 1.0, len(times_s)),
        "random bits": rng.integers(0, 2, 3700)[(times_s * 10.0).astype(int)],
        "square": (times_s % 0.4 < 0.2).astype(float),
    }
    assert decode(signal_of(times_s, levels[kind], 0.1, rng)) == ()


def test_odd_clocks_of_frames() -> None:
    """Doubled and disordered samples are left out; a jump back and a long gap begin anew."""
    rng = random(821)
    first, second = heard(rng, [any_packet(rng, 9)], 8.0), heard(rng, [any_packet(rng, 70)], 8.0)

    def shifted(signal: Signal, by_s: float) -> Signal:
        return replace(signal, time_s=signal.time_s + by_s)

    decoder = Decoder("r1", 1)
    said = decoder.push(first) + decoder.push(first)[:0]
    said += decoder.push(shifted(second, 1e4)) + decoder.push(shifted(first, 500.0)) + decoder.finish()
    assert _words(said).count(70) == 1
    assert _words(said).count(9) >= 2
    order = np.arange(len(first.time_s))
    order[50:53] = [51, 52, 50]
    mixed = Signal(
        "r1", 1, first.time_s[order], first.exposure_s[order], first.level[order],
        first.sigma_dark[order], first.sigma_lit[order],
    )  # fmt: skip
    assert _words(decode(mixed)) == [9]
    empty = Signal("r1", 1, *np.empty((5, 0)))
    assert decode(empty) == ()


def test_an_empty_second_is_no_darkness() -> None:
    rng = random(822)
    sent = any_packet(rng, 101)
    signal = heard(rng, [sent], 10.0)
    kept = np.abs(signal.time_s - sent.start_s - 3.0) > 0.5
    left = Signal(
        "r1", 1, signal.time_s[kept], signal.exposure_s[kept], signal.level[kept],
        signal.sigma_dark[kept], signal.sigma_lit[kept],
    )  # fmt: skip
    assert _words(decode(left)) == [101]


@pytest.mark.parametrize(
    "wrong", [{"words": ()}, {"words": (128,)}, {"rate_hz": 0.0}, {"repeats": 0}, {"drift": 0.05}]
)
def test_settings_that_cannot_be_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="wanted"):
        DecoderSettings(**wrong)  # type: ignore[arg-type]
