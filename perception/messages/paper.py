"""The paper's decoder, to the letter (Exp. 4): run lengths, a sliding window, parity, separators, votes.

Samples count by their number, not by their time; a sample where nothing is known counts as dark, for the
paper knows only detected and not. What the paper leaves open is settled here: lit is above half the level; a
run of n samples is n f/F bits, rounded; δ is one bit; of the repeats the word with the most votes is taken.
"""

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from perception.messages.settings import DecoderSettings
from perception.messages.uart import FRAME_BITS, meaning, word_in
from perception.types import Message, Signal

_LIT = 0.5
_DELTA = 1  # δ, bits
_STOP = FRAME_BITS - 2  # bits from the start bit to the first stop bit


@dataclass(frozen=True)
class _Frame:
    """A frame that passed: its word, when its start bit begins and its last stop bit ends."""

    word: int
    start_s: float
    end_s: float


def decode_paper(signal: Signal, settings: DecoderSettings | None = None) -> tuple[Message, ...]:
    """Return what the paper's decoder reads in a whole signal.

    Of the settings only rate and repeats count. A message's confidence is the share of the repeats that
    voted for it.
    """
    settings = DecoderSettings() if settings is None else settings
    if len(signal.time_s) < 2:
        return ()
    bits, edges_s = _reconstructed(signal, settings.rate_hz)
    frames = _frames(bits, edges_s)
    packet_s = settings.repeats * FRAME_BITS / settings.rate_hz
    messages = []
    while frames:
        packet = [frame for frame in frames if frame.end_s - frames[0].start_s < 1.05 * packet_s]
        frames = frames[len(packet) :]
        (word, votes), *others = Counter(frame.word for frame in packet).most_common(2)
        if others and others[0][1] == votes:
            continue
        messages.append(
            Message(
                robot=signal.robot,
                track=signal.track,
                start_s=packet[0].start_s,
                end_s=packet[-1].end_s,
                word=word,
                command=meaning(word),
                confidence=min(votes / settings.repeats, 1.0),
                frames=votes,
            )
        )
    return tuple(messages)


class PaperDecoder:
    """Reads one track with `decode_paper`, when it has ended."""

    def __init__(self, robot: str, track: int, settings: DecoderSettings | None = None) -> None:
        self._robot, self._track, self._settings = robot, track, settings
        self._parts: list[NDArray[np.float64]] = []

    def push(self, signal: Signal) -> tuple[Message, ...]:
        """Take in samples; nothing is said before the end."""
        columns = [signal.time_s, signal.exposure_s, signal.level, signal.sigma_dark, signal.sigma_lit]
        self._parts.append(np.stack(columns))
        return ()

    def finish(self) -> tuple[Message, ...]:
        """Return what all of it says, and forget it."""
        if not self._parts:
            return ()
        whole = Signal(self._robot, self._track, *np.concatenate(self._parts, axis=1))
        self._parts = []
        return decode_paper(whole, self._settings)


def _reconstructed(signal: Signal, rate_hz: float) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return the sequence of bits, and when each begins and the last ends: runs of equal samples, split."""
    period_s = float(np.median(np.diff(signal.time_s)))
    samples_per_bit = 1.0 / (period_s * rate_hz)  # F/f
    lit = np.isfinite(signal.sigma_lit) & (signal.level > _LIT)
    ends = np.concatenate([[0], np.flatnonzero(lit[1:] != lit[:-1]) + 1, [len(lit)]])
    times_s = np.append(signal.time_s, signal.time_s[-1] + period_s) - 0.5 * period_s
    bits: list[int] = []
    edges_s: list[float] = []
    for begin, end in pairwise(ends):
        count = round((end - begin) / samples_per_bit)
        bits += [int(lit[begin])] * count
        edges_s += list(np.linspace(times_s[begin], times_s[end], count + 1)[:-1])
    return np.array(bits, np.uint8), np.array([*edges_s, times_s[-1]])


def _frames(bits: NDArray[np.uint8], edges_s: NDArray[np.float64]) -> list[_Frame]:
    """Return the frames that a window finds which slides from start bit to start bit."""
    frames = []
    place = 1
    while place + FRAME_BITS <= len(bits):
        if not (bits[place - 1] == 1 and bits[place] == 0):  # a transition to a start bit
            place += 1
            continue
        stop = _stop(bits, place + _STOP)
        word = None if stop is None else word_in([*bits[place : place + _STOP], 1, 1])
        if stop is None or word is None:
            place += 1  # the window resets to the next start bit
            continue
        frames.append(_Frame(word, float(edges_s[place]), float(edges_s[stop + 2])))
        place = stop + 2
    return frames


def _stop(bits: NDArray[np.uint8], predicted: int) -> int | None:
    """Return where the stop bits are within [t_k − δ, t_k + δ + 5]: 1 1 0, or 1 1 where idle follows."""
    for place in range(predicted - _DELTA, predicted + _DELTA + 5 - 1):
        if tuple(bits[place : place + 3]) == (1, 1, 0):
            return place
    return predicted if bits[predicted:].all() or bits[predicted : predicted + FRAME_BITS].all() else None
