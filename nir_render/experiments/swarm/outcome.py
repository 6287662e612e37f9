"""What one robot makes of a swarm: recall, ranges, words, identities, against density, beside what can be."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.experiments.loop.runs import Progress, run_folder, run_seeds
from nir_render.experiments.swarm.hall import BODIES
from nir_render.experiments.swarm.identity import words_of
from nir_render.experiments.swarm.judge import WHYS
from nir_render.experiments.swarm.loop import SECONDS, Swarm
from nir_render.run.folder import read_lines
from nir_render.scene.scene import Scene

Array = NDArray[np.float64]

_MEDIAN_OF_NORMAL = 0.6745  # of the absolute value, of σ
_CAN_BE_RANGED = ("free", "eclipsed", "merged", "hidden")
DENSITIES_PER_M2 = (0.5, 1.0, 2.0)


@dataclass(frozen=True)
class Condition:
    """Runs of one density and one kind of bodies; `seconds` are the laps of every set."""

    plan: Swarm
    records: Sequence[dict[str, Any]]
    seconds: Sequence[dict[str, float]]

    @property
    def name(self) -> str:
        """What its folder is called."""
        return name_of(self.plan)

    def figures(self) -> dict[str, Any]:
        """Return its figures as plain data; null where there is none."""
        standing = [sight for record in self.records for sight in record["standing"]]
        sights = [sight for record in self.records for in_set in record["sights"] for sight in in_set]
        lit = [sight for sight in sights if sight[1] != "dark"]
        free = [sight for sight in lit if sight[1] == "free"]
        packets = [packet for record in self.records for packet in record["packets"]]
        return {
            "density_per_m2": self.plan.density_per_m2,
            "bodies": self.plan.bodies,
            "could_be_seen": {
                why: _share(sum(one[1] == why for one in standing), len(standing)) for why in WHYS
            },
            "within_4_px": _share(sum(one[2] for one in standing), len(standing)),
            "lit": len(lit),
            "found": sum(one[3] for one in lit),
            "free": len(free),
            "free_found": sum(one[3] for one in free),
            "false_alarms": sum(record["false_alarms"] for record in self.records),
            "parts": sum(record["parts"] for record in self.records),
            "sets_judged": len(self.plan.judged) * len(self.records),
            "range": _range_figures(free),
            "ranges_by_sight": {
                why: _claims([one for one in lit if one[1] == why]) for why in _CAN_BE_RANGED
            },
            "packets": len(packets),
            "packets_received": sum(packet[3] for packet in packets),
            "packets_by_sight": self._packets_by_sight(),
            "misattributed": sum(record["misattributed"] for record in self.records),
            "wrong_words": sum(record["wrong_words"] for record in self.records),
            "told_in_full": self._told_in_full(),
            "identities_right": sum(len(record["identities"]["right"]) for record in self.records),
            "identities_wrong": sum(record["identities"]["wrong"] for record in self.records),
            **self._tracks(),
            "shared_light_worst": max(
                (one["worst_share"] for record in self.records for one in record["shared"].values()),
                default=0.0,
            ),
            "shared_light_mean": max(
                (one["mean_share"] for record in self.records for one in record["shared"].values()),
                default=0.0,
            ),
            "seconds": self._seconds(),
        }

    def _packets_by_sight(self) -> dict[str, list[int]]:
        """Return by how the sender could be seen how many packets there were, and were received."""
        found = {why: [0, 0] for why in WHYS}
        for record in self.records:
            why_of = {sight[0]: sight[1] for sight in record["standing"]}
            for robot, _, _, received in record["packets"]:
                found[why_of[robot]][0] += 1
                found[why_of[robot]][1] += received
        return {why: counts for why, counts in found.items() if counts[0]}

    def _tracks(self) -> dict[str, int]:
        """Return how many tracks there are as runs end.

        How many of them are off on the bearing of a robot whose flare is not its own, of nobody, of whom
        another one is already.
        """
        each = [record["tracks"] for record in self.records]
        known = [[robot for robot, _ in tracks if robot is not None] for tracks in each]
        return {
            "tracks": sum(map(len, each)),
            "tracks_off": sum(robot is not None and off for tracks in each for robot, off in tracks),
            "tracks_of_nobody": sum(map(len, each)) - sum(map(len, known)),
            "tracks_twice": sum(len(tracks) - len(set(tracks)) for tracks in known),
        }

    def _told_in_full(self) -> int:
        """Return how many robots said all words of who they are."""
        length = len(words_of(0, self.plan.robots))
        count = 0
        for record in self.records:
            robots = [packet[0] for packet in record["packets"]]
            count += sum(robots.count(robot) == length for robot in set(robots))
        return count

    def _seconds(self) -> dict[str, float | None]:
        """Return processor time, the light of all cameras, and in the median a set after the first."""
        rendered = [row["render_cpu_s"] for row in self.seconds if "render_cpu_s" in row]
        later = [row for row in self.seconds if "render_cpu_s" not in row]
        parts: dict[str, float | None] = {}
        for part in ("expose", "detect", "follow"):
            known = [row[f"{part}_cpu_s"] for row in later if f"{part}_cpu_s" in row]
            parts[part] = float(np.median(known)) if known else None
        return {"light_of_a_set": max(rendered, default=None), **parts}


@dataclass(frozen=True)
class Outcome:
    """All conditions of the experiment."""

    robots: int
    scene: str
    seeds: Sequence[int]
    conditions: Sequence[Condition]

    def record(self) -> dict[str, Any]:
        """Return the figures as plain data."""
        return {
            "format": 1,
            "experiment": "swarm",
            "robots": self.robots,
            "seeds": list(self.seeds),
            "conditions": [condition.figures() for condition in self.conditions],
        }


def name_of(plan: Swarm) -> str:
    """Return what the folder of a condition is called."""
    return f"{plan.bodies}-{plan.density_per_m2:g}"


def conditions_of(
    plan: Swarm, densities_per_m2: Sequence[float] = (), bodies: str | None = None
) -> list[Swarm]:
    """Return a plan for each kind of bodies and each density; both, at 0.5, 1 and 2 per m², by default."""
    return [
        replace(plan, bodies=of_bodies, density_per_m2=density)
        for of_bodies in ([str(bodies)] if bodies else BODIES)
        for density in (densities_per_m2 or DENSITIES_PER_M2)
    ]


def outcome_of(
    scene: Scene, plans: Sequence[Swarm], seeds: Sequence[int], folder: Path, workers: int, progress: Progress
) -> Outcome:
    """Run every condition for each seed; errors as `run_seeds`."""
    found: list[Condition] = []
    for plan in plans:
        there, before = folder / name_of(plan), len(found) * len(seeds)

        def tell(done: int, _: int, before: int = before) -> None:
            progress(before + done, len(plans) * len(seeds))

        records = run_seeds(scene, plan, seeds, there, workers, tell)
        seconds = [row for seed in seeds for row in read_lines(run_folder(there, seed) / SECONDS)]
        found.append(Condition(plan, records, seconds))
    return Outcome(plans[0].robots, scene.document.name, list(seeds), found)


def _range_figures(free: Sequence[list[Any]]) -> dict[str, float | None]:
    """Return errors of ranges of robots that stand free, fully lit, beside the Cramér–Rao bound."""
    known = [one for one in free if one[3] and one[5] is not None]
    said = np.array(
        [(one[4], one[5], one[6], one[7]) for one in known if one[6] is not None and one[7] is not None]
    )
    if not len(said):
        return {
            "number": 0.0,
            "unranged": float(len(known)),
            "rmse_m": None,
            "limit_m": None,
            "bias_sigmas": None,
            "of_limit": None,
            "typical_of_limit": None,
            "of_sigma": None,
        }
    true_m, limit_m, said_m, sigma_m = said.T
    off_m = said_m - true_m
    return {
        "number": float(len(said)),
        "unranged": float(len(known) - len(said)),
        "rmse_m": math.sqrt(float((off_m**2).mean())),
        "limit_m": math.sqrt(float((limit_m**2).mean())),
        "bias_sigmas": float((off_m / limit_m).mean()),
        "of_limit": math.sqrt(float(((off_m / limit_m) ** 2).mean())),
        "typical_of_limit": float(np.median(abs(off_m / limit_m)) / _MEDIAN_OF_NORMAL),
        "of_sigma": math.sqrt(float(((off_m / sigma_m) ** 2).mean())),
    }


def _claims(sights: Sequence[list[Any]]) -> dict[str, float | None]:
    """Return how true ranges are of who shines all through: errors held against the σ they claim."""
    steady = [one for one in sights if one[8]]
    said = [one for one in steady if one[3] and one[6] is not None and one[7] is not None]
    true_m, said_m, sigma_m = (np.array([one[column] for one in said]) for column in (4, 6, 7))
    of_sigma = abs(said_m - true_m) / sigma_m
    return {
        "lit": float(len(steady)),
        "found": float(sum(one[3] for one in steady)),
        "ranged": float(len(said)),
        "within_3_sigmas": float((of_sigma <= 3.0).sum()),
        "off_typical": float(np.median(abs(said_m / true_m - 1.0))) if len(said) else None,
        "sigma_typical": float(np.median(sigma_m / true_m)) if len(said) else None,
        "of_sigma": math.sqrt(float((of_sigma**2).mean())) if len(said) else None,
    }


def _share(number: int, of: int) -> float:
    return number / of if of else 0.0
