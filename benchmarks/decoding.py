"""How well messages are read, and how fast: one JSON object. A minute or two; with `--full` about an hour.

Amplitude over noise is that of one sample, at 30 FPS and 10 Hz: three samples a bit.
"""

import argparse
import json
import sys
import time
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

sys.path.insert(0, str(Path(__file__).parents[1]))

import perception
from perception.messages.decoder import Decoder, decode
from perception.messages.lattice import Clocks, Lattice
from perception.messages.pair import decode_pair
from perception.messages.paper import decode_paper
from perception.messages.samples import ROWS, add_samples, usable_samples
from perception.messages.settings import DecoderSettings
from perception.messages.uart import encode, packet_levels
from perception.types import Signal
from tests.unit.perception.messages.best_decoder import best_word
from tests.unit.perception.messages.signals import (
    Sent,
    any_packet,
    frame_times,
    heard,
    shares,
    signal_of,
)
from tests.unit.perception.simulation import random

THEORY = {1: 3.18, 5: 1.40}
"""A/σ for 10⁻³ of payload bits, whole words, phase and drift unknown (docs/physics.md, Optical language)."""
WHERE = {1: (2.8, 3.0, 3.18), 5: (1.2, 1.3, 1.4)}


def most_likely(signal: Signal, sent: Sent, settings: DecoderSettings) -> int:
    """Return the word of the most likely packet that starts within half a bit of the true start."""
    clocks = Clocks(settings)
    columns = (signal.time_s, signal.exposure_s, signal.level, signal.sigma_dark, signal.sigma_lit)
    samples = usable_samples(*columns, settings)
    origin_s = float(samples.time_s[0]) - 10 * clocks.step_s
    size = int((samples.time_s[-1] - origin_s) / clocks.step_s) + clocks.longest + 20
    table = np.zeros((ROWS, size))
    add_samples(table, samples, 1.0, np.zeros((1, len(samples))), origin_s, clocks.step_s)
    start = (sent.start_s - origin_s) / clocks.step_s
    steps = np.arange(np.ceil(start - 4), np.floor(start + 4) + 1).astype(int)
    starts, numbers = (each.ravel() for each in np.meshgrid(steps, np.arange(len(clocks.drifts))))
    words = Lattice(table, clocks).words(starts, numbers).astype(float)
    return int(np.argmax(np.log(np.exp(words - words.max()).sum(axis=0))))


def wrong_bits(word: int, read: int) -> int:
    """Return how many payload bits of a word are read wrong."""
    return (word ^ read).bit_count()


def error_rates(runs: int) -> dict[str, Any]:
    """Payload bits wrong where something must be said, beside the best possible; the paper's decoder."""
    found: dict[str, Any] = {}
    for repeats, where in WHERE.items():
        found[f"{repeats} frames"] = {
            "theory_snr_at_1e-3": THEORY[repeats],
            **beside_best(where, runs, repeats),
        }
    rows = {}
    for snr in (1.9, 3.0, 5.0, 6.0, 7.0, 8.0, 10.0):
        rng = random(811, round(100 * snr))
        received = wrong = 0
        for run in range(runs):
            read = decode_paper(heard(rng, [any_packet(rng, run % 128)], snr))
            received += any(message.word == run % 128 for message in read)
            wrong += any(message.word != run % 128 for message in read)
        rows[f"{snr:g}"] = {"received": received / runs, "wrong": wrong / runs}
    found["paper"] = rows
    return found


def dropped(runs: int) -> dict[str, Any]:
    """5 % of the frames dropped: beside the best decoder, told phase, clock and which frames are missing."""
    return beside_best(WHERE[5], runs, 5, drops=0.05, told=True)


def beside_best(
    where: tuple[float, ...], runs: int, repeats: int, drops: float = 0.0, told: bool = False
) -> dict[str, Any]:
    """Return payload bits wrong at several A/σ, of the decoder and of the best, and how many dB part them.

    Both read the same signals; the dB are those between two lines of one slope through the logarithms of
    their rates, with standard deviations by the bootstrap over packets.
    """
    settings = DecoderSettings(repeats=repeats, lit_floor=0.0, dark_floor=0.0)
    wrong = np.zeros((2, len(where), runs))
    for place, snr in enumerate(where):
        for run in range(runs):
            rng = random(810, repeats, round(100 * snr), round(100 * drops), run)
            sent = any_packet(rng, run % 128, repeats=repeats)
            signal = heard(rng, [sent], snr, drops=drops)
            wrong[0, place, run] = wrong_bits(run % 128, most_likely(signal, sent, settings))
            wrong[1, place, run] = wrong_bits(run % 128, best_word(signal, sent, told=told))
    drawn = random(819).integers(runs, size=(200, runs))
    gaps = [lines_apart_db(where, wrong[:, :, some]) for some in drawn]
    rates = wrong.mean(axis=2) / 7.0
    sigmas = wrong.std(axis=2) / 7.0 / np.sqrt(runs)
    return {
        "packets": runs,
        "dB_below_best": {"value": lines_apart_db(where, wrong), "sigma": float(np.std(gaps))},
        "payload_bit_errors": {
            f"{snr:g}": {
                name: {"rate": float(rates[k, place]), "sigma": float(sigmas[k, place])}
                for k, name in enumerate(("decoder", "told the rest" if told else "best"))
            }
            for place, snr in enumerate(where)
        },
    }


def lines_apart_db(where: tuple[float, ...], wrong: NDArray[np.float64]) -> float:
    """Return the dB between two lines through log rates, wrong bits of shape (2, places, packets)."""
    total = wrong.sum(axis=2) + 0.5
    weight = np.sqrt(total)  # of a logarithm: by how many there are
    here_db = 20.0 * np.log10(where)
    columns = np.stack(
        [np.repeat([1.0, 0.0], len(where)), np.repeat([0.0, 1.0], len(where)), np.tile(here_db, 2)]
    )
    rows = columns.T * weight.reshape(-1, 1)
    first, second, slope = np.linalg.lstsq(rows, (np.log(total) * weight).ravel(), rcond=None)[0]
    return float((second - first) / slope)


def wrong_words(runs: int) -> dict[str, Any]:
    """Wrong words of whole packets at A/σ 3, by importance sampling; at 1.5 beside plain sampling.

    The noise is drawn about a place beyond halfway to one of the nearest other packets, or about none (a
    tenth of the runs), and each wrong word counts by the ratio of the densities.
    """
    commands, all_words = DecoderSettings(words=tuple(range(16))), DecoderSettings()
    unsure = DecoderSettings(confidence=0.9)
    return {
        "check_all_words_1.5_confidence_0.9": {
            "plain": tilted(1.5, runs, unsure, 0.0),
            "tilted": tilted(1.5, runs, unsure, 0.55),
        },
        "all_words_3": tilted(3.0, runs, all_words, 0.63),
        "commands_3": tilted(3.0, runs, commands, 0.55),
    }


def tilted(snr: float, runs: int, settings: DecoderSettings, tilt: float) -> dict[str, Any]:
    """Return the share of packets from which a wrong word is read, and its standard deviation."""
    words = settings.words
    counted, met = np.zeros(runs), 0
    for run in range(runs):
        rng = random(819, len(words), round(10 * snr), round(100 * tilt), run)
        sent = any_packet(rng, words[run % len(words)])
        times_s = frame_times(rng, 0.0, sent.end_s + 1.5, 30.0, 0.0)
        level = shares(times_s, [sent], 1e-3)
        others = [
            shares(times_s, [Sent(word, sent.start_s + shift * sent.bit_s, sent.drift)], 1e-3)
            for word, shift in nearest(words[run % len(words)], words)
        ]
        aims = snr * tilt * (np.array(others) - level)  # in standard deviations of the noise
        noise = rng.standard_normal(len(times_s))
        if tilt and rng.uniform() > 0.1:
            noise += aims[rng.integers(len(aims))]
        signal = signal_of(times_s, level, 1.0 / snr, rng)
        read = decode(replace(signal, level=level + noise / snr), settings)
        if any(message.word != sent.word for message in read):
            ratios = np.exp(aims @ noise - 0.5 * (aims**2).sum(axis=1))
            counted[run] = 1.0 / (0.1 + 0.9 * ratios.mean()) if tilt else 1.0
            met += 1
    sigma = float(counted.std() / np.sqrt(runs))
    return {"packets": runs, "met": met, "wrong": float(counted.mean()), "sigma": sigma}


@cache
def nearest(word: int, words: tuple[int, ...]) -> tuple[tuple[int, int], ...]:
    """Return the packets nearest to a word's, up to four, as (word, shift in bits)."""
    own = np.pad(encode(word), 11, constant_values=1)
    others = [
        (int((own != np.pad(encode(other), (11 + shift, 11 - shift), constant_values=1)).sum()), other, shift)
        for other in words
        if other != word
        for shift in range(-10, 11)
    ]
    return tuple((other, shift) for _, other, shift in sorted(others)[:4])


def packets(runs: int, settings: DecoderSettings, drops: float = 0.0) -> dict[str, Any]:
    """Run the whole decoder: nothing known beforehand, nothing said below its confidence."""
    rows = {}
    for snr in (2.0, 3.0, 5.0, 10.0):
        rng = random(813, len(settings.words), round(10 * snr), round(1000 * drops))
        received = wrong = 0
        for run in range(runs):
            word = settings.words[run % len(settings.words)]
            read = decode(heard(rng, [any_packet(rng, word)], snr, drops=drops), settings)
            received += any(message.word == word for message in read)
            wrong += sum(message.word != word for message in read)
        rows[f"{snr:g}"] = {"packets": runs, "received": received / runs, "wrong": wrong}
    return rows


def inside(runs: int) -> dict[str, Any]:
    """Decode recordings that start inside a packet, all words in turn, at A/σ 4 to 100; they end anywhere."""
    right = wrong = 0
    for run in range(runs):
        rng = random(814, run)
        sent = Sent(run % 128, 0.0, rng.uniform(-0.015, 0.015))
        end_s = sent.end_s + rng.choice([-0.5, 0.0, 0.3, 1.2, 2.5])
        begin_s = rng.uniform(0.01, min(5.4, end_s - 0.5))
        snr = rng.choice([4.0, 8.0, 20.0, 100.0])
        read = decode(heard(rng, [sent], float(snr), begin_s=begin_s, end_s=float(end_s)))
        right += any(message.word == sent.word for message in read)
        wrong += any(message.word != sent.word for message in read)
    return {"recordings": runs, "read": right, "wrong": wrong}


def merges(runs: int) -> dict[str, Any]:
    """Two sources that send, whose light falls together for a while, told to the decoder or not."""
    rows = {}
    for told in (True, False):
        right = wrong = 0
        for run in range(runs):
            rng = random(815, told, run)
            sent = any_packet(rng, run % 128)
            other = any_packet(rng, int(rng.integers(128)), start_s=rng.uniform(-4.0, 6.0))
            times_s = frame_times(rng, 0.0, sent.end_s + 1.5, 30.0, 0.0)
            begin_s, lasts_s = rng.uniform(0.0, 7.0), rng.uniform(0.1, 3.0)
            together = (times_s > begin_s) & (times_s < begin_s + lasts_s)
            level = shares(times_s, [sent], 1e-3)
            level = level + together * rng.uniform(0.2, 2.0) * shares(times_s, [other], 1e-3)
            signal = signal_of(times_s, level, 0.1, rng)
            if told:
                signal.sigma_dark[together] = signal.sigma_lit[together] = np.inf
            read = decode(signal)
            right += any(message.word == sent.word for message in read)
            wrong += sum(message.word != sent.word for message in read)
        rows["told" if told else "untold"] = {"merges": runs, "received": right, "wrong": wrong}
    return rows


def false_messages(hours: float) -> dict[str, Any]:
    """Messages an hour from what sends none, of this language at least, and what they are below with 95 %."""
    rows = {}
    for number, name in enumerate(
        ("idle", "lamp 100 Hz", "lamp 120 Hz", "noise", "random bits", "20 Hz sender")
    ):
        rng = random(816, number)
        said = 0
        for _ in range(round(60 * hours)):  # a minute each, its lamp at a frequency of its own
            times_s = frame_times(rng, 0.0, 60.0, 30.003, 0.0)
            level = np.ones(len(times_s))
            if name.startswith("lamp"):
                mains_hz = float(name.split()[1]) + 0.1 * rng.standard_normal()
                level = 0.5 + 0.5 * np.sin(2.0 * np.pi * mains_hz * times_s + rng.uniform(0.0, 6.28))
            if name == "noise":
                level = rng.uniform(0.0, 1.0, len(times_s))
            if name == "random bits":
                level = rng.integers(0, 2, 601)[(times_s * 10.0).astype(int)].astype(float)
            if name == "20 Hz sender":
                level = twice_as_fast(times_s, rng)
            said += len(decode(signal_of(times_s, level, 0.1, rng)))
        below = float(0.5 * chi2.ppf(0.95, 2 * said + 2))
        rows[name] = {"hours": hours, "messages": said, "below_per_hour": below / hours}
    return rows


def twice_as_fast(times_s: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the light of a sender of packets at 20 Hz, with pauses of up to 3 s, from amidst one on."""
    exposures_s, level, start_s = np.full(len(times_s), 1e-3), np.ones(len(times_s)), -rng.uniform(0.0, 2.75)
    while start_s < times_s[-1]:
        bits = encode(int(rng.integers(128)))
        level = np.minimum(level, packet_levels(times_s, exposures_s, bits, start_s, 0.05))
        start_s += 2.75 + rng.uniform(0.0, 3.0)
    return level


def pairs(runs: int) -> dict[str, Any]:
    """Two sources in one pixel, the weaker at 8 σ, clocks 0.5 % apart, one up to a packet later."""
    rows = {}
    for ratio in (0.98, 0.9, 0.7, 0.5, 0.2):
        both = said_who = wrong_who = wrong = 0
        for run in range(runs):
            rng = random(817, round(100 * ratio), run)
            words = [int(word) for word in rng.integers(128, size=2)]
            drift = rng.uniform(-0.01, 0.01)
            first = Sent(words[0], 2.0 + rng.uniform(0.0, 0.1), drift + 0.0025)
            second = Sent(words[1], 2.0 + rng.uniform(0.0, 5.5), drift - 0.0025)
            times_s = frame_times(rng, 0.0, 15.0, 30.0, 0.0)
            level = shares(times_s, [first], 1e-3) + ratio * shares(times_s, [second], 1e-3)
            known = (1.0 + 0.05 * rng.standard_normal(), ratio * (1.0 + 0.05 * rng.standard_normal()))
            signal = signal_of(times_s, level, ratio / 8.0, rng)
            read = decode_pair(signal, known, (0.05, 0.05 * ratio), (1, 2))
            both += sorted(message.word for message in read) == sorted(words)
            wrong += sum(message.word not in words for message in read)
            sure = [message for message in read if message.ambiguous_with is None]
            said_who += len(sure) == 2
            wrong_who += any(message.word != words[message.track - 1] for message in sure)
        rows[f"1:{ratio:g}"] = {
            "runs": runs,
            "both_words": both / runs,
            "words_wrong": wrong,
            "said_who": said_who / runs,
            "wrong_who": wrong_who,
        }
    return rows


def speed() -> dict[str, float]:
    """Milliseconds of one core for each set of 20 tracks that all send without a pause, in real time."""
    perception.warm_up()
    rows = {}
    for fps in (30.0, 100.0):
        rng = random(818, int(fps))
        heard_all = [
            heard(rng, [Sent(n, 0.5 + 5.6 * k) for k in range(5)], 10.0, fps=fps, end_s=29.0)
            for n in range(20)
        ]
        decoders = [Decoder("r1", n) for n in range(20)]
        sets = len(heard_all[0].time_s) // 4
        started = time.process_time()
        for at in range(sets):
            for decoder, signal in zip(decoders, heard_all, strict=True):
                some = slice(4 * at, 4 * at + 4)
                decoder.push(
                    Signal("r1", 1, signal.time_s[some], signal.exposure_s[some], signal.level[some],
                           signal.sigma_dark[some], signal.sigma_lit[some])
                )  # fmt: skip
        rows[f"{fps:g} FPS"] = round(1e3 * (time.process_time() - started) / (4 * sets), 3)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--full", action="store_true", help="twenty to a hundred times the runs")
    parser.add_argument("--only", help="one part")
    arguments = parser.parse_args()
    quick = not arguments.full
    parts = {
        "speed_ms_per_set_of_20_tracks": speed,
        "error_rates": lambda: error_rates(128 if quick else 10_000),
        "dropped_5_percent": lambda: dropped(128 if quick else 5_000),
        "wrong_words": lambda: wrong_words(64 if quick else 4_000),
        "packets_all_words": lambda: packets(128 if quick else 10_000, DecoderSettings()),
        "packets_commands": lambda: packets(64 if quick else 10_000, DecoderSettings(words=tuple(range(16)))),
        "packets_5_percent_dropped": lambda: packets(64 if quick else 5_000, DecoderSettings(), 0.05),
        "recordings_that_start_inside": lambda: inside(512 if quick else 100_000),
        "merges": lambda: merges(64 if quick else 10_000),
        "false_messages": lambda: false_messages(0.1 if quick else 10.0),
        "pairs": lambda: pairs(3 if quick else 500),
    }
    if arguments.only is not None and arguments.only not in parts:
        parser.error(f"there is no part {arguments.only!r}; wanted one of {', '.join(parts)}")
    wanted = [arguments.only] if arguments.only else parts
    print(json.dumps({name: parts[name]() for name in wanted}, indent=2))
