"""What the communication experiment found over its seeds, beside what the paper says."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nir_render.experiments.communication.judge import Command, Judged
from nir_render.experiments.communication.loop import (
    ORDER,
    PAPERS_INTERVALS_S,
    Communication,
    truth_of,
)
from nir_render.experiments.loop.controllers import COMMANDED_M
from nir_render.experiments.loop.ending import TRUTH
from nir_render.experiments.loop.runs import Progress, run_seeds
from nir_render.experiments.loop.shares import upper_limit
from nir_render.scene.scene import Scene


@dataclass(frozen=True)
class Run:
    """A run of one seed that is done."""

    seed: int
    judged: Judged
    record: dict[str, Any]


@dataclass(frozen=True)
class Outcome:
    """Runs of the experiment, those of robots that know the truth, and those by the paper's timetable."""

    plan: Communication
    scene: str
    runs: Sequence[Run]
    by_truth: Sequence[Run]
    by_timetable: Sequence[Run]

    def record(self) -> dict[str, Any]:
        """Return the figures as plain data; null where there is none."""
        bits = sum(run.record["bits"] for run in self.runs)
        wrong = sum(run.record["wrong_bits"] for run in self.runs)
        commands = [command for run in self.runs for command in run.judged.commands]
        held = [
            run.record["held_light_share"] for run in self.runs if run.record["held_light_share"] is not None
        ]
        return {
            "format": 1,
            "experiment": "communication",
            "robots": self.plan.robots,
            "level": self.plan.level,
            "seeds": [run.seed for run in self.runs],
            "met": sum(run.judged.met for run in self.runs),
            "commands": len(commands),
            "commands_read": sum(command.read_s is not None for command in commands),
            "commands_met": sum(command.met for command in commands),
            "reached_latest_s": _largest([command.reached_s for command in commands]),
            "worst_pair_held_m": _largest([command.worst_m for command in commands]),
            "read_after_packet_latest_s": _largest(
                [None if one.read_s is None else one.read_s - one.ended_s for one in commands]
            ),
            "wrong_obeyed": sum(run.judged.wrong_obeyed for run in self.runs),
            "touched": sum(run.judged.touched for run in self.runs),
            "packets": sum(run.judged.packets for run in self.runs),
            "packets_received": sum(run.judged.received for run in self.runs),
            "wrong_words": sum(run.judged.wrong_words for run in self.runs),
            "bits": bits,
            "wrong_bits": wrong,
            "bit_error_rate_upper_95": upper_limit(wrong, bits) if bits else None,
            "levels": {name: self.levels(name) for name in ("dark", "lit")},
            "held_light_share_largest": max(held) if held else None,
        }

    def levels(self, name: str) -> list[float] | None:
        """Return number, mean and standard deviation of the levels of all runs, dark or lit; None without."""
        parts = np.array([run.record["levels"][name] for run in self.runs])
        number = parts[:, 0].sum()
        if number < 2:
            return None
        mean = float((parts[:, 0] * parts[:, 1]).sum() / number)
        about = (parts[:, 0] * (parts[:, 2] ** 2 + (parts[:, 1] - mean) ** 2)).sum() / number
        return [float(number), mean, float(np.sqrt(about))]


def outcome_of(
    scene: Scene, plan: Communication, seeds: Sequence[int], folder: Path, workers: int, progress: Progress
) -> Outcome:
    """Run it for each seed, once more with the truth known, and by the paper's timetable so."""
    known, timed = truth_of(plan, "ours"), truth_of(plan, "paper")
    by_truth = run_seeds(scene, known, seeds, folder / TRUTH, workers, lambda *_: None)
    by_timetable = run_seeds(scene, timed, seeds, folder / "timetable", workers, lambda *_: None)
    runs = by_truth if plan == known else run_seeds(scene, plan, seeds, folder, workers, progress)
    return Outcome(
        plan, scene.document.name, [*map(_run, runs)], [*map(_run, by_truth)], [*map(_run, by_timetable)]
    )


def off_by_timetable_m(outcome: Outcome) -> list[float]:
    """Return by how much the worst pair misses each command's spacing at the ends of the paper's intervals.

    Infinite where a run ended before.
    """
    found = []
    for command, (_, end_s) in zip(ORDER, PAPERS_INTERVALS_S, strict=True):
        off_m = []
        for run in outcome.by_timetable:
            times_s, places_m = np.array(run.record["time_s"]), np.array(run.record["places_m"])
            if times_s[-1] < end_s:
                return [np.inf] * len(ORDER)
            d_m = _distances_m(places_m)
            near = d_m[0] < 1.35
            at = int(np.argmin(abs(times_s - end_s)))
            off_m.append(float(abs(d_m[at, near] - COMMANDED_M[command]).max()))
        found.append(min(off_m))
    return found


def _distances_m(places_m: np.ndarray[Any, np.dtype[np.float64]]) -> np.ndarray[Any, np.dtype[np.float64]]:
    one, other = np.triu_indices(places_m.shape[1], 1)
    return np.asarray(np.linalg.norm(places_m[:, one] - places_m[:, other], axis=2))


def _run(record: dict[str, Any]) -> Run:
    said = dict(record["judged"])
    commands = tuple(Command(**each) for each in said.pop("commands"))
    return Run(record["seed"], Judged(commands, **said), record)


def _largest(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return max(known) if known else None
