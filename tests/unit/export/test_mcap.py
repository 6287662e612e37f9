"""MCAP files, read back by `rosbags`, which shares nothing with what wrote them."""

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from nir_render import calibration, load_scene
from nir_render.errors import InputError
from nir_render.export import cdr
from nir_render.export.mcap_file import Exported, export_mcap
from nir_render.export.ros_definitions import DEFINITIONS
from nir_render.truth.poses import PoseTruth
from nir_render.truth.sent import SentTruth
from perception import (
    Detection,
    Message,
    Odometry,
    RawFrame,
    Track,
    calibration_document,
    detection_record,
    encode_png16,
    frame_record,
    message_record,
    odometry_record,
    track_record,
)
from perception.model.lens import project
from tests.paths import ROOT

_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # 90° about z
_COVARIANCE = np.diag([1e-4, 4e-4, 9e-4, 0.01, 0.02, 0.03])


def _lines(path: Path, records: list[dict[str, Any]]) -> None:
    path.write_text("".join(json.dumps(record) + "\n" for record in records))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one camera, two frames of noise, the first begun before time 0."""
    folder = tmp_path_factory.mktemp("run") / "run"
    (folder / "frames").mkdir(parents=True)
    scene = load_scene(ROOT / "scenes" / "one_source.yaml")
    known = dataclasses.replace(
        calibration(scene, "r1.front"), lens_model="brown_conrady", distortion=(-0.1, 0.02, 1e-3, -2e-3)
    )
    (folder / "calibration.json").write_text(json.dumps(calibration_document([known])))
    random = np.random.default_rng(1)
    frames = []
    for index in range(2):
        data_dn = random.integers(0, 4096, (known.height_px, known.width_px), dtype=np.uint16)
        frame = RawFrame("r1.front", index, -1e-4 + 0.1 * index, 2e-4, data_dn, known.black_level_dn)
        (folder / "frames" / f"{index}.png").write_bytes(encode_png16(data_dn))
        frames.append(frame_record(frame, f"frames/{index}.png"))
    _lines(folder / "frames.jsonl", frames)
    pose = PoseTruth(
        "r1", 0.0, (1.0, 2.0, 0.5), (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)), (0.0,) * 3, (0.0,) * 3
    )
    _lines(folder / "poses.jsonl", [pose.record()])
    odometry = Odometry("r1", 0.05, np.array([0.1, 0.2, 0.3]), _TURN, position_sigma_m=0.01)
    _lines(folder / "odometry.jsonl", [odometry_record(odometry)])
    _lines(folder / "sent.jsonl", [SentTruth("r2", "top", 0.0, 5.5, 12, "stop").record()])
    hit = Detection(
        "r1.front", 0, -1e-4, 700.25, 400.5, 0.02, 0.03, 12345.0, 90.0, 64.0, 9, False, False, False, 2.5,
        0.01, (1.0, 0.0, 0.0),
    )  # fmt: skip
    _lines(folder / "detections.robust.jsonl", [detection_record(hit)])
    track = Track(
        "r1", 0.0, 7, np.array([2.0, -0.5, 0.1]), np.array([0.1, 0.0, 0.0]), _COVARIANCE, identity="r2"
    )
    _lines(folder / "tracks.robust.jsonl", [track_record(track)])
    word = Message("r1", 7, 0.01, 5.51, 12, "stop", 0.999, 3)
    _lines(folder / "messages.robust.jsonl", [message_record(word)])
    return folder


@pytest.fixture(scope="module")
def exported(run: Path) -> Exported:
    return export_mcap(run, run.with_name("run.mcap"))


@pytest.fixture(scope="module")
def read(exported: Exported) -> dict[str, list[tuple[int, Any]]]:
    """All messages by topic, with their stamps."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with AnyReader([exported.file]) as reader:
        for connection, stamp_ns, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((stamp_ns, message))
    return found


def test_frames_come_back_bit_by_bit(run: Path, read: dict[str, list[tuple[int, Any]]]) -> None:
    from perception import read_frames

    frames = list(read_frames(run))
    images = read["/r1/front/image_raw"]
    assert len(images) == len(frames) == 2
    for frame, (stamp_ns, image) in zip(frames, images, strict=True):
        data_dn = image.data.view("<u2").reshape(image.height, image.step // 2)
        assert image.encoding == "mono16"
        assert np.array_equal(data_dn, frame.data_dn)
        assert stamp_ns == round((frame.time_s + 1e-4) * 1e9)  # mid-exposure
        assert image.header.stamp.sec * 10**9 + image.header.stamp.nanosec == stamp_ns
    exposures = [message for _, message in read["/r1/front/exposure"]]
    assert [one.time_s for one in exposures] == [frame.time_s for frame in frames]
    assert [one.exposure_s for one in exposures] == [2e-4, 2e-4]


def test_transforms_take_a_point_where_ours_do(run: Path, read: dict[str, list[tuple[int, Any]]]) -> None:
    """A point before the camera: by the file's transforms into the world, against our own rotations."""
    from scipy.spatial.transform import Rotation

    from perception import read_calibrations

    known = read_calibrations(run)["r1.front"]
    moves = {
        one.child_frame_id: (
            Rotation.from_quat([getattr(one.transform.rotation, axis) for axis in "xyzw"]),
            np.array([getattr(one.transform.translation, axis) for axis in "xyz"]),
        )
        for topic in ("/tf", "/tf_static")
        for _, message in read[topic]
        for one in message.transforms
    }
    at_m = np.array([0.3, -0.2, 2.0])
    for name in ("r1/front", "r1"):
        turn, shift_m = moves[name]
        at_m = turn.apply(at_m) + shift_m
    body_m = known.rotation_body_camera @ np.array([0.3, -0.2, 2.0]) + known.position_body_m
    assert at_m == pytest.approx(_TURN @ body_m + np.array([1.0, 2.0, 0.5]), abs=1e-12)


def test_camera_info_is_opencv_s(run: Path, read: dict[str, list[tuple[int, Any]]]) -> None:
    import cv2

    from perception import read_calibrations

    info = read["/r1/front/camera_info"][0][1]
    assert info.distortion_model == "plumb_bob"
    at_m = np.array([[0.4, -0.3, 2.0]])
    seen_px, _ = cv2.projectPoints(at_m, np.zeros(3), np.zeros(3), info.k.reshape(3, 3), info.d)
    assert seen_px.reshape(2) == pytest.approx(project(at_m, read_calibrations(run)["r1.front"])[0], abs=1e-9)


def test_what_perception_says_comes_back(read: dict[str, list[tuple[int, Any]]]) -> None:
    (found,) = read["/r1/front/detections/robust"][0][1].detections
    assert (found.u_px, found.v_px, found.range_m, found.range_sigma_m) == (700.25, 400.5, 2.5, 0.01)
    assert math.isnan(found.flux_sigma_dn)
    assert len(read["/r1/front/detections/robust"][1][1].detections) == 0  # nothing in the second is told
    (ring,) = read["/r1/front/annotations/robust"][0][1].circles
    assert (ring.position.x, ring.position.y) == (700.25, 400.5)
    (track,) = read["/r1/tracks/robust"][0][1].tracks
    assert track.track == 7
    assert track.identity == "r2"
    assert track.position_body_m == pytest.approx([2.0, -0.5, 0.1])
    assert track.covariance.reshape(6, 6) == pytest.approx(_COVARIANCE)
    _, ellipsoid, text = read["/r1/markers/robust"][0][1].markers
    assert sorted([ellipsoid.scale.x, ellipsoid.scale.y, ellipsoid.scale.z]) == pytest.approx(
        [0.02, 0.04, 0.06]
    )
    assert text.text == "7 r2"
    ((told_ns, told),), ((sent_ns, sent),) = read["/r1/messages/robust"], read["/r2/sent"]
    assert (told_ns, told.word, told.track, told.confidence) == (5_510_000_000, 12, 7, 0.999)
    assert (sent_ns, sent.word, sent.command) == (5_500_000_000, 12, "stop")
    ((_, odometry),) = read["/r1/odometry"]
    assert odometry.pose.covariance.reshape(6, 6)[0, 0] == pytest.approx(1e-4)
    assert odometry.pose.pose.orientation.z == pytest.approx(math.sqrt(0.5))


def test_definitions_are_those_of_ros() -> None:
    """Field by field against what `rosbags` knows of ROS 2 Humble."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    compared = 0
    for name, text in DEFINITIONS.items():
        package, own = name.split("/")
        kind = f"{package}/msg/{own}"
        if kind in store.fielddefs:
            assert get_types_from_msg(text, kind)[kind][1] == store.fielddefs[kind][1], name
            compared += 1
    assert compared >= 20


def test_bytes_are_aligned_as_ros_aligns_them() -> None:
    """Odd lengths before doubles, empty arrays, nested arrays: `rosbags` writes the same bytes."""
    store = get_typestore(Stores.EMPTY)
    kind = "nir_render_msgs/msg/Tracks"
    store.register(get_types_from_msg(cdr.definition_text("nir_render_msgs/Tracks"), kind))
    types = store.types
    header = {"stamp": {"sec": 3, "nanosec": 5}, "frame_id": "r1"}
    tracks: list[dict[str, Any]] = [
        {"track": number, "position_body_m": [1.0, 2.0, 3.0], "velocity_body_m_per_s": [0.0] * 3,
         "covariance": [0.5] * 36, "unseen_s": 0.25, "identity": "x" * number, "ghost": "no"}
        for number in range(3)
    ]  # fmt: skip
    for listed in ([], tracks):
        theirs = types[kind](
            types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](3, 5), "r1"),
            [types["nir_render_msgs/msg/Track"](**{
                name: np.array(value) if isinstance(value, list) else value for name, value in one.items()
            }) for one in listed],
        )  # fmt: skip
        ours = cdr.encode("nir_render_msgs/Tracks", {"header": header, "tracks": listed})
        written = bytes(store.serialize_cdr(theirs, kind))
        assert written.rstrip(b"\x00") == ours.rstrip(b"\x00")
        assert len(written) - len(ours) in range(4)  # theirs is padded at its end


def test_a_field_too_few_or_too_many_is_refused() -> None:
    with pytest.raises(ValueError, match="nanosec"):
        cdr.encode("builtin_interfaces/Time", {"sec": 1})
    with pytest.raises(ValueError, match="wanted 3 values, not 2"):
        cdr.encode(
            "nir_render_msgs/Track",
            {"track": 1, "position_body_m": [1.0, 2.0], "velocity_body_m_per_s": [0.0] * 3,
             "covariance": [0.0] * 36, "unseen_s": 0.0, "identity": "", "ghost": "no"},
        )  # fmt: skip


def test_the_clock_begins_no_earlier_than_ros_s(run: Path, tmp_path: Path) -> None:
    """A pose 0.4 s before the run's time 0 moves all by one whole second, which the file says."""
    from mcap.reader import make_reader

    pose = PoseTruth("r1", -0.4, (0.0,) * 3, (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3)
    (tmp_path / "early").mkdir()
    _lines(tmp_path / "early" / "poses.jsonl", [pose.record()])
    done = export_mcap(tmp_path / "early", tmp_path / "early.mcap")
    assert done.ahead_s == 1
    with done.file.open("rb") as stream:
        reader = make_reader(stream)
        assert [message.log_time for _, _, message in reader.iter_messages()] == [600_000_000]
        (told,) = reader.iter_metadata()
        assert told.metadata == {"ahead_of_the_run_s": "1"}


def test_names_that_are_one_in_ros_are_told_apart(tmp_path: Path) -> None:
    poses = [
        PoseTruth(name, 0.0, (0.0,) * 3, (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3).record()
        for name in ("r-1", "r_1")
    ]
    _lines(tmp_path / "poses.jsonl", poses)
    with pytest.raises(InputError, match="both called r_1 in ROS"):
        export_mcap(tmp_path, tmp_path / "run.mcap")
    assert not (tmp_path / "run.mcap").exists()


def test_a_folder_without_a_run_and_a_missing_package_are_told(
    tmp_path: Path, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match="holds no frames, poses or tracks"):
        export_mcap(tmp_path, tmp_path / "run.mcap")
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    with pytest.raises(InputError, match=r"nir-render\[export\]"):
        export_mcap(run, tmp_path / "run.mcap")


def test_the_command_says_what_it_wrote(run: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "nir_render.command.main", "export", str(run), "--format", "mcap"]
    done = subprocess.run(
        [*command, "-o", str(tmp_path / "x.mcap"), "--json"],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    told = json.loads(done.stdout)
    assert told["messages"]["/r1/front/image_raw"] == 2
    assert (tmp_path / "x.mcap").stat().st_size > 2 * 1280 * 960
