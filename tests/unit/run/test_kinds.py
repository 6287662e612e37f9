"""Frames for calibration: who passes over them, which calibration counts, where ranges come from."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from nir_render.errors import InputError
from nir_render.run.calibrate import FITTED_FILE, calibrate_run
from nir_render.run.perceive import chosen_estimators, perceive_run
from perception import (
    RecordingError,
    calibration_document,
    encode_png16,
    frame_record,
    parse_detection,
    read_calibrations,
    read_recording,
)
from perception.files.offsets import encode_offsets, read_offsets
from perception.types import Calibration
from tests.unit.perception.simulation import calibration, expected_e, expose, random

CAMERA = calibration(width_px=120, height_px=100, cx_px=59.5, cy_px=49.5)
KINDS = ("dark", "dark", "dark", "flat", "rail", "scene")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Three dark frames, a flat one, and two that show a source at 2 m, one of them on a rail."""
    folder = tmp_path / "recording"
    folder.mkdir()
    lines = []
    for index, kind in enumerate(KINDS):
        sources = [(60.3, 49.8, 2.0)] if kind in ("rail", "scene") else []
        mean_e = expected_e(CAMERA, sources, 2.4e-4, 1000.0 if kind == "flat" else 1.0)
        frame = expose(mean_e, CAMERA, random(71, index), 2.4e-4)
        frame = dataclasses.replace(frame, index=index, time_s=0.1 * index)
        (folder / f"{index}.png").write_bytes(encode_png16(frame.data_dn))
        lines.append(json.dumps(frame_record(frame, f"{index}.png", kind)))
    (folder / "frames.jsonl").write_text("\n".join(lines))
    _write(folder / "calibration.json", CAMERA)
    return folder


def _write(path: Path, known: Calibration) -> None:
    path.write_text(json.dumps(calibration_document([known])))


def _ranges(folder: Path, calibration_file: Path | None = None) -> dict[int, float]:
    chosen = chosen_estimators(["robust"])
    perceive_run(folder, estimators=chosen, progress=lambda *_: None, calibration=calibration_file)
    lines = (folder / "detections.robust.jsonl").read_text().splitlines()
    found = [parse_detection(json.loads(line)) for line in lines]
    return {hit.index: hit.range_m for hit in found}


def test_dark_and_flat_frames_are_not_perceived(recording: Path) -> None:
    assert _ranges(recording) == {4: pytest.approx(2.0, rel=0.01), 5: pytest.approx(2.0, rel=0.01)}
    lines = (recording / "frames.jsonl").read_text().splitlines()[:4]
    (recording / "frames.jsonl").write_text("\n".join(lines))
    with pytest.raises(InputError, match="names dark and flat frames only"):
        _ranges(recording)


def test_another_calibration_counts_in_place_of_the_folders(recording: Path, tmp_path: Path) -> None:
    """A K 8 % larger, the size free, makes ranges 4 % longer; the frames' black level moves with it."""
    known = dataclasses.replace(
        CAMERA,
        range_constant_dn_m2_per_s=1.0816 * CAMERA.range_constant_dn_m2_per_s,
        black_level_dn=CAMERA.black_level_dn + 3.0,
        sigma={"source_radius_m": 0.01},
    )
    _write(tmp_path / "other.json", known)
    before = read_recording(recording)
    after = before.calibrated_by(tmp_path / "other.json")
    assert after.records[5].black_level_dn == before.records[5].black_level_dn + 3.0
    own, other = _ranges(recording), _ranges(recording, tmp_path / "other.json")
    assert other[5] / own[5] == pytest.approx(1.04, abs=0.004)
    _write(tmp_path / "left.json", dataclasses.replace(CAMERA, camera="r1.left"))
    with pytest.raises(InputError, match=r"left\.json: knows no camera 'r1\.front'"):
        _ranges(recording, tmp_path / "left.json")
    with pytest.raises(InputError, match=r"none\.json"):
        _ranges(recording, tmp_path / "none.json")


def test_offsets_beside_a_calibration_are_taken_off_its_frames(recording: Path) -> None:
    offsets = np.zeros((100, 120), dtype=np.int16)
    offsets[10, 20], offsets[30, 40] = 7, -300
    (recording / "map.png").write_bytes(encode_offsets(offsets))
    _write(recording / "calibration.json", dataclasses.replace(CAMERA, offset_file="map.png"))
    assert np.array_equal(read_offsets(recording / "map.png", (100, 120)), offsets)
    known = read_calibrations(recording)["r1.front"]
    assert known.offset_dn is not None
    assert np.array_equal(known.offset_dn, offsets)
    plain = read_recording(recording)
    raw = dataclasses.replace(plain, calibrations={"r1.front": CAMERA}).frame(plain.records[0])
    change = plain.frame(plain.records[0]).data_dn.astype(int) - raw.data_dn
    assert (change[10, 20], change[30, 40], np.abs(change).sum()) == (-7, 300, 307)
    with pytest.raises(
        RecordingError, match=r"map\.png.*is 120 × 100 pixels of 16 bits, its camera has 100 × 120"
    ):
        read_offsets(recording / "map.png", (120, 100))
    (recording / "map.png").unlink()
    with pytest.raises(RecordingError, match=r"map\.png"):
        read_calibrations(recording)


def _relabel(folder: Path, index: int, kind: str) -> None:
    lines = [json.loads(line) for line in (folder / "frames.jsonl").read_text().splitlines()]
    lines[index]["kind"] = kind
    (folder / "frames.jsonl").write_text("\n".join(map(json.dumps, lines)))


@pytest.mark.parametrize(
    ("ranges", "said"),
    [
        ("", r"ranges\.csv: the file is missing"),
        (
            "r1.front,4,2.0\nr1.front,3,1.0",
            "range of frame 3 of 'r1.front', which frames.jsonl calls flat; correct",
        ),
        ("r1.front,5,2.0", r"no range of frame 4 of 'r1\.front', which frames\.jsonl calls rail"),
        ("r1.front,4,2.0", "shows unclipped at 1 places of the rail, wanted 2 or more"),
    ],
)
def test_what_does_not_fit_together_is_named(recording: Path, ranges: str, said: str) -> None:
    if ranges:
        (recording / "ranges.csv").write_text(f"camera,index,range_m\n{ranges}\n")
    with pytest.raises(InputError, match=said):
        calibrate_run(recording, lambda *_: None)
    assert not (recording / FITTED_FILE).exists()


def test_dark_frames_alone_are_enough_and_the_rest_stays(recording: Path) -> None:
    for index in (3, 4):
        _relabel(recording, index, "scene")
    done = calibrate_run(recording, lambda *_: None).cameras["r1.front"]
    assert [sentence.split(":")[1].split("(")[0] for sentence in done.kept] == [
        " no frame is of kind flat ",
        " no frame is of kind rail ",
    ]
    fitted = json.loads((recording / FITTED_FILE).read_text())["cameras"]["r1.front"]
    assert fitted["black_level_dn"]["value"] == pytest.approx(64.7, abs=0.3)  # 1 e of background
    assert fitted["range_constant_dn_m2_per_s"]["value"] == CAMERA.range_constant_dn_m2_per_s
    assert (recording / fitted["offset_file"]).is_file()
    _relabel(recording, 0, "darkness")
    with pytest.raises(InputError, match="Known are scene, dark, flat, rail, shared"):
        calibrate_run(recording, lambda *_: None)
