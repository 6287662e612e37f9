"""A job's rows against what `evaluate` says of the same frames."""

import math

import pytest

import nir_render as nr
from nir_render.evaluate.metrics import evaluate
from nir_render.stress.execute import execute
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
