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
from perception.messages.uart import FRAME_BITS, IDLE_BITS, frames_of_words

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

STEPS_PER_BIT = 8
_RATES = 11  # clock rates from −drift to +drift: neighbours part by 1.3 steps over a packet
# Where an edge may lie about its step, in steps, and how probably: the lattice rounds start, rate and edge.
_JITTER = np.array([-0.9, -0.35, 0.0, 0.35, 0.9])
_LOG_JITTER = np.log([0.1, 0.25, 0.3, 0.25, 0.1])
_GARBAGE_LEVELS = np.linspace(0.0, 1.0, 5)[:, None]
_ENDED, _BEGUN, _DARK, _RISE, _FALL, _GARBAGE, _SEEN = range(7)
_SUMMED = [_ENDED, _BEGUN, _GARBAGE, _SEEN]
ROWS = 7
_HOPELESS = 6.0  # log-likelihood for lit against dark that tells
_DARK_BIT = 3.0  # and for dark against lit


class Clocks:
    """The clock rates that senders may have, and where the edges of their packets lie, in steps.

    `drifts` are shares, shape (r,); `edges` the steps from a start to each edge, shape (r, bits + 1).
    """

    def __init__(self, settings: DecoderSettings) -> None:
        self.step_s = 1.0 / (settings.rate_hz * STEPS_PER_BIT)
        self.drifts = np.linspace(-settings.drift, settings.drift, _RATES if settings.drift > 0.0 else 1)
        bits = np.arange(FRAME_BITS * settings.repeats + 1)
        self.edges: Numbers = np.rint(STEPS_PER_BIT * np.outer(1.0 + self.drifts, bits)).astype(np.int64)
        self.lengths: Numbers = self.edges[:, -1]
        self.idle: Numbers = np.ceil(STEPS_PER_BIT * IDLE_BITS * (1.0 + self.drifts)).astype(np.int64)
        self.longest = int(self.lengths.max())
        self.templates = _templates(settings.words)


def _templates(words: tuple[int, ...]) -> NDArray[np.float32]:
    """Return for each word which of the 44 numbers count, shape (44, words)."""
    bits = frames_of_words()[list(words)].T == 1
    before = np.roll(bits, 1, axis=0)
    counts = np.stack([~bits, ~before & ~bits, ~before & bits, before & ~bits], axis=1)
    return counts.reshape(4 * FRAME_BITS, len(words)).astype(np.float32)


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
    begun = np.floor(middle - half - 1.0).astype(np.int64) + 1  # the first edge that may cut it
    ended = np.ceil(middle + half + 1.0).astype(np.int64)  # the first one after it
    table[_ENDED] += np.bincount(ended, dark, size)[:size]
    table[_BEGUN] += np.bincount(begun, dark, size)[:size]
    table[_GARBAGE] += np.bincount(ended, garbage, size)[:size]
    table[_SEEN] += np.bincount(middle.astype(np.int64), minlength=size)[:size]
    for further in range(int((ended - begun).max(initial=0))):
        edge = begun + further
        cut = edge < ended
        place = np.add.outer(_JITTER, edge - middle + half) / (2.0 * half)
        before = np.clip(place, 0.0, 1.0)
        fall = np.where(cut, _over_jitter(score(before)) - lit, 0.0)
        rise = np.where(cut, _over_jitter(score(1.0 - before)) - lit, 0.0)
        table[_DARK] += np.bincount(edge, np.where(cut, dark, 0.0), size)[:size]
        table[_RISE] += np.bincount(edge, rise, size)[:size]
        table[_FALL] += np.bincount(edge, fall, size)[:size]


def moved_on(table: Array, steps: int) -> None:
    """Move a table's window on: its first steps are dropped, as many empty ones follow."""
    open_score = table[_ENDED, :steps].sum() - table[_BEGUN, :steps].sum()
    table[:, :-steps] = table[:, steps:]
    table[:, -steps:] = 0.0
    table[_ENDED, 0] += open_score  # of samples that began before the window and end within it


def _over_jitter(logs: Array) -> Array:
    weighted = logs + _LOG_JITTER[:, None]
    top = weighted.max(axis=0)
    return np.asarray(top + np.log(np.exp(weighted - top).sum(axis=0)))


class Lattice:
    """Scores of packets by a table of samples, any packet that begins and ends within it.

    Packets are given by `starts`, in steps, and `rates`, the number of their clock, shape (n,) each.
    """

    def __init__(self, table: Array, clocks: Clocks) -> None:
        self._clocks = clocks
        self._sums = np.cumsum(table[_SUMMED], axis=1)
        ended, begun, self._garbage, self._seen = self._sums
        edges = [ended, begun, table[_DARK], table[_RISE], table[_FALL]]
        self._by_edge = np.stack(edges, axis=1).astype(np.float32)
        self._repeats = np.arange(0, clocks.edges.shape[1] - 1, FRAME_BITS)

    def promising(self, starts: Numbers, rates: Numbers) -> NDArray[np.bool_]:
        """Return which packets' start bits are not plainly lit, shape (n,)."""
        edges = self._clocks.edges[rates]
        begin = starts[:, None] + edges[:, self._repeats]
        end = starts[:, None] + edges[:, self._repeats + 1]
        return np.asarray((self._sums[0].take(end) - self._sums[1].take(begin)).sum(axis=1) > -_HOPELESS)

    def words(self, starts: Numbers, rates: Numbers) -> NDArray[np.float32]:
        """Return the scores of all words, shape (n, words)."""
        by_edge = self._by_edge.take(starts[:, None] + self._clocks.edges[rates], axis=0)
        shape = (len(starts), len(self._repeats), FRAME_BITS)
        row = by_edge[:, :-1, 1:].reshape(*shape, 4).sum(axis=1)
        row[:, :, 0] = by_edge[:, 1:, 0].reshape(shape).sum(axis=1) - row[:, :, 0]
        return np.asarray(row.reshape(-1, 4 * FRAME_BITS) @ self._clocks.templates)

    def contradiction(self, start: int, rate: int, column: int) -> float:
        """Return by how much another word explains one of a packet's frames better, for the worst of them."""
        by_edge = self._by_edge[start + self._clocks.edges[rate]]
        row = by_edge[:-1, 1:].copy()
        row[:, 0] = by_edge[1:, 0] - row[:, 0]
        words = row.reshape(len(self._repeats), -1) @ self._clocks.templates
        return float((words.max(axis=1) - words[:, column]).max())

    def garbage(self, starts: Numbers, rates: Numbers) -> Array:
        """Return the score of a stretch as long as a packet in which anything goes, shape (n,)."""
        ends = starts + self._clocks.lengths[rates]
        return np.asarray(self._garbage.take(ends) - self._garbage.take(starts))

    def frames_seen(self, start: int, rate: int) -> NDArray[np.bool_]:
        """Return of which repeats each bit was seen, shape (repeats,)."""
        seen = np.diff(self._seen[start + self._clocks.edges[rate]])
        return np.asarray((seen > 0).reshape(-1, FRAME_BITS).all(axis=1))

    def idle_seen(self, start: int, rate: int) -> bool:
        """Return whether the source was plainly lit in the eleven bits before a step, which is no start then.

        No packet holds eleven lit bits. Two of them may have been missed; none may look dark.
        """
        bit = STEPS_PER_BIT * (1.0 + float(self._clocks.drifts[rate]))
        edges = start - np.rint(bit * np.arange(IDLE_BITS + 1)).astype(np.int64)[::-1]
        dark = self._sums[0][edges[1:]] - self._sums[1][edges[:-1]]
        seen = np.diff(self._seen[edges]) > 0
        return bool(seen.sum() >= IDLE_BITS - 2 and dark.max() < _DARK_BIT and dark.sum() < -_HOPELESS)
