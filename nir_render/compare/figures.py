"""The figures that are compared, their sums frame by frame, and the verdict on each."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from nir_render.compare.paired import (
    LEAST_FRAMES,
    LEVEL,
    REPETITIONS,
    Interval,
    Sums,
    Values,
    exact_probability,
    interval_of_counts,
    interval_of_means,
)
from nir_render.compare.pairs import FramePair, SourcePair

Verdict = Literal["better", "worse", "differs", "no difference seen", "too few frames"]
Kind = Literal["count", "mean", "root", "bias"]


@dataclass(frozen=True)
class Figure:
    """A figure: how it is called here and in `summary.json`, its unit, and which way is better.

    `kind` tells how it is made: of counted things, a mean, the root of a mean square, or a signed mean.
    `better` is 1 where more is better, −1 where less is, 0 where neither. `per` tells what is drawn again:
    frames, or a rig's sets of frames.
    """

    name: str
    title: str
    unit: Literal["share", "per frame", "per set", "m", "deg"]
    kind: Kind
    better: int
    per: Literal["frame", "set"] = "frame"


FIGURES = (
    Figure("recall", "recall", "share", "count", 1),
    Figure("false_alarms_per_frame", "false alarms per frame", "per frame", "count", -1),
    Figure("range_mae_m", "range MAE", "m", "mean", -1),
    Figure("range_rmse_m", "range RMSE", "m", "root", -1),
    Figure("range_bias_m", "range bias", "m", "bias", -1),
    Figure("bearing_rms_deg", "bearing RMS", "deg", "root", -1),
    Figure("ranged", "found with a range", "share", "count", 1),
    Figure("ghosts_reported_per_frame", "ghosts reported per frame", "per frame", "count", 0),
    Figure("lamps_reported_per_frame", "lamps reported per frame", "per frame", "count", 0),
)


@dataclass(frozen=True)
class Compared:
    """One figure of both sides, and the difference second − first, over what both were asked.

    `count` is how many sources or frames that is, in `frames` frames. The interval from `low` to `high` holds
    the difference in 95 of 100 such comparisons; `least_seen` is the smallest that 4 of 5 of them would see.
    `only_first`, `only_second` count what one side has more of than the other, over frames, and `probability`
    is that of chance alone making such a difference; None for figures that count nothing. None stands for
    what is not known.
    """

    figure: Figure
    first: float | None
    second: float | None
    difference: float | None
    low: float | None
    high: float | None
    least_seen: float | None
    verdict: Verdict
    frames: int
    count: int
    only_first: int | None = None
    only_second: int | None = None
    probability: float | None = None

    def record(self) -> dict[str, Any]:
        """Return the numbers, as JSON has them."""
        return {name: value for name, value in asdict(self).items() if name != "figure"}


def compare_figures(frames: Sequence[FramePair], repetitions: int = REPETITIONS) -> tuple[Compared, ...]:
    """Compare every figure over paired frames.

    Recall is over sources that count on both sides; range and bearing errors are over those of them that both
    sides found (and ranged): otherwise who finds more faint sources would seem less exact.
    """
    sums = _sums(frames)
    same = _agree(sums)
    return tuple(compare_figure(figure, sums[figure.name], same, repetitions) for figure in FIGURES)


def agree(frames: Sequence[FramePair]) -> bool:
    """Tell whether both sides have the same figures in every frame."""
    return _agree(_sums(frames))


def compare_figure(
    figure: Figure, sums: Sums, same: bool = False, repetitions: int = REPETITIONS
) -> Compared:
    """Compare one figure; `same` tells that all figures agree in every frame: then nothing is estimated."""
    asked = sums.asked()
    first, second = asked.values()
    frames, count = asked.count.size, round(float(asked.count.sum()))
    interval: Interval | None
    if same and frames >= LEAST_FRAMES:
        interval = Interval(0.0, 0.0)
    elif figure.kind == "count":
        interval = interval_of_counts(asked, repetitions)
    else:
        interval = interval_of_means(asked, repetitions)
    counts: dict[str, Any] = {}
    least = interval.least_seen if interval is not None else None
    if figure.kind == "count":
        gained = asked.second - asked.first
        counts = {
            "only_first": round(float(-gained[gained < 0.0].sum())),
            "only_second": round(float(gained[gained > 0.0].sum())),
            "probability": exact_probability(gained),
        }
        if least is not None and not same:
            # By one in each of fewer frames the exact test sees nothing.
            least = max(least, LEAST_FRAMES / float(asked.count.sum()))
    return Compared(
        figure=figure,
        first=_or_none(first),
        second=_or_none(second),
        difference=_or_none(second - first),
        low=interval.low if interval is not None else None,
        high=interval.high if interval is not None else None,
        least_seen=least,
        verdict=_verdict(figure, asked, interval, counts.get("probability"), repetitions),
        frames=frames,
        count=count,
        **counts,
    )


def _agree(sums: Mapping[str, Sums]) -> bool:
    return all(np.array_equal(each.first, each.second) for each in sums.values())


def _verdict(
    figure: Figure, sums: Sums, interval: Interval | None, probability: float | None, repetitions: int
) -> Verdict:
    if interval is None:
        return "too few frames"
    differing = int(np.count_nonzero(sums.first != sums.second))
    by_chance = differing < LEAST_FRAMES or (probability is not None and probability >= 1.0 - LEVEL)
    if interval.side == 0 or by_chance:
        return "no difference seen"
    gain = interval.side * figure.better
    if figure.kind == "bias":
        # |b| < |a| where (b − a)(b + a) < 0: both factors must be told from zero.
        added = interval_of_means(Sums(-sums.first, sums.second, sums.count), repetitions)
        gain = -interval.side * (added.side if added is not None else 0)
    return "better" if gain > 0 else "worse" if gain < 0 else "differs"


def _sums(frames: Sequence[FramePair]) -> Mapping[str, Sums]:
    def of_frames(first: Callable[[FramePair], float], second: Callable[[FramePair], float]) -> Sums:
        return Sums(_array(map(first, frames)), _array(map(second, frames)), np.ones(len(frames)))

    def of_sources(
        asked: Callable[[SourcePair], bool],
        first: Callable[[SourcePair], float],
        second: Callable[[SourcePair], float],
        root: bool = False,
    ) -> Sums:
        chosen = [[pair for pair in frame.sources if pair.countable and asked(pair)] for frame in frames]
        return Sums(
            _array(sum(map(first, pairs)) for pairs in chosen),
            _array(sum(map(second, pairs)) for pairs in chosen),
            _array(map(len, chosen)),
            root,
        )

    def ranged(pair: SourcePair) -> bool:
        return math.isfinite(pair.first.range_error_m) and math.isfinite(pair.second.range_error_m)

    def placed(pair: SourcePair) -> bool:
        return math.isfinite(pair.first.bearing_error_deg) and math.isfinite(pair.second.bearing_error_deg)

    return {
        "recall": of_sources(lambda _: True, lambda p: p.first.found, lambda p: p.second.found),
        "ranged": of_sources(
            lambda p: p.first.found and p.second.found,
            lambda p: math.isfinite(p.first.range_error_m),
            lambda p: math.isfinite(p.second.range_error_m),
        ),
        "range_mae_m": of_sources(
            ranged, lambda p: abs(p.first.range_error_m), lambda p: abs(p.second.range_error_m)
        ),
        "range_rmse_m": of_sources(
            ranged, lambda p: p.first.range_error_m**2, lambda p: p.second.range_error_m**2, root=True
        ),
        "range_bias_m": of_sources(ranged, lambda p: p.first.range_error_m, lambda p: p.second.range_error_m),
        "bearing_rms_deg": of_sources(
            placed, lambda p: p.first.bearing_error_deg**2, lambda p: p.second.bearing_error_deg**2, root=True
        ),
        "false_alarms_per_frame": of_frames(
            lambda f: len(f.first.false_alarms), lambda f: len(f.second.false_alarms)
        ),
        "ghosts_reported_per_frame": of_frames(lambda f: f.first.ghosts, lambda f: f.second.ghosts),
        "lamps_reported_per_frame": of_frames(lambda f: f.first.lamps, lambda f: f.second.lamps),
    }


def _array(values: Any) -> Values:
    return np.array(list(values), dtype=np.float64)


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
