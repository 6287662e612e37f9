"""What rigs measure in sets of frames, compared: the figures `set_…` of `summary.json`, paired set by set."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from nir_render.compare.figures import Compared, Figure, compare_figure
from nir_render.compare.paired import REPETITIONS, Sums
from nir_render.compare.pairs import ScoredRun
from nir_render.evaluate.headings import heading_error_rad
from nir_render.evaluate.sets import SetEvaluation, SetScore, set_error
from perception.types import FrameKey, Measurement

FIGURES = (
    Figure("set_recall", "robots measured", "share", "count", 1, "set"),
    Figure("set_false_alarms_per_set", "false measurements per set", "per set", "count", -1, "set"),
    Figure("set_position_rmse_m", "position RMSE", "m", "root", -1, "set"),
    Figure("set_range_rmse_m", "range RMSE, joined", "m", "root", -1, "set"),
    Figure("set_ghosts_told", "images told as such", "share", "count", 1, "set"),
    Figure("set_robots_told_per_set", "robots told by several sources per set", "per set", "count", 1, "set"),
    Figure("set_heading_rms_deg", "heading RMS", "deg", "root", -1, "set"),
)

_Key = tuple[FrameKey, ...]


@dataclass(frozen=True, eq=False)
class SetPair:
    """One set of frames on both sides: sources and images that both know, and what each side said.

    `errors_m` are (position, range) of each robot that both sides kept, `headings_rad` of each that both
    told.
    """

    robots: int
    kept: tuple[int, int]
    images: int
    told: tuple[int, int]
    false_alarms: tuple[int, int]
    stands: tuple[int, int]
    errors_m: tuple[tuple[tuple[float, float], tuple[float, float]], ...]
    headings_rad: tuple[tuple[float, float], ...]


def compare_sets(pairs: Sequence[SetPair], repetitions: int = REPETITIONS) -> tuple[Compared, ...]:
    """Compare every figure over paired sets; none of which there is nothing.

    Recall is over robots that count on both sides; errors are over those of them that both measured and took
    for robots, headings over those that both told.
    """
    sums, same = _sums(pairs), sets_agree(pairs)
    return tuple(
        compare_figure(figure, sums[figure.name], same, repetitions)
        for figure in FIGURES
        if figure.name in sums
    )


def sets_agree(pairs: Sequence[SetPair]) -> bool:
    """Tell whether both sides have the same figures in every set."""
    return all(np.array_equal(each.first, each.second) for each in _sums(pairs).values())


def set_pairs(first: ScoredRun, second: ScoredRun, first_name: str, second_name: str) -> list[SetPair]:
    """Return the sets that both runs have, by the time of the first; none where a side measured nothing.

    Of the first run an estimator's measurements are taken, of the second another's or the same one's.
    """
    one, other = first.around, second.around
    if one is None or other is None or first_name not in one.summary or second_name not in other.summary:
        return []
    ours, theirs = _by_set(one), _by_set(other)
    return [
        _paired((one, ours[keys], first_name), (other, theirs[keys], second_name))
        for keys in ours
        if keys in theirs
    ]


def _sums(pairs: Sequence[SetPair]) -> Mapping[str, Sums]:
    """Return each figure's sums, set by set; none of figures of which there is nothing."""

    def of_sides(of: Callable[[SetPair, int], float], count: Callable[[SetPair], float], root: bool) -> Sums:
        first, second = (np.array([of(pair, side) for pair in pairs], dtype=np.float64) for side in range(2))
        return Sums(first, second, np.array([count(pair) for pair in pairs], dtype=np.float64), root)

    def counted(of: Callable[[SetPair, int], float], count: Callable[[SetPair], float]) -> Sums:
        return of_sides(of, count, root=False)

    def errors_m(which: int) -> Sums:
        def squared(pair: SetPair, side: int) -> float:
            return sum(error[side][which] ** 2 for error in pair.errors_m)

        return of_sides(squared, lambda pair: len(pair.errors_m), root=True)

    def headings_deg(pair: SetPair, side: int) -> float:
        return sum(math.degrees(error[side]) ** 2 for error in pair.headings_rad)

    sums = {
        "set_recall": counted(lambda pair, side: pair.kept[side], lambda pair: pair.robots),
        "set_false_alarms_per_set": counted(lambda pair, side: pair.false_alarms[side], lambda _: 1.0),
        "set_position_rmse_m": errors_m(0),
        "set_range_rmse_m": errors_m(1),
        "set_ghosts_told": counted(lambda pair, side: pair.told[side], lambda pair: pair.images),
    }
    if any(any(pair.stands) for pair in pairs):
        sums["set_robots_told_per_set"] = counted(lambda pair, side: pair.stands[side], lambda _: 1.0)
        sums["set_heading_rms_deg"] = of_sides(headings_deg, lambda pair: len(pair.headings_rad), root=True)
    return {name: each for name, each in sums.items() if each.count.sum() > 0.0}


_Side = tuple[SetEvaluation, int, str]


def _by_set(around: SetEvaluation) -> dict[_Key, int]:
    return {tuple(sorted(keys)): number for number, keys in enumerate(around.sets)}


def _paired(first: _Side, second: _Side) -> SetPair:
    ours, theirs = _scores(first), _scores(second)
    both = [(ours[name], theirs[name]) for name in ours if name in theirs]
    robots = [(a, b) for a, b in both if not a.is_ghost and a.countable and b.countable]
    images = [(a, b) for a, b in both if a.is_ghost and a.countable and b.countable]
    kept = [(_kept(a, first[2]), _kept(b, second[2])) for a, b in robots]
    heads = [_headings(side) for side in (first, second)]
    return SetPair(
        robots=len(robots),
        kept=(sum(a is not None for a, _ in kept), sum(b is not None for _, b in kept)),
        images=len(images),
        told=(
            sum(_is_told(a, first[2]) for a, _ in images),
            sum(_is_told(b, second[2]) for _, b in images),
        ),
        false_alarms=(_alarms(first), _alarms(second)),
        stands=(len(heads[0]), len(heads[1])),
        errors_m=tuple(
            (_errors_m(score_a, a), _errors_m(score_b, b))
            for (score_a, score_b), (a, b) in zip(robots, kept, strict=True)
            if a is not None and b is not None and math.isfinite(a.range_m + b.range_m)
        ),
        headings_rad=tuple((heads[0][name], heads[1][name]) for name in heads[0] if name in heads[1]),
    )


def _scores(side: _Side) -> dict[tuple[str, str, str | None, int], SetScore]:
    """Return the scores of a set by robot, source and whose image; of several mirrors by their order."""
    around, number, _ = side
    found: dict[tuple[str, str, str | None, int], SetScore] = {}
    for score in around.scores:
        if score.number == number:
            truth, again = score.truth, 0
            while (truth.robot, truth.source, truth.ghost_of, again) in found:
                again += 1
            found[truth.robot, truth.source, truth.ghost_of, again] = score
    return found


def _kept(score: SetScore, name: str) -> Measurement | None:
    said = score.measurements.get(name)
    return None if said is None or said.ghost == "yes" else said


def _is_told(score: SetScore, name: str) -> bool:
    return name in score.measurements and score.measurements[name].ghost == "yes"


def _alarms(side: _Side) -> int:
    around, number, name = side
    return sum(of_set == number for of_set, _ in around.false_alarms[name])


def _errors_m(score: SetScore, said: Measurement) -> tuple[float, float]:
    """Return by how much place and range are off."""
    left_rad, up_rad, range_m = set_error(score, said).tolist()
    away_m = float(np.linalg.norm(score.position_body_m))
    return math.hypot(left_rad * away_m, up_rad * away_m, range_m), range_m


def _headings(side: _Side) -> dict[str, float]:
    """Return heading errors by robot, of those whose heading is known."""
    around, number, name = side
    return {
        stand.robot: heading_error_rad(stand)
        for stand in around.stands.get(name, ())
        if stand.number == number and stand.true is not None
    }
