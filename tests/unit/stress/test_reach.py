"""Limits against closed forms: where a known law crosses its bound, and how often the interval holds that."""

import dataclasses
import json
import math
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
import pytest

from nir_render.randomness import generator
from nir_render.stress.crossings import Edge, spans
from nir_render.stress.design.axes import Axis
from nir_render.stress.metrics import METRICS, Bound
from nir_render.stress.reach import Reach, corners_kept, reaches_of
from nir_render.stress.summary import _edge_record, summary_of
from nir_render.stress.sums import job_sums
from tests.unit.stress.synthetic import FOG, LAMP, RANGE, Row, campaign, frame, source, table

RMSE = Bound("range_rmse", 0.05)
LINEAR = dataclasses.replace(RANGE, log=False)
ONE = dataclasses.replace(RANGE, labels=("2 m",), numbers=(2.0,), values_si=(2.0,))
Rows = Callable[[dict[str, int], int, str], list[Row]]


def _limits(axes: Sequence[Axis], bound: Bound, rows: Rows, seeds: int = 1) -> list[Reach]:
    sums = job_sums(axes, table(axes, seeds, rows, ["robust"]))
    return list(reaches_of(axes, [bound], sums, 1))


def _of_errors(errors: Sequence[float | None], axis: Axis = RANGE) -> Reach:
    """The limit along one axis of a source at each value: "none" is one that does not count."""
    assert len(errors) == len(axis.labels)
    return _limits([axis], RMSE, lambda at, seed, who: [frame(), source(errors[at[axis.name]])])[0]


def test_a_power_law_over_a_log_axis_is_crossed_where_it_says() -> None:
    """RMSE = 1 cm · (range / m)²: 5 cm at √5 m, exactly, as the law is a straight line in both logarithms."""
    limit = _of_errors([0.01 * x**2 for x in RANGE.numbers or ()])
    (span,) = limit.pooled.spans
    assert (span.start.reason, span.start.value) == ("end", 1.0)
    assert span.end.reason == "crossing"
    assert span.end.value == pytest.approx(math.sqrt(5.0), rel=1e-12)
    assert limit.pooled.status == "in part"
    assert limit.pooled.holds == (True, True, False, False, False)
    assert limit.pooled.worst == pytest.approx(0.64)
    assert span.end.low is None  # one job per value: nothing says how sure it is


def test_an_exponential_law_over_a_linear_axis_is_crossed_where_it_says() -> None:
    limit = _of_errors([0.01 * math.exp(0.6 * x) for x in LINEAR.numbers or ()], LINEAR)
    assert limit.pooled.spans[0].end.value == pytest.approx(math.log(5.0) / 0.6, rel=1e-12)


def test_an_error_of_zero_is_joined_by_a_straight_line() -> None:
    limit = _of_errors([0.0, 0.10, 0.2, 0.2, 0.2], LINEAR)
    assert limit.pooled.spans[0].end.value == pytest.approx(1.35)


@pytest.mark.parametrize("found", [(10, 9, 8, 6), (6, 8, 9, 10)])
def test_shares_are_joined_by_straight_lines_and_hold_from_below(found: tuple[int, ...]) -> None:
    """Recall 100, 90, 80, 60 % at 10, 20, 40, 80 m of a linear axis: 85 % at 30 m. The same the other way round."""
    axis = dataclasses.replace(FOG, log=False)

    def rows(at: dict[str, int], seed: int, who: str) -> list[Row]:
        return [frame(), *(source(0.01 if i < found[at[axis.name]] else None) for i in range(10))]

    (limit,) = _limits([axis], Bound("recall", 0.85), rows)
    (span,) = limit.pooled.spans
    crossing, end = (span.end, span.start) if found[0] == 10 else (span.start, span.end)
    assert crossing.reason == "crossing"
    assert crossing.value == pytest.approx(30.0)
    assert (end.value, end.reason) == (10.0 if found[0] == 10 else 80.0, "end")


@pytest.mark.parametrize(
    ("errors", "status", "spans"),
    [
        ([0.01] * 5, "throughout", [(1.0, 8.0)]),
        ([0.5] * 5, "nowhere", []),
        ([0.05, 0.5, 0.5, 0.05, 0.5], "in part", [(1.0, 1.0), (4.8, 4.8)]),
        ([0.5, 0.01, 0.5, 0.5, 0.01], "in part", [None, None]),
    ],
)
def test_a_bound_may_hold_throughout_nowhere_or_here_and_there(
    errors: list[float | None], status: str, spans: list[tuple[float, float] | None]
) -> None:
    extent = _of_errors(errors).pooled
    assert extent.status == status
    assert len(extent.spans) == len(spans)
    for span, wanted in zip(extent.spans, spans, strict=True):
        if wanted is not None:
            assert (span.start.value, span.end.value) == pytest.approx(wanted)
        assert span.start.value <= span.end.value


def test_several_spans_end_at_the_crossings_between() -> None:
    """From 50 cm to 1 cm the law crosses 5 cm at the share ln 10 / ln 50 of the logarithmic way."""
    first, second = _of_errors([0.5, 0.01, 0.5, 0.5, 0.01]).pooled.spans
    way = math.log(10.0) / math.log(50.0)
    assert first.start.value == pytest.approx(1.7**way)
    assert first.end.value == pytest.approx(2.8 * (1.7 / 2.8) ** way)
    assert second.start.value == pytest.approx(4.8 * (8.0 / 4.8) ** way)
    assert second.end.reason == "end"


def test_no_range_is_no_pass() -> None:
    """Found nowhere beyond 2.8 m: the bound holds up to there, and no further; with no range at all nowhere."""
    limit = _of_errors([0.01, 0.01, 0.01, None, None])
    (span,) = limit.pooled.spans
    assert (span.end.value, span.end.reason) == (2.8, "not defined")
    assert limit.pooled.holds == (True, True, True, False, False)
    assert _of_errors([None] * 5).pooled.status == "nowhere"


def test_nothing_that_counts_is_no_pass_either() -> None:
    def rows(at: dict[str, int], seed: int, who: str) -> list[Row]:
        return [frame(), source(0.01, countable=1 <= at[RANGE.name] <= 3)]

    (limit,) = _limits([RANGE], RMSE, rows)
    (span,) = limit.pooled.spans
    assert (span.start.value, span.start.reason, span.end.value) == (1.7, "nothing there", 4.8)
    assert limit.pooled.holds == (None, True, True, True, None)
    assert limit.pooled.status == "wherever judged"
    (limit,) = _limits([RANGE], RMSE, lambda at, seed, who: [frame(), source(0.01, countable=False)])
    assert limit.pooled.status == "nothing to judge"
    assert (limit.slices, limit.slices_kept) == (0, 0)


@pytest.mark.parametrize(("error", "status"), [(0.01, "throughout"), (0.2, "nowhere")])
def test_an_axis_of_one_value_has_no_crossing(error: float, status: Literal["throughout", "nowhere"]) -> None:
    limit = _of_errors([error], ONE)
    assert limit.pooled.status == status
    assert limit.worst is None


def test_an_axis_without_numbers_says_which_values_hold() -> None:
    limit = _of_errors([0.01, 0.3, 0.02], LAMP)
    assert limit.pooled.holds == (True, False, True)
    assert limit.pooled.spans == ()


def _clutter(at: dict[str, int], seed: int, who: str) -> list[Row]:
    """RMSE = 1 cm · x² far from the lamp, four times that beside it: 5 cm at 2.24 m and 1.12 m."""
    x = (RANGE.numbers or ())[at[RANGE.name]]
    return [frame(), source(0.01 * x**2 * (4.0 if at["lamp"] == 1 else 1.0))]


def test_the_worst_corner_is_found_and_named() -> None:
    limit, of_lamp = _limits([RANGE, LAMP], RMSE, _clutter)
    assert limit.corner == (-1, 1)
    assert limit.worst is not None
    assert limit.worst.spans[0].end.value == pytest.approx(math.sqrt(5.0) / 2.0)
    # Pooled: the mean square is (1 + 16 + 1) / 3 = 6 of the lamp's off.
    assert limit.pooled.spans[0].end.value == pytest.approx(math.sqrt(5.0 / math.sqrt(6.0)))
    assert (limit.slices, limit.slices_kept) == (3, 0)
    assert (of_lamp.slices, of_lamp.slices_kept) == (5, 1)
    sums = job_sums([RANGE, LAMP], table([RANGE, LAMP], 1, _clutter, ["robust"]))
    assert corners_kept(RMSE, "robust", sums) == (5, 15)


def test_a_corner_that_breaks_the_bound_is_worse_than_one_that_cannot_be_judged() -> None:
    def rows(at: dict[str, int], seed: int, who: str) -> list[Row]:
        unseen = at["lamp"] == 0 and at[RANGE.name] > 0
        return [
            frame(),
            source(0.2 if at["lamp"] == 2 and at[RANGE.name] == 4 else 0.01, countable=not unseen),
        ]

    limit = _limits([RANGE, LAMP], RMSE, rows)[0]
    assert limit.corner == (-1, 2)
    assert (limit.slices, limit.slices_kept) == (3, 2)


def test_the_worst_corner_is_told_by_length_of_the_axis_not_by_number_of_values() -> None:
    """Held at two near values and no further, ln 1.7 = 0.53 of the axis; at one far value, but 0.63 of both gaps."""
    errors = {0: [0.0499, 0.0499, 5.0, 5.0, 5.0], 1: [0.5, 0.5, 0.5, 0.001, 0.5], 2: [0.01] * 5}
    limit = _limits(
        [RANGE, LAMP], RMSE, lambda at, seed, who: [frame(), source(errors[at["lamp"]][at[RANGE.name]])]
    )[0]
    assert limit.corner == (-1, 0)


def test_one_seed_gives_intervals_over_corners_and_none_within_one() -> None:
    limit = _limits([RANGE, LAMP], RMSE, _clutter)[0]
    end = limit.pooled.spans[0].end
    assert end.low is not None
    assert end.high is not None
    assert end.low < end.value < end.high
    assert limit.worst is not None
    assert limit.worst.spans[0].end.low is None
    assert limit.worst.agree is None


def _noisy(trial: int, sources: int) -> Rows:
    """Gaussian errors of σ = 1 cm · x² · (1, 1.5 or 2, by the lamp): the corners differ, the seeds do not."""

    def rows(at: dict[str, int], seed: int, who: str) -> list[Row]:
        x = (RANGE.numbers or ())[at[RANGE.name]]
        sigma_m = 0.01 * x**2 * (1.0 + 0.5 * at["lamp"])
        random = generator(1000 * trial + seed, "limits", "", 10 * at[RANGE.name] + at["lamp"])
        return [frame(), *(source(float(error)) for error in sigma_m * random.standard_normal(sources))]

    return rows


@pytest.mark.parametrize(("seeds", "least", "most"), [(2, 0.55, 0.71), (4, 0.58, 0.76)])
def test_the_interval_holds_the_truth_in_68_of_100_campaigns(seeds: int, least: float, most: float) -> None:
    """Two seeds are as few as can be: the bootstrap of three pairs of jobs holds 62 (300 campaigns), of four seeds 68.

    Drawing n of n jobs instead of n − 1 would make two seeds' intervals √2 too narrow: 50 of 100.

    The true limit solves mean σ² = (5 cm)²: x⁴ = 25 · 3 / (1 + 1.5² + 2²).
    """
    true = (25.0 * 3.0 / 7.25) ** 0.25
    inside, off = [], []
    for trial in range(150):
        limit = _limits([RANGE, LAMP], RMSE, _noisy(trial, 8), seeds=seeds)[0]
        (span,) = limit.pooled.spans
        assert span.end.low is not None
        assert span.end.high is not None
        inside.append(span.end.low <= true <= span.end.high)
        off.append(math.log(span.end.value / true))
    assert least < np.mean(inside) < most
    assert abs(np.mean(off)) < 3.0 * np.std(off) / math.sqrt(len(off)) < 0.015


def _recall_spans(value: list[float], draws: list[list[float]]) -> list[tuple[float | None, ...]]:
    """Where recall is at least 0.5 over x = 0, 1, 2, …: of each span both crossings' places and intervals."""
    x, asked = np.arange(len(value), dtype=np.float64), np.ones(len(value), dtype=bool)
    found = spans(x, False, METRICS["recall"], 0.5, np.array(value), asked, np.array(draws))
    return [
        (edge.value, edge.low, edge.high)
        for one in found
        for edge in (one.start, one.end)
        if edge.reason == "crossing"
    ]


def test_repetitions_of_a_span_are_not_those_of_another() -> None:
    """Of 100 repetitions 80 move both ends of the second span, 10 lack it, 10 join it to what is beyond."""
    shares = np.linspace(0.6, 1.0, 80)
    draws = [[1.0, 0.0, float(share), 0.0, 0.0] for share in shares]
    draws += [[1.0, 0.0, 0.4, 0.0, 0.0]] * 10 + [[1.0, 0.0, 1.0, 1.0, 1.0]] * 10
    first, start, end = _recall_spans([1.0, 0.0, 0.8, 0.0, 0.0], draws)
    assert first == pytest.approx((0.5, 0.5, 0.5))
    # The 16th and the 85th of 100: where the span is missing it ends at −∞ and starts at +∞.
    assert start == pytest.approx((1.0 + 0.5 / 0.8, 1.0 + 0.5 / shares[74], 1.0 + 0.5 / shares[5]))
    assert end == pytest.approx((3.0 - 0.5 / 0.8, 3.0 - 0.5 / shares[5], 3.0 - 0.5 / shares[74]))


def test_an_interval_is_open_where_repetitions_keep_the_bound_all_through_or_break_it() -> None:
    joined, missing = [[1.0, 1.0, 1.0, 0.0, 0.0]] * 20, [[1.0, 0.0, 0.0, 0.0, 0.0]] * 20
    first, start, end = _recall_spans(
        [1.0, 0.0, 1.0, 0.0, 0.0], [[1.0, 0.0, 1.0, 0.0, 0.0]] * 60 + joined + missing
    )
    assert first == (0.5, 0.5, math.inf)
    assert start == (1.5, -math.inf, math.inf)
    assert end == (2.5, -math.inf, 2.5)


def test_an_interval_holds_its_own_crossing() -> None:
    (end,) = _recall_spans([1.0, 0.0], [[1.0, 0.4]] * 90 + [[1.0, 1.0]] * 10)
    assert end == pytest.approx((0.5, 0.5, 5.0 / 6.0))
    assert _recall_spans([1.0, 0.0], [[1.0, 1.0]] * 10) == [(0.5, 0.5, math.inf)]


def test_an_interval_tells_between_which_values_it_was_searched_for() -> None:
    x, asked = np.arange(5.0), np.ones(5, dtype=bool)
    value = np.array([1.0, 0.0, 0.8, 0.0, 0.0])
    first, second = spans(x, False, METRICS["recall"], 0.5, value, asked, value[None])
    assert (first.end.within, second.start.within, second.end.within) == ((0.0, 1.0), (1.0, 2.0), (2.0, 4.0))


@pytest.mark.parametrize(("seeds", "said"), [(4, False), (5, True)])
def test_a_single_corner_has_an_interval_from_five_seeds_on(seeds: int, said: bool) -> None:
    among = _limits([RANGE, LAMP], RMSE, _noisy(1, 8), seeds=seeds)[0]
    (alone,) = _limits([RANGE], RMSE, _alone(1), seeds=seeds)
    assert among.worst is not None
    for extent in (among.worst, alone.pooled):
        assert (extent.spans[0].end.low is not None) is said
        assert (extent.agree is not None) is said
    assert {point.low is not None for point in alone.points} == {said}
    assert {point.low is not None for point in among.points} == {True}
    assert among.pooled.spans[0].end.low is not None


def _alone(trial: int) -> Rows:
    """The last lamp's corner of `_noisy`: σ = 2 cm · x²."""
    return lambda at, seed, who: _noisy(trial, 8)({**at, "lamp": 2}, seed, who)


def test_five_seeds_of_a_single_corner_hold_the_truth_in_64_of_100_campaigns() -> None:
    """So it was in 300 campaigns; two seeds would hold 53, four 59. The true limit is √(5 / 2) m."""
    ends = [_limits([RANGE], RMSE, _alone(trial), seeds=5)[0].pooled.spans[0].end for trial in range(150)]
    inside = [(end.low or 0.0) <= math.sqrt(2.5) <= (end.high or 0.0) for end in ends]
    assert 0.55 < np.mean(inside) < 0.75


def test_the_json_says_why_a_span_ends_and_which_interval_is_open() -> None:
    asked = campaign([RANGE, LAMP], {"range_rmse": "5 cm"})
    said = summary_of(asked, table([RANGE, LAMP], 2, _noisy(1, 8), ["robust"]))["limits"][0]
    (span,) = said["all"]["spans"]
    assert (span["from"], span["from_reason"], span["from_68"]) == (1.0, "end", None)
    assert (span["to_reason"], span["to_68"]["within"]) == ("crossing", [1.0, 8.0])
    assert span["to_68"]["low"] <= span["to"] <= span["to_68"]["high"]
    assert 0.0 <= said["all"]["agree"] <= 1.0
    assert said["worst_corner"]["agree"] is None
    assert _edge_record("to", Edge(2.5, "crossing", -math.inf, 2.5, (1.0, 4.0)))["to_68"] == {
        "low": None, "high": 2.5, "low_open": True, "high_open": False, "within": [1.0, 4.0],
    }  # fmt: skip
    json.dumps(said, allow_nan=False)


def test_the_same_table_gives_the_same_intervals() -> None:
    assert _limits([RANGE, LAMP], RMSE, _noisy(1, 3), seeds=2) == _limits(
        [RANGE, LAMP], RMSE, _noisy(1, 3), seeds=2
    )


def test_a_marginal_verdict_is_told_from_a_clear_one() -> None:
    """Ten sources: σ = 5 cm against a bound of 5 cm is broken in every other repetition, against 20 cm in none."""

    def rows(at: dict[str, int], seed: int, who: str) -> list[Row]:
        random = generator(seed, "marginal", "", 0)
        errors = 0.05 * random.standard_normal(10)
        errors *= 0.05 / math.sqrt(float(np.mean(errors**2))) * (1.0 + 0.2 * (seed - 4.4) / 8.0)
        return [frame(), *(source(float(error)) for error in errors)]

    marginal = _limits([ONE], RMSE, rows, seeds=8)[0].pooled
    clear = _limits([ONE], Bound("range_rmse", 0.2), rows, seeds=8)[0].pooled
    assert clear.agree == 1.0
    assert marginal.agree is not None
    assert 0.3 < marginal.agree < 0.9
