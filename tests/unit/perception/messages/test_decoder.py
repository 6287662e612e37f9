"""The decoder on signals made by hand: what is read, what is refused, and nothing wrong."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from perception.messages.decoder import Decoder, decode
from perception.messages.paper import decode_paper
from perception.messages.settings import DecoderSettings
from perception.messages.uart import COMMANDS, aliases
from perception.types import Message, Signal
from tests.unit.perception.messages.wire import signal
from tests.unit.perception.simulation import random


def _sent(case: int, k: int, noise: float, seconds: float = 9.5, **how: Any) -> tuple[int, float, Signal]:
    rng = random(case, k)
    word, start_s = int(rng.integers(128)), 2.0 + rng.uniform(0.0, 0.1)
    drift = rng.uniform(-0.015, 0.015)
    return word, start_s, signal([(start_s, word)], seconds, noise, rng, drift=drift, **how)


@pytest.mark.parametrize(("noise", "how"), [(0.1, {}), (0.2, {"dropped": 0.05}), (0.2, {"fps": 100.0})])
def test_every_word_is_read_where_light_is_plain(noise: float, how: dict[str, Any]) -> None:
    for k in range(12):
        word, start_s, heard = _sent(2100, k, noise, **how)
        (message,) = decode(heard)
        assert (message.word, message.frames) == (word, 5)
        assert message.start_s == pytest.approx(start_s, abs=0.025)
        assert message.confidence > 0.999


def test_faint_light_is_read_or_refused_but_not_wrong() -> None:
    """A/σ 3, where each third bit taken by itself is wrong once in 14."""
    read = alone = 0
    for k in range(40):
        word, _, heard = _sent(2101, k, 1.0 / 3.0)
        said = [message.word for message in decode(heard)]
        assert said in ([], [word])
        if all(other == word for _, other in aliases(word)):
            alone += 1
            read += said == [word]
    assert read == alone > 8


def test_who_joins_inside_a_packet_reads_nothing_wrong() -> None:
    """From any bit of the packet on: the word, if idle behind it settles the phase, or nothing."""
    read = 0
    for k in range(40):
        rng = random(2102, k)
        word, start_s = int(rng.integers(128)), 0.5
        joins_s = start_s + rng.uniform(0.05, 4.3)
        heard = signal([(start_s, word)], 9.0, 0.1, rng, begins_s=joins_s)
        said = [message.word for message in decode(heard)]
        assert said in ([], [word])
        read += bool(said)
    assert read > 20
    # A recording that ends inside the packet as well leaves rotated words apart by nothing.
    for k in range(20):
        rng = random(2103, k)
        word = [word for word in range(128) if any(other != word for _, other in aliases(word))][4 * k]
        inside = signal([(0.0, word)], 5.0, 0.1, rng, begins_s=0.55 + rng.uniform(0.0, 1.1))
        assert {message.word for message in decode(inside)} <= {word}


def test_idle_dark_noise_and_lamps_say_nothing() -> None:
    rng = random(2104)
    idle = signal([], 60.0, 0.2, rng)
    assert decode(idle) == ()
    n = len(idle.time_s)
    assert decode(replace(idle, level=0.2 * rng.normal(size=n))) == ()
    assert decode(replace(idle, level=rng.uniform(0.0, 1.0, n))) == ()
    flicker = 0.75 + 0.25 * np.cos(2.0 * np.pi * 100.0 * idle.time_s) + 0.05 * rng.normal(size=n)
    assert decode(replace(idle, level=flicker)) == ()


def test_what_is_hidden_is_an_erasure() -> None:
    for k in range(12):
        word, start_s, heard = _sent(2105, k, 0.1)
        hidden = (heard.time_s > start_s + 1.5) & (heard.time_s < start_s + 2.4)
        unknown = np.where(hidden, np.inf, heard.sigma_dark)
        level = np.where(hidden, np.nan, heard.level)
        said = decode(replace(heard, level=level, sigma_dark=unknown, sigma_lit=unknown))
        assert [message.word for message in said] == [word]


def test_it_reads_on_the_way_as_it_does_at_once() -> None:
    rng = random(2106)
    heard = signal([(1.5, 8), (8.0, 65), (15.0, 3)], 24.0, 0.15, rng)
    whole = decode(heard)
    assert [message.word for message in whole] == [8, 65, 3]
    decoder = Decoder("r1", 1)
    said: list[Message] = []
    for k in range(0, len(heard.time_s), 5):
        part = {name: getattr(heard, name)[k : k + 5] for name in ("time_s", "exposure_s", "level")}
        said += decoder.push(
            replace(
                heard, **part, sigma_dark=heard.sigma_dark[k : k + 5], sigma_lit=heard.sigma_lit[k : k + 5]
            )
        )
    said += decoder.finish()
    assert [(one.word, round(one.start_s, 2)) for one in said] == [
        (one.word, round(one.start_s, 2)) for one in whole
    ]


def test_a_dictionary_helps() -> None:
    """Commands alone, at A/σ 2: all read, where the dictionary is known."""
    commands = DecoderSettings(words=tuple(range(len(COMMANDS))))
    for k in range(16):
        rng = random(2107, k)
        heard = signal([(2.0, k)], 9.5, 0.5, rng)
        assert [message.word for message in decode(heard, commands)] == [k]


def test_the_papers_decoder_reads_what_is_plain_and_fails_where_light_is_faint() -> None:
    plain = faint = 0
    for k in range(16):
        word, _, heard = _sent(2108, k, 0.02)
        plain += [message.word for message in decode_paper(heard)] == [word]
        word, _, heard = _sent(2108, k, 1.0 / 3.0)
        faint += [message.word for message in decode_paper(heard)] == [word]
    assert plain >= 14
    assert faint <= 8
