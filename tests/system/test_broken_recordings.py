"""Recordings that are broken in all the ways that people and programs break them: each is refused by name, at once.

A small recording that is right is broken in one place, and given to the command. It must end with status 2 and one
message that names what is wrong, without a traceback and without a hang.
"""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from perception import calibration_document, encode_png16
from tests.system.command import nir_render
from tests.unit.perception.simulation import calibration

Break = Callable[[Path], None]
CAMERA = "r1.front"
TRUTH = {
    "source": "top",
    "robot": "r2",
    "u_px": 30.0,
    "v_px": 20.0,
    "range_m": 3.0,
    "bearing_body": [1.0, 0.0, 0.0],
}
FOUND: dict[str, Any] = {
    "u_px": 30.2, "v_px": 20.1, "u_sigma_px": 0.1, "v_sigma_px": 0.1, "flux_dn": 1e4, "mean_dn": 500.0,
    "background_dn": 64.0, "area_px": 9, "saturated": False, "merged": False, "ghost": False, "range_m": 3.1,
    "range_sigma_m": 0.1, "bearing_body": [1.0, 0.0, 0.0],
}  # fmt: skip
HUGE = "1" + 400 * "0"
LONG = "1" + 6000 * "0"


def _write_lines(file: Path, records: list[dict[str, Any]]) -> None:
    file.write_text("".join(json.dumps(record) + "\n" for record in records), encoding="utf-8")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames of noise of 64 × 48 px, a source in each, found in both."""
    folder = tmp_path_factory.mktemp("recording")
    known = calibration(width_px=64, height_px=48, cx_px=31.5, cy_px=23.5)
    (folder / "calibration.json").write_text(json.dumps(calibration_document([known])), encoding="utf-8")
    counts = np.random.default_rng(1).normal(64.0, 3.0, (48, 64)).clip(0).astype(np.uint16)
    at = [{"format": 1, "camera": CAMERA, "index": index, "time_s": 0.1 * index} for index in (0, 1)]
    for index in (0, 1):
        (folder / f"{index}.png").write_bytes(encode_png16(counts))
    taken = {"exposure_s": 1e-3, "line_time_s": 0.0, "gain": 1.0, "black_level_dn": 64.0}
    _write_lines(folder / "frames.jsonl", [{**one, **taken, "file": f"{i}.png"} for i, one in enumerate(at)])
    _write_lines(folder / "truth.jsonl", [{**one, **TRUTH} for one in at])
    _write_lines(folder / "detections.mine.jsonl", [{**one, **FOUND} for one in at])
    return folder


def text(file: str, old: str, new: str, count: int = 1) -> Break:
    """Replace a text of a file, in its last line or as often as said."""

    def change(folder: Path) -> None:
        path = folder / file
        content = path.read_text(encoding="utf-8")
        assert old in content
        path.write_text(content.replace(old, new, count), encoding="utf-8")

    return change


def camera(**changes: Any) -> Break:
    """Change entries of the camera in calibration.json; a text that begins with = is written as it is."""

    def change(folder: Path) -> None:
        path = folder / "calibration.json"
        document = json.loads(path.read_text(encoding="utf-8"))
        document["cameras"][CAMERA].update(changes)
        content = json.dumps(document)
        for value in changes.values():
            if isinstance(value, str) and value.startswith("="):
                content = content.replace(json.dumps(value), value[1:])
        path.write_text(content, encoding="utf-8")

    return change


def lines(name: str, line: int, /, **changes: Any) -> Break:
    """Change fields of a line; a text that begins with = is written as it is."""

    def change(folder: Path) -> None:
        path = folder / name
        records = [json.loads(one) for one in path.read_text(encoding="utf-8").splitlines()]
        records[line - 1].update(changes)
        content = "".join(json.dumps(record) + "\n" for record in records)
        for value in changes.values():
            if isinstance(value, str) and value.startswith("="):
                content = content.replace(json.dumps(value), value[1:])
        path.write_text(content, encoding="utf-8")

    return change


def without(file: str) -> Break:
    return lambda folder: (folder / file).unlink()


def content(name: str, data: bytes) -> Break:
    def change(folder: Path) -> None:
        (folder / name).write_bytes(data)

    return change


def picture(kind: str, data: Any) -> bytes:
    done, buffer = cv2.imencode(kind, data)
    assert done
    return bytes(buffer.tobytes())


BROKEN: dict[str, tuple[str, Break, str]] = {
    # calibration.json
    "no calibration": ("perceive", without("calibration.json"), "calibration.json: the file is missing"),
    "quaternion of zeros": ("perceive", camera(quaternion_body_camera_xyzw=[0, 0, 0, 0]), "quaternion_body_camera_xyzw': has length 0"),
    "infinite number": ("perceive", camera(fx_px="=1e400"), "1e400, which is no JSON number"),
    "400 digits": ("perceive", camera(read_noise_e=f"={HUGE}"), "read_noise_e': is 1000"),
    "6000 digits": ("perceive", camera(read_noise_e=f"={LONG}"), "thousands of digits"),
    "NaN": ("perceive", camera(cy_px=float("nan")), "NaN, which is no JSON number"),
    "centre far off": ("evaluate", camera(cx_px=1e30), "cx_px': is 1e+30"),
    "0 bits": ("perceive", camera(bit_depth=0), "bit_depth': is 0"),
    "17 bits": ("perceive", camera(bit_depth=17), "bit_depth': is 17"),
    "clipped beyond full scale": ("perceive", camera(saturation_dn=5000), "beyond full scale, 4095 DN"),
    "black above white": ("perceive", camera(black_level_dn=4095), "black_level_dn': is 4095, not below"),
    "true for a number": ("perceive", camera(width_px=True), "width_px': is True"),
    "list in a list": ("perceive", camera(position_body_m=[[0, 0, 0]]), "position_body_m': is [[0, 0, 0]]"),
    "nesting without end": ("perceive", camera(fx_px="=" + 10**5 * "[" + 10**5 * "]"), "without end"),
    "object for a number": ("perceive", camera(fx_px={"mean": 3}), "fx_px.value': the field is missing"),
    "misspelt": ("perceive", text("calibration.json", '"prnu":', '"prnu_":'), "prnu_': there is no such field"),
    "a field twice": ("perceive", text("calibration.json", '"fx_px":', '"fx_px": 3, "fx_px":'), "'fx_px': the field stands twice"),
    "camera not known": ("perceive", text("calibration.json", CAMERA, "r1.left"), "knows no camera 'r1.front'"),
    "cameras in a list": ("perceive", content("calibration.json", b'{"format": 1, "cameras": [1]}'), "field 'cameras': is [1]"),
    "no object": ("perceive", content("calibration.json", b"3"), "holds a int"),
    "no UTF-8": ("perceive", content("calibration.json", b"\xff\xfe\x00"), "no UTF-8"),
    # frames.jsonl
    "no frames": ("perceive", without("frames.jsonl"), "frames.jsonl: the file is missing"),
    "empty": ("perceive", content("frames.jsonl", b"\n"), "names no frame"),
    "frame twice": ("perceive", lines("frames.jsonl", 2, index=0), "frame 0 of r1.front stands in line 1 already"),
    "file twice": ("perceive", lines("frames.jsonl", 2, file="./0.png"), "'./0.png' stands in line 1 already"),
    "time goes back": ("perceive", lines("frames.jsonl", 2, time_s=-1.0), "is -1.0, before the 0.0 of line 1"),
    "index of 31 digits": ("perceive", lines("frames.jsonl", 1, index=10**30), "'index': is 1000000"),
    "gain of 1e300": ("perceive", lines("frames.jsonl", 1, gain=1e300), "'gain': is 1e+300"),
    "control characters": ("perceive", lines("frames.jsonl", 1, file="a\x00.png"), "text that can be printed"),
    "half a surrogate": ("perceive", lines("frames.jsonl", 1, camera="=\"\\ud800\""), "text that can be printed"),
    "out of the folder": ("perceive", lines("frames.jsonl", 1, file="../0.png"), "within the recording's folder"),
    "black beyond saturation": ("report", lines("frames.jsonl", 1, black_level_dn=5000), "black_level_dn = 5000"),
    "picture missing": ("perceive", without("1.png"), "'1.png', which is not there"),
    # pictures
    "picture is a text": ("perceive", content("0.png", b"P5 3 4 255 "), "0.png: is no PNG, TIFF or JPEG"),
    "picture cut short": ("perceive", content("0.png", encode_png16(np.arange(3072, dtype=np.uint16).reshape(48, 64))[:500]), "damaged PNG"),
    "picture in colour": ("perceive", content("0.png", picture(".png", np.zeros((48, 64, 3), np.uint8))), "uint8 with 3 channel"),
    "picture of another size": ("perceive", content("0.png", encode_png16(np.zeros((24, 64), np.uint16))), "has 64 × 24 pixels"),
    "8 bits for 12": ("perceive", content("0.png", picture(".png", np.zeros((48, 64), np.uint8))), "holds 8-bit counts, its calibration says bit_depth = 12"),
    "counts shifted up": ("perceive", content("0.png", encode_png16(np.full((48, 64), 64 * 16 * 5, np.uint16))), "holds the count 5120, beyond full scale"),
    "float TIFF": ("perceive", content("0.png", picture(".tiff", np.zeros((48, 64), np.float32))), "floating-point numbers of 32 bits"),
    # truth.jsonl
    "truth of infinite place": ("evaluate", lines("truth.jsonl", 2, u_px="=1e400"), "truth.jsonl, line 2: holds 1e400"),
    "truth far off": ("evaluate", lines("truth.jsonl", 2, u_px=1e30), "truth.jsonl, line 2: u_px is 1e+30"),
    "truth of 400 digits": ("evaluate", lines("truth.jsonl", 1, direct_e=f"={HUGE}"), "truth.jsonl, line 1: direct_e is 1000"),
    "truth in lists": ("evaluate", lines("truth.jsonl", 1, range_m=[[3.0]]), "range_m is [[3.0]]; wanted a finite number"),
    "truth of true bearings": ("evaluate", lines("truth.jsonl", 1, bearing_body=[True, False, False]), "bearing_body is [True, False, False]"),
    "truth of long bearings": ("report", lines("truth.jsonl", 1, bearing_body=[1.0, 1.0, 0.0]), "wanted a vector of length 1"),
    "truth is a list": ("evaluate", content("truth.jsonl", b"[1]\n"), "truth.jsonl, line 1: wanted an object"),
    "truth of another frame": ("evaluate", lines("truth.jsonl", 1, index=7), "truth.jsonl: speaks of frame 7"),
    # detections.NAME.jsonl
    "long bearing": ("evaluate", lines("detections.mine.jsonl", 1, bearing_body=[2.0, 0.0, 0.0]), "detections.mine.jsonl, line 1: field 'bearing_body': has length 2"),
    "detection far off": ("report", lines("detections.mine.jsonl", 2, u_px=1e30), "line 2: field 'u_px': is 1e+30"),
    "negative σ": ("evaluate", lines("detections.mine.jsonl", 2, range_sigma_m=-0.1), "field 'range_sigma_m': is -0.1"),
    "number for a flag": ("evaluate", lines("detections.mine.jsonl", 2, merged=1), "field 'merged': is 1. Write true or false"),
    "bearing of bearings": ("evaluate", lines("detections.mine.jsonl", 2, bearing_body=[[1], 0, 0]), "'bearing_body[0]': is [1]"),
    "detection is null": ("evaluate", content("detections.mine.jsonl", b"null\n"), "detections.mine.jsonl, line 1: is None"),
    "lamp of true corners": ("evaluate", content("lamps.jsonl", b'{"camera": "r1.front", "index": 0, "lamp": "a", "outline_px": [[true, 1], [2, 3], [4, 1e30]]}\n'), "lamps.jsonl, line 1: outline_px"),
}  # fmt: skip


@pytest.mark.parametrize("name", BROKEN)
def test_it_is_refused_by_name(name: str, whole: Path, tmp_path: Path) -> None:
    command, breaks, said = BROKEN[name]
    folder = tmp_path / "recording"
    shutil.copytree(whole, folder)
    breaks(folder)
    done = nir_render(command, str(folder), cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert "".join(said.split()) in "".join(done.stderr.split())
    assert done.stderr.count("error:") == 1
    assert "Traceback" not in done.stderr
    assert len(done.stderr) < 2000


def test_it_is_right_before_it_is_broken(whole: Path, tmp_path: Path) -> None:
    shutil.copytree(whole, tmp_path / "recording")
    done = nir_render("evaluate", "recording", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["estimators"]["mine"]["recall"] == 1.0
    assert nir_render("perceive", "recording", "--estimator", "paper", cwd=tmp_path).returncode == 0


def test_all_that_is_wrong_is_said_at_once(whole: Path, tmp_path: Path) -> None:
    """Six faults in two files, and one between them: one message with a line for each."""
    folder = tmp_path / "recording"
    shutil.copytree(whole, folder)
    camera(fx_px=-1.0, bit_depth=20, psf_sigma_px="sharp")(folder)
    path = folder / "calibration.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    del document["cameras"][CAMERA]["wavelength_m"]
    path.write_text(json.dumps(document), encoding="utf-8")
    lines("frames.jsonl", 1, exposure_s=0, gain="1")(folder)
    without("1.png")(folder)
    done = nir_render("perceive", str(folder), cwd=tmp_path)
    assert done.returncode == 2
    said = [line for line in done.stderr.splitlines() if line.strip()]
    assert len(said) == 7
    for name in ("fx_px", "bit_depth", "psf_sigma_px", "wavelength_m", "exposure_s", "gain", "1.png"):
        assert sum(name in line for line in said) == 1, name


def test_of_many_faults_the_first_are_told_and_all_are_counted(whole: Path, tmp_path: Path) -> None:
    folder = tmp_path / "recording"
    shutil.copytree(whole, folder)
    (folder / "frames.jsonl").write_text(
        "".join(f'{{"format": {n}}}\n' for n in range(2, 1002)), encoding="utf-8"
    )
    done = nir_render("perceive", str(folder), cwd=tmp_path)
    assert done.returncode == 2
    assert "frames.jsonl, line 1, field 'format': is 2" in done.stderr
    assert "… and 8980 more" in done.stderr
