"""The decoder on signals made by hand: what is read, what is refused, and nothing wrong."""

from typing import Any

import pytest

from perception.messages.decoder import Decoder, decode
from perception.messages.paper import decode_paper
from perception.messages.settings import DecoderSettings
from perception.messages.uart import COMMANDS, aliases
from perception.types import Signal
from tests.unit.perception.messages.wire import signal
from tests.unit.perception.simulation import random

SAMPLES = ("time_s", "exposure_s", "level", "sigma_dark", "sigma_lit")


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


def test_tracks_that_begin_at_once_do_their_work_in_turn() -> None:
    """All twenty ended their blocks of half a second in the same sample; what is read is the same for each."""
    (word, _, heard), said, most = _sent(2109, 0, 0.1), [], 0
    decoders = [Decoder("", track) for track in range(1, 21)]
    for at in range(len(heard.time_s)):
        one = Signal("", 0, *(getattr(heard, name)[at : at + 1] for name in SAMPLES))
        before = [decoder._done for decoder in decoders]
        said += [message.word for decoder in decoders for message in decoder.push(one)]
        most = max(most, sum(d._done > was for d, was in zip(decoders, before, strict=True)))
    said += [message.word for decoder in decoders for message in decoder.finish()]
    assert said == [word] * 20
    assert most <= 4
