"""Doing the studies as campaigns, and what came of them: maps of threat × lever, and how far bounds hold."""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from nir_render.experiments.limits.holds import Hold, holds_of, with_limit
from nir_render.experiments.limits.studies import Study, crossings_of, study_campaign
from nir_render.stress.campaign import Campaign
from nir_render.stress.design.axes import Axis
from nir_render.stress.jobs import Job, plan
from nir_render.stress.metrics import METRICS
from nir_render.stress.sums import COUNT, TOTAL, JobSums, job_sums, pooled
from nir_render.stress.sweep import Progress, Sweep, sweep, write_report

LIGHT = "light"
"""Where all campaigns of an experiment keep their light, in its folder."""

Bar = Callable[[str], AbstractContextManager[Progress]]


@dataclass(frozen=True, eq=False)
class Crossing:
    """A threat crossed with one lever.

    `sums` has the Cramér–Rao bound among its estimators; `report` is the campaign's own page; `failed` how
    many of its jobs are missing.
    """

    campaign: Campaign
    sums: JobSums
    holds: tuple[Hold, ...]
    report: Path
    jobs: int
    failed: int
    warnings: tuple[str, ...]

    @property
    def threat(self) -> Axis:
        """The axis of the threat."""
        return self.campaign.axes[0]

    @property
    def lever(self) -> Axis:
        """The axis of the lever."""
        return self.campaign.axes[1]

    def of(self, estimator: str) -> tuple[Hold, ...]:
        """Return how far one estimator goes, by the lever's values."""
        return tuple(hold for hold in self.holds if hold.estimator == estimator)

    def record(self) -> dict[str, Any]:
        """Return it as plain data: how far bounds hold, and each figure by threat (rows) and lever."""
        return {
            "threat": list(self.threat.labels),
            "lever": list(self.lever.labels),
            "jobs": self.jobs,
            "failed": self.failed,
            "holds": [hold.record(self.threat, self.lever) for hold in self.holds],
            "maps": {
                metric: {name: _cells(self.campaign, self.sums, name, metric) for name in self.sums.estimators}
                for metric in self.campaign.metrics
            },
        }


@dataclass(frozen=True, eq=False)
class StudyOutcome:
    """What came of one study: its document, and a crossing for each lever."""

    study: Study
    campaign: Campaign
    crossings: Mapping[str, Crossing]

    def record(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "threat": self.study.threat,
            "ability": self.study.ability,
            "description": self.campaign.description,
            "bounds": {bound.metric: bound.value for bound in self.campaign.bounds},
            "crossings": {name: one.record() for name, one in self.crossings.items()},
        }


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of all studies that were asked for."""

    studies: tuple[StudyOutcome, ...]

    @property
    def failed(self) -> int:
        """How many jobs are missing."""
        return sum(one.failed for of in self.studies for one in of.crossings.values())

    def record(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "format": 1,
            "experiment": "limits",
            "failed": self.failed,
            "studies": {of.study.name: of.record() for of in self.studies},
        }


def outcome_of(
    studies: Sequence[Study], seeds: int | None, folder: Path, workers: int | None, bar: Bar
) -> Outcome:
    """Do what is missing of some studies, and judge them; each crossing is a campaign in `folder/STUDY/LEVER`.

    Parameters
    ----------
    seeds
        How many of each, from 1 on; as many as its document has where it is None.
    bar
        Opens the progress of a campaign, which it names.

    Raises
    ------
    InputError, StoppedError
        As `sweep`.
    """
    planned = []
    for study in studies:
        campaign = study_campaign(study, seeds)
        crossed = crossings_of(campaign, study.repeated)
        with bar("check") as progress:
            # All are checked before the first begins.
            jobs = {name: plan(one, progress) for name, one in crossed.items()}
        planned.append((study, campaign, crossed, jobs))
    found = []
    for study, campaign, crossed, jobs in planned:
        crossings = {}
        for name, one in crossed.items():
            with bar(f"{study.name}, {name.replace('_', ' ')}") as progress:
                crossings[name] = _crossing(study, one, jobs[name], folder, name, workers, progress)
        found.append(StudyOutcome(study, campaign, crossings))
    return Outcome(tuple(found))


def _crossing(
    study: Study,
    campaign: Campaign,
    jobs: Sequence[Job],
    folder: Path,
    name: str,
    workers: int | None,
    progress: Progress,
) -> Crossing:
    done: Sweep = sweep(
        campaign, jobs, folder / study.name / name, workers=workers, progress=progress, light=folder / LIGHT
    )
    return judged(study, campaign, done.table, write_report(done), len(jobs), len(done.failed), done.warnings)


def judged(
    study: Study,
    campaign: Campaign,
    table: pa.Table,
    report: Path,
    jobs: int,
    failed: int = 0,
    warnings: Sequence[str] = (),
) -> Crossing:
    """Judge a crossing by its table."""
    sums = with_limit(job_sums(campaign.axes, table))
    holds = holds_of(
        campaign.axes, campaign.bounds, sums, campaign.seeds[0], worst_is_high=study.worst_is_high
    )
    return Crossing(campaign, sums, holds, report, jobs, failed, tuple(warnings))


def _cells(campaign: Campaign, sums: JobSums, name: str, metric: str) -> list[list[float | None]]:
    rows, columns = (len(axis.labels) for axis in campaign.axes[:2])
    index = sums.place[:, 0] * columns + sums.place[:, 1]
    cells = pooled(sums.by_metric[name, metric], index, rows * columns)
    values = METRICS[metric].value(cells[TOTAL], cells[COUNT]).reshape(rows, columns)
    return [[float(value) if math.isfinite(value) else None for value in row] for row in values]
