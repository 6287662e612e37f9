"""Scores of whole packets over a lattice of starts and clock rates, as matrix products.

Time is cut in steps of an eighth of a bit. All scores are log-likelihoods over those of a source that is lit
throughout: bits outside a packet then count nothing, and packets anywhere can be compared. Between two edges
of a packet lie bits whose samples are wholly dark or lit; samples near an edge, whose exposure it cuts or may
cut, are scored by the levels on both its sides. Summed over the repeats, eleven dark bits and eleven edges
are all that the score of any word is made of: a row of 44 numbers times one column for each word.
"""

import numpy as np
from numpy.typing import NDArray

from perception.messages.samples import LevelLikelihood, Samples
from perception.messages.settings import DecoderSettings
from perception.messages.uart import FRAME_BITS, frames_of_words

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

STEPS_PER_BIT = 8
_RATES = 11  # clock rates from −drift to +drift: neighbours part by 1.3 steps over a packet
_JITTER = (-1.0 / 3.0, 0.0, 1.0 / 3.0)  # where in its step an edge lies, in steps
_GARBAGE_LEVELS = np.linspace(0.0, 1.0, 5)[:, None]
_ENDED, _BEGUN, _DARK, _RISE, _FALL, _GARBAGE, _SEEN = range(7)
_SUMMED = [_ENDED, _BEGUN, _GARBAGE, _SEEN]
ROWS = 7
_HOPELESS = 6.0


class Clocks:
    """The clock rates that senders may have, and where the edges of their packets lie, in steps.

    `drifts` are shares, shape (r,); `edges` the steps from a packet's start to each edge, shape (r, bits + 1).
    """

    def __init__(self, settings: DecoderSettings) -> None:
        self.step_s = 1.0 / (settings.rate_hz * STEPS_PER_BIT)
        self.drifts = np.linspace(-settings.drift, settings.drift, _RATES if settings.drift > 0.0 else 1)
        bits = np.arange(FRAME_BITS * settings.repeats + 1)
        self.edges: Numbers = np.rint(STEPS_PER_BIT * np.outer(1.0 + self.drifts, bits)).astype(np.int64)
        self.lengths: Numbers = self.edges[:, -1]
        self.longest = int(self.lengths.max())
        self.templates = _templates(settings.words)


def _templates(words: tuple[int, ...]) -> NDArray[np.float32]:
    """Return for each word which of the 44 numbers count, shape (44, words)."""
    bits = frames_of_words()[list(words)].T == 1
    before = np.roll(bits, 1, axis=0)
    return np.concatenate([~bits, ~before & ~bits, ~before & bits, before & ~bits]).astype(np.float32)


def add_samples(
    table: Array, samples: Samples, score: LevelLikelihood, origin_s: float, step_s: float
) -> None:
    """Add samples to a table of shape (7, steps), whose step 0 is at `origin_s`.

    Its rows hold, for an edge at each step: the scores for dark of the samples that end before it and after
    the step before; of those that begin; and of the samples that it may cut, their scores with dark on both
    sides, dark before and lit after, lit before and dark after; the score for being anything, and how many.
    """
    size = table.shape[1]
    lit = score(np.ones(len(samples)))
    dark = score(np.zeros(len(samples))) - lit
    garbage = np.log(np.exp(score(_GARBAGE_LEVELS) - lit).mean(axis=0))
    middle = (samples.time_s - origin_s) / step_s
    half = 0.5 * samples.exposure_s / step_s
    begun = np.floor(middle - half - 0.5).astype(np.int64) + 1  # the first edge that may cut it
    ended = np.ceil(middle + half + 0.5).astype(np.int64)  # the first one after it
    table[_ENDED] += np.bincount(ended, dark, size)[:size]
    table[_BEGUN] += np.bincount(begun, dark, size)[:size]
    table[_GARBAGE] += np.bincount(ended, garbage, size)[:size]
    table[_SEEN] += np.bincount(middle.astype(np.int64), minlength=size)[:size]
    for further in range(int((ended - begun).max(initial=0))):
        edge = begun + further
        cut = edge < ended
        place = np.add.outer(np.array(_JITTER), edge - middle + half) / (2.0 * half)
        before = np.clip(place, 0.0, 1.0)
        fall = np.where(cut, _log_mean(score(before)) - lit, 0.0)
        rise = np.where(cut, _log_mean(score(1.0 - before)) - lit, 0.0)
        table[_DARK] += np.bincount(edge, np.where(cut, dark, 0.0), size)[:size]
        table[_RISE] += np.bincount(edge, rise, size)[:size]
        table[_FALL] += np.bincount(edge, fall, size)[:size]


def moved_on(table: Array, steps: int) -> None:
    """Move a table's window on: its first steps are dropped, as many empty ones follow."""
    open_score = table[_ENDED, :steps].sum() - table[_BEGUN, :steps].sum()
    table[:, :-steps] = table[:, steps:]
    table[:, -steps:] = 0.0
    table[_ENDED, 0] += open_score  # of samples that began before the window and end within it


def _log_mean(logs: Array) -> Array:
    top = logs.max(axis=0)
    return np.asarray(top + np.log(np.exp(logs - top).mean(axis=0)))


class Lattice:
    """Scores of packets by a table of samples, any packet that begins and ends within it."""

    def __init__(self, table: Array, clocks: Clocks) -> None:
        self._clocks = clocks
        self._ended, self._begun, self._garbage, self._seen = np.cumsum(table[_SUMMED], axis=1)
        self._edges = np.stack([table[_DARK], table[_RISE], table[_FALL]], axis=1)
        self._repeats = np.arange(0, clocks.edges.shape[1] - 1, FRAME_BITS)

    def promising(self, starts: Numbers, rate: int) -> NDArray[np.bool_]:
        """Return at which starts the start bits are not plainly lit, the same shape as `starts`."""
        edges = self._clocks.edges[rate]
        begin = starts[:, None] + edges[self._repeats]
        end = starts[:, None] + edges[self._repeats + 1]
        return np.asarray((self._ended[end] - self._begun[begin]).sum(axis=1) > -_HOPELESS)

    def words(self, starts: Numbers, rate: int) -> Array:
        """Return the scores of all words for packets that begin at `starts`, shape (starts, words)."""
        edges = starts[:, None] + self._clocks.edges[rate]
        dark = self._ended[edges[:, 1:]] - self._begun[edges[:, :-1]]
        cut = self._edges[edges[:, :-1]]
        repeats = len(self._repeats)
        row = np.empty((len(starts), 4, FRAME_BITS), np.float32)
        row[:, 0] = dark.reshape(-1, repeats, FRAME_BITS).sum(axis=1)
        row[:, 1:] = cut.reshape(-1, repeats, FRAME_BITS, 3).sum(axis=1).transpose(0, 2, 1)
        return (row.reshape(-1, 4 * FRAME_BITS) @ self._clocks.templates).astype(np.float64)

    def garbage(self, starts: Numbers, rate: int) -> Array:
        """Return the score of a stretch as long as a packet in which anything goes, shape (starts,)."""
        return np.asarray(self._garbage[starts + self._clocks.lengths[rate]] - self._garbage[starts])

    def frames_seen(self, start: int, rate: int) -> NDArray[np.bool_]:
        """Return of which repeats each bit was seen, shape (repeats,)."""
        seen = np.diff(self._seen[start + self._clocks.edges[rate]])
        return np.asarray((seen > 0).reshape(-1, FRAME_BITS).all(axis=1))
