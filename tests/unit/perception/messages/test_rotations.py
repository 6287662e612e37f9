"""How well any receiver can tell a word from its rotations: what no decoder can better.

Told where a packet begins, on what clock, and that it is either the word or the one packet that differs from
it in the fewest bits, a receiver decides by one number: the log-odds, normal about ± d²/2 with the standard
deviation d, d² = (A/σ)² times the samples that differ. What it says only at log-odds beyond T it misses with
Φ((T − d²/2) / d), and gets wrong with Φ(−(T + d²/2) / d).
"""

import math
from collections import Counter
from functools import cache

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm

from perception.messages.decoder import decode
from perception.messages.uart import encode
from tests.unit.perception.messages.signals import Sent, any_packet, heard
from tests.unit.perception.simulation import random

SAMPLES_A_BIT = 3
SURE = math.log(0.999 / 0.001)


@cache
def _nearest() -> tuple[int, ...]:
    """Return of each word in how many bits the nearest other packet differs, idle before and after."""
    lit = np.ones((128, 55 + 24), dtype=bool)
    for word in range(128):
        data = [word >> k & 1 for k in range(7)]
        lit[word, 12:67] = 5 * [0, *data, sum(data) % 2, 1, 1]
        assert lit[word, 12:67].tolist() == [bool(bit) for bit in encode(word)]
    apart = np.stack([(lit[:, None] != np.roll(lit, k, axis=1)).sum(axis=2) for k in range(-11, 12)])
    apart[11][np.diag_indices(128)] = 999
    for shifted in (*apart[:11], *apart[12:]):
        shifted[np.diag_indices(128)] = 999  # the same word a little later is no wrong one
    return tuple(apart.min(axis=(0, 2)).tolist())


def _missed_and_wrong(snr: float, log_odds: float) -> tuple[float, float]:
    """Return the shares of packets, over all words, that such a receiver misses and gets wrong."""
    d = snr * np.sqrt(SAMPLES_A_BIT * np.array(_nearest()))
    missed, wrong = norm.cdf((log_odds - 0.5 * d**2) / d), norm.cdf(-(log_odds + 0.5 * d**2) / d)
    return float(missed.mean()), float(wrong.mean())


def _wrong_where_999_are_received(snr: float) -> float:
    enough = brentq(lambda log_odds: _missed_and_wrong(snr, log_odds)[0] - 1e-3, 0.0, 20.0)
    return _missed_and_wrong(snr, enough)[1]


def test_some_packets_differ_in_two_bits() -> None:
    assert Counter(_nearest()) == {2: 55, 4: 27, 6: 2, 10: 44}


def test_no_receiver_reads_999_in_1000_of_all_words_and_one_in_a_million_wrong() -> None:
    """One T for all words is the best: each then wins as much of the one as it pays of the other."""
    missed, wrong = _missed_and_wrong(3.0, SURE)
    np.testing.assert_allclose([missed, wrong], [1.343e-3, 8.49e-7], rtol=2e-3)
    np.testing.assert_allclose(_wrong_where_999_are_received(3.0), 1.34e-6, rtol=2e-3)
    assert brentq(lambda snr: _wrong_where_999_are_received(snr) - 1e-6, 2.9, 3.3) < 3.03


@pytest.mark.parametrize("begin_s", [0.0, 4.0])
def test_packets_without_idle_between_are_heard_from_the_beginning_alone(begin_s: float) -> None:
    """Word 3 read three bits late is word 96: who joins midway has nothing that tells them apart."""
    rng = random(830, round(begin_s))
    sent = [any_packet(rng, 3)]
    while len(sent) < 4:
        sent.append(Sent(3, sent[-1].end_s, sent[0].drift))
    said = decode(heard(rng, sent, 10.0, begin_s=begin_s, end_s=sent[-1].end_s - 0.5))
    assert [message.word for message in said] == ([3, 3, 3, 3] if begin_s == 0.0 else [])
