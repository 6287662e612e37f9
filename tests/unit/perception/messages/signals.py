"""Signals of sources that send, by the decoders' own model of the light, with Gaussian noise."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from perception.messages.uart import encode, packet_levels
from perception.types import Signal

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sent:
    """A packet that is sent, when its start bit begins, and by how much its clock is slow."""

    word: int
    start_s: float
    drift: float = 0.0
    repeats: int = 5

    @property
    def bit_s(self) -> float:
        return 0.1 * (1.0 + self.drift)

    @property
    def end_s(self) -> float:
        return self.start_s + 11 * self.repeats * self.bit_s


def frame_times(rng: np.random.Generator, begin_s: float, end_s: float, fps: float, drops: float) -> Array:
    """Return mid-exposures of a camera of any phase, a share of them dropped."""
    times_s = begin_s + (np.arange(int((end_s - begin_s) * fps)) + rng.uniform()) / fps
    return np.asarray(times_s[rng.uniform(size=len(times_s)) >= drops])


def shares(times_s: Array, sent: Sequence[Sent], exposure_s: float) -> Array:
    """Return the share of each exposure in which a source is lit that sends packets, idle in between."""
    exposures_s = np.full(len(times_s), exposure_s)
    lit = np.ones(len(times_s))
    for packet in sent:
        bits = encode(packet.word, packet.repeats)
        begin_s = times_s - 0.5 * exposure_s
        lit = np.minimum(lit, packet_levels(begin_s, exposures_s, bits, packet.start_s, packet.bit_s))
    return lit


def signal_of(
    times_s: Array, level: Array, sigma: float, rng: np.random.Generator, exposure_s: float = 1e-3
) -> Signal:
    """Return levels with noise as a signal of track 1 that claims it."""
    every = np.full(len(times_s), sigma)
    noisy = level + sigma * rng.standard_normal(len(times_s))
    return Signal("r1", 1, times_s, np.full(len(times_s), exposure_s), noisy, every, every)


def heard(
    rng: np.random.Generator,
    sent: Sequence[Sent],
    snr: float,
    *,
    fps: float = 30.0,
    exposure_s: float = 1e-3,
    begin_s: float = 0.0,
    end_s: float | None = None,
    drops: float = 0.0,
    scale: float = 1.0,
) -> Signal:
    """Return the signal of one source, its amplitude `snr` times the noise of a sample.

    It ends 1.5 s after the last packet if it is not said when.
    """
    until_s = sent[-1].end_s + 1.5 if end_s is None else end_s
    times_s = frame_times(rng, begin_s, until_s, fps, drops)
    return signal_of(times_s, scale * shares(times_s, sent, exposure_s), scale / snr, rng, exposure_s)


def any_packet(rng: np.random.Generator, word: int, start_s: float = 1.5, repeats: int = 5) -> Sent:
    """Return a packet of any phase, on a clock up to 1.5 % wrong."""
    return Sent(word, start_s + rng.uniform(0.0, 0.1), rng.uniform(-0.015, 0.015), repeats)


def pieces(signal: Signal, ends: Sequence[int]) -> list[Signal]:
    """Return a signal cut into pieces, each up to one of `ends`, and the rest."""
    cuts = [0, *ends, len(signal.time_s)]
    columns = (signal.time_s, signal.exposure_s, signal.level, signal.sigma_dark, signal.sigma_lit)
    return [
        Signal(signal.robot, signal.track, *(column[a:b] for column in columns)) for a, b in pairwise(cuts)
    ]
