"""Another's light in a signal: found where it is, and not where a source merely blinks or fades."""

import numpy as np
import pytest

from perception.messages.foreign import foreign_light
from perception.messages.settings import DecoderSettings
from perception.types import Signal
from tests.unit.perception.messages.signals import any_packet, frame_times, heard, shares, signal_of
from tests.unit.perception.simulation import random


def _touched(signal: Signal) -> np.ndarray:
    columns = (signal.time_s, signal.exposure_s, signal.level, signal.sigma_dark, signal.sigma_lit)
    return foreign_light(np.array(columns), 1.0, DecoderSettings())


@pytest.mark.parametrize(("snr", "exposure_s"), [(3.0, 1e-3), (5.0, 0.02), (10.0, 1e-3), (50.0, 0.01)])
def test_one_sender_alone_is_alone(snr: float, exposure_s: float) -> None:
    """Of 40 packets, 12 000 samples, edges within exposures among them, hardly any is thought touched."""
    rng = random(830, round(snr))
    signals = [heard(rng, [any_packet(rng, 3 * n)], snr, exposure_s=exposure_s) for n in range(40)]
    assert sum(_touched(signal).sum() for signal in signals) < 12


@pytest.mark.parametrize("ratio", [0.5, 1.0, 1.7])
def test_light_beside_it_is_found_where_it_is(ratio: float) -> None:
    """For 1.5 s, lit: of its samples that stand upon dark bits, too, all but few; far from it none."""
    rng = random(831, round(10 * ratio))
    missed = 0
    for n in range(20):
        sent = any_packet(rng, 6 * n)
        times_s = frame_times(rng, 0.0, sent.end_s + 1.5, 30.0, 0.0)
        there = np.abs(times_s - 4.0) < 0.75
        touched = _touched(signal_of(times_s, shares(times_s, [sent], 1e-3) + ratio * there, 0.1, rng))
        missed += int((there & ~touched).sum())
        assert not touched[np.abs(times_s - 4.0) > 2.5].any()
    assert missed < 0.01 * 20 * 45


def test_no_samples() -> None:
    rng = random(832)
    assert _touched(signal_of(np.empty(0), np.empty(0), 0.1, rng)).shape == (0,)
