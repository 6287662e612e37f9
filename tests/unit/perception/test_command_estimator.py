"""Estimators that are a command: what a program gets, what it may leave out, and what is told where it fails."""

import dataclasses
import json
import math
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from perception import CommandEstimator, EstimatorError, load_command
from perception.command_estimator import is_command, parse_answer, pgm16
from perception.model.bearing import bearing_body
from perception.types import Detection
from tests.paths import SCENES
from tests.unit.perception.simulation import calibration, expected_e, expose, random

CAMERA = calibration(width_px=120, height_px=100, cx_px=59.5, cy_px=49.5)
TAKEN = expose(expected_e(CAMERA, [(60.3, 49.8, 2.0)], 2.4e-4, 1.0), CAMERA, random(71), 2.4e-4)
FRAME = dataclasses.replace(TAKEN, index=0)
CAMERAS = {FRAME.camera: CAMERA}

HEAD = "import json, os, sys, time\ncameras = json.loads(input())['cameras']\n"
LOOP = HEAD + "for line in sys.stdin:\n    frame = json.loads(line)\n    "


def _program(tmp_path: Path, body: str, limit_s: float = 20.0) -> CommandEstimator:
    (tmp_path / "own.py").write_text(body + "\n", encoding="utf-8")
    # Isolated, without site: a start takes a hundredth of a second.
    return CommandEstimator(
        "own", "cmd: own", (sys.executable, "-I", "-S", str(tmp_path / "own.py")), limit_s
    )


def _asked(estimator: CommandEstimator, frames: int = 1) -> list[list[Detection]]:
    with estimator.started(CAMERAS) as process:
        found = [
            process.detect(dataclasses.replace(FRAME, index=index), Path("frames") / f"{index}.png")
            for index in range(frames)
        ]
        process.finish()
    return found


def test_a_program_gets_calibrations_then_each_frame_with_its_counts(tmp_path: Path) -> None:
    """It tells on standard error what it read; the counts are those of the frame, and gone afterwards."""
    estimator = _program(
        tmp_path,
        LOOP + "data = open(frame['pgm'], 'rb').read()\n"
        "    note = {'cameras': cameras, 'frame': frame, 'hex': data.hex()}\n"
        "    json.dump(note, open('told.json', 'w'))\n"
        "    print(json.dumps({'detections': []}), flush=True)",
    )
    before = Path.cwd()
    os.chdir(tmp_path)
    try:
        assert _asked(estimator) == [[]]
    finally:
        os.chdir(before)
    told = json.loads((tmp_path / "told.json").read_text())
    assert told["cameras"]["r1.front"]["fx_px"] == CAMERA.fx_px
    frame = told["frame"]
    assert frame["file"] == str(tmp_path / "frames" / "0.png")
    assert (frame["exposure_s"], frame["gain"], frame["black_level_dn"]) == (
        2.4e-4,
        1.0,
        FRAME.black_level_dn,
    )
    assert (frame["width_px"], frame["height_px"], frame["index"]) == (120, 100, 0)
    assert bytes.fromhex(told["hex"]) == pgm16(FRAME)
    assert not Path(frame["pgm"]).exists()
    assert not Path(frame["pgm"]).parent.exists()


def test_a_pgm_holds_the_counts_with_the_high_byte_first() -> None:
    data = np.array([[1, 256, 65535], [0, 4095, 2]], dtype=np.uint16)
    encoded = pgm16(dataclasses.replace(FRAME, data_dn=data))
    assert encoded == b"P5\n3 2\n65535\n" + bytes.fromhex("0001 0100 ffff 0000 0fff 0002")


def test_what_a_detection_leaves_out_is_not_claimed() -> None:
    (found,) = parse_answer('{"detections": [{"u_px": 70, "v_px": 40.5}]}', FRAME, CAMERA)
    assert (found.camera, found.index, found.time_s) == (FRAME.camera, FRAME.index, FRAME.time_s)
    assert (found.u_px, found.v_px, found.area_px) == (70.0, 40.5, 0)
    assert [found.saturated, found.merged, found.ghost] == [False] * 3
    missing = (found.range_m, found.range_sigma_m, found.u_sigma_px, found.flux_dn, found.mean_dn)
    assert all(map(math.isnan, missing))
    assert found.bearing_body == tuple(bearing_body([[70.0, 40.5]], CAMERA)[0])


def test_what_a_detection_claims_is_kept() -> None:
    answer = {
        "index": 0, "camera": "r1.front", "seconds": 0.1,
        "detections": [{"format": 1, "u_px": 1.0, "v_px": 2.0, "range_m": 3.0, "saturated": True, "bearing_body": [0, 0.6, 0.8],
                        "range_sigma_m": None, "flux_dn": math.nan}],
    }  # fmt: skip
    (found,) = parse_answer(json.dumps(answer), FRAME, CAMERA)
    assert (found.range_m, found.saturated, found.bearing_body) == (3.0, True, (0.0, 0.6, 0.8))
    assert math.isnan(found.range_sigma_m)
    assert math.isnan(found.flux_dn)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ("hello", "answered 'hello', which is no JSON; print nothing but"),
        ("[" * 100_000, "which is no JSON"),
        ("\xff", "which is no JSON"),
        ("[]", 'wanted {"detections":'),
        ('{"detection": []}', 'wanted {"detections":'),
        ('{"detections": {}}', 'wanted {"detections":'),
        ('{"detections": [3]}', "detection 0 is '3'; wanted an object"),
        ('{"detections": [{"u_px": 1}]}', "detection 0: v_px is None; wanted a number of pixels"),
        ('{"detections": [{"u_px": 1, "v_px": "2"}]}', "v_px is '2'; wanted a number"),
        ('{"detections": [{"u_px": 1, "v_px": NaN}]}', "v_px is None; wanted a number"),
        ('{"detections": [{"u_px": 1, "v_px": 1e999}]}', "v_px is inf; wanted a number"),
        ('{"detections": [{"u_px": 1, "v_px": 2, "range": 3}]}', "there is no field 'range'; known: camera, index"),
        ('{"detections": [{"u_px": 1, "v_px": 2, "range_m": -3}]}', "'range_m': is -3. Write a finite number above 0"),
        ('{"detections": [{"u_px": 1, "v_px": 2, "range_m": "far"}]}', "'range_m': is 'far'. Write a finite number"),
        ('{"detections": [{"u_px": 1, "v_px": 2, "bearing_body": [1, 1, 0]}]}', "'bearing_body': has length 1.41421"),
        ('{"detections": [{"u_px": 1, "v_px": 2, "bearing_body": [1, 0]}]}', "Write a list of 3 numbers"),
        ('{"detections": [{"u_px": 1, "v_px": 2, "area_px": 1.5}]}', "'area_px': is 1.5"),
        ('{"index": 7, "detections": []}', "answered of frame 7 of r1.front, asked for this one"),
        ('{"detections": [{"u_px": 1, "v_px": 2, "index": 1}]}', "detection 0 is of frame 1 of r1.front"),
        ('{"detections": [{"u_px": 1, "v_px": 1' + "0" * 400 + "}]}", "v_px is 1000"),
    ],
)  # fmt: skip
def test_nonsense_is_named(answer: str, said: str) -> None:
    with pytest.raises(EstimatorError) as raised:
        parse_answer(answer, FRAME, CAMERA)
    assert said in str(raised.value)


@pytest.mark.parametrize(
    ("body", "limit_s", "said"),
    [
        (LOOP + "sys.exit('no such model')", 20.0, "frame 0 of r1.front: ended with exit status 1; its standard error ended with\n    no such model"),
        (LOOP + "os.kill(os.getpid(), 11)", 20.0, "was ended by SIGSEGV; it said nothing on standard error"),
        ("raise SystemExit(3)", 20.0, "ended with exit status 3"),
        (LOOP + "print('loading', file=sys.stderr, flush=True); time.sleep(60)", 0.5, "no answer within 0.5 s; end each answer with a newline"),
        ("import time; time.sleep(60)", 0.5, "no answer within 0.5 s"),
        (LOOP + "print('{\"detections\": []}'); time.sleep(60)", 0.5, "no answer within 0.5 s"),  # not flushed
        (LOOP + "print('found 3', flush=True)", 20.0, "answered 'found 3', which is no JSON"),
        (LOOP + "print('{\"detections\": []}\\n{\"detections\": []}', flush=True)", 20.0, "frame 0 of r1.front: answered once more"),
        (LOOP + "os.close(1); time.sleep(60)", 20.0, "closed its standard output"),
    ],
)  # fmt: skip
@pytest.mark.skipif(os.name != "posix", reason="signals and their names are POSIX's")
def test_a_program_that_fails_is_named_and_ended(
    tmp_path: Path, body: str, limit_s: float, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("perception.command_estimator._ENDS_WITHIN_S", 1.0)
    started_s = time.monotonic()
    with pytest.raises(EstimatorError) as raised:
        _asked(_program(tmp_path, body, limit_s))
    assert said.replace("frame 0 of r1.front: answered once", "answered once") in str(raised.value)
    assert str(raised.value).startswith("cmd: own: ")
    assert time.monotonic() - started_s < 15.0


def test_the_last_lines_of_standard_error_are_kept(tmp_path: Path) -> None:
    body = LOOP + "[print('line', i, file=sys.stderr) for i in range(5000)]; sys.exit(2)"
    with pytest.raises(EstimatorError, match="line 4999") as raised:
        _asked(_program(tmp_path, body))
    assert str(raised.value).count("\n") == 8


@pytest.mark.skipif(os.name != "posix", reason="process groups are POSIX's")
def test_nothing_that_was_started_lives_on(tmp_path: Path) -> None:
    """A program that hangs with a child of its own: both are gone when the block ends."""
    body = (
        "import subprocess, sys, time\n"
        "child = subprocess.Popen([sys.executable, '-I', '-S', '-c', 'import time; time.sleep(60)'])\n"
        f"open({str(tmp_path / 'pid')!r}, 'w').write(str(child.pid))\ntime.sleep(60)"
    )
    with pytest.raises(EstimatorError, match="no answer within"):
        _asked(_program(tmp_path, body, 1.0))
    pid = int((tmp_path / "pid").read_text())
    deadline_s = time.monotonic() + 5.0
    while time.monotonic() < deadline_s and _lives(pid):
        time.sleep(0.01)
    assert not _lives(pid)


def _lives(pid: int) -> bool:
    try:
        return "State:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return False


@pytest.mark.parametrize(
    ("reference", "name"),
    [
        (f"cmd: {sys.executable} -c pass", Path(sys.executable).stem),
        (f"cmd:{sys.executable} {SCENES / 'my_detector.py'} --fast", "my_detector"),
        (f"mine=cmd: {sys.executable} -c 'a b'", "mine"),
    ],
)
def test_names(reference: str, name: str) -> None:
    assert is_command(reference)
    found = load_command(reference)
    assert (found.name, found.command[0]) == (name.replace(".", "_"), sys.executable)


@pytest.mark.parametrize(
    ("reference", "said"),
    [
        ("cmd:", "no program behind 'cmd:'"),
        ("cmd: ./nowhere --fast", "there is no program './nowhere'; build it"),
        ("cmd: 'open", "close the quotes"),
        ("cmd: plain.txt", "is here, but not to be run so; write ./plain.txt"),
        ("cmd: ./plain.txt", "chmod +x ./plain.txt"),
        ("cmd: folder", "is a folder; name the program in it"),
        (f"robust=cmd: {sys.executable}", "'robust' is an estimator that is built in"),
        (f"a b=cmd: {sys.executable}", "the name 'a b' may hold"),
        (f"=cmd: {sys.executable}", "the name '' may hold"),
    ],
)
def test_commands_that_cannot_be_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reference: str, said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plain.txt").write_text("")
    (tmp_path / "folder").mkdir()
    with pytest.raises(EstimatorError) as raised:
        load_command(reference)
    assert said in str(raised.value)


@pytest.mark.skipif(os.name != "posix", reason="how a script without an interpreter fails is POSIX's")
def test_a_script_without_its_interpreter(tmp_path: Path) -> None:
    (tmp_path / "own").write_bytes(b"\0nothing")
    (tmp_path / "own").chmod(0o755)
    with pytest.raises(EstimatorError, match="cannot be started"):
        _asked(load_command(f"cmd: {tmp_path / 'own'}"))


def test_what_is_no_command() -> None:
    assert not is_command("robust")
    assert not is_command("C:\\cmd:.py:f")
    assert not is_command("a/b=cmd: x")
    with pytest.raises(EstimatorError, match="wanted a time above 0"):
        load_command(f"cmd: {sys.executable}", math.nan)


def test_the_python_example_places_and_ranges_a_source() -> None:
    """It knows neither background nor the lens, so 2 m to a few per cent."""
    estimator = load_command(f"cmd: {sys.executable} {SCENES / 'my_detector.py'}")
    assert estimator.name == "my_detector"
    ((hit,),) = _asked(estimator)
    assert hit.range_m == pytest.approx(2.0, rel=0.03)
    assert (hit.u_px, hit.v_px) == pytest.approx((60.3, 49.8), abs=0.1)


def test_the_python_example_imports_nothing_of_ours() -> None:
    source = (SCENES / "my_detector.py").read_text(encoding="utf-8")
    assert "import perception" not in source
    assert "from perception" not in source


@pytest.mark.skipif(shutil.which("g++") is None, reason="no g++ to build the C++ example with")
def test_the_example_in_cpp_is_built_and_places_a_source(tmp_path: Path) -> None:
    program = tmp_path / "my_detector"
    build = ["g++", "-O1", "-Wall", "-Werror", "-o", str(program), str(SCENES / "my_detector.cpp")]
    subprocess.run(build, check=True)
    first, second = _asked(load_command(f"cmd: {program}"), frames=2)
    assert (first[0].u_px, first[0].v_px) == pytest.approx((60.3, 49.8), abs=0.1)
    assert (first[0].u_px, first[0].index, second[0].index) == (second[0].u_px, 0, 1)
