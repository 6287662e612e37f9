"""Scores of whole packets over a lattice of starts and clock rates.

Time is cut in steps of an eighth of a bit. All scores are log-likelihoods over those of a source that is lit
throughout: bits outside a packet then count nothing, and packets anywhere can be compared. Between two edges
of a packet lie bits whose samples are wholly dark or lit; samples near an edge, whose exposure it cuts or may
cut, are scored by the levels on both its sides. Summed over the repeats, each of eleven bits has four scores,
by itself and the bit before it: the score of any word is the sum of eleven of these 44.
"""

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.messages.samples import BEGUN, DARK, ENDED, FALL, FOREIGN, GARBAGE, RISE, SEEN
from perception.messages.settings import DecoderSettings
from perception.messages.uart import FRAME_BITS, IDLE_BITS, frames_of_words

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]

STEPS_PER_BIT = 8
_RATES = 11  # clock rates from −drift to +drift: neighbours part by 1.3 steps over a packet
_SUMMED = [ENDED, BEGUN, GARBAGE, FOREIGN, SEEN]
_HOPELESS = 6.0  # log-likelihood for lit against dark that tells
_DARK_BIT = 3.0  # and for dark against lit
_NEGLIGIBLE = 30.0  # log-likelihood below the best from which what is summed does not count


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
        self.ways = _ways(settings.words)


@cache
def clocks_of(settings: DecoderSettings) -> Clocks:
    """Return the clocks of some settings; those of all decoders are the same."""
    return Clocks(settings)


def _ways(words: tuple[int, ...]) -> Numbers:
    """Return for each word which of the 44 scores its bits have, shape (words, 11)."""
    bits = frames_of_words()[list(words)].astype(np.int64)
    return 4 * np.arange(FRAME_BITS) + 2 * np.roll(bits, 1, axis=1) + bits


def moved_on(table: Array, steps: int) -> None:
    """Move a table's window on: its first steps are dropped, as many empty ones follow."""
    open_score = table[ENDED, :steps].sum() - table[BEGUN, :steps].sum()
    table[:, :-steps] = table[:, steps:]
    table[:, -steps:] = 0.0
    table[ENDED, 0] += open_score  # of samples that began before the window and end within it


class Lattice:
    """Scores of packets by a table of samples, any packet that begins and ends within it.

    Packets are given by `starts`, in steps, and `rates`, the number of their clock, shape (n,) each.
    """

    def __init__(self, table: Array, clocks: Clocks) -> None:
        self._clocks = clocks
        self._sums = np.cumsum(table[_SUMMED], axis=1)
        ended, begun, self._garbage, self._foreign, self._seen = self._sums
        self._by_edge = np.ascontiguousarray(np.stack([ended, begun, *table[[DARK, RISE, FALL]]]).T)
        self._repeats = np.arange(0, clocks.edges.shape[1] - 1, FRAME_BITS)

    def best_words(self, starts: Numbers, rates: Numbers, floor: Array) -> tuple[Array, Array, Numbers]:
        """Return the log of the sum over all words, the best word's score, and its column, shape (n,) each.

        Minus infinity where start bits are plainly lit, or no word can reach `floor`.
        """
        return _best_words(self._by_edge, self._clocks.edges, self._clocks.ways, starts, rates, floor)

    def words(self, starts: Numbers, rates: Numbers) -> Array:
        """Return the scores of all words, shape (n, words)."""
        return _words(self._by_edge, self._clocks.edges, self._clocks.ways, starts, rates)

    def word(self, starts: Numbers, rates: Numbers, column: int) -> Array:
        """Return the scores of one word, shape (n,)."""
        one = self._clocks.ways[column : column + 1]
        return _words(self._by_edge, self._clocks.edges, one, starts, rates)[:, 0]

    def contradiction(self, start: int, rate: int, column: int) -> float:
        """Return by how much another word explains one of a packet's frames better, for the worst of them."""
        frames = self._clocks.edges[rate][self._repeats[:, None] + np.arange(FRAME_BITS + 1)]
        every = np.arange(len(frames))
        words = _words(self._by_edge, frames, self._clocks.ways, np.full(len(frames), start), every)
        return float((words.max(axis=1) - words[:, column]).max())

    def intrusion(self, start: int, rate: int, column: int) -> float:
        """Return how much better any levels explain some stretch of a packet's bits than its word does.

        A ratio of likelihoods over the best of n stretches: of a packet that lies undisturbed it exceeds x
        with a probability of less than n exp(−x) (Ville's inequality, from each beginning on).
        """
        ways = self._clocks.ways[column]
        return _intrusion(self._by_edge, self._foreign, self._clocks.edges[rate], ways, start)

    def garbage(self, starts: Numbers, rates: Numbers) -> Array:
        """Return the score of a stretch as long as a packet in which anything goes, shape (n,)."""
        ends = starts + self._clocks.lengths[rates]
        return np.asarray(self._garbage.take(ends) - self._garbage.take(starts))

    def over_anything(self, start: int, rate: int, column: int) -> float:
        """Return how much better a packet's word explains its samples than levels in which anything goes."""
        starts, rates = np.array([start]), np.array([rate])
        return float((self.word(starts, rates, column) - self.garbage(starts, rates))[0])

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


@compiled
def _promising(by_edge: Array, edges: Numbers, start: int, rate: int) -> bool:
    """Return whether a packet's start bits are not plainly lit."""
    dark = 0.0
    for bit in range(0, edges.shape[1] - 1, FRAME_BITS):
        dark += by_edge[start + edges[rate, bit + 1], 0] - by_edge[start + edges[rate, bit], 1]
    return dark > -_HOPELESS


@compiled
def _bits(scores: Array, by_edge: Array, edges: Numbers, start: int, rate: int) -> None:
    """Find the scores of a packet's bits: dark after dark, lit after dark, dark after lit, lit after lit."""
    scores[:] = 0.0
    for bit in range(edges.shape[1] - 1):
        edge, after = start + edges[rate, bit], start + edges[rate, bit + 1]
        dark = by_edge[after, 0] - by_edge[edge, 1]
        place = 4 * (bit % FRAME_BITS)
        scores[place] += dark + by_edge[edge, 2]
        scores[place + 1] += by_edge[edge, 3]
        scores[place + 2] += dark + by_edge[edge, 4]


@compiled
def _limit(scores: Array) -> float:
    """Return the score of the best frame, parity not asked for."""
    dark, lit = scores[2], -np.inf
    for place in range(4, 4 * (FRAME_BITS - 2), 4):
        was = dark
        dark = max(was + scores[place], lit + scores[place + 2])
        lit = max(was + scores[place + 1], lit + scores[place + 3])
    return float(max(dark + scores[4 * (FRAME_BITS - 2) + 1], lit))


@compiled
def _score(scores: Array, ways: Numbers, word: int) -> float:
    total = 0.0
    for bit in range(FRAME_BITS):
        total += scores[ways[word, bit]]
    return total


@compiled
def _words(by_edge: Array, edges: Numbers, ways: Numbers, starts: Numbers, rates: Numbers) -> Array:
    found = np.empty((starts.shape[0], ways.shape[0]))
    scores = np.empty(4 * FRAME_BITS)
    for n in range(starts.shape[0]):
        _bits(scores, by_edge, edges, starts[n], rates[n])
        for word in range(ways.shape[0]):
            found[n, word] = _score(scores, ways, word)
    return found


@compiled
def _intrusion(by_edge: Array, foreign: Array, edges: Numbers, ways: Numbers, start: int) -> float:
    most = since = 0.0
    for bit in range(edges.shape[0] - 1):
        edge, after = start + edges[bit], start + edges[bit + 1]
        way = ways[bit % FRAME_BITS] % 4  # twice the bit before, and the bit
        score = 0.0
        if way % 2 == 0:
            score = by_edge[after, 0] - by_edge[edge, 1]
        if way < 3:
            score += by_edge[edge, 2 + way]
        since = max(since + foreign[after] - foreign[edge] - score, 0.0)
        most = max(most, since)
    return most


@compiled
def _best_words(
    by_edge: Array, edges: Numbers, ways: Numbers, starts: Numbers, rates: Numbers, floor: Array
) -> tuple[Array, Array, Numbers]:
    total, top = np.full(starts.shape[0], -np.inf), np.full(starts.shape[0], -np.inf)
    column = np.zeros(starts.shape[0], np.int64)
    scores, words = np.empty(4 * FRAME_BITS), np.empty(ways.shape[0])
    for n in range(starts.shape[0]):
        if not _promising(by_edge, edges, starts[n], rates[n]):
            continue
        _bits(scores, by_edge, edges, starts[n], rates[n])
        if _limit(scores) < floor[n]:
            continue
        for word in range(ways.shape[0]):
            words[word] = _score(scores, ways, word)
            if words[word] > top[n]:
                top[n], column[n] = words[word], word
        weight = 0.0
        for word in range(ways.shape[0]):
            if words[word] > top[n] - _NEGLIGIBLE:
                weight += math.exp(words[word] - top[n])
        total[n] = top[n] + math.log(weight)
    return total, top, column
