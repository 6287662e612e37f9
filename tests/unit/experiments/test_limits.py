"""What the paper's conclusion leaves open: how far into a threat bounds hold, and what levers win back."""

import contextlib
import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from nir_render.experiments.limits import studies
from nir_render.experiments.limits.holds import LIMIT_NAME, Hold, hold_text, holds_of, with_limit
from nir_render.experiments.limits.outcome import Crossing, Outcome, StudyOutcome, outcome_of
from nir_render.experiments.limits.page import sentence, write_outcome
from nir_render.experiments.limits.studies import (
    STUDIES,
    as_built,
    levers_of,
    points_of_study,
    study_campaign,
)
from nir_render.experiments.limits.words import best_levers, verdict
from nir_render.stress.design.axes import Axis
from nir_render.stress.metrics import parse_bound
from nir_render.stress.sums import job_sums
from nir_render.stress.sweep import Progress
from tests.unit.stress.synthetic import FOG, Row, campaign, frame, source, table

POWER = Axis(
    "power", "power", ("power",), ("0.2 W", "0.8 W", "3.2 W"), ("0.2 W", "0.8 W", "3.2 W"), "W",
    (0.2, 0.8, 3.2), (0.2, 0.8, 3.2), log=True,
)  # fmt: skip
BOUNDS = (parse_bound("range_rmse_share", "5 %"), parse_bound("recall", "95 %"))
FOG_STUDY = next(study for study in STUDIES if study.name == "fog")


def _rows(at: dict[str, int], seed: int, name: str) -> list[Row]:
    """robust is off by 4 m / √(4 n) / V, n steps of fourfold power; paper by 20 m / V, never found below 40 m."""
    visibility_m = (FOG.numbers or ())[at[FOG.name]]
    share = {"robust": 1.5 / 2.0 ** at["power"], "paper": 20.0}[name] / visibility_m
    found = name == "robust" or visibility_m >= 40.0
    one = source(2.0 * share if found else None, true_range_m=2.0, range_limit_m=2.0 * 0.7 / visibility_m)
    return [frame(), one]


def _crossing(seeds: int = 1) -> Crossing:
    axes = (FOG, POWER)
    sums = with_limit(job_sums(axes, table(axes, seeds, _rows)))
    return Crossing(axes, 0, sums, holds_of(axes, BOUNDS, sums, 1, worst_is_high=False))


def _outcome() -> StudyOutcome:
    document = campaign([FOG, POWER], {"range_rmse_share": "5 %", "recall": "95 %"}, 1)
    return StudyOutcome(FOG_STUDY, document, {"power": _crossing()}, 12, 0)


def test_bounds_hold_down_to_where_the_first_breaks() -> None:
    """Errors are powers of V, straight lines of its logarithm: 5 % at V = 20 × the metres they fall by."""
    crossing = _crossing()
    robust = crossing.of("robust")
    assert [hold.status for hold in robust] == ["to", "to", "throughout"]
    assert [hold.edge.value for hold in robust if hold.edge] == pytest.approx([30.0, 15.0], rel=1e-9)
    assert [bound.metric for bound in robust[0].breaks] == ["range_rmse_share"]
    assert [hold.edge.value for hold in crossing.of(LIMIT_NAME) if hold.edge] == pytest.approx([14.0] * 3)
    assert {hold.status for hold in crossing.of("paper")} == {"nowhere"}
    assert crossing.of("paper")[0].values["range_rmse_share"] == pytest.approx(0.25)


def test_a_threat_that_grows_with_its_numbers_is_borne_up_to_a_limit() -> None:
    """The same errors at reflectances: now those of V = 10 m are the harmless end, where they are largest."""

    def rows(at: dict[str, int], seed: int, name: str) -> list[Row]:
        return [frame(), source(2.0 * (FOG.numbers or ())[at[FOG.name]] * 2e-3, true_range_m=2.0)]

    axes = (FOG, POWER)
    holds = holds_of(axes, BOUNDS, job_sums(axes, table(axes, 1, rows)), 1, worst_is_high=True)
    assert {round(hold.edge.value, 6) for hold in holds if hold.edge} == {25.0}
    assert hold_text(FOG, holds[0], worst_is_high=True) == (
        "up to about 25 m (between 20 and 40 m), by range RMSE, relative"
    )


def test_what_is_said() -> None:
    of, crossing = _outcome(), _crossing()
    said = [hold_text(FOG, hold, worst_is_high=False) for hold in crossing.holds]
    assert said[crossing.holds.index(crossing.of("robust")[0])] == (
        "down to about 30 m (between 20 and 40 m), by range RMSE, relative"
    )
    assert said[crossing.holds.index(crossing.of("robust")[2])] == "throughout, down to 10 m"
    assert (
        said[crossing.holds.index(crossing.of("paper")[0])] == "not even at 80 m: range RMSE, relative 25.0 %"
    )
    assert verdict(of, crossing, "robust") == "3.2 W: throughout, down to 10 m"
    assert verdict(of, crossing, "paper") == "makes no difference"
    assert best_levers(of, "robust") == ["power 3.2 W: throughout, down to 10 m"]


def test_a_gain_within_what_seeds_differ_by_is_none() -> None:
    """As built 30 m and 15 m with more power; both lie in one gap of an axis of two values."""
    axis = Axis("v", "v", ("v",), (10, 80), ("10 m", "80 m"), "m", (10.0, 80.0), (10.0, 80.0), log=True)

    def rows(at: dict[str, int], seed: int, name: str) -> list[Row]:
        share = 1.5 / 2.0 ** min(at["power"], 1) / (axis.numbers or ())[at["v"]]
        return [frame(), source(2.0 * share, true_range_m=2.0)]

    axes = (axis, POWER)
    sums = job_sums(axes, table(axes, 1, rows))
    crossing = Crossing(axes, 0, sums, holds_of(axes, BOUNDS, sums, 1, worst_is_high=False))
    assert verdict(_outcome(), crossing, "robust").startswith("no more than seeds differ by (0.8 W: down to")


def test_the_page_and_its_figures(tmp_path: Path) -> None:
    outcome = Outcome((_outcome(),))
    page = write_outcome(outcome, tmp_path).read_text()
    assert "down to about 30 m (between 20 and 40 m), by range RMSE, relative" in page
    assert "power 3.2 W: throughout, down to 10 m" in page
    assert sentence(outcome).startswith("Fog: ranging: paper not even at 80 m")
    record: dict[str, Any] = json.loads((tmp_path / "outcome.json").read_text())
    power = record["studies"]["fog"]["crossings"]["power"]
    assert power["as_built"] == "0.2 W"
    assert power["maps"]["range_rmse_share"]["robust"][2] == pytest.approx([0.0375, 0.01875, 0.009375])
    assert power["maps"]["recall"]["paper"] == [[0.0] * 3, [0.0] * 3, [1.0] * 3, [1.0] * 3]
    robust = next(one for one in power["holds"] if (one["estimator"], one["at"]) == ("robust", "0.8 W"))
    assert (robust["limit"], robust["between"]) == (pytest.approx(15.0), [10.0, 20.0])


def test_intervals_are_those_of_seeds() -> None:
    """Five seeds whose errors differ by ±20 %: limits of repetitions lie about 30 m, within what they differ by."""

    def rows(at: dict[str, int], seed: int, name: str) -> list[Row]:
        share = 1.5 * (0.8, 0.9, 1.0, 1.1, 1.2)[seed - 1] / (FOG.numbers or ())[at[FOG.name]]
        return [frame(), source(2.0 * share, true_range_m=2.0)]

    axes = (FOG, POWER)
    hold: Hold = holds_of(axes, BOUNDS, job_sums(axes, table(axes, 5, rows)), 1, worst_is_high=False)[0]
    assert hold.edge is not None
    assert hold.edge.value == pytest.approx(30.0 * 1.02**0.5)  # root of the mean of squares
    assert hold.edge.low is not None
    assert hold.edge.high is not None
    assert 26.0 < hold.edge.low < hold.edge.value < hold.edge.high < 34.0
    assert "30.3 m (" in hold_text(FOG, hold, worst_is_high=False)


@pytest.mark.parametrize(
    "study", [one for one in STUDIES if one.name != "crowding"], ids=lambda one: one.name
)
def test_each_lever_is_pulled_alone(study: Any) -> None:
    """Every lever has the scene's own value, and every point all levers but one at theirs."""
    if study.threat == "sun":
        pytest.importorskip("pvlib", reason="pvlib is not installed: pip install 'nir-render[sun]'")
    document = study_campaign(study, 2)
    levers = levers_of(document, study.repeated)
    built = {index: as_built(document, document.axes[index]) for index in levers}
    points = [point.values for point in points_of_study(document, study.repeated)]
    assert max(sum(values[index] != built[index] for index in levers) for values in points) == 1
    threats = len(document.axes[0].labels)
    assert len(points) == threats * (1 + sum(len(document.axes[index].labels) - 1 for index in levers))
    assert len(set(points)) == len(points)
    assert document.seeds == (1, 2)


@contextlib.contextmanager
def _no_bar(name: str) -> Iterator[Progress]:
    yield lambda done, total: None


@pytest.mark.verify
@pytest.mark.mitsuba
def test_a_wall_close_behind_no_longer_takes_a_range_along(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reflectance 0.05 and 0.85, gaps of 5 and 30 cm, 3 m away: light off the wall in the flare, 2ρ(1 − h/√(h² + R²)).

    With R = 1.5 cm (2.4 px), what takes that light for the source's own is 3.4 % short at 5 cm and 0.85:
    10.2 cm. A fit with a halo keeps a tenth of it at most, and three times the physical limit; that the light
    is there is seen by the limit, whose noise it is (how much it is: `tests/physics/test_enlarge.py`). Four
    jobs with one seed; done once, they are not done again.
    """
    multipath = next(study for study in STUDIES if study.name == "multipath")
    document = yaml.safe_load(multipath.document.read_text(encoding="utf-8"))
    document["scene"] = str(multipath.document.parent / document["scene"])
    gap = {**document["axes"]["gap"], "values": ["5 cm", "30 cm"]}
    document["axes"] = {
        "reflectance": {"path": "materials.paint.reflectance", "values": [0.05, 0.85]},
        "gap": gap,
    }
    monkeypatch.setattr(studies, "DOCUMENTS", tmp_path)
    multipath.document.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
    outcome = outcome_of([multipath], 1, tmp_path / "limits", 1, _no_bar)
    (of,) = outcome.studies
    assert (of.jobs, of.failed) == (4, 0)
    maps = of.record()["crossings"]["gap"]["maps"]
    bias_m, pull = maps["range_bias"]["robust"], maps["range_pull"]["robust"]
    assert abs(bias_m[1][0]) < 0.1 * 0.034 * 3.0
    assert abs(bias_m[1][1]) < 0.01 * 3.0
    assert max(itertools.chain(*pull)) < 3.0
    limit_share = maps["range_rmse_share"]["physical limit"]
    assert 1.03 < limit_share[1][0] / limit_share[0][0] < 1.1
    assert "Multipath: ranging" in write_outcome(outcome, tmp_path / "limits").read_text()
    parts = {path: path.stat().st_mtime_ns for path in (tmp_path / "limits" / "multipath" / "jobs").iterdir()}
    again = outcome_of([multipath], 1, tmp_path / "limits", 1, _no_bar)
    assert again.record() == outcome.record()
    assert {path: path.stat().st_mtime_ns for path in parts} == parts
