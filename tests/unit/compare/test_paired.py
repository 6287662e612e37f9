"""The statistics of paired differences, held against synthetic runs whose true difference is known."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import binomtest

from nir_render.compare.figures import FIGURES, Figure, compare_figure
from nir_render.compare.paired import (
    LEAST_FRAMES,
    Sums,
    exact_probability,
    interval_of_counts,
    interval_of_means,
)

Values = np.ndarray
RUNS = 1000
FRAMES, SOURCES = 40, 3
BY_NAME = {figure.name: figure for figure in FIGURES}


def _sums(first: Values, second: Values, count: Values | None = None, *, root: bool = False) -> Sums:
    one, other = np.asarray(first, dtype=float), np.asarray(second, dtype=float)
    return Sums(one, other, np.ones(one.size) if count is None else np.asarray(count, dtype=float), root)


def _errors(random: np.random.Generator, frames: int, tails: float | None) -> tuple[Values, Values, Values]:
    """Errors of both sides, and which of the sources both found; sources of one frame share a part.

    Gaussian, or Student's t with so many degrees of freedom, scaled to σ = 1. The first side has a bias of 0.2
    and σ² = 0.25 + 1, the second 0.1 and 0.8² · 0.25 + 0.9².
    """
    shape = (frames, SOURCES)
    shared = 0.5 * random.normal(size=(frames, 1))
    if tails is None:
        one, other = random.normal(size=shape), random.normal(size=shape)
    else:
        scale = math.sqrt((tails - 2.0) / tails)
        one, other = scale * random.standard_t(tails, shape), scale * random.standard_t(tails, shape)
    return 0.2 + shared + one, 0.1 + 0.8 * shared + 0.9 * other, random.random(shape) < 0.8


TRUE = {
    "bias": -0.1,
    "root": math.sqrt(0.01 + 0.16 + 0.81) - math.sqrt(0.04 + 0.25 + 1.0),
    # The mean size of a Gaussian: σ √(2/π) exp(−m²/2σ²) + m erf(m/√2σ).
    "mean": (lambda of: of(0.1, math.sqrt(0.97)) - of(0.2, math.sqrt(1.25)))(
        lambda m, s: s * math.sqrt(2.0 / math.pi) * math.exp(-0.5 * (m / s) ** 2) + m * math.erf(m / s / math.sqrt(2.0))
    ),
}  # fmt: skip
SIZE: dict[str, Callable[[Values], Values]] = {"bias": lambda e: e, "root": np.square, "mean": np.abs}


@pytest.mark.verify
@pytest.mark.parametrize(
    ("kind", "frames", "tails"),
    [
        *((kind, frames, None) for kind in SIZE for frames in (10, FRAMES)),
        *((kind, FRAMES, 5.0) for kind in ("bias", "root")),
    ],
)
def test_intervals_of_means_cover_the_truth(kind: str, frames: int, tails: float | None) -> None:
    """1000 synthetic runs: the 95 % interval holds the true difference in 93 to 97 of 100."""
    random = np.random.default_rng([7, frames, len(kind)])
    held = 0
    for _ in range(RUNS):
        one, other, found = _errors(random, frames, tails)
        first, second = ((SIZE[kind](side) * found).sum(axis=1) for side in (one, other))
        interval = interval_of_means(_sums(first, second, found.sum(axis=1), root=kind == "root"), 500)
        assert interval is not None
        held += interval.low <= TRUE[kind] <= interval.high
    assert 930 <= held <= 970


@pytest.mark.verify
def test_intervals_of_recall_cover_the_truth() -> None:
    """Recall 0.90 and 0.95 of 1 to 4 sources a frame, some frames dark for both: the difference is 0.05."""
    random = np.random.default_rng(8)
    held = 0
    for _ in range(RUNS):
        count = random.integers(1, 5, size=60)
        both = random.binomial(count, 0.5)
        first = random.binomial(both, 0.9) + random.binomial(count - both, 0.9)
        second = random.binomial(both, 0.95) + random.binomial(count - both, 0.95)
        interval = interval_of_counts(_sums(first, second, count), 500)
        assert interval is not None
        held += interval.low <= 0.05 <= interval.high
    assert 930 <= held <= 970


@pytest.mark.verify
def test_intervals_of_false_alarms_cover_the_truth() -> None:
    """Alarms of both sides, a part of them shared: 0.8 and 0.5 per frame."""
    random = np.random.default_rng(9)
    held = 0
    for _ in range(RUNS):
        shared = random.poisson(0.3, FRAMES)
        interval = interval_of_counts(
            _sums(shared + random.poisson(0.5, FRAMES), shared + random.poisson(0.2, FRAMES)), 500
        )
        assert interval is not None
        held += interval.low <= -0.3 <= interval.high
    assert 930 <= held <= 970


@pytest.mark.verify
@pytest.mark.parametrize("name", ["range_mae_m", "range_rmse_m", "range_bias_m", "recall"])
def test_sides_that_are_alike_are_seldom_called_different(name: str) -> None:
    """Of 1000 comparisons of sides with one true figure at most about 50 see something that is not there."""
    random = np.random.default_rng([10, len(name)])
    figure, called = BY_NAME[name], 0
    for _ in range(RUNS):
        if name == "recall":
            sums = _sums(random.binomial(3, 0.9, FRAMES), random.binomial(3, 0.9, FRAMES), np.full(FRAMES, 3))
        else:
            kind = figure.kind
            one, other = (random.normal(0.1, 1.0, (FRAMES, SOURCES)) for _ in range(2))
            sums = _sums(
                SIZE[kind](one).sum(axis=1),
                SIZE[kind](other).sum(axis=1),
                np.full(FRAMES, 3),
                root=kind == "root",
            )
        called += compare_figure(figure, sums, repetitions=300).verdict != "no difference seen"
    assert called <= 72  # 50, and 3 σ of it


@pytest.mark.verify
def test_the_least_that_is_seen_is_seen_in_four_of_five() -> None:
    """Sides that differ by what such a comparison says it would see, on average: 76 to 86 of 100 see it."""
    random = np.random.default_rng(11)
    figure = BY_NAME["range_bias_m"]
    least = np.mean([
        compare_figure(figure, _sums(*random.normal(size=(2, FRAMES))), repetitions=300).least_seen
        for _ in range(200)
    ])  # fmt: skip
    seen = sum(
        interval.side == 1
        for _ in range(RUNS)
        if (
            interval := interval_of_means(
                _sums(*(random.normal(size=(2, FRAMES)) + np.array([[0.0], [least]]))), 300
            )
        )
    )
    assert 760 <= seen <= 860


def test_the_interval_is_that_of_the_textbook_where_there_is_one() -> None:
    """A mean of differences of 200 Gaussian frames: Student's t interval, to a few per cent of its width."""
    random = np.random.default_rng(12)
    first, second = random.normal(size=(2, 200))
    interval = interval_of_means(_sums(first, second))
    assert interval is not None
    gained = second - first
    half = 1.9720 * gained.std(ddof=1) / math.sqrt(200)
    assert interval.low == pytest.approx(gained.mean() - half, abs=0.06 * half)
    assert interval.high == pytest.approx(gained.mean() + half, abs=0.06 * half)


def test_pairing_takes_out_what_both_sides_share() -> None:
    """Errors that differ by a tenth of what they share: paired, the interval is a tenth as wide."""
    random = np.random.default_rng(13)
    shared = 5.0 + random.normal(size=100)
    own = 0.1 * random.normal(size=(2, 100))
    paired = interval_of_means(_sums(shared + own[0], shared + own[1]))
    apart = interval_of_means(_sums(shared + own[0], random.permutation(shared) + own[1]))
    assert paired is not None
    assert apart is not None
    assert paired.high - paired.low < 0.15 * (apart.high - apart.low)


def test_the_same_input_gives_the_same_bits() -> None:
    random = np.random.default_rng(14)
    sums = _sums(random.random(50), random.random(50), root=True)
    assert interval_of_means(sums) == interval_of_means(sums)
    counts = _sums(random.poisson(1.0, 50), random.poisson(1.0, 50))
    assert interval_of_counts(counts) == interval_of_counts(counts)


@pytest.mark.parametrize("figure", FIGURES, ids=lambda figure: figure.name)
def test_sides_that_agree_in_every_frame_differ_by_exactly_nothing(figure: Figure) -> None:
    values = np.random.default_rng(15).poisson(2.0, 30) + 0.1 * (FIGURES.index(figure) > 1)
    compared = compare_figure(figure, _sums(values, values.copy()), same=True)
    assert (compared.difference, compared.low, compared.high, compared.least_seen) == (0.0, 0.0, 0.0, 0.0)
    assert compared.verdict == "no difference seen"


def test_what_never_happened_is_not_ruled_out() -> None:
    """No miss on either side in 50 frames of one source: by the rule of three, 3/50 would be no surprise."""
    compared = compare_figure(BY_NAME["recall"], _sums(np.ones(50), np.ones(50)))
    assert compared.difference == 0.0
    assert compared.low is not None
    assert compared.high is not None
    assert compared.least_seen is not None
    assert -0.08 < compared.low < -0.03 < 0.03 < compared.high < 0.08
    assert compared.least_seen >= 6 / 50


def test_the_same_difference_in_every_frame_is_sure() -> None:
    interval = interval_of_means(_sums(np.full(20, 0.1), np.full(20, 0.3)))
    assert interval is not None
    assert [interval.low, interval.high] == pytest.approx([0.2, 0.2])


def test_one_frame_that_differs_is_no_difference() -> None:
    """However large it is: of 40 frames, 39 agree."""
    second = np.ones(40)
    second[7] = 1e3
    compared = compare_figure(BY_NAME["range_rmse_m"], _sums(np.ones(40), second, root=True))
    assert compared.verdict == "no difference seen"
    assert compared.low is not None
    assert compared.low < 0.0


@pytest.mark.parametrize("frames", range(LEAST_FRAMES))
def test_few_frames_get_no_interval(frames: int) -> None:
    sums = _sums(np.zeros(frames), np.ones(frames))
    for name in ("recall", "range_mae_m"):
        compared = compare_figure(BY_NAME[name], sums)
        assert (compared.low, compared.least_seen, compared.verdict) == (None, None, "too few frames")
        assert compared.frames == frames
    assert compare_figure(BY_NAME["recall"], _sums(np.zeros(6), np.ones(6))).verdict == "better"


def test_frames_that_were_not_asked_do_not_count() -> None:
    """Six frames with sources among 60 without are six frames."""
    sums = _sums(np.zeros(66), np.r_[np.ones(6), np.zeros(60)], np.r_[np.ones(6), np.zeros(60)])
    compared = compare_figure(BY_NAME["recall"], sums)
    assert (compared.frames, compared.count, compared.second) == (6, 6, 1.0)


def test_one_source_a_frame_is_mcnemars_exact_test() -> None:
    """3 found by the first only, 12 by the second: binomial, two-sided; concordant frames do not count."""
    gained = np.r_[-np.ones(3), np.ones(12), np.zeros(40)]
    assert exact_probability(gained) == pytest.approx(binomtest(3, 15, 0.5).pvalue, rel=1e-12)
    assert exact_probability(np.zeros(5)) == 1.0
    assert exact_probability(np.ones(6)) == 2.0 * 0.5**6


def test_sources_of_one_frame_are_tossed_together() -> None:
    """Steps of 3 and 1: sums ±4, ±2 with a quarter each; 2 or more is certain, 4 has one half."""
    assert exact_probability(np.array([3.0, -1.0])) == 1.0
    assert exact_probability(np.array([3.0, 1.0])) == 0.5
    random = np.random.default_rng(16)
    gained = random.integers(-3, 4, size=12).astype(float)
    tossed = np.array([[(toss >> k) % 2 * 2 - 1 for k in range(12)] for toss in range(4096)]) @ np.abs(gained)
    assert exact_probability(gained) == pytest.approx(np.mean(np.abs(tossed) >= abs(gained.sum())), abs=1e-12)


@pytest.mark.parametrize(
    ("first", "second", "verdict"),
    [(1.0, 0.2, "better"), (0.2, 1.0, "worse"), (-1.0, -0.2, "better"), (-0.5, 0.5, "differs"), (1.0, -0.2, "better")],
)  # fmt: skip
def test_a_bias_is_better_where_it_is_closer_to_zero(first: float, second: float, verdict: str) -> None:
    noise = 0.1 * np.random.default_rng(17).normal(size=(2, 60))
    compared = compare_figure(BY_NAME["range_bias_m"], _sums(first + noise[0], second + noise[1]))
    assert compared.verdict == verdict


@pytest.mark.parametrize(
    ("name", "verdict"),
    [("recall", "better"), ("false_alarms_per_frame", "worse"), ("ghosts_reported_per_frame", "differs")],
)
def test_which_way_is_better(name: str, verdict: str) -> None:
    compared = compare_figure(BY_NAME[name], _sums(np.zeros(20), np.ones(20)))
    assert compared.verdict == verdict
    assert (compared.only_first, compared.only_second) == (0, 20)
