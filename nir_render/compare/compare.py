"""Two runs, or two estimators of one run, paired and compared: from folders to figures and a page."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nir_render.compare.figures import Compared, agree, compare_figures
from nir_render.compare.pairs import FramePair, Pairing, ScoredRun, frame_pair, pair_runs, read_scored
from nir_render.compare.sets import compare_sets, set_pairs, sets_agree
from nir_render.errors import InputError


@dataclass(frozen=True, eq=False)
class EstimatorComparison:
    """An estimator of the first run and one of the second, on all paired frames, and sets of frames.

    `sets` has the figures of what their rigs measured, none where a side has no measurements. `identical`
    tells that they have the same figures in every frame and set.
    """

    first: str
    second: str
    frames: tuple[FramePair, ...]
    figures: tuple[Compared, ...]
    identical: bool
    sets: tuple[Compared, ...] = ()

    @property
    def all_figures(self) -> tuple[Compared, ...]:
        """Those of frames, then those of sets."""
        return (*self.figures, *self.sets)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two runs as they were read, how they pair, and each pair of estimators."""

    first: ScoredRun
    second: ScoredRun
    pairing: Pairing
    estimators: tuple[EstimatorComparison, ...]

    @property
    def labels(self) -> tuple[str, str]:
        """What to call the sides: the runs by the shortest end of their paths that tells them apart."""
        one, other = (run.folder.resolve() for run in (self.first, self.second))
        for parts in range(1, max(len(one.parts), len(other.parts)) + 1):
            labels = ("/".join(one.parts[-parts:]), "/".join(other.parts[-parts:]))
            if labels[0] != labels[1]:
                return labels
        return one.name, other.name

    def sides(self, pair: EstimatorComparison) -> tuple[str, str]:
        """Return what to call the sides of a pair of estimators."""
        if self.first is self.second:
            return pair.first, pair.second
        first, second = self.labels
        return (
            (first, second)
            if pair.first == pair.second
            else (f"{first}: {pair.first}", f"{second}: {pair.second}")
        )

    def record(self) -> dict[str, Any]:
        """Return the comparison as JSON has it."""
        return {
            "format": 1,
            "first": str(self.first.folder),
            "second": str(self.second.folder),
            "frames": len(self.pairing.keys),
            "same_frames": self.pairing.same_frames,
            "notes": list(self.pairing.notes),
            "estimators": [
                {
                    "first": pair.first,
                    "second": pair.second,
                    "identical": pair.identical,
                    "figures": {compared.figure.name: compared.record() for compared in pair.all_figures},
                }
                for pair in self.estimators
            ],
        }


def compare_runs(first: Path, second: Path | None = None, estimators: Sequence[str] = ()) -> Comparison:
    """Compare two runs, or two estimators of one.

    Parameters
    ----------
    first, second
        Run folders with truth and detections; without the second, two estimators of the first.
    estimators
        None: of two runs each estimator that both have, of one run its only two. One name: that of both runs.
        Two names: the first of the first run against the second of the second, or of the same run.

    Raises
    ------
    InputError
        A folder cannot be scored, the runs do not show the same world, or there are no such estimators.
    """
    if len(estimators) > 2:
        raise InputError(f"--estimators {','.join(estimators)}: wanted one name or two, such as paper,robust")
    of_first, of_second = (estimators[:1], estimators[-1:])
    one = read_scored(first, estimators if second is None else of_first)
    other = one if second is None else read_scored(second, of_second)
    pairing = pair_runs(one, other)
    notes = list(pairing.notes)
    pairs: list[tuple[str, str]]
    if second is None:
        if len(estimators or one.estimators) != 2:
            raise InputError(
                f"{first}: has detections of {', '.join(one.estimators)}; give two of them, "
                "--estimators FIRST,SECOND, or a second run"
            )
        before, after = estimators or one.estimators
        pairs = [(before, after)]
    elif estimators:
        pairs = [(of_first[0], of_second[0])]
    else:
        pairs = [(name, name) for name in one.estimators if name in other.estimators]
        for run, rest, which in ((one, other, "first"), (other, one, "second")):
            alone = [name for name in run.estimators if name not in rest.estimators]
            if alone:
                notes.append(f"only the {which} run has detections of {', '.join(alone)}")
        if not pairs:
            raise InputError(
                f"{first} has detections of {', '.join(one.estimators)}, {second} of "
                f"{', '.join(other.estimators)}; give --estimators FIRST,SECOND"
            )
    return Comparison(
        one,
        other,
        Pairing(pairing.keys, pairing.same_frames, tuple(notes)),
        tuple(_compared(one, other, pairing, names) for names in pairs),
    )


def _compared(
    first: ScoredRun, second: ScoredRun, pairing: Pairing, names: tuple[str, str]
) -> EstimatorComparison:
    frames = tuple(frame_pair(key, first, second, *names) for key in pairing.keys)
    sets = set_pairs(first, second, *names)
    identical = agree(frames) and sets_agree(sets)
    return EstimatorComparison(*names, frames, compare_figures(frames), identical, compare_sets(sets))
