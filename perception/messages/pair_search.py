"""The search for what two sources sent whose light falls in one place.

The levels are none, A₁, A₂ and A₁ + A₂. First one source's packets are scored with the other's light left
open (dark or lit); from each of the best on, the two are read in turn, each given the other, and the
amplitudes fitted, until they stay. What explains the samples best is taken. Where the amplitudes part the
sources, they also say who said which; where they do not, clocks that drift apart still yield both words.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.messages.lattice import STEPS_PER_BIT, Clocks, Lattice
from perception.messages.samples import ROWS, Samples, add_samples, log_likelihood
from perception.messages.settings import DecoderSettings
from perception.messages.uart import FRAME_BITS, encode, frames_of_words, packet_levels

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

_LOOKED_AT = 20000  # best scores of starts, rates and words among which these are found
_TRIED = 10  # packets of each source that are tried as a beginning
_TURNS = 4
_WORTH = 15.0  # log-likelihood over idle that a packet needs
_COARSE = -50.0  # and where it is looked over coarsely
_NEGLIGIBLE = -20.0  # log-likelihood over idle of words that are not counted
_TURNED_OVER = 3  # best pairs of which other words are tried
_OTHERS = 8  # pairs of other words that are tried where two packets lie
_RIVALS = 40.0  # log-likelihood below the best of them
_SHIFTS = (-1.0 / 3.0, 0.0, 1.0 / 3.0)  # of a packet's edges, in steps: they are known to a step
_LATE = np.linspace(-1.0, 1.0, 9)  # steps by which a start is moved, and by how much the drift,
_DRIFTS = np.linspace(-2e-3, 2e-3, 9)  # about the packet's middle
_NEAR = STEPS_PER_BIT  # steps about a packet within which it may be found again in its turn
_SEEN = 0.75  # share of a frame's bits of which there must be samples
_ANY_LEVEL = -np.log(3.0)  # log-density of a sample that any light may have made


@dataclass(frozen=True)
class Packet:
    """A packet as it may have been sent: where it starts, in steps, its clock's drift, its word."""

    start: float
    drift: float
    word: int


Packets = tuple[Packet | None, Packet | None]


@dataclass(frozen=True)
class Pair:
    """What both sources sent (None: nothing), with amplitudes, and how well that explains the samples."""

    packets: Packets
    amplitudes: Array
    score: float
    confidence: tuple[float, float] = (0.0, 0.0)


class PairSearch:
    """The samples of a pair, and the scores of packets by them.

    `course` is how the amplitudes change, relative to their mean, shape (2, n).
    """

    def __init__(
        self, samples: Samples, amplitudes: Array, sigmas: Array, course: Array, settings: DecoderSettings
    ) -> None:
        self._samples, self._settings = samples, settings
        self._amplitudes, self._sigmas, self._course = amplitudes, sigmas, course
        self._clocks = Clocks(settings)
        step_s, margin = self._clocks.step_s, self._clocks.longest + STEPS_PER_BIT
        self._origin_s = float(samples.time_s[0]) - margin * step_s
        self._steps = int((samples.time_s[-1] - self._origin_s) / step_s) + 1
        self._size = self._steps + margin
        self._bits = FRAME_BITS * settings.repeats
        # A packet of which less than a frame is in the signal is none.
        self._first = STEPS_PER_BIT * 11

    def times_s(self, packet: Packet) -> tuple[float, float]:
        """Return when a packet starts, and how long its bits are."""
        bit_s = (1.0 + packet.drift) / self._settings.rate_hz
        return self._origin_s + packet.start * self._clocks.step_s, bit_s

    def frames_seen(self, packet: Packet) -> Indices:
        """Return which of a packet's frames were seen: those with samples in three of four bits."""
        start_s, bit_s = self.times_s(packet)
        bit = np.floor((self._samples.time_s - start_s) / bit_s).astype(np.int64)
        bits = FRAME_BITS * self._settings.repeats
        count = np.bincount(bit[(bit >= 0) & (bit < bits)], minlength=bits)
        return np.flatnonzero((count > 0).reshape(-1, FRAME_BITS).mean(axis=1) >= _SEEN)

    def intrusion(self, pair: Pair, packet: Packet) -> float:
        """Return how much better any levels explain some stretch of samples in a packet than the pair does.

        As `Lattice.intrusion`: the log of a ratio of likelihoods, which chance makes x with e^−x at most.
        """
        gain = _ANY_LEVEL - self._density(pair.amplitudes @ self._both(pair.packets))[self._within(packet)]
        since = np.concatenate([[0.0], np.cumsum(gain)])
        return float((since - np.minimum.accumulate(since)).max())

    def modulation(self, pair: Pair, number: int) -> float:
        """Return by how much a source's packet explains its samples better than no packet does, as a log.

        A source that is lit all the time may be brighter or fainter than predicted, and change: its light is
        then a parabola over the packet, beside that of the other.
        """
        packet = pair.packets[number]
        assert packet is not None
        within = self._within(packet)
        light = pair.amplitudes[:, None] * self._both(pair.packets)
        level, others = light.sum(axis=0), light[1 - number]
        time = self._samples.time_s - self._samples.time_s[within].mean()
        powers = np.stack([np.ones_like(time), time, time**2])[:, within]
        rest = (self._samples.level - others)[within]
        variance = self._variance(level)[within]
        weight = 1.0 / variance
        for _ in range(3):
            factors = np.linalg.lstsq((powers * weight) @ powers.T, (powers * weight) @ rest, rcond=None)[0]
            off = np.abs(rest - factors @ powers)
            weight = (off < np.maximum(4.0 * np.sqrt(variance), np.median(off))) / variance
        steady = level.copy()
        steady[within] = others[within] + factors @ powers
        return float((self._density(level) - self._density(steady)).sum())

    def _within(self, packet: Packet) -> NDArray[np.bool_]:
        """Tell which samples lie in a packet or a bit beside it."""
        start_s, bit_s = self.times_s(packet)
        off = (self._samples.time_s - start_s) / bit_s - 0.5 * self._bits
        return np.abs(off) < 0.5 * self._bits + 1.0

    def best(self) -> Pair | None:
        """Return the pair that explains the samples best; None where nothing was sent."""
        either = np.array([0.0, 1.0, 1.0, 1.0])[:, None] * np.ones(len(self._samples))  # lit more often
        ways: list[Packets] = []
        for number in (0, 1):
            lattice = self._lattice(number, either, self._amplitudes)
            for packet in self._tops(lattice):
                _add_new(ways, self._in_turn(number, packet))
        found = sorted(map(self._settled, ways), key=lambda pair: -pair.score)
        tried = [pair.packets for pair in found]
        for pair in found[:_TURNED_OVER]:
            found += [self._settled(way) for way in self._other_words(pair) if _add_new(tried, way)]
        if not found:
            return None
        best = max(found, key=lambda pair: pair.score)
        first, second = (min(self._share_of_word(best, one), _among(found, best, one)) for one in (0, 1))
        return replace(best, confidence=(first, second))

    def _share_of_word(self, pair: Pair, number: int) -> float:
        """Return the probability of a source's word among all it may have sent, given the other's."""
        lattice = self._lattice(number, self._shifted(pair.packets[1 - number]), pair.amplitudes)
        steps, rates = self._grid(self._starts(), 1)
        total, top, columns = lattice.best_words(steps, rates, np.full(len(steps), _NEGLIGIBLE))
        best, said = int(np.argmax(top)), pair.packets[number]
        if said is None or top[best] < _WORTH:
            return float(said is None and top[best] < _WORTH)
        if self._settings.words[columns[best]] != said.word or abs(steps[best] - said.start) > _NEAR:
            return 0.0
        near = np.abs(steps - steps[best]) <= _NEAR
        word = lattice.word(steps[near], rates[near], int(columns[best]))
        share = np.exp(word - top[best]).sum() / (np.exp(total - top[best]).sum() + np.exp(-top[best]))
        return min(float(share), 1.0)

    def log_odds_of_who(self, pair: Pair) -> float:
        """Return the log-odds of who said which against the other way round, over the amplitudes."""
        shares = self._both(pair.packets)
        level = pair.amplitudes @ shares
        variance = self._variance(level)
        weight = (np.abs(self._samples.level - level) < 6.0 * np.sqrt(variance)) / variance
        swapped = self._both((pair.packets[1], pair.packets[0]))
        return self._evidence(shares, weight) - self._evidence(swapped, weight)

    def _in_turn(self, number: int, packet: Packet) -> Packets:
        """Read the two sources in turn from a packet of one on."""
        packets: list[Packet | None] = [None, None]
        packets[number] = packet
        amplitudes = self._amplitudes
        for turn in range(_TURNS):
            other = 1 - number if turn % 2 == 0 else number
            lattice = self._lattice(other, self._shifted(packets[1 - other]), amplitudes)
            packets[other] = self._read(lattice, packets[other] if turn >= _TURNS // 2 else None)
            amplitudes = self._fitted(packets)
        return packets[0], packets[1]

    def _settled(self, way: Packets) -> Pair:
        """Return two packets with starts, drifts and amplitudes fitted, and how well they explain all."""
        packets = list(way)
        amplitudes = self._fitted(packets)
        for _ in range(2):
            for one in (0, 1):
                packets[one] = self._polished(packets, one, amplitudes)
            amplitudes = self._fitted(packets)
        shares = self._both(packets)
        score = float(self._density(amplitudes @ shares).sum())
        score -= 0.5 * float((((amplitudes - self._amplitudes) / self._sigmas) ** 2).sum())
        return Pair((packets[0], packets[1]), amplitudes, score)

    def _other_words(self, pair: Pair) -> list[Packets]:
        """Return the best other words of two packets as they lie: all pairs at once, by least squares.

        Where the two amplitudes are alike, a bit more of one and a bit less of the other look alike too, and
        no reading in turn finds from one of these pairs to the other.
        """
        first, second = pair.packets
        if first is None or second is None:
            return []
        every = np.ones(len(self._samples))
        weight = 1.0 / self._variance(pair.amplitudes @ self._both(pair.packets))
        both = pair.amplitudes[:, None] * self._course
        # The light that each bit takes away where it is dark, summed over the repeats: shape (11, n) each.
        taken = [
            light * (every - self._lit_but_one(packet))
            for light, packet in zip(both, (first, second), strict=True)
        ]
        less = both.sum(axis=0) - self._samples.level
        dark = 1.0 - frames_of_words()[list(self._settings.words)]
        alone = [dark @ each @ (weight * less) - 0.5 * (dark @ each) ** 2 @ weight for each in taken]
        scores = alone[0][:, None] + alone[1] - dark @ ((taken[0] * weight) @ taken[1].T) @ dark.T
        best = np.argsort(-scores, axis=None)[:_OTHERS]
        words = self._settings.words
        return [
            (replace(first, word=words[row]), replace(second, word=words[column]))
            for row, column in zip(*np.unravel_index(best, scores.shape), strict=True)
            if scores[row, column] > scores.max() - _RIVALS
        ]

    def _polished(self, packets: Sequence[Packet | None], number: int, amplitudes: Array) -> Packet | None:
        """Return a packet with its start and drift between those of the lattice."""
        packet = packets[number]
        if packet is None:
            return None
        own, others = amplitudes[:, None][[number, 1 - number]] * self._course[[number, 1 - number]]
        other = others * self._share(packets[1 - number], 0.0)
        drifts = packet.drift + np.repeat(_DRIFTS, len(_LATE))
        middle = 0.5 * self._clocks.longest * np.repeat(_DRIFTS, len(_LATE))
        starts = packet.start + np.tile(_LATE, len(_DRIFTS)) - middle
        levels = other + own * self._shares(packet.word, starts, drifts)
        best = int(np.argmax(self._density(levels).sum(axis=1)))
        return replace(packet, start=float(starts[best]), drift=float(drifts[best]))

    def _lattice(self, number: int, other: Array, amplitudes: Array) -> Lattice:
        """Return the scores of a source's packets; `other` are the shares that the other may send, (m, n)."""
        table = np.zeros((ROWS, self._size))
        others = amplitudes[1 - number] * other * (self._course[1 - number] / self._course[number])
        one = _in_units(self._samples, self._course[number])
        add_samples(table, one, amplitudes[number], others, self._origin_s, self._clocks.step_s)
        return Lattice(table, self._clocks)

    def _density(self, level: Array) -> Array:
        """Return the log-density of the samples at levels of the sum, shape (..., n)."""
        return log_likelihood(self._samples, level)

    def _tops(self, lattice: Lattice) -> list[Packet]:
        """Return the best packets, of each start and word only the best of its neighbours."""
        steps, rates = self._grid(self._starts()[::2], 2)
        top = lattice.best_words(steps, rates, np.full(len(steps), _WORTH))[1]
        worthy = np.flatnonzero(top > _WORTH)
        steps, rates = steps[worthy], rates[worthy]
        scores = lattice.words(steps, rates)
        tops: list[Packet] = []
        if not scores.size:
            return tops
        best = np.argpartition(-scores, min(_LOOKED_AT, scores.size - 1), axis=None)[:_LOOKED_AT]
        for place in best[np.argsort(-scores.ravel()[best])]:
            row, column = divmod(int(place), scores.shape[1])
            word, start = self._settings.words[column], int(steps[row])
            if len(tops) >= _TRIED or scores[row, column] < _WORTH:
                break
            if all(one.word != word or abs(one.start - start) > _NEAR for one in tops):
                tops.append(Packet(start, float(self._clocks.drifts[rates[row]]), word))
        return tops

    def _starts(self) -> Indices:
        return np.arange(self._first, self._steps - self._first)

    def _grid(self, starts: Indices, every: int) -> tuple[Indices, Indices]:
        """Return starts and rates of all packets that begin at `starts`, on every rate or every second."""
        steps, rates = np.meshgrid(starts, np.arange(0, len(self._clocks.drifts), every))
        return steps.ravel(), rates.ravel()

    def _read(self, lattice: Lattice, about: Packet | None) -> Packet | None:
        """Return the best packet of a source, given the other's: of all, or only near where it was found.

        All are looked over in steps of two, and the best is looked at from near.
        """
        if about is None:
            steps, rates = self._grid(self._starts()[::2], 2)
            top = lattice.best_words(steps, rates, np.full(len(steps), _COARSE))[1]
            centre = float(steps[np.argmax(top)])
        else:
            centre = about.start
        starts = self._starts()
        steps, rates = self._grid(starts[np.abs(starts - centre) <= _NEAR], 1)
        _, top, columns = lattice.best_words(steps, rates, np.full(len(steps), _COARSE))
        best = int(np.argmax(top)) if len(top) else 0
        if not len(top) or top[best] < _WORTH:
            return None
        word = self._settings.words[columns[best]]
        return Packet(float(steps[best]), float(self._clocks.drifts[rates[best]]), word)

    def _fitted(self, packets: Sequence[Packet | None]) -> Array:
        """Return the amplitudes by least squares, with what was known of them; outliers do not count."""
        shares = self._both(packets)
        known: NDArray[np.floating] = self._amplitudes
        for _ in range(2):
            variance = self._variance(known @ shares)
            near = np.abs(self._samples.level - known @ shares) < 4.0 * np.sqrt(variance) + 0.1
            weight = near / variance
            normal = (shares * weight) @ shares.T + np.diag(1.0 / self._sigmas**2)
            side = (shares * weight) @ self._samples.level + self._amplitudes / self._sigmas**2
            known = np.linalg.solve(normal, side)
        return np.asarray(known)

    def _variance(self, level: Array) -> Array:
        one = self._samples
        return np.asarray(one.dark_variance + np.maximum(level, 0.0) * (one.lit_variance - one.dark_variance))

    def _evidence(self, shares: Array, weight: Array) -> float:
        """Return the log-evidence of who sent which share, over the amplitudes (Gaussian)."""
        off = self._samples.level - self._amplitudes @ shares
        normal = (shares * weight) @ shares.T + np.diag(1.0 / self._sigmas**2)
        side = (shares * weight) @ off
        return float(-0.5 * (weight @ off**2 - side @ np.linalg.solve(normal, side)))

    def _shifted(self, packet: Packet | None) -> Array:
        """Return the shares of a packet with its edges a little earlier and later, shape (m, n)."""
        if packet is None:
            return np.ones((1, len(self._samples)))
        return np.stack([self._share(packet, shift) for shift in _SHIFTS])

    def _both(self, packets: Sequence[Packet | None]) -> Array:
        """Return the light of both over their mean amplitudes, shape (2, n)."""
        return self._course * np.stack([self._share(packet, 0.0) for packet in packets])

    def _share(self, packet: Packet | None, shift: float) -> Array:
        if packet is None:
            return np.ones(len(self._samples))
        shares = self._shares(packet.word, np.array([packet.start + shift]), np.array([packet.drift]))
        return np.asarray(shares[0])

    def _lit_but_one(self, packet: Packet) -> Array:
        """Return the shares of exposures that a packet of one dark bit lights, for each bit of a frame."""
        start, drift = np.array([packet.start]), np.array([packet.drift])
        frames = np.tile(1 - np.eye(FRAME_BITS, dtype=np.uint8), self._settings.repeats)
        return np.concatenate([self._lit(bits, start, drift) for bits in frames])

    def _shares(self, word: int, starts: Array, drifts: Array) -> Array:
        """Return the shares of exposures that a word's packets light, shape (k, n), by starts and drifts."""
        return self._lit(encode(word, self._settings.repeats), starts, drifts)

    def _lit(self, bits: NDArray[np.uint8], starts: Array, drifts: Array) -> Array:
        one = self._samples
        bit_s = (1.0 + drifts[:, None]) / self._settings.rate_hz
        start_s = self._origin_s + starts[:, None] * self._clocks.step_s
        begin = (one.time_s - 0.5 * one.exposure_s - start_s) / bit_s
        return packet_levels(begin, one.exposure_s / bit_s, bits, 0.0, 1.0)


def _in_units(samples: Samples, unit: Array) -> Samples:
    """Return samples with their levels in other units, of each sample its own, shape (n,)."""
    dark, lit = samples.dark_variance, samples.lit_variance
    at_unit = dark + unit * (lit - dark)
    return Samples(
        samples.time_s, samples.exposure_s, samples.level / unit, dark / unit**2, at_unit / unit**2
    )


def _add_new(ways: list[Packets], way: Packets) -> bool:
    """Add a pair of packets where none alike is there; return whether it was new."""
    new = not any(all(_alike(*each) for each in zip(way, one, strict=True)) for one in ways)
    if new:
        ways.append(way)
    return new


def _among(found: Sequence[Pair], best: Pair, number: int) -> float:
    """Return the probability of a source's word among all explanations found, whoever of the two sent it."""
    packet = best.packets[number]
    weights = np.exp([pair.score - best.score for pair in found])
    same = [
        any(_alike(packet, other) for other in (pair.packets[number], pair.packets[1 - number]))
        for pair in found
    ]
    return float(weights[same].sum() / weights.sum())


def _alike(one: Packet | None, other: Packet | None) -> bool:
    if one is None or other is None:
        return one is other
    return one.word == other.word and abs(one.start - other.start) <= _NEAR
