"""A ROS 2 bag of a real camera (MCAP): its grey pictures, and when each was taken."""

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from nir_render.errors import InputError
from nir_render.run.folder import write_file

_IMAGE = "sensor_msgs/msg/Image"
_DEPTHS = {"mono8": 1, "8UC1": 1, "mono16": 2, "16UC1": 2}
_PLAIN_LITTLE_ENDIAN = b"\x00\x01"
_NOT_IN_NAMES = re.compile(r"[^A-Za-z0-9_]")
_LAST_WORDS = ("image", "image_raw", "image_mono")


@dataclass(frozen=True)
class Topic:
    """The pictures of a topic in a folder: of which camera, `robot.name`, by which pattern, their times."""

    camera: str
    pattern: str
    times: str


def unpacked(bag: Path, folder: Path) -> list[Topic]:
    """Write the pictures of a bag as PNG, the counts bit by bit, and the time of each, by topic.

    Times are those of the pictures' stamps, in seconds from the first of all topics on.

    Raises
    ------
    InputError
        It is no MCAP file, a picture has colours, or is damaged; two topics of one name; nothing is there.
    """
    stamps_ns: dict[str, list[int]] = {}
    for topic, stamp_ns, picture in _pictures(bag):
        taken = stamps_ns.setdefault(topic, [])
        png = cv2.imencode(".png", picture)[1].tobytes()
        write_file(folder / "frames" / _camera_of(topic) / f"{len(taken):06d}.png", png)
        taken.append(stamp_ns)
    if not stamps_ns:
        raise InputError(f"{bag}: holds no {_IMAGE}; record the topic of the camera's raw pictures")
    cameras = [_camera_of(topic) for topic in stamps_ns]
    if len(set(cameras)) < len(cameras):
        raise InputError(
            f"{bag}: two topics of {', '.join(stamps_ns)} would be one camera; record one of them"
        )
    first_ns = min(min(taken) for taken in stamps_ns.values())
    topics = []
    for topic, taken in stamps_ns.items():
        place = f"frames/{_camera_of(topic)}"
        lines = "".join(f"{(stamp_ns - first_ns) / 1e9:.9f}\n" for stamp_ns in taken)
        write_file(folder / place / "times.txt", lines.encode())
        topics.append(Topic(_camera_of(topic), f"{place}/*.png", f"{place}/times.txt"))
    return sorted(topics, key=lambda one: one.camera)


def _pictures(bag: Path) -> Iterator[tuple[str, int, NDArray[np.uint8] | NDArray[np.uint16]]]:
    """Yield topic, stamp in nanoseconds and counts of each picture, in the order of the bag."""
    try:
        from mcap.exceptions import McapError
        from mcap.reader import make_reader
    except ImportError:
        raise InputError(f"{bag}: mcap is not installed; pip install 'nir_render[export]'") from None
    if not bag.is_file():
        raise InputError(f"{bag}: there is no such file; give the .mcap file of a bag")
    with bag.open("rb") as stream:
        try:
            for schema, channel, message in make_reader(stream).iter_messages():
                if schema is None or schema.name != _IMAGE:
                    continue
                stamp_ns, picture = _image(message.data)
                yield channel.topic, stamp_ns or message.log_time, picture
        except (McapError, struct.error, ValueError) as error:
            raise InputError(
                f"{bag}: {error or type(error).__name__}; wanted a bag of ROS 2, in MCAP"
            ) from None


def _image(data: bytes) -> tuple[int, NDArray[np.uint8] | NDArray[np.uint16]]:
    """Return stamp in nanoseconds and counts of a `sensor_msgs/msg/Image`; ValueError where it is none."""
    if data[:2] != _PLAIN_LITTLE_ENDIAN:
        raise ValueError("a picture is not written as plain little-endian CDR")
    seconds, nanoseconds, length = struct.unpack_from("<iII", data, 4)
    at = _aligned(16 + length)
    rows, columns, length = struct.unpack_from("<III", data, at)
    encoding = data[at + 12 : at + 12 + length].rstrip(b"\0").decode("ascii", errors="replace")
    at += 12 + length
    (is_big_endian,) = struct.unpack_from("<B", data, at)
    at = _aligned(at + 1)
    step, size = struct.unpack_from("<II", data, at)
    pixels = data[at + 8 : at + 8 + size]
    return 1_000_000_000 * seconds + nanoseconds, counts_of(
        rows, columns, encoding, is_big_endian, step, pixels
    )


def counts_of(
    rows: int, columns: int, encoding: str, is_big_endian: int, step: int, data: bytes
) -> NDArray[np.uint8] | NDArray[np.uint16]:
    """Return the raw counts of a `sensor_msgs/Image` by its fields, shape (rows, columns).

    Raises
    ------
    ValueError
        It is not grey, or cut off.
    """
    if encoding not in _DEPTHS:
        raise ValueError(f"a picture is {encoding!r}; wanted raw counts: {', '.join(_DEPTHS)}")
    depth = _DEPTHS[encoding]
    if len(data) != rows * step or step < columns * depth:
        raise ValueError(f"a picture of {columns} × {rows} px is cut off")
    lines = np.frombuffer(data, np.uint8).reshape(rows, step)[:, : columns * depth]
    if depth == 1:
        return lines
    return np.ascontiguousarray(lines).view(">u2" if is_big_endian else "<u2").astype(np.uint16)


def _aligned(at: int) -> int:
    return (at + 3) // 4 * 4


def _camera_of(topic: str) -> str:
    """Return a topic as `robot.camera`: `/r1/front/image_raw` is r1.front, `/camera/image` is r1.camera."""
    parts = [_NOT_IN_NAMES.sub("_", part) for part in topic.split("/") if part]
    if len(parts) > 1 and parts[-1] in _LAST_WORDS:
        del parts[-1]
    return ".".join(parts[-2:]) if len(parts) > 1 else f"r1.{parts[0]}"
