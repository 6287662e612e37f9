"""Two sources in one place of the image: both packets, from the sum of their light.

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
from perception.messages.samples import ROWS, Samples, add_samples, log_likelihood, usable_samples
from perception.messages.settings import DecoderSettings
from perception.messages.uart import encode, meaning, packet_levels
from perception.types import Message, Signal

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

WHO_ODDS = 1e3
"""Odds from which it is said who said which."""
_LOOKED_AT = 20000  # best scores of starts, rates and words among which these are found
_TRIED = 10  # packets of each source that are tried as a beginning
_TURNS = 4
_WORTH = 15.0  # log-likelihood over idle that a packet needs
_SHIFTS = (-1.0 / 3.0, 0.0, 1.0 / 3.0)  # of a packet's edges, in steps: they are known to a step
_LATE = np.linspace(-1.0, 1.0, 9)  # steps by which a start is moved, and by how much the drift,
_DRIFTS = np.linspace(-2e-3, 2e-3, 9)  # about the packet's middle
_NEAR = STEPS_PER_BIT  # steps about a packet within which it may be found again in its turn


@dataclass(frozen=True)
class _Packet:
    """A packet as it may have been sent: where it starts, in steps, its clock's drift, its word."""

    start: float
    drift: float
    word: int


@dataclass(frozen=True)
class _Pair:
    """What both sources sent (None: nothing), with amplitudes, and how well that explains the samples."""

    packets: tuple[_Packet | None, _Packet | None]
    amplitudes: Array
    score: float
    confidence: tuple[float, float] = (0.0, 0.0)


def decode_pair(
    signal: Signal,
    amplitudes: tuple[float, float],
    amplitude_sigmas: tuple[float, float],
    tracks: tuple[int, int],
    settings: DecoderSettings | None = None,
) -> tuple[Message, ...]:
    """Return what two sources say whose light falls in one place, at most one packet each.

    Parameters
    ----------
    signal
        Of the sum of both. `sigma_dark` where both are dark, `sigma_lit` at a level of 1.
    amplitudes, amplitude_sigmas
        The levels of each alone, in the units of the signal, and how well they are known: by ranges and
        fluxes before the two merged.
    tracks
        The numbers of their tracks. Where who said which is less than a thousand times as probable as the
        other way round, each message is `ambiguous_with` the other track.
    """
    settings = DecoderSettings() if settings is None else settings
    columns = (signal.time_s, signal.exposure_s, signal.level, signal.sigma_dark, signal.sigma_lit)
    samples = usable_samples(*columns, settings)
    if not len(samples):
        return ()
    reader = _PairReader(samples, np.array(amplitudes), np.array(amplitude_sigmas), settings)
    best = reader.best()
    if best is None:
        return ()
    sure = reader.log_odds_of_who(best) >= np.log(WHO_ODDS)
    messages = []
    for number, packet in enumerate(best.packets):
        if packet is None or best.confidence[number] < settings.confidence:
            continue
        start_s, bit_s = reader.times_s(packet)
        messages.append(
            Message(
                robot=signal.robot,
                track=tracks[number],
                start_s=start_s,
                end_s=start_s + reader.bits * bit_s,
                word=packet.word,
                command=meaning(packet.word),
                confidence=best.confidence[number],
                frames=settings.repeats,
                ambiguous_with=None if sure else tracks[1 - number],
            )
        )
    return tuple(messages)


class _PairReader:
    """The samples of a pair, and the scores of packets by them."""

    def __init__(self, samples: Samples, amplitudes: Array, sigmas: Array, settings: DecoderSettings) -> None:
        self._samples, self._settings = samples, settings
        self._amplitudes, self._sigmas = amplitudes, sigmas
        self._clocks = Clocks(settings)
        self.bits = self._clocks.edges.shape[1] - 1
        step_s, margin = self._clocks.step_s, self._clocks.longest + STEPS_PER_BIT
        self._origin_s = float(samples.time_s[0]) - margin * step_s
        self._steps = int((samples.time_s[-1] - self._origin_s) / step_s) + 1
        self._size = self._steps + margin
        # A packet of which less than a frame is in the signal is none.
        self._first = STEPS_PER_BIT * 11

    def times_s(self, packet: _Packet) -> tuple[float, float]:
        """Return when a packet starts, and how long its bits are."""
        bit_s = (1.0 + packet.drift) / self._settings.rate_hz
        return self._origin_s + packet.start * self._clocks.step_s, bit_s

    def best(self) -> _Pair | None:
        """Return the pair that explains the samples best; None where nothing was sent."""
        either = np.array([0.0, 1.0, 1.0, 1.0])[:, None]  # lit more often than dark
        found: list[_Pair] = []
        for number in (0, 1):
            lattice = self._lattice(number, either, self._amplitudes)
            found += [self._settled(number, packet) for packet in self._tops(lattice)]
        if not found:
            return None
        best = max(found, key=lambda pair: pair.score)
        first, second = (min(self._share_of_word(best, one), _among(found, best, one)) for one in (0, 1))
        return replace(best, confidence=(first, second))

    def _share_of_word(self, pair: _Pair, number: int) -> float:
        """Return the probability of a source's word among all it may have sent, given the other's."""
        lattice = self._lattice(number, self._shifted(pair.packets[1 - number]), pair.amplitudes)
        packet, share = self._read(lattice, None)
        return share if _alike(packet, pair.packets[number]) else 0.0

    def log_odds_of_who(self, pair: _Pair) -> float:
        """Return the log-odds of who said which against the other way round, over the amplitudes."""
        shares = np.stack([self._share(packet, 0.0) for packet in pair.packets])
        level = pair.amplitudes @ shares
        variance = self._variance(level)
        weight = (np.abs(self._samples.level - level) < 6.0 * np.sqrt(variance)) / variance
        return self._evidence(shares, weight) - self._evidence(shares[::-1], weight)

    def _settled(self, number: int, packet: _Packet) -> _Pair:
        """Read the two sources in turn from a packet of one on."""
        packets: list[_Packet | None] = [None, None]
        packets[number] = packet
        amplitudes = self._amplitudes
        for turn in range(_TURNS):
            other = 1 - number if turn % 2 == 0 else number
            given = packets[1 - other]
            lattice = self._lattice(other, self._shifted(given), amplitudes)
            packets[other] = self._read(lattice, packets[other] if turn >= _TURNS // 2 else None)[0]
            amplitudes = self._fitted(packets)
        for _ in range(2):
            for one in (0, 1):
                packets[one] = self._polished(packets, one, amplitudes)
            amplitudes = self._fitted(packets)
        shares = np.stack([self._share(packet, 0.0) for packet in packets])
        score = float(self._density(amplitudes @ shares).sum())
        score -= 0.5 * float((((amplitudes - self._amplitudes) / self._sigmas) ** 2).sum())
        return _Pair((packets[0], packets[1]), amplitudes, score)

    def _polished(self, packets: Sequence[_Packet | None], number: int, amplitudes: Array) -> _Packet | None:
        """Return a packet with its start and drift between those of the lattice."""
        packet = packets[number]
        if packet is None:
            return None
        other = amplitudes[1 - number] * self._share(packets[1 - number], 0.0)
        ways = [
            replace(packet, start=packet.start + late - 0.5 * self._clocks.longest * drift,
                    drift=packet.drift + drift)
            for late in _LATE
            for drift in _DRIFTS
        ]  # fmt: skip
        levels = np.stack([amplitudes[number] * self._share(way, 0.0) + other for way in ways])
        return ways[int(np.argmax(self._density(levels).sum(axis=1)))]

    def _lattice(self, number: int, other: Array, amplitudes: Array) -> Lattice:
        """Return the scores of a source's packets; `other` are the shares that the other may send, (m, n)."""
        table = np.zeros((ROWS, self._size))
        others = amplitudes[1 - number] * np.broadcast_to(other, (len(other), len(self._samples)))
        add_samples(table, self._samples, amplitudes[number], others, self._origin_s, self._clocks.step_s)
        return Lattice(table, self._clocks)

    def _density(self, level: Array) -> Array:
        """Return the log-density of the samples at levels of the sum, shape (..., n)."""
        return log_likelihood(self._samples, level)

    def _scored(self, lattice: Lattice, starts: NDArray[np.int64]) -> tuple[Indices, Indices, Array]:
        """Return starts, rates and word scores of all packets that begin at `starts`."""
        steps, rates = (each.ravel() for each in np.meshgrid(starts, np.arange(len(self._clocks.drifts))))
        floor = np.full(len(steps), -np.inf)
        asked = lattice.best_words(steps, rates, floor)[1] > -np.inf
        steps, rates = steps[asked], rates[asked]
        return steps, rates, lattice.words(steps, rates)

    def _tops(self, lattice: Lattice) -> list[_Packet]:
        """Return the best packets, of each start and word only the best of its neighbours."""
        steps, rates, scores = self._scored(lattice, self._starts())
        tops: list[_Packet] = []
        if not scores.size:
            return tops
        best = np.argpartition(-scores, min(_LOOKED_AT, scores.size - 1), axis=None)[:_LOOKED_AT]
        for place in best[np.argsort(-scores.ravel()[best])]:
            row, column = divmod(int(place), scores.shape[1])
            word, start = self._settings.words[column], int(steps[row])
            if len(tops) >= _TRIED or scores[row, column] < _WORTH:
                break
            if all(one.word != word or abs(one.start - start) > _NEAR for one in tops):
                tops.append(_Packet(start, float(self._clocks.drifts[rates[row]]), word))
        return tops

    def _starts(self) -> NDArray[np.int64]:
        return np.arange(self._first, self._steps - self._first)

    def _read(self, lattice: Lattice, about: _Packet | None) -> tuple[_Packet | None, float]:
        """Return the best packet of a source, given the other's, and its word's probability.

        It is looked for everywhere, or only near where it was found before.
        """
        starts = self._starts()
        if about is not None:
            starts = starts[np.abs(starts - about.start) <= _NEAR]
        steps, rates, scores = self._scored(lattice, starts)
        top = float(scores.max(initial=-np.inf))
        if top < _WORTH:
            return None, 1.0
        row, column = divmod(int(np.argmax(scores)), scores.shape[1])
        near = np.abs(steps - steps[row]) <= _NEAR
        total = np.exp(scores - top).sum() + np.exp(-top)
        share = float(np.exp(scores[near, column] - top).sum() / total)
        word = self._settings.words[column]
        return _Packet(int(steps[row]), float(self._clocks.drifts[rates[row]]), word), min(share, 1.0)

    def _fitted(self, packets: Sequence[_Packet | None]) -> Array:
        """Return the amplitudes by least squares, with what was known of them; outliers do not count."""
        shares = np.stack([self._share(packet, 0.0) for packet in packets])
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

    def _shifted(self, packet: _Packet | None) -> Array:
        """Return the shares of a packet with its edges a little earlier and later, shape (m, n)."""
        if packet is None:
            return np.ones((1, len(self._samples)))
        return np.stack([self._share(packet, shift) for shift in _SHIFTS])

    def _share(self, packet: _Packet | None, shift: float) -> Array:
        if packet is None:
            return np.ones(len(self._samples))
        start_s, bit_s = self.times_s(packet)
        start_s += shift * self._clocks.step_s
        one = self._samples
        begin_s = one.time_s - 0.5 * one.exposure_s
        return packet_levels(
            begin_s, one.exposure_s, encode(packet.word, self._settings.repeats), start_s, bit_s
        )


def _among(found: Sequence[_Pair], best: _Pair, number: int) -> float:
    """Return the probability of a source's word among all explanations found, whoever of the two sent it."""
    packet = best.packets[number]
    weights = np.exp([pair.score - best.score for pair in found])
    same = [
        any(_alike(packet, other) for other in (pair.packets[number], pair.packets[1 - number]))
        for pair in found
    ]
    return float(weights[same].sum() / weights.sum())


def _alike(one: _Packet | None, other: _Packet | None) -> bool:
    if one is None or other is None:
        return one is other
    return one.word == other.word and abs(one.start - other.start) <= _NEAR
