"""What a signal says of when a packet was sent and which word it was: log likelihoods over time and words.

All hypotheses are held against a source that is idle, that is lit throughout. A sample speaks for light by

λ = ln p(y | lit) − ln p(y | dark),

so a packet is as likely, beside the idle source, as e to the power of minus the sum of λ over its dark bits.
The bits' sums come from the running integral of λ, spread over each exposure: an edge within an exposure
shares it out. A share f of light is then short of the exact likelihood by ½ f (1 − f) / σ², which is added at
each edge. Whole words over start and rate at once reach a bit error of 10⁻³ at an amplitude of 3.2 σ a sample
where deciding bit by bit needs 6 (PHYSICS of the language: docs/tracking.md).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.messages.uart import FRAME_BITS, RATE_HZ, REPEATS, WORDS, frames
from perception.types import Signal

Array = NDArray[np.float64]

MOST_EVIDENCE = 12.0
"""No sample speaks more clearly than this: something may have passed before it."""


@dataclass(frozen=True)
class Wire:
    """How words are sent, and how well the sender's clock goes.

    Attributes
    ----------
    rate_hz
        Bits per second.
    repeats
        Frames in a packet.
    drift
        The most by which a sender's rate is off, relatively, beside the receiver's clock.
    words
        The words that are ever sent; None for all 128.
    """

    rate_hz: float = RATE_HZ
    repeats: int = REPEATS
    drift: float = 0.015
    words: tuple[int, ...] | None = None

    @property
    def bit_s(self) -> float:
        """How long a bit lasts."""
        return 1.0 / self.rate_hz

    @property
    def frame_s(self) -> float:
        """How long a frame lasts."""
        return FRAME_BITS * self.bit_s

    @property
    def packet_s(self) -> float:
        """How long a packet lasts."""
        return self.repeats * self.frame_s

    @property
    def log_prior(self) -> Array:
        """Logarithm of each word's probability, shape (128,)."""
        prior = np.full(WORDS, -np.inf)
        words = range(WORDS) if self.words is None else self.words
        prior[list(words)] = -np.log(len(words))
        return prior


@dataclass(frozen=True, eq=False)
class Evidence:
    """Running integrals over the samples of a signal.

    `edge_s`, shape (2n,), are the beginnings and ends of exposures, `sum`, shape (2n,), is Σ λ up to there;
    `inverse_variance`, shape (n,), is 1/σ² of each sample.
    """

    edge_s: Array
    sum: Array
    inverse_variance: Array

    def between(self, edges_s: Array) -> Array:
        """Return Σ λ between consecutive times, shape (..., k) → (..., k − 1)."""
        if self.sum.size == 0:
            return np.zeros((*edges_s.shape[:-1], edges_s.shape[-1] - 1))
        return np.asarray(np.diff(np.interp(edges_s, self.edge_s, self.sum)))

    def at_edges(self, edges_s: Array) -> Array:
        """Return ½ f (1 − f) / σ², where a change of light falls into an exposure, 0 elsewhere."""
        if self.sum.size == 0:
            return np.zeros(edges_s.shape)
        before = np.searchsorted(self.edge_s, edges_s)
        inside = before % 2 == 1
        sample = np.minimum(before // 2, len(self.inverse_variance) - 1)
        begin, end = self.edge_s[2 * sample], self.edge_s[2 * sample + 1]
        share = np.clip((edges_s - begin) / np.maximum(end - begin, 1e-12), 0.0, 1.0)
        return np.where(inside, 0.5 * share * (1.0 - share) * self.inverse_variance[sample], 0.0)


def evidence_of(signal: Signal) -> Evidence:
    """Return what the samples of a signal say; those without a finite σ say nothing."""
    known = np.isfinite(signal.sigma_dark) & np.isfinite(signal.sigma_lit) & np.isfinite(signal.level)
    level, dark, lit = signal.level[known], signal.sigma_dark[known], signal.sigma_lit[known]
    favour = 0.5 * (level / dark) ** 2 - 0.5 * ((level - 1.0) / lit) ** 2 - np.log(lit / dark)
    favour = np.clip(favour, -MOST_EVIDENCE, MOST_EVIDENCE)
    half_s = 0.5 * signal.exposure_s[known]
    middle_s = signal.time_s[known]
    # Two cameras may look at once: what overlaps is laid end to end, at the cost of a fraction of an exposure.
    begin_s = middle_s - half_s
    end_s = np.maximum(middle_s + half_s, begin_s + 1e-9)
    begin_s[1:] = np.maximum(begin_s[1:], np.minimum(end_s[:-1], middle_s[1:]))
    end_s = np.maximum(end_s, begin_s + 1e-9)
    edge_s = np.column_stack([begin_s, end_s]).ravel()
    total = np.cumsum(favour)
    running = np.column_stack([total - favour, total]).ravel()
    return Evidence(np.maximum.accumulate(edge_s), running, np.minimum(1.0 / (dark * lit), 2.0 * MOST_EVIDENCE))


def bits_of(evidence: Evidence, start_s: Array, rate_error: Array, wire: Wire) -> tuple[Array, Array]:
    """Return the evidence for light in each bit of packets, and what edges add.

    Parameters
    ----------
    start_s, rate_error
        When a packet begins, and by how much longer its bits are than those of `wire`, relatively; shape (g,).

    Returns
    -------
    Σ λ of each bit, shape (g, repeats, 11), and the addition where a bit differs from the one before it,
    shape (g, repeats, 11).
    """
    number = np.arange(wire.repeats * FRAME_BITS + 1)
    edges_s = start_s[:, None] + wire.bit_s * (1.0 + rate_error[:, None]) * number
    shape = (len(start_s), wire.repeats, FRAME_BITS)
    return evidence.between(edges_s).reshape(shape), evidence.at_edges(edges_s[:, :-1]).reshape(shape)


def of_words(bits: Array, edges: Array) -> Array:
    """Return how likely each word is beside an idle source, as a logarithm, shape (..., 11) → (..., 128)."""
    sent = frames().astype(np.float64)
    changed = sent != np.roll(sent, 1, axis=1)
    return np.asarray(-bits @ (1.0 - sent).T + edges @ changed.T.astype(np.float64))


def of_anything(bits: Array) -> Array:
    """Return how likely bits of any kind are beside an idle source, ln ∏ ½ (1 + e^−λ), (..., 11) → (...)."""
    return np.asarray((np.logaddexp(0.0, -bits) - np.log(2.0)).sum(axis=-1))
