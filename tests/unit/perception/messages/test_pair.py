"""Two sources in one pixel: four levels, two clocks, both words."""

import numpy as np
import pytest

from perception.messages.pair import decode_pair
from perception.types import Signal
from tests.unit.perception.messages.signals import Sent, frame_times, shares, signal_of
from tests.unit.perception.messages.wire import EXPOSURE_S, lit
from tests.unit.perception.simulation import random


def _both(case: int, k: int, ratio: float) -> tuple[list[int], Signal]:
    """Return the words, and the sum of two that start within a packet of each other; σ is an eighth of the
    fainter one's amplitude."""
    rng = random(case, k)
    words = rng.integers(128, size=2).tolist()
    starts_s = 1.5 + rng.uniform(0.0, 5.5, 2)
    time_s = np.arange(0.01, 15.0, 1.0 / 30.0)
    sigma = np.full(len(time_s), ratio / 8.0)
    level = lit([(starts_s[0], words[0])], time_s, -0.0025)
    level = (
        level + ratio * lit([(starts_s[1], words[1])], time_s, 0.0025) + sigma * rng.normal(size=len(time_s))
    )
    return words, Signal("r1", 1, time_s, np.full(len(time_s), EXPOSURE_S), level, sigma, sigma)


@pytest.mark.parametrize("ratio", [pytest.param(0.98, marks=pytest.mark.verify), 0.5])
def test_both_words_are_read_and_who_said_which_where_it_can_be_told(ratio: float) -> None:
    read = 0
    for k in range(10):
        words, heard = _both(2200 + round(100 * ratio), k, ratio)
        said = decode_pair(heard, (1.0, ratio), (0.05, 0.05 * ratio), (1, 2))
        by_track = {one.track: one for one in said}
        right = sorted(one.word for one in said) == sorted(words)
        read += right
        assert {one.word for one in said} <= set(words)
        if right and all(one.ambiguous_with is None for one in said):
            assert [by_track[track].word for track in (1, 2)] == words
        if ratio == 0.98:
            assert all(one.ambiguous_with is not None for one in said) or words[0] == words[1]
    assert read >= 9


def _sum(sent: tuple[Sent | None, Sent | None], ratio: float, seed: int) -> Signal:
    rng = random(840, seed)
    times_s = frame_times(rng, 0.0, 15.0, 30.0, 0.0)
    lit = [shares(times_s, [] if one is None else [one], 1e-3) for one in sent]
    return signal_of(times_s, lit[0] + ratio * lit[1], ratio / 8.0, rng)


def test_one_of_two_sends() -> None:
    (message,) = decode_pair(_sum((None, Sent(19, 3.0)), 0.5, 1), (1.0, 0.5), (0.05, 0.025), (1, 2))
    assert (message.word, message.track, message.ambiguous_with) == (19, 2, None)


def test_two_that_send_nothing_say_nothing() -> None:
    assert decode_pair(_sum((None, None), 0.5, 2), (1.0, 0.5), (0.05, 0.025), (1, 2)) == ()
    empty = Signal("r1", 1, *np.empty((5, 0)))
    assert decode_pair(empty, (1.0, 0.5), (0.05, 0.025), (1, 2)) == ()
