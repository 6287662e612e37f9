"""Limits found more exactly: where values are added, when that ends, and what they must not change."""

import contextlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pyarrow as pa
import pytest

from nir_render.errors import InputError
from nir_render.randomness import generator
from nir_render.stress import refine as rounds
from nir_render.stress.campaign import Campaign
from nir_render.stress.crossings import Edge
from nir_render.stress.design.axes import Axis, AxisDocument, Refinement, with_values
from nir_render.stress.design.points import combinations_of, number_of_points
from nir_render.stress.jobs import Job
from nir_render.stress.reach import campaign_reaches
from nir_render.stress.refine import _halfway, refined
from nir_render.stress.summary import summary_of
from nir_render.stress.sums import job_sums
from nir_render.stress.sweep import Sweep
from tests.unit.stress.synthetic import LAMP, Row, campaign, frame, source, table

LIMIT_M = 0.05
PER_SQUARE = 0.003  # the error grows as range²: 5 cm are reached at 4.0825 m


def axis(refine: object, count: int = 5, spacing: str = "log") -> Axis:
    written = {"from": "1 m", "to": "8 m", "count": count, "spacing": spacing, "refine": refine}
    return AxisDocument.model_validate(written).axis("robots.r2.x")


def asked(axes: tuple[Axis, ...], seeds: int = 1) -> Campaign:
    return replace(campaign(axes, {"range_rmse": "5 cm"}, seeds), estimators=("robust",))


def rendered(wanted: Campaign, noise: float = 0.0, trial: int | None = None) -> pa.Table:
    """Return what the jobs of a campaign would have found, behind the lamp 1.4 × the error.

    With `trial` errors are normal, of that size, another draw for each trial.
    """
    ranges = wanted.axes[0]

    def rows(at: dict[str, int], seed: int, name: str) -> list[Row]:
        range_m = (ranges.values_si or ())[at[ranges.name]]
        error_m = PER_SQUARE * range_m**2 * (1.4 if at.get("lamp") == 2 else 1.0)
        random = generator(seed + 1000 * (trial or 0), "refine", "", round(1e6 * range_m))
        normal = random.standard_normal(4)
        errors = error_m * (1.0 + noise * normal if trial is None else normal)
        return [frame(), *(source(float(error)) for error in errors)]

    return table(wanted.axes, len(wanted.seeds), rows, ["robust"])


def settled(wanted: Campaign, noise: float = 0.0, trial: int | None = None) -> Campaign:
    """Return a campaign after as many rounds as it takes."""
    for _ in range(50):
        finer = refined(wanted, rendered(wanted, noise, trial))
        if finer is wanted:
            return wanted
        wanted = finer
    raise AssertionError("no end of rounds")


@pytest.mark.parametrize(("spacing", "refine", "step"), [("log", "1 %", 0.01), ("linear", "4 cm", 0.04)])
def test_a_limit_is_bracketed_by_a_quarter_of_the_grids_jobs_or_fewer(
    spacing: str, refine: str, step: float
) -> None:
    found = settled(asked((axis(refine, spacing=spacing),)))
    truth_m = (LIMIT_M / PER_SQUARE) ** 0.5
    numbers = np.array(found.axes[0].numbers)
    after = int(np.searchsorted(numbers, truth_m))
    low, high = numbers[after - 1 : after + 1]
    assert (high / low - 1.0 if spacing == "log" else high - low) <= step * 1.000001
    # A grid as fine: in how many values would it have the same gap?
    grid = np.log(8.0) / np.log1p(step) + 1 if spacing == "log" else 7.0 / step + 1
    assert numbers.size <= grid / 4
    (reach,) = campaign_reaches(found, job_sums(found.axes, rendered(found)))
    # Straight in the logarithms between neighbours, as range² is: on a log axis nothing is left.
    assert reach.pooled.spans[0].end.value == pytest.approx(truth_m, rel=1e-9 if spacing == "log" else 1e-4)


def test_the_worst_corner_has_values_of_its_own_and_other_axes_keep_their_figures() -> None:
    coarse = asked((axis("1 %"), LAMP))
    found = settled(coarse)
    numbers = np.array(found.axes[0].numbers)
    for error in (PER_SQUARE * 1.4, PER_SQUARE * np.sqrt((1.0 + 1.0 + 1.4**2) / 3.0)):
        after = int(np.searchsorted(numbers, (LIMIT_M / error) ** 0.5))
        assert numbers[after] / numbers[after - 1] - 1.0 <= 0.010001
    before, behind = (summary_of(wanted, rendered(wanted)) for wanted in (coarse, found))
    assert before["estimators"] == behind["estimators"]
    assert before["limits"][1] == behind["limits"][1]  # along the lamps
    assert behind["limits"][0]["worst_corner"]["corner"] == {"lamp": "behind"}


def test_a_limit_that_seeds_leave_open_is_not_divided_further() -> None:
    sure = settled(asked((axis("0.1 %"),), seeds=6), noise=0.002)
    open_ = settled(asked((axis("0.1 %"),), seeds=6), noise=0.5)
    assert len(sure.axes[0].labels) > len(open_.axes[0].labels) + 2
    (reach,) = campaign_reaches(open_, job_sums(open_.axes, rendered(open_, 0.5)))
    end = reach.pooled.spans[-1].end
    numbers = np.array(open_.axes[0].numbers)
    after = int(np.searchsorted(numbers, end.value))
    assert end.low is not None
    assert end.high is not None
    # Halves of the gap would be narrower than the interval.
    assert end.high - end.low > 0.5 * (numbers[after] - numbers[after - 1])


@pytest.mark.verify
def test_intervals_of_refined_limits_hold_the_truth_as_often_as_unrefined_ones() -> None:
    """Eight seeds of four sources, whose errors are normal: 60 of 100 on the written values.

    With gaps of half the interval it is 49: repetitions then find the nearest of many crossings.
    """
    truth_m, held = (LIMIT_M / PER_SQUARE) ** 0.5, []
    for trial in range(250):
        wanted = settled(asked((axis("0.5 %"),), seeds=8), trial=trial)
        (reach,) = campaign_reaches(wanted, job_sums(wanted.axes, rendered(wanted, trial=trial)))
        end = reach.pooled.spans[0].end
        assert end.low is not None
        assert end.high is not None
        held.append(end.low <= truth_m <= end.high)
    assert 0.55 <= np.mean(held) <= 0.75  # 61 % ± 3 % by chance


def test_no_gap_is_made_narrower_than_the_interval() -> None:
    edge = Edge(3.0, "crossing", gap=1)
    ranges = replace(axis("1 %", spacing="linear"), numbers=(1.0, 2.0, 4.0))
    assert _halfway(ranges, edge, width=0.99) == 3.0
    assert _halfway(ranges, edge, width=1.01) is None


@pytest.mark.parametrize("unranged", [False, True])
def test_limits_below_zero_are_found(unranged: bool) -> None:
    """On both sides of 0 the error grows with the square of the place; or there is no range from there on.

    Then a span ends at its last value itself, in which gap must be known all the same.
    """
    truth_m = (LIMIT_M / PER_SQUARE) ** 0.5
    wanted = asked(
        (AxisDocument.model_validate({"from": "-8 m", "to": "7 m", "count": 6, "refine": "4 cm"}).axis("x"),)
    )

    def rows(at: dict[str, int], seed: int, name: str) -> list[Row]:
        place_m = (wanted.axes[0].values_si or ())[at["x"]]
        return [frame(), source(None if unranged and abs(place_m) > truth_m else PER_SQUARE * place_m**2)]

    for _ in range(20):
        wanted = refined(wanted, table(wanted.axes, 1, rows, ["robust"]))
    numbers = np.array(wanted.axes[0].numbers)
    for limit_m in (-truth_m, truth_m):
        after = int(np.searchsorted(numbers, limit_m))
        assert numbers[after] - numbers[after - 1] <= 0.04 * 1.000001


class Rounds:
    """In place of `sweep` and `plan`: rounds in which so many jobs are there before each."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, before: Sequence[int], **faults: object) -> None:
        self.before, self.faults, self.rounds = list(before), faults, 0
        monkeypatch.setattr(rounds, "sweep", self.sweep)
        monkeypatch.setattr(rounds, "plan", self.plan)

    def sweep(self, wanted: Campaign, jobs: Sequence[object], folder: Path, **_: object) -> Sweep:
        self.rounds += 1
        failed = cast("dict[str, str]", self.faults.get("failed", {}))
        return Sweep(wanted, tuple(jobs), rendered(wanted), failed, self.before.pop(0), folder, ())  # type: ignore[arg-type]

    def plan(self, finer: Campaign, *_: object) -> list[object]:
        if "scene" in self.faults:
            raise InputError(str(self.faults["scene"]))
        return [None] * number_of_points(finer.axes, None)

    def result(self, wanted: Campaign) -> Sweep:
        jobs = cast("list[Job]", [None] * number_of_points(wanted.axes, None))
        return rounds.sweep_refined(
            wanted, jobs, Path(), workers=1, bar=lambda _: contextlib.nullcontext(lambda *_: None)
        )


def test_jobs_done_before_are_not_those_of_earlier_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new campaign has none; one that was stopped in its second round has the first and a part of it."""
    assert Rounds(monkeypatch, [0, 5, 6]).result(asked((axis("20 %"),))).reused == 0
    assert Rounds(monkeypatch, [5, 6, 6]).result(asked((axis("20 %"),))).reused == 6


@pytest.mark.parametrize("fault", ["scene", "failed", "too many"])
def test_a_refinement_that_cannot_go_on_gives_what_there_is(
    monkeypatch: pytest.MonkeyPatch, fault: str
) -> None:
    if fault == "too many":
        monkeypatch.setattr(rounds, "MOST_JOBS", 5)
    faults: dict[str, object] = {"scene": "a camera in a wall"} if fault == "scene" else {}
    played = Rounds(monkeypatch, [0], **({"failed": {"a": "died"}} if fault == "failed" else faults))
    result = played.result(asked((axis("20 %"),)))
    assert played.rounds == 1
    said = {"scene": "this: a camera in a wall", "failed": "", "too many": "write larger steps"}[fault]
    assert said in " ".join(result.warnings)
    assert bool(result.warnings) == (fault != "failed")


def test_whole_numbers_stay_whole() -> None:
    written = AxisDocument.model_validate({"values": [1, 8], "refine": 1}).axis("robots.r2.x")
    found = settled(asked((written,)))
    assert found.axes[0].values == (1, 4, 5, 6, 8)  # 4.08 lies between
    assert all(isinstance(value, int) for value in found.axes[0].values)


def test_added_values_go_with_the_written_ones_of_other_axes() -> None:
    one, other = axis("1 %", 3), replace(axis("1 %", 3), name="b", paths=("b",))
    axes = (with_values(one, [1.5, 2.0]), with_values(other, [4.0]))
    points = combinations_of(axes)
    assert number_of_points(axes, None) == len(points) == 9 + 2 * 3 + 1 * 3
    assert all(not (axes[0].added[i] and axes[1].added[j]) for i, j in points)


def test_what_is_written_of_it_is_checked() -> None:
    for refine, said in (
        ("5 s", "a time"),
        ("0 m", "wanted a step"),
        ("fine", "wanted a step"),
        (0.1, "without a unit"),
    ):
        with pytest.raises(ValueError, match=said):
            axis(refine)
    with pytest.raises(ValueError, match="between labels"):
        AxisDocument.model_validate({"values": ["a", "b"], "refine": "1 %"}).axis("x")
    with pytest.raises(ValueError, match="write a step"):
        AxisDocument.model_validate({"values": ["0 m", "1 m"], "refine": "1 %"}).axis("x")


def test_a_share_is_one_unless_the_axis_is_written_in_percent() -> None:
    """10 % of plain numbers is a share of each; on an axis in % it is a step."""
    for values, step, by_ratio in (
        ([1, 2], 0.1, True),
        (["1 m", "2 m"], 0.1, True),
        (["1 %", "2 %"], 10.0, False),
    ):
        found = AxisDocument.model_validate({"values": values, "refine": "10 %"}).axis("x").refinement
        assert found is not None
        assert found.step == pytest.approx(step)
        assert found.by_ratio is by_ratio
    plain = AxisDocument.model_validate({"values": [1, 2], "refine": 0.1}).axis("x").refinement
    assert plain == Refinement(0.1, by_ratio=False)
    with pytest.raises(ValueError, match="without a unit"):
        AxisDocument.model_validate({"values": ["1 %", "2 %"], "refine": 0.1}).axis("x")
