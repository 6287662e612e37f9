"""Sets per second of the tracker alone, and what its filter and the paper's claim and reach: one JSON object.

`--write FILE.npz` also leaves the filter's runs there, for `tracking_stone_soup.py`.
"""

import argparse
import json
import statistics
import sys
import time
from pathlib import Path

import numpy as np
from scipy import stats

sys.path.insert(0, str(Path(__file__).parents[1]))

from perception.track import Tracker
from tests.unit.perception.simulation import random
from tests.unit.perception.track.test_kalman import CASES, RUNS, START, simulated
from tests.unit.perception.track.world import clutter, measurement

SETS, FPS = 90, 30.0


def timed(targets: int, false: int) -> dict[str, float | int]:
    """Time sets of so many blinking targets among so many false detections."""
    rng = random(1690, targets, false)
    azimuth, height = rng.uniform(-np.pi, np.pi, targets), rng.uniform(-0.5, 0.5, targets)
    towards = np.stack(
        [np.cos(azimuth) * np.cos(height), np.sin(azimuth) * np.cos(height), np.sin(height)], axis=1
    )
    place_m = towards * rng.uniform(1.0, 6.0, (targets, 1))
    velocity = rng.normal(0.0, 0.1, (targets, 3))
    lit = rng.uniform(size=(targets, 200)) < 0.6
    lit[:, 3::5] = True  # no dark run is longer than a message's
    tracker, seconds, busy, tracks = Tracker(), [], [], 0
    for n in range(SETS):
        now_s = n / FPS
        shown = np.flatnonzero(lit[:, int(now_s / 0.1)])
        found = [measurement(place_m[k] + now_s * velocity[k], now_s, rng, int(k)) for k in shown]
        found += clutter(false, now_s, rng)
        start, begun = time.perf_counter(), time.thread_time()
        tracks = len(tracker.update(now_s, found))
        seconds.append(time.perf_counter() - start)
        busy.append(time.thread_time() - begun)
    median_s = statistics.median(seconds[SETS // 3 :])
    return {
        "sets_per_s": round(1.0 / median_s, 1),
        "milliseconds_median": round(1e3 * median_s, 2),
        "processor_milliseconds_median": round(1e3 * statistics.median(busy[SETS // 3 :]), 2),
        "milliseconds_most": round(1e3 * max(seconds), 2),
        "tracks_at_end": tracks,
    }


def filters() -> dict[str, dict[str, dict[str, float]]]:
    """Return mean NEES (6 expected), the share of steps in its 95 % band, RMSE over the root of the bound."""
    low, high = stats.chi2.ppf([0.025, 0.975], 6 * RUNS) / RUNS
    forms = [("sound", 0.0), *(("paper", epsilon_m2) for epsilon_m2 in (1e-8, 1e-6, 1e-4))]
    found: dict[str, dict[str, dict[str, float]]] = {}
    for case in CASES:
        for form, epsilon_m2 in forms:
            runs = [simulated(case, form, key, epsilon_m2) for key in range(3)]
            nees = np.array([one.nees for one in runs])
            error_m2 = sum(one.rmse_m**2 for one in runs) / sum(one.bound_m**2 for one in runs)
            found.setdefault(case.name, {})[form if form == "sound" else f"paper, {epsilon_m2:g} m²"] = {
                "nees": round(float(nees.mean()), 2),
                "in_band": round(float(np.mean((nees > low) & (nees < high))), 3),
                "rmse_over_bound": round(float(np.sqrt(error_m2)), 3),
            }
    return found


def written(path: Path) -> None:
    """Write the runs of the sound filter."""
    columns = {}
    for case in CASES:
        runs = simulated(case, "sound", 0)
        name = case.name.replace(" ", "_")
        for column in ("first", "truth", "estimates", "bearing", "range_m"):
            columns[f"{name}.{column}"] = getattr(runs, column)
        columns[f"{name}.case"] = np.array(
            [case.interval_s, case.psd, case.bearing_rad, case.flux_noise_at_1_m]
        )
    np.savez(path, start=START, **columns)


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", type=Path)
    chosen = parser.parse_args()
    if chosen.write:
        written(chosen.write)
    timed(5, 0)
    figures = {
        "tracker": {
            f"{targets} targets, {false} false": timed(targets, false)
            for targets, false in ((5, 0), (20, 0), (100, 0), (5, 200), (20, 200), (100, 200))
        },
        "filter": filters(),
    }
    print(json.dumps(figures, indent=2, ensure_ascii=False))


if __name__ == "__main__":
    main()
