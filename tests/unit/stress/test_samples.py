"""Campaigns of samples: where the points lie, what the table holds of them, and what is said of limits."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import yaml
from pydantic import ValidationError

from nir_render.errors import InputError
from nir_render.stress.campaign import load_campaign
from nir_render.stress.design.axes import Axis, AxisDocument
from nir_render.stress.design.points import SampleDocument, points_of
from nir_render.stress.jobs import Job, plan
from nir_render.stress.metrics import parse_bound
from nir_render.stress.reach import reaches_of
from nir_render.stress.sums import job_sums
from nir_render.stress.table import gathered, read_part, write_part
from tests.paths import ROOT


def axes() -> list[Axis]:
    """Return 1 to 8 m by ratios, an albedo, and two lamps."""
    return [
        AxisDocument.model_validate({"from": "8 m", "to": "1 m", "spacing": "log", "count": 6}).sampled("range"),
        AxisDocument.model_validate({"from": 0, "to": 1}).sampled("albedo"),
        AxisDocument.model_validate(["off", "on"]).sampled("lamp"),
    ]  # fmt: skip


def sample(**changes: object) -> SampleDocument:
    return SampleDocument.model_validate({"count": 256} | changes)


@pytest.mark.parametrize("design", ["sobol", "latin_hypercube"])
def test_points_cover_each_axis_evenly(design: str) -> None:
    points = list(points_of(axes(), sample(design=design)))
    shares = np.array([[np.log(float(p.written[0])) / np.log(8.0), float(p.written[1])] for p in points])
    # One in each of 256 parts of each axis.
    for column in shares.T:
        assert sorted(np.floor(256 * column).astype(int)) == list(range(256))
    assert [point.written[2] for point in points].count("on") == 128
    if design == "sobol":  # and in each square of 16 × 16: a (0, 2)-sequence
        squares = np.floor(16 * shares).astype(int)
        assert len({tuple(square) for square in squares}) == 256


def test_points_are_keyed_by_their_seed() -> None:
    for design in ("sobol", "latin_hypercube", "random"):
        first, again, other = (list(points_of(axes(), sample(design=design, seed=s))) for s in (1, 1, 2))
        assert first == again
        assert len({p.written[:2] for p in first} & {p.written[:2] for p in other}) == 0


def test_what_is_set_is_what_the_table_holds() -> None:
    for point in points_of(axes(), sample()):
        range_m = float(str(point.settings["range"]).removesuffix(" m"))
        assert range_m == point.written[0]
        edges = axes()[0].edges or ()
        assert edges[point.values[0]] <= range_m <= edges[point.values[0] + 1]


def test_a_sampled_limit_lies_where_the_formula_has_it(tmp_path: Path) -> None:
    """An error of 3 mm · range², whatever the albedo: 5 cm at 4.08 m.

    Over a part of the width w = ln √2 the RMS of range² is √(sinh(2 w) / (2 w)) = 1.040 × that at its middle.
    """
    jobs, parts = [], []
    for number, point in enumerate(points_of(axes(), sample())):
        range_m = float(point.written[0])
        rows = [
            {"camera": "r1.front", "index": 0, "estimator": "robust", "kind": "source", "countable": True,
             "found": True, "ranged": True, "true_range_m": range_m, "range_error_m": 0.003 * range_m**2},
            {"camera": "r1.front", "index": 0, "estimator": "robust", "kind": "frame", "frame_false_alarms": 0},
        ]  # fmt: skip
        write_part(tmp_path / "part.parquet", rows, "x")
        part = read_part(tmp_path / "part.parquet")
        assert part is not None
        jobs.append(Job(f"{number:032x}", point, 1, {}, "light"))
        parts.append(part[0])
    table = gathered(jobs, parts, axes())
    assert table["axis.range"].type == pa.float64()
    assert sorted(set(table["axis.range"].to_pylist())) == sorted({p.point.written[0] for p in jobs})
    sums = job_sums(axes(), table)
    assert sums.place.tolist() == [list(job.point.values) for job in jobs]
    reach = reaches_of(axes(), [parse_bound("range_rmse", "5 cm")], sums, sampled=True)[0]
    assert reach.worst is None
    end = reach.pooled.spans[0].end
    assert end.value == pytest.approx((0.05 / 0.003 / 1.040) ** 0.5, rel=0.005)


def written(tmp_path: Path, **changes: object) -> Path:
    document = {
        "format": 1, "name": "sampled", "scene": str(ROOT / "scenes/clutter.yaml"),
        "axes": {"range": {"path": "robots.r2.position.x", "from": "2 m", "to": "4 m"}},
        "sample": {"count": 8}, "estimators": ["robust"],
    } | changes  # fmt: skip
    path = tmp_path / "campaign.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


def test_a_campaign_of_samples_is_planned_point_by_point(tmp_path: Path) -> None:
    campaign = load_campaign(written(tmp_path, seeds=2))
    jobs = plan(campaign)
    assert len({job.key for job in jobs}) == len(jobs) == 16
    assert len({job.settings["robots.r2.position.x"] for job in jobs}) == 8


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"sample": {"count": 12}}, "take 8 or 16"),
        ({"sample": {"count": 8, "design": "grid"}}, "latin_hypercube"),
        ({"axes": {"robots.r2.position.x": ["2 m", "3 m"]}}, "no axis is a range"),
        ({"axes": {"robots.r2.position.x": {"from": "2 m", "to": "3 m", "refine": "1 %"}}}, "leave it out"),
    ],
)
def test_samples_badly_written_say_so(tmp_path: Path, changes: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_campaign(written(tmp_path, **changes))


def test_sobol_points_come_in_powers_of_two() -> None:
    with pytest.raises(ValidationError, match="64 or 128"):
        sample(count=100)
    assert len(list(points_of(axes(), sample(count=100, design="latin_hypercube")))) == 100
