"""The stack on topics of ROS: a stand-in for its node, with the messages that `rosbags` knows of ROS 2."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from nir_render.errors import InputError
from nir_render.export import ros_messages as ros
from nir_render.export.cdr import fields_of
from nir_render.export.live import Live, OdometryError, Outcome, Taken
from nir_render.export.mcap_file import export_mcap
from perception import (
    Heard,
    Odometry,
    Pipeline,
    RawFrame,
    SetMeasurements,
    calibration_document,
    encode_png16,
    frame_record,
    message_record,
    parse_message,
    parse_track,
    read_calibrations,
)
from perception.messages.uart import encode
from tests.unit.perception.stage import CAMERA, CAMERAS, EXPOSURE_S, RATE_HZ, frame_of

Array = NDArray[np.float64]
STORE = get_typestore(Stores.ROS2_HUMBLE)
WORD, START_S = 65, 0.31
TAKEN = Taken(EXPOSURE_S, stamped="middle")


@dataclass
class StandIn:
    """A node that keeps what is published, and hands on what is said on a topic."""

    heard: dict[str, Callable[[Any], None]] = field(default_factory=dict)
    published: dict[str, list[Any]] = field(default_factory=dict)
    kinds: dict[str, Any] = field(default_factory=dict)

    def create_subscription(
        self, kind: Any, topic: str, callback: Callable[[Any], None], quality: Any
    ) -> None:
        self.kinds[topic], self.heard[topic] = kind, callback

    def create_publisher(self, kind: Any, topic: str, quality: Any) -> Any:
        self.kinds[topic] = kind
        return SimpleNamespace(publish=self.published.setdefault(topic, []).append)


def _class_of(kind: str) -> Any:
    """Return what makes a message, as strict about what its fields are as ROS's own classes."""
    package, _, name = kind.partition("/")
    wanted = {"float": float, "int": int, "uint": int, "bool": bool, "string": str}

    def make(**fields: Any) -> Any:
        for one in fields_of(kind):
            if not one.is_array:
                types = wanted.get(one.kind.rstrip("0123456789"), object)
                assert isinstance(fields[one.name], types), (kind, one, fields[one.name])
        # `rosbags` wants arrays where ROS takes bytes.
        return STORE.types[f"{package}/msg/{name}"](
            **{
                name: np.frombuffer(one, np.uint8) if isinstance(one, bytes) else one
                for name, one in fields.items()
            }
        )

    return make


def _image(frame: RawFrame, stamp_s: float) -> Any:
    fields = ros.to_image(frame, frame.camera, stamp_s)
    stamp = SimpleNamespace(**fields["header"]["stamp"])
    return SimpleNamespace(**{**fields, "header": SimpleNamespace(stamp=stamp)})


@pytest.fixture(scope="module")
def frames() -> list[RawFrame]:
    """Six seconds of one robot that drives by and says a word; every twentieth frame was dropped."""
    bits = encode(WORD)
    taken = []
    for index in (index for index in range(186) if index % 20 != 7):
        middle_s = index / RATE_HZ + 0.5 * EXPOSURE_S
        bit = int(np.floor((middle_s - START_S) * 10.0))
        lit = not 0 <= bit < len(bits) or bool(bits[bit])
        place_m = np.array([2.0 + 0.05 * middle_s, -0.6 + 0.12 * middle_s, 0.1])
        taken.append(frame_of(index, [place_m] if lit else []))
    return taken


def test_a_replayed_bag_gives_what_its_folder_does(tmp_path: Path, frames: list[RawFrame]) -> None:
    """Frames into a folder, an MCAP file of it, read by `rosbags`, its topics into the node: tracks, word, markers.

    Stamps are whole nanoseconds, times in the folder are not: tracks agree to what that moves them.
    """
    folder = tmp_path / "run"
    (folder / "frames").mkdir(parents=True)
    (folder / "calibration.json").write_text(json.dumps(calibration_document([CAMERA])))
    lines = []
    for frame in frames:
        (folder / f"frames/{frame.index}.png").write_bytes(encode_png16(frame.data_dn))
        lines.append(json.dumps(frame_record(frame, f"frames/{frame.index}.png")) + "\n")
    (folder / "frames.jsonl").write_text("".join(lines))
    exported = export_mcap(folder, tmp_path / "run.mcap")

    node, outcomes = StandIn(), list[Outcome]()
    live = Live(read_calibrations(folder), {CAMERA.camera: TAKEN}, told=outcomes.append)
    live.attach(node, message_of=_class_of, quality=10)
    assert set(node.heard) == {"/r1/front/image_raw"}
    with AnyReader([exported.file]) as reader:
        for connection, _, raw in reader.messages():
            if connection.topic in node.heard:
                node.heard[connection.topic](reader.deserialize(raw, connection.msgtype))
    live.finish()

    pipeline = Pipeline(CAMERAS)
    heard = [pipeline.push([frame]) for frame in frames]
    said = [message for one in heard for message in one.messages] + list(pipeline.finish())
    assert len(heard) == len(frames)
    told = [json.loads(one.data) for one in node.published["/r1/tracks"]]
    for one, record in zip(heard, told[: len(heard)], strict=True):
        assert record["clock_s"] == 0
        assert record["time_s"] == pytest.approx(one.time_s, abs=1e-9)
        tracks = [parse_track(line) for line in record["tracks"]]
        for track, same in zip(one.tracks, tracks, strict=True):
            assert (same.track, same.detections and 1) == (track.track, track.detections and 1)
            sigma_m = np.sqrt(np.diag(track.covariance)[:3])
            assert np.all(np.abs(same.position_body_m - track.position_body_m) < 1e-3 * sigma_m)
    words = [
        parse_message(line)
        for one in node.published["/r1/messages"]
        for line in json.loads(one.data)["messages"]
    ]
    assert [one.word for one in words] == [one.word for one in said] == [WORD]
    assert words[0].start_s == pytest.approx(START_S, abs=0.02)
    assert [message_record(one) for outcome in outcomes for one in outcome.messages] == [
        message_record(one) for one in words
    ]
    # Markers can be written as ROS writes them, and say the same places.
    markers = node.published["/r1/markers"][60]
    written = STORE.serialize_cdr(markers, "visualization_msgs/msg/MarkerArray")
    read: Any = STORE.deserialize_cdr(written, "visualization_msgs/msg/MarkerArray")
    _, ellipsoid, _ = read.markers
    assert ellipsoid.pose.position.x == pytest.approx(outcomes[60].tracks[0].position_body_m[0])
    assert markers.markers[0].header.stamp.sec == 2


class Notes(Pipeline):
    """Notes the sets that it is given."""

    def __init__(self) -> None:
        self.sets: list[list[tuple[str, int]]] = []
        self.odometry: list[tuple[Odometry, ...]] = []
        self.frames: list[list[RawFrame]] = []

    def push(self, frames: Any, odometry: Any = ()) -> Heard:
        self.sets.append([(frame.camera, round(1e3 * frame.time_s)) for frame in frames])
        self.odometry.append(tuple(odometry))
        self.frames.append(list(frames))
        return Heard(frames[0].time_s, SetMeasurements((), ()), (), ())

    def finish(self) -> tuple[()]:
        return ()


def _two(pipeline: Pipeline, **more: Any) -> Live:
    cameras = {name: replace(CAMERA, camera=name) for name in ("r1.front", "r1.back")}
    return Live(cameras, dict.fromkeys(cameras, Taken(EXPOSURE_S)), 0.1, pipeline, **more)


def test_pictures_of_half_a_period_are_a_set() -> None:
    """Whole sets at once, in whatever order they come; one that lacks a camera when the next one begins; by ROS's clock."""
    pipeline = Notes()
    live = _two(pipeline)
    dark = frame_of(0, [])
    for camera, time_ms in [
        ("r1.back", 3), ("r1.front", 0),  # a set
        ("r1.front", 100),  # alone: its camera comes again
        ("r1.front", 200), ("r1.back", 249),  # a set
        ("r1.back", 300), ("r1.front", 351),  # two: more than half a period apart
    ]:  # fmt: skip
        live.take_image(camera, _image(replace(dark, camera=camera), 1_700_000_000 + 1e-3 * time_ms))
    live.finish()
    assert live.clock_s == 1_700_000_000
    assert pipeline.sets == [
        [("r1.front", 0), ("r1.back", 3)],
        [("r1.front", 100)],
        [("r1.front", 200), ("r1.back", 249)],
        [("r1.back", 300)],
        [("r1.front", 351)],
    ]


def test_a_camera_may_lag_behind_and_one_that_is_silent_is_not_waited_for() -> None:
    """Of pictures each 100 ms, of which one camera's come 120 ms late, all are in sets of two; then it falls silent."""
    pipeline = Notes()
    live = _two(pipeline)
    dark = frame_of(0, [])
    sent = [(100 * k, "r1.front", 100 * k) for k in range(20)]
    sent += [(100 * k + 120, "r1.back", 100 * k) for k in range(8)]
    for _, camera, time_ms in sorted(sent):
        live.take_image(camera, _image(replace(dark, camera=camera), 1e-3 * time_ms))
    whole = [[("r1.back", 100 * k), ("r1.front", 100 * k)] for k in range(8)]
    assert [sorted(one) for one in pipeline.sets[:8]] == whole
    # A quarter of a second, and half a period, after it began a set goes on without the other.
    assert pipeline.sets[8:] == [[("r1.front", 100 * k)] for k in range(8, 16)]
    live.take_image("r1.back", _image(replace(dark, camera="r1.back"), 1.0))
    assert live.late == {"r1.front": 0, "r1.back": 1}
    live.finish()
    assert pipeline.sets[16:] == [[("r1.front", 100 * k)] for k in range(16, 20)]


def test_a_clock_that_is_set_back_begins_anew() -> None:
    """As a bag that is played again: no picture of it is late."""
    pipeline = Notes()
    live = _two(pipeline)
    dark = frame_of(0, [])
    for time_ms in (5000, 5100, 0, 100):
        for camera in ("r1.back", "r1.front"):
            live.take_image(camera, _image(replace(dark, camera=camera), 1e-3 * time_ms))
    live.finish()
    assert live.late == {"r1.front": 0, "r1.back": 0}
    begins_ms = [one[0][1] + 1000 * int(live.clock_s or 0) for one in pipeline.sets]
    assert begins_ms == [5000, 5100, 0, 100]


def test_known_offsets_are_taken_off_and_counts_that_cannot_be_are_left_out() -> None:
    offset_dn = np.zeros((CAMERA.height_px, CAMERA.width_px), np.int16)
    offset_dn[10, 20] = 7
    pipeline, said = Notes(), list[str]()
    live = Live({CAMERA.camera: replace(CAMERA, offset_dn=offset_dn)}, {CAMERA.camera: TAKEN}, 0.1, pipeline)
    node = StandIn()
    live.attach(node, message_of=_class_of, quality=10, warn=said.append)
    frame = frame_of(0, [])
    node.heard["/r1/front/image_raw"](_image(frame, 0.0))
    assert int(frame.data_dn[10, 20]) - int(pipeline.frames[0][0].data_dn[10, 20]) == 7
    assert int(frame.data_dn[10, 21]) == int(pipeline.frames[0][0].data_dn[10, 21])
    shifted = replace(frame, data_dn=np.full_like(frame.data_dn, 16 * 300))
    node.heard["/r1/front/image_raw"](_image(shifted, 0.1))
    assert len(pipeline.sets) == 1
    assert len(said) == 1
    assert "send counts as the sensor made them" in said[0]


def test_odometry_comes_back_as_it_was_sent_but_for_its_covariance() -> None:
    """Ours, as the export writes it, a quarter turn; what is older than two seconds is forgotten, so are twins."""
    pipeline = Notes()
    live = _two(pipeline, odometry_error=OdometryError(0.01, 0.02, 0.03, 0.04))
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    dark = frame_of(0, [])
    for step in range(60):
        sent = Odometry("r1", 0.1 * step, np.array([0.1 * step, 0.2, 0.3]), turn, 1e3, 1e3)
        fields = ros.to_odometry(sent, "r1", sent.time_s)
        pose = {name: SimpleNamespace(**fields["pose"]["pose"][name]) for name in ("position", "orientation")}
        message = SimpleNamespace(
            header=SimpleNamespace(stamp=SimpleNamespace(**fields["header"]["stamp"])),
            pose=SimpleNamespace(pose=SimpleNamespace(**pose), covariance=fields["pose"]["covariance"]),
        )
        live.take_odometry(message)
        live.take_odometry(message)  # as a lossy connection may send it again
        live.take_image("r1.front", _image(replace(dark, camera="r1.front"), 0.1 * step))
    live.finish()
    last = pipeline.odometry[-1][-1]
    assert last.time_s == pytest.approx(5.9)
    assert last.position_m == pytest.approx([5.9, 0.2, 0.3])
    assert last.rotation == pytest.approx(turn)
    assert (last.position_sigma_m, last.rotation_sigma_rad) == (0.01, 0.02)
    assert (last.position_walk_m_per_sqrt_s, last.rotation_walk_rad_per_sqrt_s) == (0.03, 0.04)
    assert 20 <= len(pipeline.odometry[-1]) <= 24


def test_what_cannot_be_taken_is_told() -> None:
    live = _two(Notes())
    dark = _image(frame_of(0, []), 0.0)
    colours = SimpleNamespace(**{**vars(dark), "encoding": "rgb8"})
    with pytest.raises(InputError, match=r"r1\.front: a picture is 'rgb8'; wanted raw counts"):
        live.take_image("r1.front", colours)
    with pytest.raises(InputError, match="a picture of 240 × 120 px is cut off"):
        live.take_image("r1.front", SimpleNamespace(**{**vars(dark), "data": bytes(dark.data)[:-2]}))
    half = SimpleNamespace(**{**vars(dark), "height": 60, "data": bytes(dark.data)[: len(dark.data) // 2]})
    with pytest.raises(InputError, match="a picture has 240 × 60 px, its calibration 240 × 120"):
        live.take_image("r1.front", half)
    with pytest.raises(InputError, match="no exposure is given"):
        Live(CAMERAS, {})
    with pytest.raises(InputError, match="of the robots r1, r2; give those of one robot"):
        Live({"r1.front": CAMERA, "r2.front": CAMERA}, {})
    with pytest.raises(InputError, match="where ROS 2 is installed and sourced"):
        live.attach(StandIn())
    with pytest.raises(InputError, match=r"topics: r1\.side: no such camera"):
        live.attach(StandIn(), {"r1.side": "/side"}, message_of=_class_of, quality=10)
