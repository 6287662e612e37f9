"""Figures of TrackEval for random sequences, from an environment of its own: `python tests/track_eval.py`.

    pip install trackeval "numpy<2" scipy

prints the table that `tests/unit/evaluate/test_track_metrics.py` holds. Only numpy makes the sequences.
"""

import json
import sys
from typing import Any

import numpy as np


def sequence(seed: int) -> list[tuple[list[int], list[int], Any]]:
    """Return instants of a few sources on a line and a tracker that loses, swaps and invents some of them."""
    rng = np.random.Generator(np.random.Philox(seed))
    sources, steps = 2 + seed % 5, 40
    start, pace = rng.uniform(0.0, 4.0, sources), rng.normal(0.0, 0.05, sources)
    follows = list(range(sources))
    latest = sources
    instants = []
    for step in range(steps):
        there = [k for k in range(sources) if rng.random() < 0.9]
        seen = []
        for k in there:
            if rng.random() < 0.05:
                follows[k], latest = latest, latest + 1
            if rng.random() < 0.85:
                seen.append((follows[k], start[k] + pace[k] * step + rng.normal(0.0, 0.2)))
        if rng.random() < 0.1 and sources > 1:
            follows[0], follows[1] = follows[1], follows[0]
        seen += [(1000 + 10 * step + n, rng.uniform(0.0, 4.0)) for n in range(rng.poisson(0.3))]
        places = np.array([start[k] + pace[k] * step for k in there]).reshape(-1, 1)
        said = np.array([place for _, place in seen]).reshape(1, -1)
        similarity = np.maximum(0.0, 1.0 - np.abs(places - said))
        instants.append((there, [who for who, _ in seen], similarity))
    return instants


def _figures(seed: int) -> dict[str, float]:
    from trackeval.metrics import CLEAR, HOTA, Identity  # type: ignore[import-not-found]

    instants = sequence(seed)
    names: list[dict[int, int]] = [{}, {}]
    ids = [
        [np.array([own.setdefault(one, len(own)) for one in each[side]], dtype=int) for each in instants]
        for side, own in enumerate(names)
    ]
    data = {
        "num_timesteps": len(instants), "gt_ids": ids[0], "tracker_ids": ids[1],
        "similarity_scores": [each[2] for each in instants], "num_gt_ids": len(names[0]),
        "num_tracker_ids": len(names[1]), "num_gt_dets": sum(map(len, ids[0])),
        "num_tracker_dets": sum(map(len, ids[1])),
    }  # fmt: skip
    hota = HOTA().eval_sequence(data)
    clear = CLEAR({"THRESHOLD": 0.5, "PRINT_CONFIG": False}).eval_sequence(data)
    identity = Identity({"THRESHOLD": 0.5, "PRINT_CONFIG": False}).eval_sequence(data)
    return {
        "hota": float(hota["HOTA"].mean()), "detection_accuracy": float(hota["DetA"].mean()),
        "association_accuracy": float(hota["AssA"].mean()), "idf1": float(identity["IDF1"]),
        "mota": float(clear["MOTA"]), "switches": int(clear["IDSW"]), "fragments": int(clear["Frag"]),
        "hits": int(clear["CLR_TP"]), "misses": int(clear["CLR_FN"]), "false_alarms": int(clear["CLR_FP"]),
    }  # fmt: skip


if __name__ == "__main__":
    sys.stdout.write(json.dumps([_figures(seed) for seed in range(6)], indent=1) + "\n")
