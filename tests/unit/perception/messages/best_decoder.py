"""The best that can be done with a packet: what the decoder is held to.

The probability of each word, summed over starts and clock rates on a grid so fine that a finer one changes
nothing, by the exact levels and the true noise. Neither lattice nor outliers, and nothing shared with the
decoder but the frames of the words.
"""

import math

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.messages.uart import FRAME_BITS, frames_of_words
from perception.types import Signal
from tests.unit.perception.messages.signals import Sent

Array = NDArray[np.float64]

_STARTS = np.linspace(-0.5, 0.5, 25)  # bits about the true start
_DRIFTS = np.linspace(-0.015, 0.015, 31)


def best_word(signal: Signal, sent: Sent, *, told: bool = False) -> int:
    """Return the most probable word of a packet that starts within half a bit of the true start.

    `told`: at the true start, on the true clock; which frames are missing the signal's times tell anyhow.
    """
    starts_s = np.array([sent.start_s]) if told else sent.start_s + 0.1 * _STARTS
    drifts = np.array([sent.drift]) if told else _DRIFTS
    scores = _scores(
        signal.time_s, signal.exposure_s, signal.level, signal.sigma_lit, starts_s, drifts,
        frames_of_words().astype(np.int64), sent.repeats,
    )  # fmt: skip
    top = scores.max()
    return int(np.argmax(np.exp(scores - top).sum(axis=0)))


@compiled
def _scores(
    time_s: Array, exposure_s: Array, level: Array, sigma: Array, starts_s: Array, drifts: Array,
    frames: NDArray[np.int64], repeats: int,
) -> Array:  # fmt: skip
    """Return the log-likelihoods of all words over a lit source's, shape (starts · drifts, words)."""
    found = np.empty((starts_s.shape[0] * drifts.shape[0], frames.shape[0]))
    pair = np.empty(
        (FRAME_BITS, 4)
    )  # of a bit and the one before it: both dark, dark lit, lit dark, both lit
    row = 0
    for start_s in starts_s:
        for drift in drifts:
            bit_s = 0.1 * (1.0 + drift)
            pair[:] = 0.0
            for n in range(time_s.shape[0]):
                begin = (time_s[n] - 0.5 * exposure_s[n] - start_s) / bit_s
                end = (time_s[n] + 0.5 * exposure_s[n] - start_s) / bit_s
                last = math.floor(end)
                if end <= 0.0 or begin >= FRAME_BITS * repeats:
                    continue
                before = min(max((last - begin) / (end - begin), 0.0), 1.0)  # the share of the bit before
                place = last % FRAME_BITS
                lit = (level[n] - 1.0) ** 2
                for way in range(4):
                    was, now = way // 2, way % 2
                    if last <= 0:
                        was = 1
                    if last >= FRAME_BITS * repeats:
                        now = 1
                    share = before * was + (1.0 - before) * now
                    pair[place, way] += 0.5 * (lit - (level[n] - share) ** 2) / sigma[n] ** 2
            for word in range(frames.shape[0]):
                total = 0.0
                for place in range(FRAME_BITS):
                    was = frames[word, place - 1]  # before the start bit a stop bit, or idle: both lit
                    total += pair[place, 2 * was + frames[word, place]]
                found[row, word] = total
            row += 1
    return found
