"""The maximum-likelihood receiver of one source: whole packets over start, rate and word at once.

Soft values of all repetitions are summed before anything is decided; a vote over repetitions costs 3 dB. Each
start on a fine grid, each rate and each word is a hypothesis, scored when its last bit is in; hypotheses that
explain the same light in another way compete, and a word is only said where its probability is high. So who
joins in the middle of a packet reads no rotated word: rotated readings differ only in what lies before the
first bit and after the last, and where that was not seen the word is refused.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.messages.evidence import (
    Evidence,
    Wire,
    bits_of,
    evidence_of,
    of_anything,
    of_words,
)
from perception.messages.uart import FRAME_BITS, WORDS, aliases, meaning
from perception.types import Message, Signal

Array = NDArray[np.float64]

LEAST_CONFIDENCE = 0.9997
"""A word less probable than this is not said."""

_STEPS_PER_BIT = 10
_RATES = 7
_BLOCK_BITS = 3.0
_FRAME_LOST = 0.02
"""How probable it is that a frame within a packet is nothing of the kind: the source was hidden."""
_LOG_PACKET = math.log(1e-3)
"""How probable it is, as a logarithm, that a packet begins within half a bit."""
_PEAKS = 8
_PRE_BITS, _PRE_EVIDENCE = 3.0, 8.0
_TELLING = 12.0
"""Hypotheses that gain less on the idle source are not looked at."""
_MOST_SCALE = 3.0
_SURE_LEVEL = 0.25


@dataclass(frozen=True, eq=False)
class _Scored:
    """Hypotheses that are complete: starts, the best rate for each word, and how likely; (n,), (n, 128)."""

    start_s: Array
    rate_error: Array
    score: Array

    @staticmethod
    def none() -> "_Scored":
        return _Scored(np.empty(0), np.empty((0, WORDS)), np.empty((0, WORDS)))

    def joined(self, other: "_Scored") -> "_Scored":
        pairs = ((self.start_s, other.start_s), (self.rate_error, other.rate_error), (self.score, other.score))
        return _Scored(*(np.concatenate(pair) for pair in pairs))

    def where(self, kept: NDArray[np.bool_]) -> "_Scored":
        return _Scored(self.start_s[kept], self.rate_error[kept], self.score[kept])


class Decoder:
    """Reads what one source sends, sample by sample; give it those of one track.

    Its memory reaches back a little more than a packet.

    Parameters
    ----------
    wire
        How words are sent.
    least_confidence
        Words less probable are not said.
    """

    def __init__(self, wire: Wire = Wire(), least_confidence: float = LEAST_CONFIDENCE) -> None:  # noqa: B008
        self._wire = wire
        self._least = least_confidence
        self._signal: Signal | None = None
        self._scored = _Scored.none()
        self._next_s = -math.inf
        self._free_from_s = -math.inf
        self._first_s = math.inf
        self._aliased = _words_with_aliases(wire)

    def push(self, signal: Signal) -> tuple[Message, ...]:
        """Take further samples, later than those before; return the messages that are complete.

        Raises
        ------
        ValueError
            Times do not increase.
        """
        self._append(signal)
        return tuple(self._read(final=False))

    def finish(self) -> tuple[Message, ...]:
        """Return what can be said of what was not yet decided, as no more will come."""
        return tuple(self._read(final=True))

    def _append(self, signal: Signal) -> None:
        held = self._signal
        times_s = signal.time_s if held is None else np.concatenate([held.time_s[-1:], signal.time_s])
        if (np.diff(times_s) < 0.0).any():
            raise ValueError("samples must come in the order of time; sort them, or leave late ones out")
        if held is None or held.time_s.size == 0:
            self._signal = signal
        else:
            oldest_s = self._next_s - 2.0 * self._wire.frame_s
            oldest_s = min(oldest_s, self._free_from_s) if math.isfinite(self._free_from_s) else oldest_s
            oldest_s = max(oldest_s, held.time_s[-1] - 2.0 * self._wire.packet_s - 4.0 * self._wire.frame_s)
            kept = held.time_s >= oldest_s
            columns = {
                name: np.concatenate([getattr(held, name)[kept], getattr(signal, name)])
                for name in ("time_s", "exposure_s", "level", "sigma_dark", "sigma_lit")
            }
            self._signal = replace(signal, **columns)
        if signal.time_s.size:
            self._first_s = min(self._first_s, float(signal.time_s[0]))

    def _read(self, final: bool) -> list[Message]:
        signal, wire = self._signal, self._wire
        if signal is None or signal.time_s.size == 0:
            return []
        said: list[Message] = []
        now_s = float(signal.time_s[-1])
        if not math.isfinite(self._next_s):
            self._next_s = self._first_s - wire.packet_s
        longest_s = wire.packet_s * (1.0 + wire.drift)
        # At the end of a recording packets may be cut off by less than a frame.
        last_s = now_s - longest_s + (0.5 * wire.frame_s if final else 0.0)
        if last_s - self._next_s < _BLOCK_BITS * wire.bit_s and not final:
            return said
        evidence = evidence_of(_scaled(signal))
        while self._next_s < last_s:
            until_s = min(self._next_s + wire.frame_s, last_s)
            self._score(evidence, until_s)
            # A long signal given at once is read as it would have been on the way.
            passed_s = until_s + longest_s
            said += self._decided(evidence, math.inf if final and until_s >= last_s else passed_s)
        return said

    def _score(self, evidence: Evidence, until_s: float) -> None:
        """Score the packets that begin from where scoring stands up to a time."""
        wire = self._wire
        step_s = wire.bit_s / _STEPS_PER_BIT
        count = max(math.ceil((until_s - self._next_s) / step_s - 1e-9), 1)
        start_s = self._next_s + step_s * np.arange(count)
        end_s = start_s[-1] + wire.packet_s * (1.0 + wire.drift)
        self._next_s = float(start_s[-1] + step_s)
        horizon_s = self._next_s - wire.packet_s - 2.0 * wire.frame_s
        self._scored = self._scored.where(self._scored.start_s >= horizon_s)
        at = (evidence.edge_s >= start_s[0] - wire.bit_s) & (evidence.edge_s <= end_s + wire.bit_s)
        darkness = -np.minimum(np.diff(evidence.sum[at]), 0.0).sum() if at.sum() > 1 else 0.0
        if darkness < _TELLING:
            return
        rates = np.linspace(-wire.drift, wire.drift, _RATES) * (1.0 - 1.0 / _RATES)
        starts, errors = np.meshgrid(start_s, rates, indexing="ij")
        bits, edges = bits_of(evidence, starts.ravel(), errors.ravel(), wire)
        score = of_words(bits.sum(axis=1), edges.sum(axis=1)).reshape(count, _RATES, WORDS)
        best = score.argmax(axis=1)
        top = np.take_along_axis(score, best[:, None, :], axis=1)[:, 0, :] + wire.log_prior
        self._scored = self._scored.joined(_Scored(start_s, rates[best], top))

    def _decided(self, evidence: Evidence, now_s: float) -> list[Message]:
        """Return the messages that can be told now, and forget what they explain."""
        said = []
        wire = self._wire
        while self._scored.start_s.size:
            free = self._scored.start_s >= self._free_from_s
            self._scored = self._scored.where(free)
            if not self._scored.start_s.size:
                break
            row, word = np.unravel_index(int(self._scored.score.argmax()), self._scored.score.shape)
            if self._scored.score[row, word] + _LOG_PACKET < 0.0:
                break
            start_s = float(self._scored.start_s[row])
            end_s = start_s + wire.packet_s * (1.0 + float(self._scored.rate_error[row, word]))
            sure = not self._aliased[word] and self._is_whole(evidence, int(row), int(word))
            # The next start may gain by a step more; other readings end up to a frame later.
            patience_s = wire.bit_s if sure else wire.frame_s + 2.0 * wire.bit_s
            if now_s < end_s + patience_s:
                break
            message, end_s = self._judged(evidence, start_s)
            if message is not None:
                said.append(message)
            self._free_from_s = max(end_s - 0.3 * wire.bit_s, start_s + 0.5 * wire.bit_s)
        return said

    def _is_whole(self, evidence: Evidence, row: int, word: int) -> bool:
        """Tell whether idle light was seen before a packet, and each of its frames speaks for the word."""
        start_s, rate_error = self._scored.start_s[[row]], self._scored.rate_error[row, [word]]
        before = evidence.between(start_s - np.array([_PRE_BITS * self._wire.bit_s, 0.0]))
        of_frames = of_words(*(part[0] for part in bits_of(evidence, start_s, rate_error, self._wire)))
        return bool(before[0] > _PRE_EVIDENCE and (of_frames[:, word] > _PRE_EVIDENCE).all())

    def _judged(self, evidence: Evidence, start_s: float) -> tuple[Message | None, float]:
        """Weigh the best readings of the light about a start; return what is said, and until when it went."""
        wire = self._wire
        starts, errors, peak = self._fine_grid(start_s)
        bits, edges = bits_of(evidence, starts, errors, wire)
        anything = of_anything(bits)
        sent = np.logaddexp(
            of_words(bits, edges) + math.log1p(-_FRAME_LOST), anything[:, :, None] + math.log(_FRAME_LOST)
        )
        log_word = sent.sum(axis=1) + wire.log_prior + _LOG_PACKET - math.log(len(starts) / (peak.max() + 1))
        other = anything.sum(axis=1) + _LOG_PACKET - math.log(len(starts) / (peak.max() + 1))
        most = max(float(log_word.max()), float(other.max()), 0.0)
        by_word = np.exp(log_word - most).sum(axis=0)
        total = by_word.sum() + np.exp(other - most).sum() + math.exp(-most)
        word = int(by_word.argmax())
        best = int(log_word[:, word].argmax())
        begin_s = float(starts[best])
        end_s = begin_s + wire.packet_s * (1.0 + float(errors[best]))
        confidence = float(by_word[word] / total)
        if confidence < self._least:
            nothing = np.exp(other - most).sum() + math.exp(-most) > 0.5 * total
            return None, (begin_s + wire.bit_s if nothing else end_s)
        of_frames = of_words(bits[best], edges[best])[:, word] - anything[best]
        observed = np.abs(bits[best]).sum(axis=1) > 1.0
        assert self._signal is not None
        return Message(
            robot=self._signal.robot,
            track=self._signal.track,
            start_s=begin_s,
            end_s=end_s,
            word=word,
            command=meaning(word),
            confidence=min(confidence, 1.0),
            frames=int(((of_frames > math.log(_FRAME_LOST)) & observed).sum()),
        ), end_s

    def _fine_grid(self, start_s: float) -> tuple[Array, Array, NDArray[np.int64]]:
        """Return starts and rates around the best readings of the light about a start, and of which each is."""
        wire, scored = self._wire, self._scored
        near = np.abs(scored.start_s - start_s) < wire.frame_s + wire.bit_s
        rows = np.flatnonzero(near)
        best = scored.score[rows].max(axis=1)
        peaks: list[tuple[float, float]] = []
        for k in np.argsort(-best).tolist():
            at_s = float(scored.start_s[rows[k]])
            if all(abs(at_s - other_s) > 0.45 * wire.bit_s for other_s, _ in peaks):
                word = int(scored.score[rows[k]].argmax())
                peaks.append((at_s, float(scored.rate_error[rows[k], word])))
            if len(peaks) == _PEAKS:
                break
        shift_s = wire.bit_s / _STEPS_PER_BIT * np.linspace(-1.5, 1.5, 7)
        turn = wire.drift / _RATES * np.linspace(-1.5, 1.5, 7)
        grid = np.stack(np.meshgrid(shift_s, turn, indexing="ij"), axis=-1).reshape(-1, 2)
        starts = np.concatenate([at_s + grid[:, 0] for at_s, _ in peaks])
        errors = np.concatenate([rate + grid[:, 1] for _, rate in peaks])
        return starts, errors, np.repeat(np.arange(len(peaks)), len(grid))


def decode(signal: Signal, wire: Wire = Wire(), least_confidence: float = LEAST_CONFIDENCE) -> tuple[Message, ...]:  # noqa: B008
    """Return the messages in a whole signal, as a `Decoder` reads them on the way.

    Raises
    ------
    ValueError
        Times do not increase.
    """
    decoder = Decoder(wire, least_confidence)
    return (*decoder.push(signal), *decoder.finish())


def _words_with_aliases(wire: Wire) -> Sequence[bool]:
    """Tell of each word whether it can be read, rotated, as another that is sent."""
    sent = set(range(WORDS) if wire.words is None else wire.words)
    return [any(other in sent for _, other in aliases(word)) for word in range(WORDS)]


def _scaled(signal: Signal) -> Signal:
    """Return the signal with its lit level at 1: range constant and the source's flux are not known better."""
    known = np.isfinite(signal.sigma_lit) & np.isfinite(signal.level)
    clear = known & (signal.sigma_lit < _SURE_LEVEL) & (signal.level > 0.4)
    if clear.sum() < FRAME_BITS:
        return signal
    scale = float(np.clip(np.median(signal.level[clear]), 1.0 / _MOST_SCALE, _MOST_SCALE))
    return replace(
        signal,
        level=signal.level / scale,
        sigma_dark=signal.sigma_dark / scale,
        sigma_lit=signal.sigma_lit / scale,
    )
