"""Pairing of runs, the figures of paired frames, the page, and what a careless user is told."""

import dataclasses
import json
import math
import re
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nir_render.compare.compare import compare_runs
from nir_render.compare.page import compare_html, differing_frames
from nir_render.truth.sources import SourceTruth
from perception import (
    calibration_document,
    detection_record,
    encode_png16,
    frame_record,
    measure_set,
    measurement_record,
)
from perception.types import Detection
from tests.system.command import nir_render
from tests.unit.report.cases import Page, calibration, detection, frame, truth

FRAMES = 8
RANGES_M = {"r2": 2.0, "r3": 4.0}
PLACES_PX = {"r2": 100.0, "r3": 200.0}
HOSTILE = "<script>alert('x')<"


def _row(index: int, robot: str, **changes: Any) -> SourceTruth:
    return truth(index=index, robot=robot, u_px=PLACES_PX[robot], range_m=RANGES_M[robot], **changes)


def _hit(index: int, robot: str, error_m: float, **changes: Any) -> Detection:
    at = {"u_px": PLACES_PX[robot], "range_m": RANGES_M[robot] + error_m}
    return detection(index=index, **{**at, **changes})


def _write(
    folder: Path,
    detections: Mapping[str, Sequence[Detection]],
    rows: Sequence[SourceTruth] | None = None,
    frames: int = FRAMES,
    seed: int = 0,
) -> Path:
    """Write a run of one camera and two sources."""
    folder.mkdir()
    lines = []
    for index in range(frames):
        noise = np.random.default_rng([seed, index]).integers(0, 9, (240, 320)).astype(np.uint16)
        taken = frame(index=index)
        (folder / f"{index}.png").write_bytes(encode_png16(taken.data_dn + noise))
        lines.append(frame_record(taken, f"{index}.png"))
    if rows is None:
        rows = [_row(index, robot) for index in range(frames) for robot in RANGES_M]
    _lines(folder / "frames.jsonl", lines)
    _lines(folder / "truth.jsonl", [row.record() for row in rows])
    (folder / "calibration.json").write_text(json.dumps(calibration_document([calibration()])))
    for name, found in detections.items():
        _lines(folder / f"detections.{name}.jsonl", [detection_record(each) for each in found])
    return folder


def _lines(path: Path, records: Sequence[Mapping[str, Any]]) -> None:
    path.write_text("".join(json.dumps(record) + "\n" for record in records), encoding="utf-8")


def _all(errors_m: Mapping[str, Sequence[float]]) -> list[Detection]:
    return [_hit(index, robot, error) for robot, own in errors_m.items() for index, error in enumerate(own)]


ERRORS_M = {"r2": [0.10, -0.12, 0.11, -0.09, 0.10, 0.12, -0.11, 0.08], "r3": [0.2] * FRAMES}
SMALL_M = {"r2": [0.01, -0.02, 0.01, -0.01, 0.02, 0.01, -0.01, 0.02], "r3": [0.03] * FRAMES}


@pytest.fixture
def runs(tmp_path: Path) -> tuple[Path, Path]:
    """Before: large errors, r3 missed in frame 2, an alarm in frame 5. After: small ones, a miss in frame 0."""
    before = [hit for hit in _all(ERRORS_M) if (hit.index, hit.u_px) != (2, 200.0)]
    before.append(detection(index=5, u_px=30.0, v_px=30.0))
    after = [hit for hit in _all(SMALL_M) if (hit.index, hit.u_px) != (0, 100.0)]
    return (
        _write(tmp_path / "before", {"mine": before, "old": before}),
        _write(tmp_path / "after", {"mine": after, "new": after}),
    )


def test_figures_are_over_what_both_were_asked(runs: tuple[Path, Path]) -> None:
    """Worked out by hand: of 16 sources each misses one, and the errors are over the 14 that both ranged."""
    result = compare_runs(*runs)
    (pair,) = result.estimators
    figures = {compared.figure.name: compared for compared in pair.figures}
    recall = figures["recall"]
    assert (recall.first, recall.second, recall.difference) == (15 / 16, 15 / 16, 0.0)
    assert (recall.only_first, recall.only_second, recall.probability, recall.count) == (1, 1, 1.0, 16)
    assert recall.verdict == "no difference seen"
    alarms = figures["false_alarms_per_frame"]
    assert (alarms.first, alarms.second, alarms.only_first) == (1 / 8, 0.0, 1)
    own = np.abs(ERRORS_M["r2"])[1:].sum() + 0.2 * 7
    other = np.abs(SMALL_M["r2"])[1:].sum() + 0.03 * 7
    mae = figures["range_mae_m"]
    assert (mae.count, mae.frames) == (14, 8)
    assert [mae.first, mae.second] == pytest.approx([own / 14, other / 14])
    assert mae.difference == pytest.approx((other - own) / 14)
    assert mae.low is not None
    assert mae.high is not None
    assert mae.low < (other - own) / 14 < mae.high < 0.0
    assert [figures[name].verdict for name in ("range_mae_m", "range_rmse_m", "range_bias_m")] == [
        "better"
    ] * 3
    assert result.pairing.same_frames
    assert result.pairing.notes == (
        "only the first run has detections of old",
        "only the second run has detections of new",
    )


def test_what_rigs_measure_is_compared_set_by_set(tmp_path: Path) -> None:
    """Ranges 4 and 1 cm long of the same two sources, one called an image in one set of the second run."""
    for name, error_m in (("before", 0.04), ("after", 0.01)):
        found = _all({"r2": [error_m] * FRAMES, "r3": [error_m] * FRAMES})
        folder = _write(tmp_path / name, {"mine": found})
        lines = []
        for index in range(FRAMES):
            hits = [hit for hit in found if hit.index == index]
            seen = measure_set([frame(index=index)], [hits], {"r1.front": calibration()}).measurements
            called = name == "after" and index == 3
            lines += [
                measurement_record(dataclasses.replace(one, ghost="yes" if called and k == 0 else "no"))
                for k, one in enumerate(seen)
            ]
        _lines(folder / "measurements.mine.jsonl", lines)
    (pair,) = compare_runs(tmp_path / "before", tmp_path / "after").estimators
    figures = {compared.figure.name: compared for compared in pair.sets}
    assert set(figures) == {
        "set_recall", "set_false_alarms_per_set", "set_position_rmse_m", "set_range_rmse_m"
    }  # fmt: skip
    assert (figures["set_recall"].first, figures["set_recall"].second) == (1.0, 15 / 16)
    ranges = figures["set_range_rmse_m"]
    assert (ranges.count, ranges.frames, ranges.verdict) == (15, FRAMES, "better")
    assert [ranges.first, ranges.second] == pytest.approx([0.04, 0.01])
    assert ranges.difference == pytest.approx(-0.03)
    page = compare_html(compare_runs(tmp_path / "before", tmp_path / "after"))
    assert "15 sources in 8 sets" in page
    (same,) = compare_runs(tmp_path / "after", tmp_path / "after").estimators
    assert same.identical
    assert all(each.difference == 0.0 for each in same.sets)


def test_a_run_against_itself_and_its_copy_is_exactly_zero(runs: tuple[Path, Path], tmp_path: Path) -> None:
    shutil.copytree(runs[0], tmp_path / "copy")
    for other in (runs[0], tmp_path / "copy"):
        result = compare_runs(runs[0], other)
        for pair in result.estimators:
            assert pair.identical
            for compared in pair.figures:
                numbers = (compared.difference, compared.low, compared.high, compared.least_seen)
                assert numbers == (0.0, 0.0, 0.0, 0.0) or compared.count == 0
                assert compared.first == compared.second
            assert differing_frames(pair.frames) == []
        assert "all differences are zero" in compare_html(result)
    assert compare_runs(*runs).record() == compare_runs(*runs).record()


def test_estimators_are_chosen_by_name(runs: tuple[Path, Path]) -> None:
    def chosen(first: Path, second: Path | None = None, names: Sequence[str] = ()) -> list[tuple[str, str]]:
        return [(pair.first, pair.second) for pair in compare_runs(first, second, names).estimators]

    assert chosen(*runs) == [("mine", "mine")]
    assert chosen(*runs, names=["old", "new"]) == [("old", "new")]
    assert chosen(*runs, names=["mine"]) == [("mine", "mine")]
    assert chosen(runs[0]) == [("mine", "old")]
    assert chosen(runs[0], names=["old", "mine"]) == [("old", "mine")]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["before", "nowhere"], "nowhere: there is no such folder; give a run folder"),
        (["before", "before/0.png"], "there is no such folder"),
        (["before", "after", "--estimators", "old"], "after: has no detections of 'old'; there are some of: mine, new"),
        (["before", "--estimators", "mine"], "has detections of mine, old; give two of them"),
        (["before", "--estimators", "mine,robust"], "has no detections of 'robust'"),
        (["before", "--estimators", "a,b,c"], "wanted one name or two, such as paper,robust"),
        (["before", "after", "--estimators", ""], None),
        (["before", "blank"], "there are no detections; run 'nir-render perceive"),
        (["before", "untrue"], "without truth nothing is scored"),
        (["before", "other"], "give --estimators FIRST,SECOND"),
        (["before", "moved"], "not of the same truth: in 8 places a source stands elsewhere; r3.top in frame 0 of r1.front is 4.0000 m"),
        (["before", "later"], "have no frame in common (camera and index): frame 0 of r1.front, frame 1 of r1.front"),
        (["before", "broken"], "line 1: broken JSON"),
    ],
)  # fmt: skip
def test_what_a_careless_user_is_told(
    runs: tuple[Path, Path], tmp_path: Path, arguments: list[str], said: str | None
) -> None:
    rows = [_row(index, robot) for index in range(FRAMES) for robot in RANGES_M]
    moved = [dataclasses.replace(row, range_m=row.range_m + (row.robot == "r3") * 1e-3) for row in rows]
    _write(tmp_path / "blank", {})
    _write(tmp_path / "untrue", {"mine": []})
    (tmp_path / "untrue" / "truth.jsonl").unlink()
    _write(tmp_path / "other", {"x": []})
    _write(tmp_path / "moved", {"mine": []}, moved)
    later = _write(tmp_path / "later", {"mine": []}, [])
    records = [json.loads(line) for line in (later / "frames.jsonl").read_text().splitlines()]
    _lines(later / "frames.jsonl", [{**record, "index": record["index"] + 50} for record in records])
    _write(tmp_path / "broken", {"mine": []})
    (tmp_path / "broken" / "detections.mine.jsonl").write_text("{\n")
    done = nir_render("compare", *arguments, cwd=tmp_path)
    if said is None:
        assert done.returncode == 0, done.stderr
        return
    assert done.returncode == 2
    assert said.replace("line 1", "1") in " ".join(done.stderr.split()) or said in done.stderr
    assert not (tmp_path / "before" / "compare.html").exists()


def test_what_else_differs_is_said_and_the_rest_pairs(runs: tuple[Path, Path], tmp_path: Path) -> None:
    """Another exposure's light, other counts, a source too faint in one run, one out of view, two frames less."""
    rows = [
        _row(index, robot, direct_e=2e4, peak_snr=1.0 if (index, robot) == (1, "r3") else 20.0)
        for index in range(6)
        for robot in RANGES_M
        if (index, robot) != (3, "r2")
    ]
    after = [hit for hit in _all(SMALL_M) if hit.index < 6]
    other = _write(tmp_path / "other", {"mine": after}, rows, frames=6, seed=1)
    result = compare_runs(runs[0], other)
    assert len(result.pairing.keys) == 6
    assert not result.pairing.same_frames
    notes = "\n".join(result.pairing.notes)
    for said in (
        "2 frames in the first run only, left out: frame 6 of r1.front, frame 7 of r1.front",
        "1 source in view in the first run only, left out: r2.top in frame 3 of r1.front",
        "11 sources of another light",
        "1 source that counts for recall in one run only, left out: r3.top in frame 1 of r1.front",
        "the counts of 6 of 6 frames differ, such as frame 0 of r1.front",
    ):
        assert said in notes
    assert next(compared.count for compared in result.estimators[0].figures) == 10


def test_sources_without_a_range_count_as_found_and_no_error(tmp_path: Path) -> None:
    found = _all(ERRORS_M)
    unranged = [dataclasses.replace(hit, range_m=math.nan) if hit.index < 3 else hit for hit in found]
    folder = _write(tmp_path / "run", {"a": found, "b": unranged})
    figures = {compared.figure.name: compared for compared in compare_runs(folder).estimators[0].figures}
    assert (figures["recall"].second, figures["ranged"].second) == (1.0, 10 / 16)
    assert figures["range_mae_m"].count == 10
    assert figures["bearing_rms_deg"].count == 16


def test_frames_that_differ_most_come_first(runs: tuple[Path, Path]) -> None:
    """Misses and alarms first, 2, 0 and 5, by their errors; then those by errors alone."""
    (pair,) = compare_runs(*runs).estimators
    order = [each.key[1] for each in differing_frames(pair.frames)]
    assert set(order[:3]) == {0, 2, 5}
    assert set(order) == set(range(FRAMES))


def test_the_command_shows_a_table_a_page_and_one_json_object(
    runs: tuple[Path, Path], tmp_path: Path
) -> None:
    done = nir_render("compare", "before", "after", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "range MAE" in done.stdout
    assert "Better: range MAE, range RMSE, range bias." in done.stdout
    assert "only the first run has detections of old" in " ".join(done.stderr.split())
    assert done.stdout.endswith("open after/compare.html\n")
    as_json = nir_render("compare", "before", "after", "--json", "--page", "own/page.html", cwd=tmp_path)
    record = json.loads(as_json.stdout)
    assert (record["frames"], record["page"]) == (8, "own/page.html")
    (pair,) = record["estimators"]
    assert pair["figures"]["range_mae_m"]["verdict"] == "better"
    assert (tmp_path / "own" / "page.html").read_bytes() == (tmp_path / "after" / "compare.html").read_bytes()


def test_the_page_stands_alone_and_shows_both_sides(runs: tuple[Path, Path]) -> None:
    html = compare_html(compare_runs(*runs))
    page = Page(html)
    assert all(address.startswith("data:") for address in page.addresses)
    assert "script" not in page.tags
    assert not re.search(r"https?://(?!www\.w3\.org)", html)
    assert html.count('aria-label="frame') == 12  # six frames, on both sides
    for said in (
        "before and after",
        "not found",
        "false alarms",
        "8 frames of 8 differ; the 6 that differ most",
    ):
        assert said in page.text


def test_nothing_of_the_users_becomes_markup(tmp_path: Path) -> None:
    rows = [_row(index, robot, source=HOSTILE) for index in range(FRAMES) for robot in RANGES_M]
    folder = _write(tmp_path / "a<b>", {"a": _all(ERRORS_M), "b": _all(SMALL_M)}, rows)
    html = compare_html(compare_runs(folder))
    assert HOSTILE not in html
    assert "a<b>" not in html
    Page(html)
