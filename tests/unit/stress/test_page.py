"""The page of a campaign: what it says of known errors, that it is safe, whole and small."""

import dataclasses
import math
import re
from typing import Any

import pytest
from matplotlib.figure import Figure as MatplotlibFigure

from nir_render.report.drawing import ratio_ticks
from nir_render.stress.bootstrap import along_axes
from nir_render.stress.crossings import Edge, Span
from nir_render.stress.design.axes import Axis, with_values
from nir_render.stress.metrics import METRICS, Bound
from nir_render.stress.page import plots as campaign_plots
from nir_render.stress.page.page import campaign_html
from nir_render.stress.page.sections import _small_pairs
from nir_render.stress.page.tables import false_alarms_table
from nir_render.stress.page.words import bound_text, extent_text, metric_text, tick_text
from nir_render.stress.reach import Extent
from nir_render.stress.sums import at_written_values, job_sums
from tests.unit.report.cases import Page
from tests.unit.stress.synthetic import FOG, LAMP, RANGE, Row, campaign, frame, source, table

HOSTILE = "<script>alert('$x$ & y')</script>"


def _rows(at: dict[str, int], seed: int, name: str) -> list[Row]:
    """`robust`: ±1 cm · (range / m)², so 5 cm at √5 m; `paper`: 40 cm short, blind at the farthest value, one alarm."""
    index = at[RANGE.name]
    x = (RANGE.numbers or ())[index]
    if name == "paper":
        return [frame(1), source(None if index == 4 else -0.4, true_range_m=x)]
    return [frame(), source(0.01 * x**2 * (-1) ** seed, true_range_m=x)]


def _html(**facts: Any) -> tuple[Page, str]:
    asked = campaign([RANGE], {"range_rmse": "5 cm", "recall": "95 %"})
    html = campaign_html(asked, table([RANGE], 2, _rows), facts)
    return Page(html), html


def test_the_page_says_where_each_estimator_fails_and_by_how_much() -> None:
    page, _ = _html(
        versions={"nir-render": "9.9.9"}, commands={"4-1": "nir-render run clutter.yaml --seed 1"}
    )
    assert "robust finds 100 % of 10 sources and ranges 100 %, with an RMS error of 30.7 cm" in page.text
    assert (
        "paper finds 80.0 % of 10 sources and ranges 80.0 %, with an RMS error of 40.0 cm (bias −40.0 cm)"
        in page.text
    )
    assert "range RMSE ≤ 5 cm" in page.text
    assert (
        "robust keeps it at 2 of 5 combinations of values; along range up to about 2.24 m (between 1.7 m and 2.8 m)"
        in page.text
    )
    assert "paper keeps it at none of 5 combinations of values." in page.text
    # Recall goes from all at 4.8 m to none at 8 m: 95 % after 0.05 of the logarithmic way.
    assert (
        "paper keeps it at 4 of 5 combinations of values; along range up to about 4.92 m (between 4.8 m and 8 m)"
        in page.text
    )
    assert "of 80.0 % of the sources" in page.text  # its range RMSE is not of the ones it missed
    assert "worst 64.0 cm" in page.text
    assert "nir-render run clutter.yaml --seed 1" in page.text
    assert "9.9.9" in page.text
    assert "no frame is above it" in page.text


def test_the_page_carries_all_it_shows_and_loads_nothing() -> None:
    page, html = _html()
    assert [address[:19] for address in page.addresses] == ["data:image/svg+xml;"] * 2
    assert "script" not in page.tags
    assert "http" not in re.sub(r'"data:[^"]*"', "", html)
    assert html == _html()[1]


def test_whatever_comes_from_outside_is_text() -> None:
    axis = Axis(HOSTILE, HOSTILE, (HOSTILE,), (1, 2), (HOSTILE, "b"))
    asked = campaign([axis], {"recall": "95 %"}, name=HOSTILE, description=HOSTILE)
    rows = table([axis], 1, lambda at, seed, name: [frame(), source(0.01)], [HOSTILE])
    jobs = set(rows["job"].to_pylist())
    facts = {
        "commands": dict.fromkeys(jobs, HOSTILE), "warnings": [HOSTILE], "failed": [{"job": "x", "error": HOSTILE}],
        HOSTILE: HOSTILE,
    }  # fmt: skip
    html = campaign_html(asked, rows, facts)
    page = Page(html)
    assert "script" not in page.tags
    assert HOSTILE not in html
    assert page.text.count(HOSTILE) > 15


def test_what_failed_and_what_is_noisy_is_said() -> None:
    noisy = table(
        [LAMP], 1, lambda at, seed, name: [frame(render_noise_share=0.02 + 0.04 * at["lamp"]), source(0.01)]
    )
    asked = campaign([LAMP], {"range_rmse": "5 cm"})
    failed = [{"job": "1", "error": "the fog ate it"}, {"job": "2", "error": "other"}]
    text = Page(campaign_html(asked, noisy, {"failed": failed})).text
    assert "2 jobs failed, missing in all figures here. The first: the fog ate it" in text
    assert "6.0 % in the median frame and 10.0 % in the worst of 3 frames" in text
    assert "2 frames are above the target of 5.0 %" in text
    assert "along lamp throughout" in text


@pytest.mark.parametrize("bounds", [{}, {"range_rmse": "5 cm", "false_alarms": 0}])
def test_a_campaign_without_a_source_is_no_pass(bounds: dict[str, Any]) -> None:
    asked = campaign([LAMP], bounds, metrics=["range_rmse"])
    text = Page(campaign_html(asked, table([LAMP], 1, lambda at, seed, name: [frame()]), {})).text
    assert "robust met no source that counts: there is nothing to judge." in text
    assert ("has nothing to be judged by." in text) is bool(bounds)
    assert ("states no bounds" in text) is not bool(bounds)
    assert ("along lamp throughout" in text) is bool(bounds)  # no false alarms in three frames


def test_values_added_at_limits_are_told_and_change_no_figure_of_the_whole() -> None:
    """An alarm in each job at the added value alone: none of the written ones has any."""
    ranges = with_values(RANGE, [2.2])
    added = ranges.added.index(True)
    asked = campaign([ranges, LAMP], {"range_rmse": "5 cm"}, 1)
    rows = table(
        [ranges, LAMP],
        1,
        lambda at, seed, name: [frame(int(at[RANGE.name] == added)), source(0.01)],
        ["robust"],
    )
    text = Page(campaign_html(asked, rows, {})).text
    assert (
        "Every combination of the values written was rendered with each of the seeds 1; a value added" in text
    )
    table_ = false_alarms_table(rows, at_written_values([ranges, LAMP], job_sums([ranges, LAMP], rows))[1])
    assert table_.rows[0][1:4] == ["0", "0.000", "0 of 15"]


def test_a_map_has_room_for_written_values_however_many_were_added() -> None:
    ranges = with_values(RANGE, [2.0 + 0.01 * step for step in range(60)])
    assert _small_pairs([ranges, FOG]) == [(0, 1)]


def test_a_large_campaign_stays_a_small_page() -> None:
    """60 × 40 values, 4800 jobs: as a path each, corners and cells would take tens of megabytes."""
    wide = dataclasses.replace(
        RANGE, labels=tuple(f"{i} m" for i in range(1, 61)), numbers=tuple(map(float, range(1, 61))),
        values_si=tuple(map(float, range(1, 61))),
    )  # fmt: skip
    down = dataclasses.replace(
        FOG, labels=wide.labels[:30], numbers=(wide.numbers or ())[:30], values_si=(wide.values_si or ())[:30]
    )
    asked = campaign([wide, down], {"range_rmse": "5 cm"}, 1)
    rows = table(
        [wide, down],
        1,
        lambda at, seed, name: [frame(), source(0.001 * (1 + at[wide.name]) * (1 + at[down.name]))],
    )
    commands = dict.fromkeys(set(rows["job"].to_pylist()), "nir-render run " + 200 * "x")
    html = campaign_html(
        asked, rows, {"commands": commands, "failed": [{"error": "x"}] * 5000, "warnings": ["y" * 9999] * 999}
    )
    assert len(html) < 700_000


@pytest.mark.parametrize("limit_m", [1e-4, 10.0])
def test_the_limit_lies_within_the_picture(limit_m: float, monkeypatch: pytest.MonkeyPatch) -> None:
    drawings: list[MatplotlibFigure] = []
    monkeypatch.setattr(campaign_plots, "svg_of", drawings.append)
    rows = table([RANGE], 1, lambda at, seed, name: [frame(), source(0.03, range_limit_m=limit_m)])
    told = along_axes([RANGE], job_sums([RANGE], rows), 1)
    campaign_plots.against_axes(METRICS["range_rmse"], [RANGE], [0], told, 0.05)
    shown = [panel.get_ylim() for panel in drawings[0].axes]
    assert all(low < limit_m < high for low, high in shown)
    assert len(shown) == 2


def test_the_ratio_to_the_limit_is_that_of_the_two_metrics_beside_it() -> None:
    """Errors of 10 and 30 cm with limits of 1 and 10 cm: RMS 22.4 cm is 3.15 × 7.11 cm; the pull is 7.38."""
    rows = table(
        [LAMP], 1,
        lambda at, seed, name: [frame(), source(0.1), source(0.3, range_limit_m=0.1)],
    )  # fmt: skip
    text = Page(campaign_html(campaign([LAMP], {"range_rmse": "5 cm"}), rows, {})).text
    assert "an RMS error of 22.4 cm (bias +20.0 cm), 3.15 × the physical limit of 7.11 cm." in text


UP_TO = Span(Edge(1.0, "end"), Edge(4.3, "crossing", 4.1, 4.52))


@pytest.mark.parametrize(
    ("extent", "said"),
    [
        (Extent("in part", (), (UP_TO,), 0.5, 1.0), "up to 4.3 m (4.1–4.52)"),
        (Extent("in part", (), (Span(Edge(1.0, "end"), Edge(4.3, "crossing", 4.1, float("inf"))),), 1.0, 1.0), "up to 4.3 m (4.1–beyond 8)"),
        (Extent("in part", (), (Span(Edge(2.0, "crossing", -float("inf"), 2.5), Edge(8.0, "end")),), 1.0, 1.0), "from 2 m (below 1–2.5) up"),
        (Extent("in part", (), (Span(Edge(2.0, "crossing", 1.8, 2.5), Edge(4.0, "crossing", -float("inf"), float("inf"), (2.8, 4.8))),), 1.0, 1.0), "from 2 m (1.8–2.5) to 4 m (below 2.8–beyond 4.8)"),
        (Extent("in part", (), (Span(Edge(1.0, "end"), Edge(1.868, "crossing", 1.8681, 1.872)),), 1.0, 1.0), "up to about 1.87 m (between 1.7 m and 2.8 m)"),
        (Extent("in part", (), (Span(Edge(1.9, "crossing"), Edge(8.0, "end")),), None, 1.0), "from about 1.9 m (between 1.7 m and 2.8 m) up"),
        (Extent("in part", (), (Span(Edge(1.0, "end"), Edge(2.8, "crossing")),), None, 1.0), "up to 2.8 m"),
        (Extent("in part", (), (UP_TO, Span(Edge(4.8, "not defined"), Edge(4.8, "nothing there"))), 1.0, 1.0), "up to 4.3 m (4.1–4.52) and at 4.8 m alone"),
        (Extent("in part", (), (Span(Edge(1.0, "end"), Edge(2.8, "not defined")),), None, 1.0), "up to 2.8 m (no such figure beyond)"),
        (Extent("nowhere", (), (), 0.7, 1.0), "nowhere (narrowly: 70 of 100 repetitions agree)"),
        (Extent("throughout", (), (), None, 1.0), "throughout"),
        (Extent("wherever judged", (True, True, True, True, None), (), None, 1.0), "wherever there is something to judge (nothing at 8 m)"),
        (Extent("nothing to judge", (), (), None, 1.0), "nothing to judge"),
    ],
)  # fmt: skip
def test_limits_in_words(extent: Extent, said: str) -> None:
    assert extent_text(RANGE, extent) == said


def test_an_axis_without_numbers_names_its_values() -> None:
    extent = Extent("in part", (True, False, None), (), None, 1.0)
    assert extent_text(LAMP, extent) == "at off, not at side, nothing to judge at behind"


def test_metrics_and_bounds_in_words() -> None:
    assert bound_text(Bound("range_rmse", 0.05, "5 cm")) == "range RMSE ≤ 5 cm"
    assert bound_text(Bound("recall", 0.95)) == "recall ≥ 95.0 %"
    assert bound_text(Bound("range_bias", 0.01, "1 cm")) == "|range bias| ≤ 1 cm"
    assert metric_text("bearing_rms", 0.0017453) == "0.100°"
    assert metric_text("range_bias", -0.4) == "−40.0 cm"
    assert metric_text("range_rmse_share", 1.5) == "150 %"
    assert metric_text("range_rmse", float("nan")) == "–"


@pytest.mark.parametrize(
    ("name", "value", "bound", "text"),
    [
        ("range_rmse_share", 0.000512, None, "0.0512 %"), ("range_rmse_share", 1.4961, None, "150 %"),
        ("range_rmse_share", 0.0202, 0.02, "2.02 %"), ("range_rmse_share", 0.020003, 0.02, "2.0003 %"),
        ("range_rmse_share", 0.019996, 0.02, "2.00 %"), ("false_alarms", 0.1042, 0.1, "0.104"),
        ("false_alarms", 0.1042, None, "0.1"), ("false_alarms", 120.0, None, "120"), ("false_alarms", 0.0, 0.0, "0"),
        ("recall", 0.9499, 0.95, "94.99 %"), ("recall", 0.95, 0.95, "95.0 %"), ("recall", 0.9999, None, "99.9 %"),
        ("range_bias", -0.05001, 0.05, "−5.001 cm"), ("range_rmse", 0.0500001, 0.05, "5.00001 cm"),
        ("bearing_rms", math.radians(0.10004), math.radians(0.1), "0.10004°"), ("range_pull", 154.6, None, "155"),
    ],
)  # fmt: skip
def test_a_metric_in_words_tells_its_verdict(name: str, value: float, bound: float | None, text: str) -> None:
    assert metric_text(name, value, bound) == text


def test_ticks_are_short() -> None:
    assert tick_text("bearing_rms", math.radians(0.1)) == "0.1°"
    assert tick_text("range_rmse_share", 0.02) == "2 %"
    assert tick_text("range_pull", 100.0) == "100"
    assert tick_text("range_rmse", 0.1) == "10 cm"


def test_round_numbers_of_a_log_scale() -> None:
    assert ratio_ticks(0.009, 0.3).tolist() == pytest.approx([0.01, 0.02, 0.05, 0.1, 0.2])
    assert ratio_ticks(0.01, 20.0).tolist() == pytest.approx([0.01, 0.1, 1.0, 10.0])
