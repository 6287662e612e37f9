"""Doing the studies as campaigns, and what came of them: maps of threat × lever, and how far bounds hold."""

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from nir_render.experiments.limits.holds import Hold, holds_of, with_limit
from nir_render.experiments.limits.studies import (
    Study,
    as_built,
    levers_of,
    points_of_study,
    study_campaign,
)
from nir_render.stress.campaign import Campaign
from nir_render.stress.design.axes import Axis
from nir_render.stress.jobs import plan
from nir_render.stress.metrics import METRICS
from nir_render.stress.sums import COUNT, TOTAL, JobSums, job_sums, pooled
from nir_render.stress.sweep import Progress, sweep

LIGHT = "light"
"""Where all campaigns of an experiment keep their light, in its folder."""

Bar = Callable[[str], AbstractContextManager[Progress]]


@dataclass(frozen=True, eq=False)
class Crossing:
    """A threat crossed with one lever.

    `axes` are the threat, the lever, and what is repeated; `built` is which of the lever's values robots have
    as they are built. `sums` has the Cramér–Rao bound among its estimators.
    """

    axes: tuple[Axis, ...]
    built: int
    sums: JobSums
    holds: tuple[Hold, ...]

    @property
    def threat(self) -> Axis:
        """The axis of the threat."""
        return self.axes[0]

    @property
    def lever(self) -> Axis:
        """The axis of the lever."""
        return self.axes[1]

    def of(self, estimator: str) -> tuple[Hold, ...]:
        """Return how far one estimator goes, by the lever's values."""
        return tuple(hold for hold in self.holds if hold.estimator == estimator)

    def record(self, metrics: Sequence[str]) -> dict[str, Any]:
        """Return it as plain data: how far bounds hold, and each figure by threat (rows) and lever."""
        return {
            "threat": list(self.threat.labels),
            "lever": list(self.lever.labels),
            "as_built": self.lever.labels[self.built],
            "holds": [hold.record(self.threat, self.lever) for hold in self.holds],
            "maps": {
                metric: {name: self._cells(name, metric) for name in self.sums.estimators}
                for metric in metrics
            },
        }

    def _cells(self, name: str, metric: str) -> list[list[float | None]]:
        rows, columns = (len(axis.labels) for axis in self.axes[:2])
        index = self.sums.place[:, 0] * columns + self.sums.place[:, 1]
        cells = pooled(self.sums.by_metric[name, metric], index, rows * columns)
        values = METRICS[metric].value(cells[TOTAL], cells[COUNT]).reshape(rows, columns)
        return [[float(value) if math.isfinite(value) else None for value in row] for row in values]


@dataclass(frozen=True, eq=False)
class StudyOutcome:
    """What came of one study: its document, and a crossing for each lever; `failed` is how many jobs did."""

    study: Study
    campaign: Campaign
    crossings: Mapping[str, Crossing]
    jobs: int
    failed: int
    warnings: tuple[str, ...] = ()

    def record(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "threat": self.study.threat,
            "ability": self.study.ability,
            "description": self.campaign.description,
            "jobs": self.jobs,
            "failed": self.failed,
            "seeds": len(self.campaign.seeds),
            "bounds": {bound.metric: bound.value for bound in self.campaign.bounds},
            "crossings": {name: one.record(self.campaign.metrics) for name, one in self.crossings.items()},
        }


@dataclass(frozen=True, eq=False)
class Outcome:
    """What came of all studies that were asked for."""

    studies: tuple[StudyOutcome, ...]

    @property
    def failed(self) -> int:
        """How many jobs are missing."""
        return sum(of.failed for of in self.studies)

    def record(self) -> dict[str, Any]:
        """Return it as plain data."""
        return {
            "format": 1,
            "experiment": "limits",
            "studies": {of.study.name: of.record() for of in self.studies},
        }


def outcome_of(
    studies: Sequence[Study], seeds: int | None, folder: Path, workers: int | None, bar: Bar
) -> Outcome:
    """Do what is missing of some studies, and judge them; each is a campaign in `folder/STUDY`.

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
    found = []
    for study in studies:
        campaign = study_campaign(study, seeds)
        with bar("check") as progress:
            jobs = plan(campaign, progress, points=points_of_study(campaign, study.repeated))
        with bar(study.name) as progress:
            done = sweep(
                campaign,
                jobs,
                folder / study.name,
                workers=workers,
                progress=progress,
                light=folder / LIGHT,
            )
        crossings = crossings_of(study, campaign, job_sums(campaign.axes, done.table))
        found.append(StudyOutcome(study, campaign, crossings, len(jobs), len(done.failed), done.warnings))
    return Outcome(tuple(found))


def crossings_of(study: Study, campaign: Campaign, sums: JobSums) -> dict[str, Crossing]:
    """Judge a study by the sums of its table, lever by lever: all others as built."""
    levers = levers_of(campaign, study.repeated)
    built = {index: as_built(campaign, campaign.axes[index]) for index in levers}
    known = with_limit(sums)
    crossings = {}
    for lever in levers:
        others = [index for index in levers if index != lever]
        kept = np.all([known.place[:, index] == built[index] for index in others], axis=0)
        order = [0, lever, *(index for index in range(1, len(campaign.axes)) if index not in levers)]
        axes = tuple(campaign.axes[index] for index in order)
        own = known.subset(np.broadcast_to(kept, len(known.jobs)))
        own = replace(own, place=own.place[:, order])
        holds = holds_of(axes, campaign.bounds, own, campaign.seeds[0], worst_is_high=study.worst_is_high)
        crossings[campaign.axes[lever].name] = Crossing(axes, built[lever], own, holds)
    return crossings
