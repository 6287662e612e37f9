"""How right the told headings of robots with several LEDs are: one JSON object. `--poses 10000` for all.

One robot 1 to 5 m away, anywhere around the paper's rig and turned anyhow, detections drawn from the errors
that they claim (`tests/unit/perception/rig/poses.py`), with `--noise 10` ten times as large ones, or with
`--raw` from raw frames (`raw_poses.py`). For two LEDs alike, two of unlike power, and three:

- `over_bound`: RMSE of the best hypothesis' heading, modulo symmetry, over the bound where that is at most
  10°. Seen broadside a robot looks the same turned as much the other way, until ranges tell it. The bound
  knows nothing of that: where the best hypothesis is the other one it is counted apart (`wrong`).
- `covered_there`: where the bound is beyond 10°, how often σ 1.96 times about the best heading holds truth.
- `wrong`: the best hypothesis is not the true one; `expected_wrong` by the odds that were claimed.
- `untold`: the true pose, with who is which source, is in no hypothesis; `most` are ends of one-sided
  intervals of 95 %.
- `seconds`: of the processor, simulation and bound included.
"""

import argparse
import json
import math
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from tests.unit.perception.rig.poses import (
    ALIKE,
    COMMON,
    FINE,
    THREE,
    UNLIKE,
    Figures,
    Noise,
    against_bound,
    drawn,
    figures,
)
from tests.unit.perception.rig.raw_poses import photographed
from tests.unit.perception.simulation import FLUX_PER_S_AT_1_M

AT_ONCE = 250
UNLIKE_SIGMA = {"sigma": {"range_constant_dn_m2_per_s": 0.3 * 0.74 * FLUX_PER_S_AT_1_M}}
LAYOUTS = {"alike": (ALIKE, math.pi), "unlike": (UNLIKE, 2.0 * math.pi), "three": (THREE, 2.0 * math.pi)}


def main() -> None:
    """Print the figures; with `--out` they are also on disk as they come."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--poses", type=int, default=500, help="of each layout")
    parser.add_argument("--only", choices=LAYOUTS, help="one of the layouts")
    parser.add_argument("--noise", type=float, default=1.0, help="so many times that of `poses.FINE`")
    parser.add_argument("--raw", action="store_true", help="from raw frames")
    parser.add_argument("--out", type=Path, help="a file that holds what is done so far")
    arguments = parser.parse_args()
    noise = Noise(FINE.px * arguments.noise, FINE.relative * arguments.noise)
    look = photographed if arguments.raw else partial(drawn, noise=noise)
    found: dict[str, dict[str, float | int | None]] = {}
    for name, (layout, turn) in LAYOUTS.items():
        if arguments.only in (None, name):
            parts: list[Figures] = []
            seconds = 0.0
            for seed in range(math.ceil(arguments.poses / AT_ONCE)):
                start = time.process_time()
                poses = min(AT_ONCE, arguments.poses - seed * AT_ONCE)
                # Of unlike power in one calibration: its constant is that of either; the layout knows more.
                unlike = UNLIKE_SIGMA if arguments.raw and name == "unlike" else {}
                known = replace(layout, flux_sigma_common=2.0 * COMMON) if unlike else layout
                parts.append(figures(known, poses, turn, seed, look, **unlike))
                seconds += time.process_time() - start
                found[name] = {**_told(_joined(parts), turn), "seconds": round(seconds, 1)}
                if arguments.out:
                    arguments.out.write_text(json.dumps(found, indent=2) + "\n")
    print(json.dumps({"benchmark": "headings", "poses": arguments.poses, "layouts": found}, indent=2))


def _joined(parts: list[Figures]) -> Figures:
    columns = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in Figures.__dataclass_fields__
        if name != "lost"
    }
    return Figures(**columns, lost=sum(part.lost for part in parts))


def _told(found: Figures, turn: float) -> dict[str, float | int | None]:
    _, covered, nees = against_bound(found)
    told, close = len(found.error), found.bound <= math.radians(10.0)
    ratio2 = (found.error[close] / found.bound[close]) ** 2
    right = ~found.astray[close]
    # Sources that are alike change places as the robot turns by half a turn: the same said otherwise.
    wrong = found.astray | (found.swapped if turn > math.pi else False)
    untold = int((found.named == 0.0).sum())
    return {
        "told": told,
        "not_told": found.lost,
        "over_bound": round(math.sqrt(ratio2[right].mean()), 4),
        "over_bound_sigma": round(1.0 / math.sqrt(2.0 * right.sum()), 4),
        "over_bound_astray_too": round(math.sqrt(ratio2.mean()), 4),
        "nees": round(float(found.pulls2[~found.astray].mean()) / 4.0, 4),
        "nees_astray_too": round(nees, 4),
        "beyond_10_degrees": int((~close).sum()),
        "covered_there": None if math.isnan(covered) else round(covered, 4),
        "wrong": int(wrong.sum()),
        "wrong_most": round(_most(int(wrong.sum()), told), 5),
        "expected_wrong": round(float((1.0 - found.alike).sum()), 1),
        "wrong_but_held_above_99_percent": int((wrong & (found.alike > 0.99)).sum()),
        "held_above_99_percent": int((found.alike > 0.99).sum()),
        "untold": untold,
        "untold_most": round(_most(untold, told), 6),
        "least_odds_of_the_true": float(found.named.min()),
    }


def _most(events: int, trials: int) -> float:
    """Return the end of the one-sided 95 % interval of a share, by Clopper and Pearson."""
    from scipy.stats import beta

    return float(beta.ppf(0.95, events + 1, trials - events)) if events < trials else 1.0


if __name__ == "__main__":
    main()
