"""What an experiment found over its seeds, beside what the paper says."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.experiments.flocking.loop import Flocking, Run, run_of
from nir_render.experiments.loop.ending import TRUTH
from nir_render.experiments.loop.runs import Progress, run_seeds
from nir_render.scene.scene import Scene

Array = NDArray[np.float64]

ARENA = Path(__file__).parents[2] / "data" / "experiments" / "arena.yaml"
"""The paper's arena."""

WANTED_M = 0.05
"""The paper's "spacing error < 5 cm"."""


@dataclass(frozen=True)
class Outcome:
    """Runs of an experiment, and those of the same seeds in which robots knew the truth."""

    plan: Flocking
    scene: str
    runs: Sequence[Run]
    by_truth: Sequence[Run]

    @property
    def valid(self) -> list[Run]:
        """The runs in which all are one flock, and nobody bumped into another."""
        return [run for run in self.runs if run.spacing.valid]

    def errors_m(self) -> Array:
        """Return the spacing error of each run, infinite where it says nothing."""
        return _errors_m(self.runs)

    def losses_m(self) -> Array:
        """Return by how much each run's error is larger than with the truth known."""
        with np.errstate(invalid="ignore"):
            return np.asarray(_errors_m(self.runs) - _errors_m(self.by_truth))

    def record(self) -> dict[str, Any]:
        """Return the figures as plain data; null where there is none."""
        errors, losses = self.errors_m(), self.losses_m()
        spreads = [run.spacing.spread_m for run in self.valid]
        held = [
            run.record["held_light_share"] for run in self.runs if run.record["held_light_share"] is not None
        ]
        return {
            "format": 1,
            "experiment": "flocking",
            "law": self.plan.law,
            "level": self.plan.level,
            "seeds": [run.seed for run in self.runs],
            "valid": len(self.valid),
            "below_5_cm": int((errors < WANTED_M).sum()),
            "spread_below_5_cm": int(sum(spread < WANTED_M for spread in spreads)),
            "touched": sum(run.spacing.touched for run in self.runs),
            "spacing_error_median_m": _number(np.median(errors)),
            "spacing_error_largest_m": _number(errors.max()),
            "loss_against_truth_median_m": _number(np.median(losses)),
            "mean_distance_of_all_pairs_m": _number(np.mean([run.spacing.all_pairs_m for run in self.runs])),
            "nearest_m": _number(min(run.spacing.nearest_m for run in self.runs)),
            "held_light_share_largest": _number(max(held)) if held else None,
        }


def outcome_of(
    scene: Scene, plan: Flocking, seeds: Sequence[int], folder: Path, workers: int, progress: Progress
) -> Outcome:
    """Run an experiment for each seed, and once more with the truth known; errors as `run_seeds`."""
    known = replace(plan, level="truth")
    by_truth = run_seeds(scene, known, seeds, folder / TRUTH, workers, lambda *_: None)
    runs = by_truth if plan == known else run_seeds(scene, plan, seeds, folder, workers, progress)
    return Outcome(plan, scene.document.name, [*map(run_of, runs)], [*map(run_of, by_truth)])


def _errors_m(runs: Sequence[Run]) -> Array:
    return np.array([run.spacing.error_m if run.spacing.valid else np.inf for run in runs])


def _number(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None
