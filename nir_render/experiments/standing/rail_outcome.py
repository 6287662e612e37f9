"""What the range experiment found: errors, and how often the source was found, beside the physical limit."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.experiments.loop.runs import Progress, run_seeds
from nir_render.experiments.loop.shares import lower_limit
from nir_render.experiments.standing.rail import Rail
from nir_render.experiments.standing.sightings import STACKS, Sighting, sighting_of
from nir_render.scene.scene import Scene
from perception.calibration.result import IDEAL_MAE
from perception.paper import regress_paper_range_constant

Array = NDArray[np.float64]

CALIBRATED_LX = 500.0
"""Constants are fitted at this level, as the paper does at one."""


@dataclass(frozen=True)
class Judged:
    """A frame, and each stack's range there with the fitted constants: NaN where found without one.

    Attributes
    ----------
    place
        Of which seed, and where: frames of one place share its light.
    fitted
        Whether the constants were fitted at this place: it then says nothing of their errors.
    """

    place: tuple[int, int]
    fitted: bool
    lux: float
    range_m: float
    limit_m: float
    said_m: dict[str, float]
    false_alarms: dict[str, int]


@dataclass(frozen=True)
class Outcome:
    """Runs of the experiment: all frames of each seed.

    Attributes
    ----------
    intercepts
        By seed, in σ: of the paper's line m = K / d² + intercept, which should go through 0.
    """

    plan: Rail
    scene: str
    judged: dict[int, list[Judged]]
    intercepts: dict[int, float]

    def frames(self, lux: float | None = None) -> list[Judged]:
        """Return the frames of all seeds, of one level or of all."""
        return [one for of_seed in self.judged.values() for one in of_seed if lux in (None, one.lux)]

    def record(self) -> dict[str, Any]:
        """Return the figures as plain data; null where there is none."""
        everything = self.frames()
        return {
            "format": 1,
            "experiment": "calibration",
            "seeds": list(self.judged),
            "frames": len(everything),
            "frames_held_out": len(held_out(everything)),
            "ideal_mae_m": ideal_mae_m(everything),
            "stacks": {name: figures(everything, name) for name in STACKS},
            "levels_lx": {
                f"{lux:g}": {name: figures(self.frames(lux), name) for name in STACKS}
                for lux in self.plan.levels_lx
            },
            "intercept_largest_sigmas": max(map(abs, self.intercepts.values())),
        }


def held_out(frames: Sequence[Judged]) -> list[Judged]:
    """Return the frames of places that no constant was fitted at."""
    return [one for one in frames if not one.fitted]


def ideal_mae_m(frames: Sequence[Judged]) -> float:
    """Return the mean absolute error of an estimator at the Cramér–Rao bound, at the places held out."""
    return float(IDEAL_MAE * np.mean([one.limit_m for one in held_out(frames)]))


def figures(frames: Sequence[Judged], stack: str) -> dict[str, Any]:
    """Return the errors of a stack at the places held out, and how often it found the source anywhere.

    `places_lower_95` is the limit of the share of places at which it is found in every frame: frames of one
    place share its light, and are no trials of their own.
    """
    found = [one for one in frames if stack in one.said_m]
    missed_at = {one.place for one in frames if stack not in one.said_m}
    places = {one.place for one in frames}
    said = [one for one in held_out(found) if np.isfinite(one.said_m[stack])]
    off_m = np.array([one.said_m[stack] - one.range_m for one in said])
    return {
        "found": len(found),
        "frames": len(frames),
        "places_found": len(places - missed_at),
        "places": len(places),
        "places_lower_95": lower_limit(len(places - missed_at), len(places)),
        "without_a_range": len(held_out(found)) - len(said),
        "false_alarms": sum(one.false_alarms[stack] for one in frames),
        "mae_m": float(np.abs(off_m).mean()) if len(off_m) else None,
        "rmse_m": float(np.sqrt((off_m**2).mean())) if len(off_m) else None,
        "bias_m": float(off_m.mean()) if len(off_m) else None,
    }


def outcome_of(
    scene: Scene, plan: Rail, seeds: Sequence[int], folder: Path, workers: int, progress: Progress
) -> Outcome:
    """Run it for each seed; errors as `run_seeds`."""
    frames: dict[int, list[Judged]] = {}
    intercepts: dict[int, float] = {}
    for record in run_seeds(scene, plan, seeds, folder, workers, progress):
        seed = record["seed"]
        frames[seed], intercepts[seed] = judged(record["sightings"], seed)
    return Outcome(plan, scene.document.name, frames, intercepts)


def judged(rows: Iterable[dict[str, Any]], seed: int) -> tuple[list[Judged], float]:
    """Fit both constants on every other place, and return what they make of all.

    The paper's is the slope of its regression (its Exp1), robust's the mean of the flux times the square of
    the range, weighted by the bound: both from the same frames, at 500 lx or what is nearest to it.

    Returns
    -------
    All frames, and the intercept of the paper's line in σ.
    """
    listed = [
        (row["place"], row["lux"], sighting_of({k: v for k, v in row.items() if k not in ("place", "lux")}))
        for row in rows
    ]
    level = min({lux for _, lux, _ in listed}, key=lambda lux: abs(lux - CALIBRATED_LX))
    fitted = [one for place, lux, one in listed if place % 2 == 0 and lux == level]
    slope, intercept_sigmas = _papers_line(fitted)
    longer = _scale(fitted)
    frames = []
    for place, lux, one in listed:
        said_m = {}
        if (paper := one.seen["paper"]) is not None:
            said_m["paper"] = float(np.sqrt(slope / paper.signal_dn_per_s))
        if (robust := one.seen["robust"]) is not None:
            said_m["robust"] = robust.range_m * longer
        frames.append(
            Judged((seed, place), place % 2 == 0, lux, one.range_m, one.limit_m, said_m, one.false_alarms)
        )
    return frames, intercept_sigmas


def _papers_line(fitted: Sequence[Sighting]) -> tuple[float, float]:
    seen = [(one.range_m, one.seen["paper"].signal_dn_per_s) for one in fitted if one.seen["paper"]]
    ranges_m, signals = np.array(seen).T
    line = regress_paper_range_constant(signals, np.zeros(len(signals)), 1.0, ranges_m)
    return line.slope_dn_m2_per_s, line.intercept_dn_per_s / line.intercept_sigma_dn_per_s


def _scale(fitted: Sequence[Sighting]) -> float:
    """Return by what robust's ranges have to be longer to be right in the mean."""
    seen = [(one.range_m, one.limit_m, one.seen["robust"].range_m) for one in fitted if one.seen["robust"]]
    ranges_m, limits_m, said_m = np.array([each for each in seen if np.isfinite(each[2])]).T
    weights = (ranges_m / limits_m) ** 2
    return float(np.exp((weights * np.log(ranges_m / said_m)).sum() / weights.sum()))
