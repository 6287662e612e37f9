"""Sets per second of the whole stack, from four raw frames of 1280 × 960 to tracks and bits: one JSON object.

Robots stand about a rig of four cameras and repeat a word each at 10 Hz; the frames, 30 sets a second,
are drawn before anything is timed (`tests/unit/perception/simulation.py`) and each is read once in every
way, so that it comes from memory as a camera leaves it there. Figures are of the sets after the first
second: how many are done in a second, slow ones and all; how long a set takes, and of that detection by
itself, in threads, in processes, and in processes that are at work with the next set while this one is
followed; how many tracks there are at the end, and how many messages were read.
`--seconds 7` and more lets whole packets be heard.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import perception
from perception import Detection, RawFrame
from perception.estimators import detect_frames
from perception.messages.uart import encode
from tests.unit.perception.rig.world import exposed, means_of, rig
from tests.unit.perception.simulation import random

FPS, BITS_PER_S, WARM_S = 30.0, 10.0, 1.0
EXPOSURE_S = 2e-4
NEAREST_M, FARTHEST_M, APART_RAD = 1.5, 6.0, 0.12
CAMERAS = rig(own_source=True)
Sets = Iterable[Sequence[RawFrame]]
Reader = Callable[[Sets], Iterator[tuple[Sequence[RawFrame], Sequence[Sequence[Detection]]]]]


def sets_of(robots: int, seconds: float) -> list[list[RawFrame]]:
    """Return the frames of each set."""
    rng = random(95, robots)
    towards: list[np.ndarray] = []
    while len(towards) < robots:
        azimuth, height = rng.uniform(-np.pi, np.pi), rng.uniform(-0.4, 0.4)
        one = np.array([np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)])
        if all(one @ other < np.cos(APART_RAD) for other in towards):
            towards.append(one)
    places_m = np.array(towards) * rng.uniform(NEAREST_M, FARTHEST_M, (robots, 1))
    start_s = rng.uniform(0.0, 6.0, robots)
    dark_e = means_of(CAMERAS, [], EXPOSURE_S)
    light_e = [_parts(means_of(CAMERAS, [place_m], EXPOSURE_S), dark_e) for place_m in places_m]
    sets = []
    for index in range(round(seconds * FPS)):
        now_s = index / FPS
        bit = ((now_s - start_s) * BITS_PER_S).astype(int)
        lit = [encode(k % 128)[b % 55] if b >= 0 else 1 for k, b in enumerate(bit.tolist())]
        means_e = [mean_e.copy() for mean_e in dark_e]
        for k in np.flatnonzero(lit):
            for camera, part, flare_e in light_e[k]:
                means_e[camera][part] += flare_e
        frames = exposed(CAMERAS, means_e, random(96, robots, index), EXPOSURE_S)
        sets.append([replace(frame, index=index, time_s=now_s) for frame in frames])
    return sets


def _parts(
    means_e: list[np.ndarray], dark_e: list[np.ndarray]
) -> list[tuple[int, tuple[slice, slice], np.ndarray]]:
    """Return the part of each camera's frame that a robot lights: camera, rows and columns, electrons."""
    parts = []
    for camera, (mean_e, without_e) in enumerate(zip(means_e, dark_e, strict=True)):
        rows, columns = np.nonzero(mean_e != without_e)
        if len(rows):
            part = slice(rows.min(), rows.max() + 1), slice(columns.min(), columns.max() + 1)
            parts.append((camera, part, (mean_e - without_e)[part]))
    return parts


def timed(sets: Sequence[Sequence[RawFrame]], read: Reader) -> dict[str, float | int]:
    """Time the whole stack on sets of frames, and its parts."""
    pipeline = perception.Pipeline(CAMERAS)
    spent: list[tuple[float, float]] = []
    messages, tracks = 0, 0
    reading = read(sets)
    started = time.perf_counter()
    for frames, found in reading:
        detected = time.perf_counter()
        heard = pipeline.follow(frames, found)
        followed = time.perf_counter()
        spent.append((detected - started, followed - detected))
        messages, tracks = messages + len(heard.messages), len(heard.tracks)
        started = time.perf_counter()
    settled = [1e3 * np.array(each) for each in spent[round(WARM_S * FPS) :]]
    whole_ms = [float(each.sum()) for each in settled]
    return {
        "sets_per_s": round(1e3 / statistics.mean(whole_ms), 1),
        "median_ms": round(statistics.median(whole_ms), 2),
        "p99_ms": round(float(np.percentile(whole_ms, 99.0)), 2),
        "detect_median_ms": round(statistics.median(float(each[0]) for each in settled), 2),
        "follow_median_ms": round(statistics.median(float(each[1]) for each in settled), 2),
        "tracks_at_end": tracks,
        "messages": messages,
    }


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, nargs="*", default=[5, 20, 100])
    parser.add_argument("--seconds", type=float, default=2.5)
    chosen = parser.parse_args()
    perception.warm_up()
    with perception.DetectorProcesses(CAMERAS) as beside:
        ways: dict[str, Reader] = {
            "threads": lambda sets: ((frames, detect_frames(frames, CAMERAS)) for frames in sets),
            "processes": lambda sets: ((frames, beside.detect_frames(frames)) for frames in sets),
            "processes_ahead": beside.detect_sets,
        }
        figures = {}
        for robots in chosen.robots:
            sets = sets_of(robots, chosen.seconds)
            figures[str(robots)] = {way: timed(sets, read) for way, read in ways.items()}
    print(json.dumps({"benchmark": "stack", "cameras": len(CAMERAS), "robots": figures}))


if __name__ == "__main__":
    main()
