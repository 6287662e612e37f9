"""The stage `perceive`: estimators of all kinds side by side, and what becomes of the others where one fails."""

import dataclasses
import json
import re
import shlex
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nir_render.errors import InputError
from nir_render.run.folder import read_period_s
from nir_render.run.perceive import chosen_estimators, estimators_in_process, perceive_run
from perception import (
    Odometry,
    calibration_document,
    encode_png16,
    frame_record,
    frame_sets,
    odometry_record,
    parse_frame_record,
)
from tests.system.command import nir_render
from tests.unit.perception.simulation import calibration, expected_e, expose, random

FRONT = calibration(width_px=120, height_px=100, cx_px=59.5, cy_px=49.5)
LEFT = dataclasses.replace(FRONT, camera="r1.left")
FRAME = expose(expected_e(FRONT, [(60.3, 49.8, 2.0)], 2.4e-4, 1.0), FRONT, random(71), 2.4e-4)
HEAD = "import json, sys\ninput()\nfor line in sys.stdin:\n    frame = json.loads(line)\n    "


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Two cameras, three times; the left camera is a millisecond late, and its frames stand behind."""
    folder = tmp_path / "recording"
    folder.mkdir()
    frames = [
        dataclasses.replace(FRAME, camera=camera, index=index, time_s=0.1 * index + late_s)
        for camera, late_s in (("r1.front", 0.0), ("r1.left", 1e-3))
        for index in range(3)
    ]
    lines = []
    for frame in frames:
        name = f"{frame.camera}-{frame.index}.png"
        (folder / name).write_bytes(encode_png16(frame.data_dn))
        lines.append(json.dumps(frame_record(frame, name)))
    (folder / "frames.jsonl").write_text("\n".join(lines))
    (folder / "calibration.json").write_text(json.dumps(calibration_document([FRONT, LEFT])))
    return folder


def _command(folder: Path, name: str, body: str) -> str:
    (folder.parent / f"{name}.py").write_text(body)
    return f"{name}=cmd: {shlex.join([sys.executable, '-I', '-S', str(folder.parent / f'{name}.py')])}"


def _found(folder: Path, name: str) -> list[tuple[str, int]]:
    lines = (folder / f"detections.{name}.jsonl").read_text().splitlines()
    return [(record["camera"], record["index"]) for record in map(json.loads, lines)]


ALL = [(camera, index) for camera in ("r1.front", "r1.left") for index in range(3)]


def test_sets_are_what_a_robots_cameras_took_within_half_a_period(recording: Path) -> None:
    records = [
        parse_frame_record(json.loads(line)) for line in (recording / "frames.jsonl").read_text().splitlines()
    ]
    other = dataclasses.replace(records[0], camera="r2.front")
    sets = [[(one.camera, one.index) for one in each] for each in frame_sets([*records, other])]
    pairs = [[("r1.front", index), ("r1.left", index)] for index in range(3)]
    assert sorted(sets) == sorted([*pairs, [("r2.front", 0)]])
    assert [len(each) for each in frame_sets(records, period_s=1.0)] == [2, 2, 2]  # one of each camera


def test_estimators_of_sets_and_commands_run_beside_the_others(recording: Path) -> None:
    """Whatever the order in which sets and programs are asked, lines stand in the order of the frames."""
    (recording.parent / "own.py").write_text(
        "from perception import detect\n"
        "def sets(frames, calibrations, odometry):\n"
        "    assert [frame.camera for frame in frames] == ['r1.front', 'r1.left']\n"
        "    return [hit for frame in reversed(frames) for hit in detect(frame, calibrations[frame.camera])]\n"
    )
    fixed = _command(
        recording,
        "fixed",
        HEAD + "print(json.dumps({'detections': [{'u_px': 60, 'v_px': frame['index']}]}), flush=True)",
    )
    steps: list[tuple[int, int]] = []
    chosen = chosen_estimators(["robust", f"{recording.parent / 'own.py'}:sets", fixed])
    done = perceive_run(recording, estimators=chosen, progress=lambda now, total: steps.append((now, total)))
    assert (done.detections, done.failures) == ({"robust": 6, "sets": 6, "fixed": 6}, {})
    assert [_found(recording, name) for name in chosen] == [ALL] * 3
    assert (recording / "detections.sets.jsonl").read_bytes() == (
        recording / "detections.robust.jsonl"
    ).read_bytes()
    assert steps == [(2, 6), (4, 6), (6, 6)]


def test_a_recording_without_flares_is_told_why(recording: Path) -> None:
    """Six frames, two of them clipped all over; with flares in one camera's the other's faults still are told."""
    dark = encode_png16(np.full((100, 120), 64, dtype=np.uint16))
    for file in recording.glob("*.png"):
        file.write_bytes(
            encode_png16(np.full((100, 120), 4095, dtype=np.uint16)) if "-2" in file.name else dark
        )
    chosen = chosen_estimators(["robust"])
    (said,) = perceive_run(recording, estimators=chosen, progress=lambda *_: None).warnings
    assert said.startswith("robust found nothing in 6 frames: all pixels read 64 counts")
    assert "read out (4); 100 % of the pixels are clipped (at 4095 counts)" in said
    assert said.endswith("saturation_dn (2)")
    (recording / "r1.front-0.png").write_bytes(encode_png16(FRAME.data_dn))
    (said,) = perceive_run(recording, estimators=chosen, progress=lambda *_: None).warnings
    assert said.startswith("robust found nothing in 3 frames of r1.left: all pixels read 64 counts")
    (recording / "r1.left-0.png").write_bytes(encode_png16(FRAME.data_dn))
    assert perceive_run(recording, estimators=chosen, progress=lambda *_: None).warnings == ()
    hasty = chosen_estimators(["robust"], 1e-9)
    warned = perceive_run(recording, estimators=hasty, progress=lambda *_: None).warnings
    assert "time was up before any flare was measured" in warned[0]
    assert warned[-1].startswith("robust saw more in 2 frames than it measures")


NEAR = [(60.3, 49.8, 0.5)]
FAR = [(20.2, 20.7, 6.1), (90.4, 25.3, 5.5), (30.8, 75.1, 7.2), (95.6, 70.9, 5.8), (60.1, 48.8, 6.6)]


@pytest.mark.parametrize(
    ("places", "exposure_s", "off", "said", "least_percent", "most_percent"),
    [
        (NEAR, 2e-5, {"source_radius_m": 1.05 * FRONT.source_radius_m},
         "robust saw near sources whose size and flux, as calibrated, contradict, in 3 frames", 2.0, 5.0),
        (FAR, 1e-3, {"psf_sigma_px": FRONT.psf_sigma_px / 1.1},
         r"robust saw small flares (9|10|11)(\.\d)? % wider than the calibration's point spread .*, in 3 frames", 0.05, 3.0),
    ],
)  # fmt: skip
def test_a_calibration_that_flares_contradict_is_told(
    recording: Path,
    places: list[tuple[float, float, float]],
    exposure_s: float,
    off: dict[str, Any],
    said: str,
    least_percent: float,
    most_percent: float,
) -> None:
    """The radius of a source at .5 m, 5 % too large, or a point spread that is too narrow, in one of two cameras."""
    seen = expose(expected_e(FRONT, places, exposure_s, 1.0), FRONT, random(72), exposure_s)
    for file in recording.glob("*.png"):
        file.write_bytes(encode_png16(seen.data_dn))
    lines = [json.loads(line) for line in (recording / "frames.jsonl").read_text().splitlines()]
    (recording / "frames.jsonl").write_text(
        "\n".join(json.dumps({**line, "exposure_s": exposure_s}) for line in lines)
    )
    document = calibration_document([FRONT, dataclasses.replace(LEFT, **off)])
    (recording / "calibration.json").write_text(json.dumps(document))
    chosen = chosen_estimators(["robust"])
    (told,) = perceive_run(recording, estimators=chosen, progress=lambda *_: None).warnings
    assert re.match(said, told)
    assert least_percent < float(told.rpartition("off by ")[2].partition(" %")[0]) < most_percent


@pytest.mark.parametrize(
    ("off", "claimed", "is_told"), [(1.025, 0.0, True), (1.0, 0.0, False), (1.025, 0.01, False)]
)
def test_frames_tell_together_of_a_width_of_which_each_is_silent(
    tmp_path: Path, off: float, claimed: float, is_told: bool
) -> None:
    """Of 2.5 %, by 24 frames of five sources, each of which tells it to 1.2 %; not where it is claimed to 1 %."""
    mean_e, lines = expected_e(FRONT, FAR, 1e-3, 2.0), []
    for index in range(24):
        frame = dataclasses.replace(
            expose(mean_e, FRONT, random(72, index), 1e-3), camera="r1.front", index=index, time_s=0.1 * index
        )
        (tmp_path / f"{index}.png").write_bytes(encode_png16(frame.data_dn))
        lines.append(json.dumps(frame_record(frame, f"{index}.png")))
    (tmp_path / "frames.jsonl").write_text("\n".join(lines))
    width_px = FRONT.psf_sigma_px / off
    known = dataclasses.replace(
        FRONT, psf_sigma_px=width_px, sigma={**FRONT.sigma, "psf_sigma_px": claimed * width_px}
    )
    (tmp_path / "calibration.json").write_text(json.dumps(calibration_document([known])))
    warnings = perceive_run(
        tmp_path, estimators=chosen_estimators(["robust"]), progress=lambda *_: None
    ).warnings
    assert len(warnings) == is_told
    if is_told:
        assert (
            "% wider than the calibration's point spread (defocus, or larger sources?), in all" in warnings[0]
        )
        told = float(warnings[0].partition("small flares ")[2].partition(" %")[0])
        assert told == pytest.approx(100.0 * (off - 1.0), abs=0.8)


def test_cameras_that_turn_while_exposed_are_told(tmp_path: Path) -> None:
    """By six sources swept along u by 1.5 px."""
    camera = calibration(width_px=320, height_px=240, cx_px=159.5, cy_px=119.5)
    places = [(u, v, 4.0 + 0.01 * u) for u in (90.2, 160.4, 230.7) for v in (80.3, 160.1)]
    node, weight = np.polynomial.legendre.leggauss(6)
    swept_e = [expected_e(camera, [(u + 0.75 * at, v, m) for u, v, m in places], 3e-4, 5.0) for at in node]
    frame = expose(np.tensordot(0.5 * weight, swept_e, axes=1), camera, random(73), 3e-4)
    (tmp_path / "0.png").write_bytes(encode_png16(frame.data_dn))
    (tmp_path / "frames.jsonl").write_text(json.dumps(frame_record(frame, "0.png")))
    (tmp_path / "calibration.json").write_text(json.dumps(calibration_document([camera])))
    chosen = chosen_estimators(["robust"])
    (told,) = perceive_run(tmp_path, estimators=chosen, progress=lambda *_: None).warnings
    assert re.match(r"robust saw cameras turn while exposed, 1\.[456]\d? px in 1 frame: if none did", told)


def test_an_estimator_of_sets_gets_its_robot_s_odometry(recording: Path) -> None:
    (recording.parent / "own.py").write_text(
        "from perception import detect\n"
        "def sets(frames, calibrations, odometry):\n"
        "    assert [record.time_s for record in odometry] == [0.0, 0.5]\n"
        "    return [hit for frame in frames for hit in detect(frame, calibrations[frame.camera])]\n"
    )
    records = [Odometry(robot, at_s, np.zeros(3), np.eye(3)) for robot in ("r1", "r2") for at_s in (0.0, 0.5)]
    lines = [json.dumps(odometry_record(record)) for record in records]
    (recording / "odometry.jsonl").write_text("\n".join(lines))
    chosen = chosen_estimators([f"{recording.parent / 'own.py'}:sets"])
    done = perceive_run(recording, estimators=chosen, progress=lambda *_: None)
    assert (done.detections, done.failures) == ({"sets": 6}, {})


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (HEAD + "if frame['index'] == 1: sys.exit('out of memory')\n    print('{\"detections\": []}', flush=True)",
         "frame 1 of r1.front: ended with exit status 1; its standard error ended with\n    out of memory"),
        (HEAD + "print('{\"detections\": [{}]}', flush=True)", "frame 0 of r1.front: detection 0: u_px is None"),
        (HEAD + "import time; time.sleep(60)", "frame 0 of r1.front: no answer within 0.5 s"),
    ],
)  # fmt: skip
def test_one_that_fails_takes_no_other_along(recording: Path, body: str, said: str) -> None:
    broken = _command(recording, "broken", body)
    (recording / "detections.broken.jsonl").write_text("")  # of an earlier call
    done = nir_render(
        *("perceive", str(recording), "--estimator", broken, "--estimator", "robust"),
        *("--time-limit", "0.5", "--json"),
        cwd=recording,
    )
    assert done.returncode == 2
    answer = json.loads(done.stdout)
    assert answer["detections"] == {"robust": 6}
    assert said in answer["failed"]["broken"]
    assert f"error: --estimator {broken}: {said}" in done.stderr
    assert "detections.broken.jsonl is of an earlier call, and stays as it was" in done.stderr
    assert "Traceback" not in done.stderr
    assert _found(recording, "robust") == ALL


def test_a_function_that_fails_takes_no_other_along_either(recording: Path) -> None:
    (recording.parent / "own.py").write_text("def mine(frame, calibration): return 1 / 0\n")
    own = f"{recording.parent / 'own.py'}:mine"
    done = nir_render(
        "perceive", str(recording), "--estimator", own, "--estimator", "paper", cwd=recording.parent
    )
    assert done.returncode == 2
    assert "ZeroDivisionError" in done.stderr
    assert _found(recording, "paper") == ALL
    assert not (recording / "detections.mine.jsonl").exists()


def test_two_commands_of_one_name_are_refused() -> None:
    with pytest.raises(InputError, match=r"another estimator is called 'a' too; write OTHER=cmd: "):
        chosen_estimators([f"a=cmd: {sys.executable} x", f"a=cmd: {sys.executable} y"])


def test_a_command_is_no_estimator_of_a_campaign() -> None:
    with pytest.raises(InputError, match="is a command"):
        estimators_in_process([f"a=cmd: {sys.executable}"])


def test_exposures_of_a_bracket_are_one_set_where_the_period_is_given(recording: Path) -> None:
    """Three exposures 10 ms apart, every second: by the median interval nine sets, in fact three of two cameras."""
    lines = []
    for camera in (FRONT, LEFT):
        for number in range(9):
            exposure_s = (1.2e-4, 2.4e-4, 4.8e-4)[number % 3]
            mean_e = expected_e(camera, [(60.3, 49.8, 2.0)], exposure_s, 1.0)
            taken = dataclasses.replace(
                expose(mean_e, camera, random(72, number), exposure_s),
                index=number,
                time_s=number // 3 + 0.01 * (number % 3),
            )
            name = f"{camera.camera}-{number}.png"
            (recording / name).write_bytes(encode_png16(taken.data_dn))
            lines.append(json.dumps(frame_record(taken, name)))
    (recording / "frames.jsonl").write_text("\n".join(lines))
    chosen = chosen_estimators(["robust"])

    def sets() -> list[int]:
        said = (recording / "measurements.robust.jsonl").read_text().splitlines()
        return sorted(len(json.loads(line)["detections"]) for line in said)

    perceive_run(recording, estimators=chosen, progress=lambda *_: None)
    assert len(sets()) > 3
    assert read_period_s(recording) is None
    perceive_run(recording, estimators=chosen, progress=lambda *_: None, period_s=1.0)
    assert sets() == [6, 6, 6]  # one source, in three exposures of two cameras that stand in one place
    assert read_period_s(recording) == 1.0
    (recording / "sets.json").write_text('{"format": 1, "period_s": -1}')
    with pytest.raises(InputError, match="write a time above 0"):
        read_period_s(recording)
    for wrong in ("0", "nan"):
        done = nir_render("perceive", str(recording), "--period", wrong, cwd=recording)
        assert (done.returncode, "wanted seconds above 0, such as 0.1" in done.stderr) == (2, True)


@pytest.mark.parametrize("limit", ["0", "-1", "nan", "inf"])
def test_a_limit_that_is_none(recording: Path, limit: str) -> None:
    done = nir_render("perceive", str(recording), "--time-limit", limit, cwd=recording)
    assert done.returncode == 2
    assert "wanted seconds above 0, such as 60" in done.stderr
