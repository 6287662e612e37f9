"""A run folder as one MCAP file, the container of ROS 2 and Foxglove: frames, poses, detections, tracks.

Everything is stamped by the run's own clock. What is of a frame, or of a set of frames, is stamped with the
middle of the exposure; what else `frames.jsonl` says of it stands in `exposure`.
"""

import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from nir_render.errors import InputError
from nir_render.export import cdr
from nir_render.export import ros_messages as ros
from nir_render.run import folder as run_folder
from nir_render.truth.poses import parse_pose
from nir_render.truth.sent import parse_sent
from perception import (
    FrameRecord,
    RecordingError,
    parse_detection,
    parse_message,
    parse_track,
    read_calibrations,
    read_frame,
    read_frame_records,
)
from perception.files.tracks import read_odometry
from perception.rig.frame_sets import mid_exposure_s, robot_of
from perception.types import Calibration, Detection, FrameKey, Track

if TYPE_CHECKING:
    from mcap.writer import Writer

Progress = Callable[[int, int], None]
"""Called with the number of messages written, and of all."""

_ATTACHED = (run_folder.SCENE, run_folder.CALIBRATION, run_folder.MANIFEST)
_FOREVER = "{sec: 9223372036, nsec: 854775807}"
# Who comes later is told at once what stands still: rosbag2's notation of a quality of service.
_LATCHED = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n"
    f"  deadline: {_FOREVER}\n  lifespan: {_FOREVER}\n  liveliness: 1\n"
    f"  liveliness_lease_duration: {_FOREVER}\n  avoid_ros_namespace_conventions: false\n"
)


@dataclass(frozen=True)
class _Post:
    """A message to come: when, where, of which kind; its fields are made of the time on the file's clock."""

    time_s: float
    topic: str
    kind: str
    fields: Callable[..., ros.Fields]


@dataclass(frozen=True)
class Exported:
    """What became of a run: the file, its messages by topic, and the seconds that its clock is ahead."""

    file: Path
    messages: dict[str, int]
    ahead_s: int


def export_mcap(folder: Path, file: Path, progress: Progress = lambda *_: None) -> Exported:
    """Write what a run folder holds as an MCAP file.

    Parameters
    ----------
    folder
        A run folder; whatever of its files is there is written.
    file
        Where to; what is there is replaced.
    progress
        Called as it goes.

    Raises
    ------
    InputError
        The package `mcap` is not installed, the folder holds nothing to write or is broken, two names are one
        in ROS, or the disk refuses.
    """
    try:
        posts = list(_posts(folder))
    except RecordingError as error:
        raise InputError(*error.problems) from None
    if not posts:
        raise InputError(f"{folder}: holds no frames, poses or tracks; give the folder of a run")
    # ROS has no time below 0, and an exposure about the first instant begins before it.
    ahead_s = math.ceil(max(0.0, -min(post.time_s for post in posts)))
    counts: dict[str, int] = defaultdict(int)
    with run_folder.write_stream(file) as stream:
        writer = _writer(stream)
        channels: dict[str, int] = {}
        schemas: dict[str, int] = {}
        for done, post in enumerate(sorted(posts, key=lambda each: each.time_s)):
            if post.topic not in channels:
                channels[post.topic] = _channel(writer, post, schemas)
            at_s = post.time_s + ahead_s
            stamp_ns = ros.nanoseconds(at_s)
            data = cdr.encode(post.kind, _fields_of(post, at_s))
            writer.add_message(channels[post.topic], stamp_ns, data, stamp_ns)
            counts[post.topic] += 1
            progress(done + 1, len(posts))
        for name in _ATTACHED:
            if (path := folder / name).is_file():
                kind = "application/json" if name.endswith(".json") else "application/yaml"
                writer.add_attachment(0, 0, name, kind, path.read_bytes())
        writer.add_metadata("clock", {"ahead_of_the_run_s": str(ahead_s)})
        writer.finish()  # type: ignore[no-untyped-call]
    return Exported(file, dict(sorted(counts.items())), ahead_s)


def _writer(stream: BinaryIO) -> "Writer":
    try:
        from mcap.writer import Writer
    except ImportError:
        raise InputError(
            "MCAP files are written by the package mcap, which is not installed; install nir-render[export]"
        ) from None
    writer = Writer(stream)
    writer.start(profile="ros2", library="nir_render")
    return writer


def _channel(writer: "Writer", post: _Post, schemas: dict[str, int]) -> int:
    if post.kind not in schemas:
        package, name = post.kind.split("/")
        text = cdr.definition_text(post.kind).encode()
        schemas[post.kind] = writer.register_schema(f"{package}/msg/{name}", "ros2msg", text)
    quality = {"offered_qos_profiles": _LATCHED if post.topic == "/tf_static" else ""}
    return writer.register_channel(post.topic, "cdr", schemas[post.kind], quality)


def _fields_of(post: _Post, at_s: float) -> ros.Fields:
    try:
        return post.fields(time_s=at_s)
    except RecordingError as error:  # a picture is read only now
        raise InputError(*error.problems) from None


def _posts(folder: Path) -> Iterator[_Post]:
    """Yield all that a folder has to say, in any order."""
    known = read_calibrations(folder) if (folder / run_folder.CALIBRATION).is_file() else {}
    frames = read_frame_records(folder) if (folder / run_folder.FRAMES).is_file() else []
    poses = _lines(folder / run_folder.POSES, parse_pose)
    sent = _lines(folder / run_folder.SENT, parse_sent)
    names = _Names()
    robots = dict.fromkeys([*map(robot_of, known), *(pose.robot for pose in poses)])
    for robot in robots:
        names.of(robot)
    taken_s = {
        (frame.camera, frame.index): mid_exposure_s(frame, known[frame.camera].height_px)
        for frame in frames
        if frame.camera in known
    }
    begin_s = min([*taken_s.values(), *(pose.time_s for pose in poses)], default=0.0)
    yield from _mounts(known, begin_s, names)
    for frame in frames:
        if (frame.camera, frame.index) in taken_s:
            yield from _of_frame(
                folder, frame, known[frame.camera], taken_s[frame.camera, frame.index], names
            )
    for pose in poses:
        yield _Post(
            pose.time_s, "/tf", "tf2_msgs/TFMessage",
            partial(ros.to_place, pose, names.of(pose.robot)),
        )  # fmt: skip
    if (folder / "odometry.jsonl").is_file():
        for robot, records in read_odometry(folder).items():
            for one in records:
                yield _Post(
                    one.time_s, f"/{names.of(robot)}/odometry", "nav_msgs/Odometry",
                    partial(ros.to_odometry, one, names.of(robot)),
                )  # fmt: skip
    for packet in sent:
        robot = names.of(packet.robot)
        yield _Post(
            packet.end_s, f"/{robot}/sent", "nir_render_msgs/Word",
            partial(ros.to_word, packet, robot),
        )  # fmt: skip
    for name, path in run_folder.detection_files(folder).items():
        found = run_folder.parse_lines(path, parse_detection)
        yield from _detected(name, found, frames, taken_s, names)
    for name, path in _estimators(folder, "tracks"):
        yield from _followed(name, run_folder.parse_lines(path, parse_track), names)
    for name, path in _estimators(folder, "messages"):
        for message in run_folder.parse_lines(path, parse_message):
            robot = names.of(message.robot)
            yield _Post(
                message.end_s, f"/{robot}/messages/{names.of(name)}", "nir_render_msgs/Word",
                partial(ros.to_word, message, robot),
            )  # fmt: skip


def _mounts(known: dict[str, Calibration], begin_s: float, names: "_Names") -> Iterator[_Post]:
    """Yield how cameras stand on their robots: one message for all."""
    if known:
        mounts = {(names.of(robot_of(name)), names.camera(name)): one for name, one in known.items()}
        yield _Post(begin_s, "/tf_static", "tf2_msgs/TFMessage", partial(ros.to_mounts, mounts))


def _of_frame(
    folder: Path, record: FrameRecord, known: Calibration, time_s: float, names: "_Names"
) -> Iterator[_Post]:
    place = names.camera(record.camera)
    yield _Post(
        time_s, f"/{place}/image_raw", "sensor_msgs/Image",
        partial(_image, folder, record, place),
    )  # fmt: skip
    yield _Post(
        time_s, f"/{place}/camera_info", "sensor_msgs/CameraInfo",
        partial(ros.to_camera_info, known, place),
    )  # fmt: skip
    yield _Post(
        time_s, f"/{place}/exposure", "nir_render_msgs/Exposure",
        partial(ros.to_exposure, record, place),
    )  # fmt: skip


def _image(folder: Path, record: FrameRecord, place: str, time_s: float) -> ros.Fields:
    return ros.to_image(read_frame(folder, record), place, time_s)


def _detected(
    name: str, found: Iterable[Detection], frames: Sequence[FrameRecord], taken_s: dict[FrameKey, float],
    names: "_Names",
) -> Iterator[_Post]:  # fmt: skip
    """Yield what was found in each frame; a frame in which nothing was is told too."""
    by_frame: dict[FrameKey, list[Detection]] = {
        (frame.camera, frame.index): [] for frame in frames if frame.shows_sources
    }
    for one in found:
        by_frame.setdefault((one.camera, one.index), []).append(one)
    for (camera, index), of_one in by_frame.items():
        time_s = taken_s.get((camera, index), of_one[0].time_s if of_one else math.nan)
        if not math.isfinite(time_s):
            continue
        place, own = names.camera(camera), names.of(name)
        yield _Post(
            time_s, f"/{place}/detections/{own}", "nir_render_msgs/Detections",
            partial(ros.to_detections, of_one, camera, index, place),
        )  # fmt: skip
        yield _Post(
            time_s, f"/{place}/annotations/{own}", "foxglove_msgs/ImageAnnotations",
            partial(ros.to_annotations, of_one),
        )  # fmt: skip


def _followed(name: str, tracks: Iterable[Track], names: "_Names") -> Iterator[_Post]:
    """Yield the tracks of each robot and time, as they are and to be looked at."""
    by_set: dict[tuple[str, float], list[Track]] = defaultdict(list)
    for track in tracks:
        by_set[track.robot, track.time_s].append(track)
    for (of_robot, time_s), of_one in by_set.items():
        robot, own = names.of(of_robot), names.of(name)
        yield _Post(
            time_s, f"/{robot}/tracks/{own}", "nir_render_msgs/Tracks",
            partial(ros.to_tracks, of_one, robot),
        )  # fmt: skip
        yield _Post(
            time_s, f"/{robot}/markers/{own}", "visualization_msgs/MarkerArray",
            partial(ros.to_markers, of_one, robot),
        )  # fmt: skip


def _lines(path: Path, parse: Callable[[Any], Any]) -> list[Any]:
    return run_folder.parse_lines(path, parse) if path.is_file() else []


def _estimators(folder: Path, kind: str) -> list[tuple[str, Path]]:
    paths = sorted(folder.glob(f"{kind}.*.jsonl"))
    return [(path.name.removeprefix(f"{kind}.").removesuffix(".jsonl"), path) for path in paths]


class _Names:
    """Names as ROS allows them, letters, digits and underscores, each of one of ours."""

    def __init__(self) -> None:
        self._ours: dict[str, str] = {}

    def of(self, name: str) -> str:
        """Return the name in ROS; raise InputError where another has it already."""
        theirs = re.sub(r"[^A-Za-z0-9_]", "_", name)
        theirs = f"_{theirs}" if theirs[:1].isdigit() else theirs
        if self._ours.setdefault(theirs, name) != name:
            raise InputError(
                f"{name} and {self._ours[theirs]} are both called {theirs} in ROS; rename one of them"
            )
        return theirs

    def camera(self, name: str) -> str:
        """Return a camera's place among the names: its robot, and its own name there."""
        return f"{self.of(robot_of(name))}/{re.sub(r'[^A-Za-z0-9_]', '_', name.rpartition('.')[2])}"
