"""Metrics against values worked out by hand, and against what `evaluate` says of the same detections."""

import dataclasses
import math

import pytest

from nir_render.evaluate.metrics import evaluate
from nir_render.stress.metrics import METRICS, known_metric, parse_bound
from nir_render.stress.sums import ASKED, COUNT, LIMIT, LIMITED, TOTAL, job_sums
from perception.types import Detection
from tests.unit.report.cases import calibration, detection, truth
from tests.unit.stress.synthetic import FOG, Row, frame, packet, sequence, source, table

# Five sources count: found at +3 cm and −4 cm of 2 and 4 m, found without a range, missed, found without a limit.
# A sixth does not count, a seventh is a ghost, whatever is said of them.
BY_HAND = [
    frame(false_alarms=3),
    source(0.03, bearing_error_deg=0.03),
    source(-0.04, true_range_m=4.0, range_limit_m=0.02, bearing_error_deg=0.04, bearing_limit_deg=0.02),
    source(0.0, range_error_m=None, ranged=False, bearing_error_deg=0.0),
    source(None),
    source(0.12, true_range_m=8.0, range_limit_m=None, bearing_error_deg=None),
    source(5.0, countable=False),
    source(7.0, kind="ghost"),
    sequence(0.9, 2, message_wrong=1, message_bit_error_rate=0.01),
    sequence(0.6, 1),
    packet(True), packet(True), packet(False),
]  # fmt: skip


def _pooled(rows: list[Row], name: str) -> tuple[float, float, int, int]:
    """Return metric, limit, of how many, and of how many there could be; `paper` says something else."""
    one = dataclasses.replace(FOG, labels=("10 m",), numbers=(10.0,), values_si=(10.0,))
    sums = job_sums(
        [one], table([one], 1, lambda at, seed, who: rows if who == "robust" else [frame(9), source(9.0)])
    )
    own = sums.by_metric["robust", name].sum(axis=1)
    metric = METRICS[name]
    value, limit = metric.value(own[TOTAL], own[COUNT]), metric.value(own[LIMIT], own[LIMITED])
    return float(value), float(limit), int(own[COUNT]), int(own[ASKED])


@pytest.mark.parametrize(
    ("name", "value", "limit", "count", "asked"),
    [
        ("recall", 0.8, None, 5, 5),
        ("ranged", 0.6, None, 5, 5),
        ("range_rmse", math.sqrt((0.03**2 + 0.04**2 + 0.12**2) / 3), math.sqrt((0.01**2 + 0.02**2) / 2), 3, 5),
        ("range_mae", 0.19 / 3, math.sqrt(2 / math.pi) * 0.015, 3, 5),
        ("range_bias", 0.11 / 3, None, 3, 5),
        ("range_rmse_share", math.sqrt((0.015**2 + 0.01**2 + 0.015**2) / 3), 0.005, 3, 5),
        ("range_pull", math.sqrt((9 + 4) / 2), 1.0, 2, 5),
        ("bearing_rms", math.radians(0.05 / math.sqrt(3)), math.radians(math.sqrt((1 + 4 + 1) / 3) * 0.01), 3, 5),
        ("false_alarms", 3.0, None, 1, 1),
        ("hota", 0.75, None, 2, 2),
        ("idf1", 0.75, None, 2, 2),
        ("switches", 1.5, None, 2, 2),
        ("wrong_messages", 0.5, None, 2, 2),
        ("bit_errors", 0.01, None, 1, 2),  # nothing was sent in the other
        ("received", 2 / 3, None, 3, 3),
    ],
)  # fmt: skip
def test_metrics_worked_out_by_hand(
    name: str, value: float, limit: float | None, count: int, asked: int
) -> None:
    got = _pooled(BY_HAND, name)
    assert got[0] == pytest.approx(value, rel=1e-12)
    assert math.isnan(got[1]) if limit is None else got[1] == pytest.approx(limit, rel=1e-12)
    assert got[2:] == (count, asked)


@pytest.mark.parametrize("name", [name for name, metric in METRICS.items() if metric.kind == "source"])
def test_a_metric_of_nothing_is_not_defined_and_keeps_no_bound(name: str) -> None:
    value, _, count, asked = _pooled([frame(), source(0.0, countable=False)], name)
    assert math.isnan(value)
    assert (count, asked) == (0, 0)
    assert not METRICS[name].holds(value, 0.5)


def test_a_bias_is_held_by_its_absolute_value_and_others_by_their_side() -> None:
    assert METRICS["range_bias"].holds([-0.06, -0.05, 0.05, 0.06], 0.05).tolist() == [
        False,
        True,
        True,
        False,
    ]
    assert METRICS["recall"].holds([0.94, 0.95, 1.0], 0.95).tolist() == [False, True, True]
    assert METRICS["range_rmse"].holds([0.04, 0.05, 0.06], 0.05).tolist() == [True, True, False]


def test_metrics_agree_with_evaluate() -> None:
    """Two frames, four sources, one too faint; found at odd errors, one without a range; two false alarms."""
    tilted = (math.cos(0.01), math.sin(0.01), 0.0)
    rows = [
        truth(), truth(u_px=200.0, range_m=3.0), truth(index=1, range_m=5.0, direct_e=3e3),
        truth(index=1, u_px=200.0, peak_snr=2.0),
    ]  # fmt: skip
    found = [
        detection(range_m=2.07), detection(u_px=200.5, range_m=math.nan, bearing_body=tilted), detection(u_px=30.0),
        detection(index=1, range_m=4.8, bearing_body=tilted), detection(index=1, u_px=200.0, range_m=9.0),
        detection(index=1, u_px=300.0),
    ]  # fmt: skip
    keys = [("r1.front", 0), ("r1.front", 1)]
    result = evaluate(keys, rows, {"r1.front": calibration()}, {"robust": found})
    table_rows = [
        frame(sum(alarm.index == index for alarm in result.false_alarms["robust"])) for index in (0, 1)
    ]
    for score in result.scores:
        said: Detection | None = score.detections.get("robust")
        error_m = None if said is None or math.isnan(said.range_m) else said.range_m - score.truth.range_m
        angle_rad = math.acos(min(1.0, said.bearing_body[0])) if said is not None else 0.0
        table_rows.append(
            source(
                error_m, found=said is not None, countable=score.countable, true_range_m=score.truth.range_m,
                range_limit_m=score.range_limit_m, bearing_limit_deg=score.bearing_limit_deg,
                bearing_error_deg=None if said is None else math.degrees(angle_rad),
            )
        )  # fmt: skip
    summary = result.summary["estimators"]["robust"]
    for name, key in (
        ("recall", "recall"), ("range_rmse", "range_rmse_m"), ("range_mae", "range_mae_m"), ("range_bias", "range_bias_m"),
        ("false_alarms", "false_alarms_per_frame"),
    ):  # fmt: skip
        assert _pooled(table_rows, name)[0] == pytest.approx(summary[key], rel=1e-9)
    assert math.degrees(_pooled(table_rows, "bearing_rms")[0]) == pytest.approx(
        summary["bearing_rms_deg"], rel=1e-6
    )
    assert _pooled(table_rows, "range_rmse")[1] == pytest.approx(summary["range_limit_rmse_m"], rel=1e-12)
    assert _pooled(table_rows, "ranged")[0] == pytest.approx(2 / 3)


@pytest.mark.parametrize(
    ("name", "text", "value"),
    [
        ("range_rmse", "5 cm", 0.05), ("recall", "95 %", 0.95), ("ranged", 0.9, 0.9), ("bearing_rms", "0.1 deg", math.radians(0.1)),
        ("false_alarms", 0, 0.0), ("switches", 0, 0.0), ("received", "95 %", 0.95), ("range_pull", "1.5", 1.5), ("range_rmse_share", "2 %", 0.02), ("recall", "1", 1.0),
    ],
)  # fmt: skip
def test_bounds_are_read_with_their_units(name: str, text: object, value: float) -> None:
    bound = parse_bound(name, text)
    assert (bound.metric, bound.text) == (name, str(text))
    assert bound.value == pytest.approx(value, rel=1e-11)


@pytest.mark.parametrize(
    ("kept", "of", "text"),
    [(19, 20, "95 %"), (57, 60, "95 %"), (7, 20, "35 %"), (41, 100, "41 %"), (47, 100, "47 %"), (47, 100, 0.47)],
)  # fmt: skip
def test_a_share_at_its_bound_keeps_it_and_one_less_does_not(kept: int, of: int, text: object) -> None:
    metric, bound = METRICS["recall"], parse_bound("recall", text)
    assert metric.holds(metric.value(kept, of), bound.value)
    assert not metric.holds(metric.value(kept - 1, of), bound.value)


def test_every_whole_per_cent_is_kept_at_exactly_that_share() -> None:
    metric = METRICS["recall"]
    for number in range(1, 101):
        assert metric.holds(metric.value(number, 100), parse_bound("recall", f"{number} %").value)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("range_rms", "5 cm", "no figure 'range_rms'; did you mean 'range_rmse'"),
        ("xyz", "5 cm", "no figure 'xyz'. Known are recall, ranged"),
        ("range_rmse", "5", "bare number"),
        ("range_rmse", "5 deg", "an angle; wanted a length"),
        ("range_rmse", "0 cm", "above 0"),
        ("range_bias", "-1 cm", "above 0"),
        ("recall", "95", "one up to 1, such as '95 %'"),
        ("recall", "0 %", "no share"),
        ("false_alarms", "-1", "below 0"),
        ("bearing_rms", "0.1", "bare number"),
    ],
)
def test_a_bound_that_is_none_is_refused(name: str, text: object, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        parse_bound(name, text)


def test_every_metric_is_known_by_its_name() -> None:
    assert [known_metric(name) for name in METRICS] == [metric.name for metric in METRICS.values()]


def test_a_table_of_another_campaign_is_refused() -> None:
    other = dataclasses.replace(FOG, values_si=(11.0, 20.0, 40.0, 80.0))
    with pytest.raises(ValueError, match=r"10\.0 on the axis 'fog.visibility', which the campaign has not"):
        job_sums([other], table([FOG], 1, lambda at, seed, who: [frame()]))
