"""How long perception takes for sets of four frames, and how exact it is: one JSON object.

Sets of four frames of 1280 × 960 with 0, 4, 20, 80 and 400 spheres at 1.5 to 9 m among them; milliseconds for
a set (`detect_frames`, on as many threads as it takes by itself, and `DetectorProcesses`), each read several
times, once all that is compiled is loaded (`perception.warm_up`); errors of place over the Cramér–Rao limit
(1 is all that light allows). Beside it, where they are installed, `sep` (Source Extractor as a library) and
`photutils`, on the same frames, in the same process. And what is taken in processes of their own by the
import, by the first frame after it (five flares), and by `warm_up` in place of that (loops of everything).
"""

import importlib.util
import json
import math
import os
import pickle
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

import perception
from perception import Calibration, RawFrame
from perception.model.fisher import flare_limit
from perception.model.sensor import electrons
from tests.unit.perception.simulation import calibration, expected_e, expose, random

SETS = 10
READS = 5
"""Of each set: the 99th percentile is of 50 times."""

STARTS = 5
"""Processes of which import and first frame are timed."""

FRAMES = 4
COUNTS = (0, 1, 5, 20, 100)
"""Flares in each frame: the set has four times as many."""

EXPOSURE_S = 3e-4
BACKGROUND_E = 3.0
CAMERA = replace(calibration(), sigma={}, bit_depth=16, saturation_dn=65535)
Flares = list[tuple[float, float, float]]
"""Places in px and ranges in m."""
Places = list[tuple[float, float]]


def frames_of(count: int, number: int) -> list[tuple[RawFrame, Flares]]:
    """Return a set of frames, and the flares in each."""
    made = []
    for index in range(FRAMES):
        generator = random(91, count, number, index)
        flares: Flares = []
        while len(flares) < count:
            u, v = 30.0 + 1220.0 * generator.random(), 30.0 + 900.0 * generator.random()
            if all(math.hypot(u - a, v - b) > 40.0 for a, b, _ in flares):
                flares.append((u, v, 1.5 * 6.0 ** generator.random()))
        mean_e = expected_e(CAMERA, flares, EXPOSURE_S, BACKGROUND_E)
        made.append((expose(mean_e, CAMERA, random(92, count, number, index), EXPOSURE_S), flares))
    return made


START = """
import pickle, sys, time; started = time.perf_counter()
import perception; imported = time.perf_counter()
frame, camera = pickle.load(sys.stdin.buffer); read = time.perf_counter()
if sys.argv[1] == "frame": perception.detect_frames([frame], {camera.camera: camera})
else: perception.warm_up()
print(imported - started, time.perf_counter() - read)
"""


def by_robust(frames: Sequence[RawFrame], known: Calibration) -> list[Places]:
    """Find flares with the robust estimator."""
    found = perception.detect_frames(frames, {known.camera: known})
    return [[(hit.u_px, hit.v_px) for hit in hits] for hits in found]


def one_by_one(find: Callable[[RawFrame, Calibration], Places]) -> Callable[..., list[Places]]:
    """Return a finder of sets that reads frame by frame."""
    return lambda frames, known: [find(frame, known) for frame in frames]


def by_sep(frame: RawFrame, known: Calibration) -> Places:
    """Find flares with sep: background, extraction, windowed positions."""
    import sep

    image_e = np.ascontiguousarray(electrons(frame, known))
    background = sep.Background(image_e)
    found = sep.extract(image_e - background, 6.0, err=background.globalrms)
    u, v, _ = sep.winpos(image_e - background, found["x"], found["y"], 1.2 * np.ones(len(found)))
    return list(zip(u.tolist(), v.tolist(), strict=True))


def by_photutils(frame: RawFrame, known: Calibration) -> Places:
    """Find flares with photutils: DAOStarFinder on a median-subtracted frame."""
    from photutils.detection import DAOStarFinder

    image_e = electrons(frame, known)
    level_e = float(np.median(image_e))
    noise_e = 1.4826 * float(np.median(np.abs(image_e - level_e)))
    found = DAOStarFinder(threshold=6.0 * noise_e, fwhm=2.355 * known.psf_sigma_px)(image_e - level_e)
    if found is None:
        return []
    columns = ("x_centroid", "y_centroid") if "x_centroid" in found.colnames else ("xcentroid", "ycentroid")
    return [(float(row[columns[0]]), float(row[columns[1]])) for row in found]


PEERS: dict[str, Callable[[Sequence[RawFrame], Calibration], list[Places]]] = {
    "robust": by_robust, "sep": one_by_one(by_sep), "photutils": one_by_one(by_photutils),
}  # fmt: skip


def main() -> None:
    """Time every finder on every set, in turn, and print medians and errors."""
    with perception.DetectorProcesses(
        {CAMERA.camera: CAMERA}, count=min(FRAMES, os.cpu_count() or 1)
    ) as beside:
        _time(beside)


def _time(beside: perception.DetectorProcesses) -> None:
    def by_processes(frames: Sequence[RawFrame], _known: Calibration) -> list[Places]:
        return [[(hit.u_px, hit.v_px) for hit in hits] for hits in beside.detect_frames(frames)]

    finders = {n: f for n, f in PEERS.items() if n == "robust" or importlib.util.find_spec(n) is not None}
    finders["robust_in_processes"] = by_processes
    cases = {}
    perception.warm_up()
    for count in COUNTS:
        spent_ms: dict[str, list[float]] = {name: [] for name in finders}
        over_limit: dict[str, list[float]] = {name: [] for name in finders}
        found: dict[str, int] = dict.fromkeys(finders, 0)
        for number in range(SETS):
            frames = frames_of(count, number)
            for name, find in finders.items():
                for _ in range(READS):
                    started = time.perf_counter()
                    hits = find([frame for frame, _ in frames], CAMERA)
                    spent_ms[name].append(1e3 * (time.perf_counter() - started))
                for places, (_, flares) in zip(hits, frames, strict=True):
                    for u, v, range_m in flares:
                        near = [(a, b) for a, b in places if math.hypot(a - u, b - v) < 2.0]
                        found[name] += len(near) == 1
                        if len(near) == 1 and number < 2:
                            over_limit[name].append((near[0][0] - u) / _limit_px(u, v, range_m))
        cases[str(FRAMES * count)] = {
            name: {
                "median_ms": round(statistics.median(spent_ms[name]), 2),
                "p99_ms": round(float(np.percentile(spent_ms[name], 99.0)), 2),
                "found": round(found[name] / max(count * SETS * FRAMES, 1), 4),
                "rms_over_limit": round(float(np.sqrt(np.mean(np.square(over_limit[name])))), 3)
                if count
                else None,
            }
            for name in finders
        }
    start = _start_s()
    print(json.dumps({"benchmark": "perception", "frames": FRAMES, "sets": SETS, **start, "flares": cases}))


def _start_s() -> dict[str, float]:
    """Return what the import, the first frame and, in place of it, `warm_up` take: medians of processes."""
    # Bytecode is on the disk where people work; the first process writes it.
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    first_frame = pickle.dumps((frames_of(5, 0)[0][0], CAMERA))
    said: dict[str, list[list[float]]] = {"frame": [], "loops": []}
    for _ in range(1 + STARTS):
        for what, times in said.items():
            words = [sys.executable, "-c", START, what]
            text = subprocess.check_output(words, input=first_frame, env=environment)  # noqa: S603 (our own)
            times.append([float(word) for word in text.split()])
    import_s, frame_s = (statistics.median(each[1:]) for each in zip(*said["frame"], strict=True))
    loops_s = statistics.median(each for _, each in said["loops"][1:])
    return {
        "import_s": round(import_s, 3),
        "first_frame_s": round(frame_s, 3),
        "warm_up_s": round(loops_s, 3),
    }


def _limit_px(u: float, v: float, range_m: float) -> float:
    x, y = (u - CAMERA.cx_px) / CAMERA.fx_px, (v - CAMERA.cy_px) / CAMERA.fy_px
    cosine = 1.0 / math.sqrt(1.0 + x * x + y * y)
    gain = CAMERA.system_gain_dn_per_e
    flux_e = CAMERA.range_constant_dn_m2_per_s / gain * EXPOSURE_S * cosine / range_m**2
    return flare_limit(CAMERA, u, v, range_m, flux_e, BACKGROUND_E).u_sigma_px


if __name__ == "__main__":
    main()
