"""A folder that another program wrote: frames, calibration, the least of truth, detections. It is scored as it is."""

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import nir_render as nr
from nir_render.run.evaluate import evaluate_run
from nir_render.run.render import render_run
from perception import calibration_document, encode_png16
from tests.paths import SCENES
from tests.system.command import nir_render


def _write_lines(file: Path, records: Iterable[dict[str, Any]]) -> None:
    file.write_text("".join(json.dumps(record) + "\n" for record in records), encoding="utf-8")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two frames of noise; a source at (640, 480) px, 3 m away, in each; found 1.5 px beside, at 3.1 m, in the
    first; in the second only something on a lamp is found, and something that is nothing."""
    known = nr.calibration(nr.load_scene(SCENES / "one_source.yaml"), "r1.front")
    (tmp_path / "calibration.json").write_text(json.dumps(calibration_document([known])))
    counts = np.random.default_rng(1).normal(64.0, 3.0, (960, 1280)).clip(0).astype(np.uint16)
    for index in (0, 1):
        (tmp_path / f"{index}.png").write_bytes(encode_png16(counts))
    at = [{"format": 1, "camera": "r1.front", "index": index, "time_s": 0.1 * index} for index in (0, 1)]
    _write_lines(
        tmp_path / "frames.jsonl",
        [
            {
                **one,
                "exposure_s": 1e-3,
                "line_time_s": 0.0,
                "gain": 1.0,
                "black_level_dn": 64.0,
                "file": f"{i}.png",
            }
            for i, one in enumerate(at)
        ],
    )
    source = {"source": "top", "robot": "r2", "u_px": 640.0, "v_px": 480.0, "range_m": 3.0}
    _write_lines(tmp_path / "truth.jsonl", [{**one, **source, "bearing_body": [1.0, 0.0, 0.0]} for one in at])
    corners = [[100, 100], [120, 100], [120, 120], [100, 120]]
    _write_lines(
        tmp_path / "lamps.jsonl",
        [{"format": 1, "camera": "r1.front", "index": 1, "lamp": "lamps.one", "outline_px": corners}],
    )
    found = {
        "u_sigma_px": 0.1, "v_sigma_px": 0.1, "flux_dn": 1e4, "mean_dn": 500.0, "background_dn": 64.0, "area_px": 9,
        "saturated": False, "merged": False, "ghost": False, "range_m": 3.1, "range_sigma_m": 0.1,
        "bearing_body": [1.0, 0.0, 0.0],
    }  # fmt: skip
    places = [(0, 641.5, 480.0), (1, 110.0, 110.0), (1, 300.0, 300.0)]
    _write_lines(
        tmp_path / "detections.mine.jsonl", [{**at[i], **found, "u_px": u, "v_px": v} for i, u, v in places]
    )
    return tmp_path


def test_it_is_scored(folder: Path) -> None:
    summary = evaluate_run(folder).summary
    assert (summary["frames"], summary["sources_visible"]) == (2, 2)
    assert summary["range_limit_rmse_m"] is None  # it says nothing of electrons
    mine = summary["estimators"]["mine"]
    assert mine["recall"] == 0.5
    assert mine["range_bias_m"] == pytest.approx(0.1)
    assert (mine["lamps_reported"], mine["false_alarms_per_frame"]) == (1, 0.5)
    assert (folder / "summary.json").is_file()
    assert (folder / "preview.png").is_file()


def test_nothing_of_the_renderer_is_asked(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("mitsuba", "drjit"):
        monkeypatch.setitem(sys.modules, name, None)
    assert evaluate_run(folder).summary["estimators"]["mine"]["recall"] == 0.5


def test_a_line_that_speaks_of_no_frame_is_named(folder: Path) -> None:
    lines = (folder / "lamps.jsonl").read_text().replace('"index": 1', '"index": 7')
    (folder / "lamps.jsonl").write_text(lines)
    with pytest.raises(
        nr.InputError, match=r"lamps.jsonl: speaks of frame 7 of r1.front, which frames.jsonl"
    ):
        evaluate_run(folder)


def test_a_broken_line_is_named(folder: Path) -> None:
    truth = (folder / "truth.jsonl").read_text().splitlines()
    (folder / "truth.jsonl").write_text(
        "\n".join([truth[0], truth[1].replace('"range_m": 3.0', '"range_m": "3 m"')])
    )
    with pytest.raises(nr.InputError, match=r"truth.jsonl, line 2: range_m is '3 m'; wanted a finite number"):
        evaluate_run(folder)


@pytest.mark.mitsuba
def test_two_cameras_swapped_are_named(tmp_path: Path) -> None:
    """The files of front and left under each other's names; where robots stand between cameras that shows."""
    robots = {"r1": {"rig": "infra_swarm"}}
    for name, place in (("r2", "[1.5, 1.5, 0] m"), ("r3", "[-1.2, 1.1, 0] m"), ("r4", "[2.0, 0.4, 0] m")):
        robots[name] = {"rig": "infra_swarm", "position": place}
    document = {
        "format": 1,
        "clock": {"frames": 2, "frame_rate": "10 Hz"},
        "observe": ["r1"],
        "robots": robots,
    }
    run = tmp_path / "run"
    render_run(nr.parse_scene(document), run, overwrite=False, progress=lambda *_: None)
    right = nir_render("perceive", str(run), "--estimator", "robust", "--json", cwd=tmp_path)
    assert "warnings" not in json.loads(right.stdout)
    names = {"r1.front": "r1.left", "r1.left": "r1.front"}
    records = [json.loads(line) for line in (run / "frames.jsonl").read_text(encoding="utf-8").splitlines()]
    _write_lines(
        run / "frames.jsonl",
        ({**record, "camera": names.get(record["camera"], record["camera"])} for record in records),
    )
    swapped = nir_render("perceive", str(run), "--estimator", "robust", cwd=tmp_path)
    assert swapped.returncode == 0
    assert "with the images of r1.front and r1.left exchanged it were 8 of 8" in swapped.stderr
