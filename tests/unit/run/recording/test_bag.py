"""A bag of a real camera becomes a recording: written by rosbags, as ROS would; counts bit by bit, times to the ns."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from nir_render.errors import InputError
from nir_render.run.recording.make import new_recording

STORE = get_typestore(Stores.ROS2_HUMBLE)
IMAGE = STORE.types["sensor_msgs/msg/Image"]
BEGIN_NS = 1_700_000_000_123_456_789


def image(data: Any, encoding: str, stamp_ns: int, *, big: bool = False, spare: int = 0) -> Any:
    rows, columns = data.shape
    raw = data.astype(">u2" if big else data.dtype.newbyteorder("<")).view(np.uint8).reshape(rows, -1)
    raw = np.pad(raw, ((0, 0), (0, spare)))
    stamp = STORE.types["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
    header = STORE.types["std_msgs/msg/Header"](stamp, "camera_optical")
    return IMAGE(header, rows, columns, encoding, int(big), raw.shape[1], raw.ravel())


def bag(folder: Path, topics: dict[str, list[Any]]) -> Path:
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, messages in topics.items():
            connection = writer.add_connection(topic, IMAGE.__msgtype__, typestore=STORE)
            for number, message in enumerate(messages):
                writer.write(connection, 5 + number, STORE.serialize_cdr(message, IMAGE.__msgtype__))
    return next(folder.glob("*.mcap"))


def counts(seed: int, bits: int) -> Any:
    dtype = np.uint16 if bits > 8 else np.uint8
    return np.random.default_rng(seed).integers(0, 2**bits, (13, 17), dtype=dtype)


def test_pictures_and_times_are_those_of_the_bag(tmp_path: Path) -> None:
    front = [counts(seed, 12) for seed in range(3)]
    stamps_ns = [BEGIN_NS, BEGIN_NS + 33_333_333, BEGIN_NS + 70_000_001]
    file = bag(
        tmp_path / "bag",
        {
            "/r1/front/image_raw": [
                image(front[0], "mono16", stamps_ns[0]),
                image(front[1], "16UC1", stamps_ns[1], big=True),
                image(front[2], "mono16", stamps_ns[2], spare=6),
            ],
            "/cam": [image(counts(9, 8), "mono8", BEGIN_NS + 5_000_000)],
        },
    )
    assert new_recording(tmp_path / "out", file) == ["frames/r1.cam/*.png", "frames/r1.front/*.png"]
    pictures = sorted((tmp_path / "out" / "frames" / "r1.front").glob("*.png"))
    for picture, written in zip(pictures, front, strict=True):
        assert (cv2.imread(str(picture), cv2.IMREAD_UNCHANGED) == written).all()
    eight = cv2.imread(str(tmp_path / "out" / "frames" / "r1.cam" / "000000.png"), cv2.IMREAD_UNCHANGED)
    assert (eight == counts(9, 8)).all()
    times = (tmp_path / "out" / "frames" / "r1.front" / "times.txt").read_text().split()
    assert times == ["0.000000000", "0.033333333", "0.070000001"]
    text = (tmp_path / "out" / "recording.yaml").read_text()
    assert '  r1.front:\n    frames: "frames/r1.front/*.png"\n    times: frames/r1.front/times.txt\n' in text


@pytest.mark.parametrize(
    ("topics", "said"),
    [
        ({"/a/b": [image(counts(1, 8), "bgr8", 5)]}, "a picture is 'bgr8'; wanted raw counts: mono8"),
        ({"/a/b": [image(counts(1, 8), "mono16", 5)]}, "a picture of 17 × 13 px is cut off"),
        ({"/a/b": [image(counts(1, 8), "mono8", 5)], "/a/b/image": [image(counts(1, 8), "mono8", 5)]}, "two topics"),
        ({}, "holds no sensor_msgs/msg/Image"),
    ],
)  # fmt: skip
def test_what_is_no_bag_of_grey_pictures_is_refused(topics: Any, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said):
        new_recording(tmp_path / "out", bag(tmp_path / "bag", topics))
    (tmp_path / "text.mcap").write_text("no bag")
    with pytest.raises(InputError, match="wanted a bag of ROS 2"):
        new_recording(tmp_path / "other", tmp_path / "text.mcap")
