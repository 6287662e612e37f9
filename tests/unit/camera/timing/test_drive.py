"""Means of drives over stretches of time against exact rational arithmetic, and by hand at the edges."""

import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from nir_render.camera.timing.drive import drive_of, mean_level
from nir_render.scene.documents.ambient.sun import Sun
from nir_render.scene.documents.times.drives import Drive
from perception.messages.uart import encode

BITS = {"pattern": "0101101111", "rate": "10 Hz", "start": "50 ms"}
DRIVES: list[dict[str, Any]] = [
    {"square": {"frequency": "1 kHz", "duty": 0.3, "phase": "0.13 ms"}},
    {"square": {"frequency": "7.3 Hz", "duty": 0.85}},
    {"square": {"frequency": "120 Hz", "duty": 1}},
    {"square": {"frequency": "50 kHz", "duty": 0}},
    {"bits": BITS},
    {"bits": {**BITS, "idle": 0.25, "repeat": 3}},
    {"bits": {"pattern": "00101", "rate": "997 Hz", "repeat": "forever", "idle": 0}},
    {"packets": {"sends": [{"at": "-0.4 s", "text": "a~"}], "rate": "80 Hz"}},
    {
        "packets": {
            "sends": [{"at": "2 s", "command": "hold"}, {"at": "0 s", "word": 77}],
            "rate": "30 Hz",
            "offset": "13 ms",
            "drift": "-1.3 %",
        }
    },
]


def _exactly(drive: Drive, time: Fraction) -> Fraction:
    """Return the integral of a drive from a common beginning to a time, in rational numbers."""
    if drive.square is not None:
        square = drive.square
        frequency, duty = Fraction(square.frequency_hz), Fraction(square.duty)
        periods = (time - Fraction(square.phase_s)) * frequency
        return (math.floor(periods) * duty + min(periods - math.floor(periods), duty)) / frequency
    if drive.packets is not None:
        dark, bit = Fraction(0), Fraction(drive.packets.bit_s)
        for start_s, word in drive.packets.starts_s:
            for number, lit in enumerate(encode(word)):
                place = (time - Fraction(start_s)) / bit - number
                dark += 0 if lit else min(max(place, Fraction(0)), Fraction(1)) * bit
        return time - dark
    assert drive.bits is not None
    bits, levels = drive.bits, [int(bit) for bit in drive.bits.pattern]
    rate, idle = Fraction(bits.rate_hz), Fraction(bits.idle)
    place = (time - Fraction(bits.start_s)) * rate
    if place < 0:
        return idle * place / rate
    end = place if bits.repeat == "forever" else Fraction(len(levels) * bits.repeat)
    within = min(place, end)
    repeats, number = divmod(math.floor(within), len(levels))
    sent = repeats * sum(levels) + sum(levels[:number]) + levels[number] * (within - math.floor(within))
    return (sent + idle * (place - within)) / rate


@pytest.mark.parametrize("document", DRIVES)
def test_means_are_exact(document: dict[str, Any]) -> None:
    """Stretches of 10 µs to 1 s from −1 s to 4 s: to 1e-12, or the rounding of a time of 4 s, 1e-15 s."""
    drive = Drive.model_validate(document)
    random = np.random.default_rng(5)
    start_s, duration_s = random.uniform(-1.0, 4.0, 1000), 10.0 ** random.uniform(-5.0, 0.0, 1000)
    exact = [
        float((_exactly(drive, Fraction(a) + Fraction(n)) - _exactly(drive, Fraction(a))) / Fraction(n))
        for a, n in zip(start_s, duration_s, strict=True)
    ]
    off = np.abs(mean_level(drive, start_s, duration_s) - exact)
    assert (off <= np.maximum(1e-12, 1e-15 / duration_s)).all(), off.max()
    assert np.std(exact) > 0.1 or document["square"].get("duty") in (0, 1)


@pytest.mark.parametrize("document", DRIVES)
def test_a_stretch_without_edges_has_its_level_to_the_bit(document: dict[str, Any]) -> None:
    """Stretches of 1 µs, of which at most one in 20 can hold an edge (of the square wave at 50 kHz)."""
    drive = Drive.model_validate(document)
    levels = mean_level(drive, np.linspace(-0.5, 2.5, 3001) + 1.234567e-5, 1e-6)
    whole = {0.0, 1.0} | ({0.25} if document.get("bits", {}).get("idle") == 0.25 else set())
    assert np.isin(levels, list(whole)).mean() > 0.95


def test_a_square_wave_by_hand() -> None:
    """100 Hz, a quarter on, from 2 ms on: on 2 to 4.5 ms, 12 to 14.5 ms, …"""
    drive = Drive.model_validate({"square": {"frequency": "100 Hz", "duty": 0.25, "phase": "2 ms"}})
    start_s = np.array([0.0, 2e-3, 4e-3, 1e-3, -8e-3, 3e-3, 4.5e-3])
    duration_s = np.array([1e-3, 1e-3, 1e-3, 2e-3, 10e-3, 25e-3, 7.5e-3])
    by_hand = [0.0, 1.0, 0.5, 0.5, 0.25, (1.5 + 2.5 + 2.5) / 25.0, 0.0]
    np.testing.assert_allclose(mean_level(drive, start_s, duration_s), by_hand, atol=1e-12)


def test_bits_by_hand() -> None:
    """101 twice at 10 Hz from 1 s on, half lit when idle: edges at 1.0, 1.1, 1.2, 1.4, 1.5 and 1.6 s."""
    drive = Drive.model_validate(
        {"bits": {"pattern": "101", "rate": "10 Hz", "start": "1 s", "repeat": 2, "idle": 0.5}}
    )
    start_s = np.array([0.0, 0.9, 1.0, 1.05, 1.1, 1.2, 1.0, 1.58, 9.0, 0.0])
    duration_s = np.array([0.5, 0.2, 0.1, 0.1, 0.1, 0.2, 0.6, 0.04, 1.0, 2.0])
    by_hand = [0.5, 0.75, 1.0, 0.5, 0.0, 1.0, 2.0 / 3.0, 0.75, 0.5, (0.5 + 0.4 + 0.2) / 2.0]
    np.testing.assert_allclose(mean_level(drive, start_s, duration_s), by_hand, atol=1e-12)


def test_a_packet_by_hand() -> None:
    """`turn_left`, word 7, 0 1110000 1 11, from 1 s on at 10 Hz: dark in the bits 0, 4 to 7, then 11 again."""
    sends = [{"at": "1 s", "command": "turn_left"}]
    drive = Drive.model_validate({"packets": {"sends": sends}})
    start_s = np.array([0.9, 1.0, 1.05, 1.35, 1.75, 2.05, 1.0, 0.0, 6.45, -3.0])
    duration_s = np.array([0.1, 0.1, 0.1, 0.2, 0.1, 0.1, 1.1, 7.0, 0.1, 0.5])
    by_hand = [1.0, 0.0, 0.5, 0.25, 0.5, 0.5, 6.0 / 11.0, (7.0 - 2.5) / 7.0, 1.0, 1.0]
    np.testing.assert_allclose(mean_level(drive, start_s, duration_s), by_hand, atol=1e-12)


@pytest.mark.parametrize("document", [*DRIVES, {"constant": 0.3}])
def test_no_time_at_all_has_the_level_there(document: dict[str, Any]) -> None:
    drive = Drive.model_validate(document)
    start_s = np.linspace(-0.2, 2.0, 45) + 1e-4
    np.testing.assert_array_equal(mean_level(drive, start_s, 0.0), mean_level(drive, start_s, 1e-9))


def test_constant_drives_and_the_sun() -> None:
    assert (mean_level(Drive(constant=0.3), np.zeros((2, 3)), 0.1) == 0.3).all()
    sun = Sun.model_validate({"azimuth": "0 deg", "elevation": "40 deg", "irradiance": "0.3 W/m^2/nm"})
    assert drive_of(sun).constant == 1.0
