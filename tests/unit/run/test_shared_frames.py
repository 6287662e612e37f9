"""Frames of sources that two cameras share: `calibrate` on a folder, and what it writes."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nir_render.errors import InputError
from nir_render.run.calibrate import FITTED_FILE, PAGE, calibrate_run
from nir_render.run.perceive import chosen_estimators, perceive_run
from perception import calibration_document, encode_png16, frame_record, parse_calibration_document
from perception.files.detections import parse_causes
from perception.files.offsets import encode_offsets
from perception.types import Calibration
from tests.unit.perception.rig.world import frames_of
from tests.unit.perception.simulation import calibration, random

YAW_DEG, HEADINGS = 25.0, 8


def _cameras() -> dict[str, Calibration]:
    """Two cameras of 36.9° across, 25° apart: 12° of the view are in both."""
    base = calibration(width_px=320, height_px=240, cx_px=159.5, cy_px=119.5)
    turn = Rotation.from_euler("z", YAW_DEG, degrees=True).as_matrix()
    return {
        "r1.front": base,
        "r1.left": replace(
            base,
            camera="r1.left",
            rotation_body_camera=turn @ base.rotation_body_camera,
            position_body_m=turn @ base.position_body_m,
        ),
    }


@cache
def _frames() -> tuple[tuple[str, str, bytes], ...]:
    """Two sources in the overlap at each of eight headings: line of `frames.jsonl`, file, picture."""
    draw, cameras, made = random(1509), _cameras(), []
    for heading in range(HEADINGS):
        places = []
        for tilt in (0.06, -0.06):
            yaw = np.radians(12.5) + draw.uniform(-0.06, 0.06)
            range_m = np.exp(draw.uniform(*np.log((0.8, 5.0))))
            places.append(range_m * np.array([np.cos(yaw), np.sin(yaw), tilt + draw.uniform(-0.03, 0.03)]))
            places[-1][2] += 0.12  # the cameras' height
        for frame in frames_of(cameras, places, draw, 2.4e-4):
            taken = replace(frame, index=heading, time_s=0.5 * heading)
            file = f"{taken.camera}.{heading}.png"
            line = json.dumps(frame_record(taken, file, "shared"))
            made.append((line, file, encode_png16(taken.data_dn)))
    return tuple(made)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """These frames, the left camera said to stand half a degree otherwise."""
    for _, file, picture in _frames():
        (tmp_path / file).write_bytes(picture)
    (tmp_path / "frames.jsonl").write_text("\n".join(line for line, *_ in _frames()))
    cameras = _cameras()
    turn = Rotation.from_rotvec([0.004, -0.006, 0.005]).as_matrix()
    left = cameras["r1.left"]
    said = replace(left, rotation_body_camera=turn @ left.rotation_body_camera)
    _write(tmp_path, [cameras["r1.front"], said])
    return tmp_path


def _write(folder: Path, cameras: list[Calibration]) -> None:
    (folder / "calibration.json").write_text(json.dumps(calibration_document(cameras)))


def test_a_camera_that_stands_otherwise_is_set_right(recording: Path) -> None:
    told = calibrate_run(recording, lambda *_: None)
    assert (told.faults, dict(told.cameras)) == ([], {})
    rig = told.rigs["r1"]
    assert (rig.reference, rig.refused) == ("r1.front", 0)
    assert rig.flares >= 12
    written = json.loads((recording / FITTED_FILE).read_text())
    fitted, true = parse_calibration_document(written), _cameras()
    off = fitted["r1.left"].rotation_body_camera @ true["r1.left"].rotation_body_camera.T
    turned = Rotation.from_matrix(off).as_rotvec()
    sigma = np.sqrt(np.diagonal(rig.poses[0].covariance))[:3]
    assert np.abs(turned / sigma).max() < 4.0
    assert sigma.max() < 1e-3  # it was 0.009 off
    assert "sigma" in written["cameras"]["r1.left"]["quaternion_body_camera_xyzw"]
    assert np.allclose(fitted["r1.front"].rotation_body_camera, true["r1.front"].rotation_body_camera)
    record = rig.record()
    assert record["cameras"]["r1.left"]["turned_sigma_rad"] == pytest.approx(sigma)
    json.dumps(record)
    page = (recording / PAGE).read_text()
    assert f"{rig.flares} flares that two cameras share tell the others" in page


def test_shared_frames_of_one_camera_or_with_ranges_are_refused(recording: Path) -> None:
    (recording / "ranges.csv").write_text("camera,index,range_m\nr1.front,0,2.0\n")
    with pytest.raises(InputError, match=r"which frames\.jsonl calls shared; correct its `kind`"):
        calibrate_run(recording, lambda *_: None)
    (recording / "ranges.csv").unlink()
    lines = (recording / "frames.jsonl").read_text().splitlines()
    (recording / "frames.jsonl").write_text("\n".join(line for line in lines if "r1.front" in line))
    with pytest.raises(InputError, match=r"r1\.front: it takes two cameras to share flares"):
        calibrate_run(recording, lambda *_: None)
    assert not (recording / FITTED_FILE).exists()


def test_offsets_that_no_dark_frame_tells_anew_stay(recording: Path) -> None:
    (recording / "map.png").write_bytes(encode_offsets(np.zeros((240, 320), dtype=np.int16)))
    cameras = parse_calibration_document(json.loads((recording / "calibration.json").read_text()))
    _write(recording, [replace(cameras["r1.front"], offset_file="map.png"), cameras["r1.left"]])
    calibrate_run(recording, lambda *_: None)
    written = json.loads((recording / FITTED_FILE).read_text())["cameras"]
    assert written["r1.front"]["offset_file"] == "map.png"


def test_causes_are_written_where_asked_for_and_else_taken_away(recording: Path) -> None:
    def perceive(causes: bool) -> int:
        chosen = chosen_estimators(["robust"])
        return perceive_run(recording, estimators=chosen, progress=lambda *_: None, causes=causes).detections[
            "robust"
        ]

    count = perceive(causes=True)
    lines = (recording / "causes.robust.jsonl").read_text().splitlines()
    found = [parse_causes(json.loads(line)) for line in lines]
    hits = [json.loads(line) for line in (recording / "detections.robust.jsonl").read_text().splitlines()]
    assert len(found) == count == len(hits)
    for one, hit in zip(found, hits, strict=True):
        assert (one.camera, one.index, one.range_sigma_m) == (
            hit["camera"],
            hit["index"],
            hit["range_sigma_m"],
        )
        assert sum(part**2 for part in one.causes_m.values()) == pytest.approx(one.range_sigma_m**2)
    perceive(causes=False)
    assert not (recording / "causes.robust.jsonl").exists()
