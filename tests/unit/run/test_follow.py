"""What time adds to a run folder, also with a tracker and a decoder of one's own."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from nir_render import parse_scene
from nir_render.errors import InputError
from nir_render.run.evaluate import evaluate_run
from nir_render.run.follow import OwnParts
from nir_render.run.perceive import chosen_estimators, perceive_run
from nir_render.run.render import render_run

_OWN = """
import numpy as np
from perception import Message, Track


def nearest(measurements, odometry, state):
    state["sets"] = state.get("sets", 0) + 1
    if state["sets"] > 3 and "%s" == "fails":
        raise RuntimeError("lost my way")
    return [
        Track("r1", one.time_s, 7 + k, one.position_body_m, np.zeros(3), np.eye(6), one.detections)
        for k, one in enumerate(measurements)
    ]


def always_stop(signal, calibrations):
    assert "r1.front" in calibrations
    return [Message("", 0, signal.time_s[0], signal.time_s[-1], 0, "stop", 0.5, 1)]
"""


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve frames of a source that drives by, at 30 FPS, by a small camera."""
    small: dict[str, Any] = {
        "preset": "infra_swarm",
        "cameras": {"front": {"sensor": {"preset": "mt9m031", "columns": 160, "rows": 120}}},
    }
    scene = parse_scene(
        {
            "format": 1, "name": "by", "clock": {"frames": 12, "frame_rate": "30 Hz"}, "observe": ["r1.front"],
            "robots": {
                "r1": {"rig": small},
                "r2": {
                    "rig": "infra_swarm",
                    "motion": [
                        {"time": "0 s", "position": "[3, -0.3, 0] m"}, {"time": "1 s", "position": "[3, 0.3, 0] m"},
                    ],
                },
            },
        }
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("followed") / "run"
    render_run(scene, folder, overwrite=False, progress=lambda *_: None)
    return folder


def test_a_run_that_loses_every_frame_is_refused(tmp_path: Path) -> None:
    rig = {"preset": "infra_swarm", "cameras": {"front": {"clock": {"dropped": 0.999}}}}
    scene = parse_scene(
        {"format": 1, "name": "lost", "observe": ["r1.front"], "robots": {"r1": {"rig": rig}}}
    )
    with pytest.raises(InputError, match="every frame of every camera is dropped"):
        render_run(scene, tmp_path / "run", overwrite=False, progress=lambda *_: None)
    assert not (tmp_path / "run").exists()


def _perceived(rendered: Path, tmp_path: Path, own: OwnParts) -> tuple[Path, Any]:
    folder = tmp_path / "run"
    shutil.copytree(rendered, folder)
    done = perceive_run(folder, estimators=chosen_estimators(["robust"]), progress=lambda *_: None, own=own)
    return folder, done


def _lines(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_a_run_is_followed_and_scored(rendered: Path, tmp_path: Path) -> None:
    folder, _ = _perceived(rendered, tmp_path, OwnParts())
    tracks = _lines(folder / "tracks.robust.jsonl")
    assert {line["track"] for line in tracks} == {1}
    poses = [line for line in _lines(folder / "poses.jsonl") if line["robot"] == "r2"]
    assert poses[6]["position_m"] == pytest.approx([3.0, -0.3 + 0.6 * 6 / 30, 0.0])
    assert not (folder / "odometry.jsonl").exists()  # the observer stands still
    assert (folder / "messages.robust.jsonl").read_text() == ""
    numbers = evaluate_run(folder).summary["estimators"]["robust"]
    assert numbers["track_switches"] == 0
    assert numbers["track_position_rmse_m"] < 0.05
    # Until it is confirmed it is missed, and not followed afterwards by anyone else.
    assert numbers["track_sources"] == numbers["tracks"] == 1
    assert numbers["track_false_alarms_per_set"] == 0.0


def test_a_tracker_and_a_decoder_of_ones_own_take_their_places(rendered: Path, tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(_OWN % "works")
    folder, done = _perceived(rendered, tmp_path, OwnParts.of(f"{file}:nearest", f"{file}:always_stop"))
    assert not done.failures
    assert {line["track"] for line in _lines(folder / "tracks.robust.jsonl")} == {7}
    (message,) = _lines(folder / "messages.robust.jsonl")
    assert (message["robot"], message["track"], message["command"]) == ("r1", 7, "stop")
    # A decoder of one's own is asked when the track has ended: with the last of the sets.
    assert message["told_s"] == _lines(folder / "tracks.robust.jsonl")[-1]["time_s"]


def test_a_tracker_that_fails_is_named_and_nothing_is_written(rendered: Path, tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(_OWN % "fails")
    folder, done = _perceived(rendered, tmp_path, OwnParts.of(f"{file}:nearest", None))
    assert "RuntimeError: lost my way (mine.py, line 9)" in done.failures["robust"]
    assert not (folder / "tracks.robust.jsonl").exists()


@pytest.mark.parametrize(("option", "place"), [("--tracker", 0), ("--decoder", 1)])
def test_what_cannot_be_loaded_is_told_of(tmp_path: Path, option: str, place: int) -> None:
    references: list[str | None] = [None, None]
    references[place] = str(tmp_path / "none.py:function")
    with pytest.raises(InputError, match=f"{option} .*there is no file"):
        OwnParts.of(*references)
