"""A job's rows against what `evaluate` says of the same frames."""

import math
from pathlib import Path

import pytest

import nir_render as nr
from nir_render.evaluate.metrics import evaluate
from nir_render.run.evaluate import evaluate_run
from nir_render.run.perceive import chosen_estimators, estimators_in_process, perceive_run
from nir_render.run.render import render_run
from nir_render.stress.job.execute import execute
from perception import ESTIMATORS, detect
from tests.paths import SCENES

pytestmark = pytest.mark.mitsuba

SCENE = SCENES / "one_source.yaml"


def test_rows_say_what_evaluate_says() -> None:
    scene = nr.load_scene(SCENE, {"clock.frames": 3, "clock.frame_rate": "0.2 Hz"})  # at 1, 6 and 10 m
    rows, frames_sha256 = execute(scene, ESTIMATORS)
    again, same_sha256 = execute(scene, ESTIMATORS)
    assert (rows, frames_sha256) == (again, same_sha256)
    assert frames_sha256 != execute(scene.with_({"seed": 2}), {})[1]

    shots = list(nr.simulate(scene))
    calibration = nr.calibration(scene, "r1.front")
    found = {
        name: [hit for shot in shots for hit in detect(shot.frame, calibration, name)] for name in ESTIMATORS
    }
    keys = [(shot.frame.camera, shot.frame.index) for shot in shots]
    result = evaluate(keys, [row for shot in shots for row in shot.truth], {"r1.front": calibration}, found)
    assert [row["kind"] for row in rows].count("frame") == 3 * len(ESTIMATORS)
    for name in ESTIMATORS:
        own = [row for row in rows if row["kind"] == "source" and row["estimator"] == name]
        summary = result.summary["estimators"][name]
        assert len(own) == 3
        assert sum(row["found"] for row in own) == summary["recall"] * 3
        errors_m = [row["range_error_m"] for row in own if row["ranged"]]
        rmse_m = math.sqrt(sum(error**2 for error in errors_m) / len(errors_m))
        assert rmse_m == pytest.approx(summary["range_rmse_m"], rel=1e-12)
        angles_deg = [row["bearing_error_deg"] for row in own if row["found"]]
        rms_deg = math.sqrt(sum(angle**2 for angle in angles_deg) / len(angles_deg))
        assert rms_deg == pytest.approx(summary["bearing_rms_deg"], rel=1e-12)
        limits_m = [score.range_limit_m for score in result.scores]
        assert [row["range_limit_m"] for row in own] == limits_m
        alarms = [
            row["frame_false_alarms"] for row in rows if row["kind"] == "frame" and row["estimator"] == name
        ]
        assert sum(alarms) / 3 == summary["false_alarms_per_frame"]
        assert sum(row["kind"] == "false_alarm" and row["estimator"] == name for row in rows) == sum(alarms)


def test_an_estimator_of_sets_gets_the_cameras_of_a_robot_together(tmp_path: Path) -> None:
    """Two cameras, two times: what `robust` finds frame by frame; no odometry, as the observer rests."""
    (tmp_path / "own.py").write_text(
        "from perception import detect\n"
        "def sets(frames, calibrations, odometry):\n"
        "    assert [frame.camera for frame in frames] == ['r1.front', 'r1.left'] and odometry is None\n"
        "    return [hit for frame in reversed(frames) for hit in detect(frame, calibrations[frame.camera])]\n"
    )
    aside = {"robots.r1.rig.cameras.left.orientation": {"yaw": "20 deg"}}
    scene = nr.load_scene(SCENE, {"clock.frames": 2, "observe": ["r1.front", "r1.left"], **aside})
    own = estimators_in_process(["robust", f"{tmp_path / 'own.py'}:sets"])
    rows, frames_sha256 = execute(scene, own)
    alone, same_sha256 = execute(scene, {"robust": ESTIMATORS["robust"]})
    assert frames_sha256 == same_sha256
    of = {
        name: [{**row, "estimator": ""} for row in rows if row["estimator"] == name]
        for name in ("robust", "sets")
    }
    assert of["sets"] == of["robust"] == [{**row, "estimator": ""} for row in alone]
    assert sum(row["kind"] == "source" and row["found"] for row in of["sets"]) == 4


def test_an_estimator_that_sees_ghosts_has_its_false_alarms_in_the_rows() -> None:
    scene = nr.load_scene(SCENE, {"clock.frames": 1})

    def beside_it(frame, calibration):  # type: ignore[no-untyped-def]
        import dataclasses

        (hit,) = detect(frame, calibration, "robust")
        return [hit, dataclasses.replace(hit, u_px=hit.u_px + 50.0, range_m=math.nan)]

    rows, _ = execute(scene, {"mine": beside_it})
    (alarm,) = [row for row in rows if row["kind"] == "false_alarm"]
    (source,) = [row for row in rows if row["kind"] == "source"]
    (frame,) = [row for row in rows if row["kind"] == "frame"]
    assert alarm["u_px"] == source["u_px"] + 50.0
    assert alarm["range_m"] is None
    assert frame["frame_false_alarms"] == 1


TALKING = {
    "clock": {"frames": 130, "frame_rate": "20 Hz"},
    "robots.r1.rig.cameras.front.sensor.rows": 120,
    "robots.r1.rig.cameras.front.sensor.columns": 160,
    "robots.r2.motion": [],
    "robots.r2.position": "[2, 0.2, 0] m",
    "robots.r2.rig.sources.top.drive": {"packets": {"sends": [{"at": "0.4 s", "command": "forward"}]}},
}


def test_sequences_and_packets_are_what_a_run_has_of_them(tmp_path: Path) -> None:
    """A command of 5.5 s at 2 m: tracks, packets and bits as `run` and `evaluate` have them of the same scene."""
    scene = nr.load_scene(SCENE, TALKING)
    rows, _ = execute(scene, {"robust": ESTIMATORS["robust"]})
    (sequence,) = [row for row in rows if row["kind"] == "sequence"]
    (packet,) = [row for row in rows if row["kind"] == "packet"]
    render_run(scene, tmp_path / "run", overwrite=False, progress=lambda *_: None)
    perceive_run(tmp_path / "run", estimators=chosen_estimators(["robust"]), progress=lambda *_: None)
    numbers = evaluate_run(tmp_path / "run").summary["estimators"]["robust"]
    for column in ("track_hota", "track_idf1", "track_switches", "message_wrong", "message_bit_error_rate"):
        assert sequence[column] == pytest.approx(numbers[column], abs=1e-12), column
    assert sequence["camera"] == packet["camera"] == "r1"
    assert sequence["track_hota"] > 0.9
    assert (numbers["message_sent"], numbers["message_received"]) == (1, 1)
    assert (packet["robot"], packet["source"], packet["received"]) == ("r2", "top", True)


def test_a_few_frames_say_nothing_of_tracks() -> None:
    scene = nr.load_scene(SCENE, {**TALKING, "clock.frames": 9})
    rows, _ = execute(scene, {"robust": ESTIMATORS["robust"]})
    assert {row["kind"] for row in rows} <= {"frame", "source", "ghost", "false_alarm"}
