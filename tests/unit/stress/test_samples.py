"""Campaigns of samples: where the points lie, what the table holds of them, and what is said of limits."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import yaml
from pydantic import ValidationError

from nir_render.errors import InputError
from nir_render.randomness import generator
from nir_render.stress.bootstrap import along_axes
from nir_render.stress.campaign import load_campaign
from nir_render.stress.design.axes import Axis, AxisDocument
from nir_render.stress.design.points import SampleDocument, points_of
from nir_render.stress.jobs import Job, plan
from nir_render.stress.metrics import METRICS, parse_bound
from nir_render.stress.page.tables import worst_table
from nir_render.stress.reach import points_of as metric_along
from nir_render.stress.reach import reaches_of
from nir_render.stress.sums import JobSums, job_sums
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


def sampled_sums(campaign: int, seeds: int) -> JobSums:
    """128 random points, each with all seeds: an error of 3 mm · range² · (1 + 2 · albedo), and 20 % noise."""
    ranges = np.array(axes()[0].edges)
    random = generator(campaign, "coverage", "", seeds)
    share, albedo, lamp = random.random((3, 128))
    range_m = 8.0**share
    place = np.stack([np.searchsorted(ranges, range_m) - 1, 8 * albedo, 2 * lamp], axis=1).astype(np.int64)
    error_m = 0.003 * range_m**2 * (1.0 + 2.0 * albedo)
    squares = (np.repeat(error_m, seeds) * (1.0 + 0.2 * random.standard_normal(128 * seeds))) ** 2
    one = np.ones(squares.size)
    sums = np.stack([squares, one, one, 0.0 * one, 0.0 * one])
    return JobSums(
        tuple(map(str, range(squares.size))), np.tile(np.arange(seeds), 128), np.repeat(place, seeds, axis=0),
        tuple((float(r), float(a), "on") for r, a in zip(range_m, albedo, strict=True) for _ in range(seeds)),
        ("robust",), {("robust", "range_rmse"): sums},
    )  # fmt: skip


@pytest.mark.parametrize("seeds", [1, 2, 5])
def test_intervals_of_samples_hold_other_samples_however_many_seeds_each_has(seeds: int) -> None:
    """Of 100 campaigns' intervals 68 hold the part's own figure: what varies is which points there are."""
    edges = np.log(np.array(axes()[0].edges))
    # The mean square in a part: E[range⁴] by ratios, E[(1 + 2 a)²] = 13/3, and 1 + 0.2² by the noise.
    quartic = np.diff(np.exp(4.0 * edges)) / (4.0 * np.diff(edges))
    truth_m = 0.003 * np.sqrt(quartic * 13.0 / 3.0 * 1.04)
    held = []
    for campaign in range(80):
        sums = sampled_sums(campaign, seeds)
        sums = replace(sums, place=sums.place[:, :1])
        told = along_axes(axes()[:1], sums, 1, sampled=True)[0]
        metric, totals = METRICS["range_rmse"], sums.by_metric["robust", "range_rmse"]
        points = metric_along(metric, totals, sums.place[:, 0], 6, told.repetitions)
        held += [
            point.low <= truth <= point.high
            for point, truth in zip(points, truth_m, strict=True)
            if point.low is not None and point.high is not None
        ]
    assert len(held) == 480
    assert 0.60 <= np.mean(held) <= 0.76  # by chance 68 % ± 2 %; parts of 21 points on average


def test_points_are_drawn_with_all_their_seeds_along_every_axis() -> None:
    sums = sampled_sums(1, 5)
    for told in along_axes(axes(), sums, 1, sampled=True):
        weight = told.repetitions.weight.reshape(-1, 128, 5)
        assert not told.has_corners
        assert (weight == weight[:, :, :1]).all()
        assert told.repetitions.repeated.all()
        assert 0.8 < weight[:, :, 0].var(axis=0).mean() < 1.2  # each a Poisson number, nearly


def test_parts_of_few_points_have_no_intervals() -> None:
    sums = sampled_sums(1, 5)
    few = sums.subset(np.arange(128 * 5) < 20 * 5)
    along_range, along_albedo, along_lamp = along_axes(axes(), few, 1, sampled=True)
    assert not along_range.repetitions.repeated.any()  # 20 points in 6 parts
    assert not along_albedo.repetitions.repeated.any()
    assert along_lamp.repetitions.repeated.all()


def test_the_worst_points_are_told_by_their_own_values() -> None:
    sums = sampled_sums(1, 1)
    listed = worst_table(axes(), sums, METRICS["range_rmse"], {}, None)
    assert listed is not None
    worst = int(np.argmax(sums.by_metric["robust", "range_rmse"][0]))
    range_m, albedo, _ = sums.written[worst]
    assert listed.rows[0][1:4] == [f"{range_m:.6g} m", f"{albedo:.6g}", "on"]


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
