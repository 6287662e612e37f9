"""The stack of one robot on ROS 2, live: pictures of its cameras in, whom it follows and what they say out.

    rclpy.init()
    node = rclpy.create_node("nir")
    live = Live(perception.read_calibrations("recording"), {"r1.front": Taken(exposure_s=2e-4)})
    live.attach(node)
    rclpy.spin(node)

It was not tried on ROS itself: what stands in for a node is in `tests/unit/export/test_live.py`.
"""

import importlib
import json
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from nir_render.errors import InputError
from nir_render.export import cdr
from nir_render.export import ros_messages as ros
from nir_render.export.ros_definitions import DEFINITIONS
from nir_render.run.recording.bag import counts_of
from perception import (
    Calibration,
    Heard,
    Message,
    Odometry,
    Pipeline,
    RawFrame,
    Track,
    message_record,
    track_record,
)
from perception.rig.frame_sets import robot_of

_IMAGE, _ODOMETRY = "sensor_msgs/Image", "nav_msgs/Odometry"
_TEXT, _MARKERS = "std_msgs/String", "visualization_msgs/MarkerArray"
_KEPT_S = 2.0  # of the robot's own motion, before the last set
_QUEUED = 10

MakeMessage = Callable[..., Any]
"""The class of a message: its fields by name make one."""


class Node(Protocol):
    """What is wanted of a node: that of `rclpy`, or what stands in for it."""

    def create_subscription(
        self, kind: Any, topic: str, callback: Callable[[Any], None], quality: Any
    ) -> Any:
        """Have a callback take the messages of a topic."""

    def create_publisher(self, kind: Any, topic: str, quality: Any) -> Any:
        """Return what publishes on a topic, by its `publish`."""


@dataclass(frozen=True)
class Taken:
    """How a camera takes its pictures, which no picture of ROS says.

    Attributes
    ----------
    exposure_s
        Of each row.
    gain
        Factor on the calibrated system gain.
    line_time_s
        Delay between rows, 0 for a global shutter.
    stamped
        What of the exposure the pictures' stamps are: the `begin` of the first row's, or the `middle` of the
        middle row's, as in our own exports.
    """

    exposure_s: float
    gain: float = 1.0
    line_time_s: float = 0.0
    stamped: Literal["begin", "middle"] = "begin"


class Live:
    """What takes a robot's pictures as they come, and tells whom it follows and what they say.

    Pictures that begin within half a period of the first of a set are one set: it goes through the stack when
    all cameras are in it, or when a later one comes. Times of the stack count from the first message's whole
    second on, `clock_s`.

    Parameters
    ----------
    calibrations
        Of each camera, by its name, `robot.camera`; all of one robot.
    taken
        How each takes its pictures, by its name.
    period_s
        From one set to the next.
    pipeline
        The stack; by default a `Pipeline` as it comes. One whose `detector` is `DetectorProcesses` is faster
        with several cameras.
    told
        Called with each set's outcome, and at the end with the messages that were still open.

    Raises
    ------
    InputError
        Cameras of several robots or none; one of which is not said how it takes its pictures; no period.
    """

    def __init__(
        self,
        calibrations: Mapping[str, Calibration],
        taken: Mapping[str, Taken],
        period_s: float = 1.0 / 30.0,
        pipeline: Pipeline | None = None,
        told: "Callable[[Outcome], None]" = lambda _: None,
    ) -> None:
        robots = sorted({robot_of(name) for name in calibrations})
        if len(robots) != 1:
            raise InputError(
                f"calibrations are of the robots {', '.join(robots) or 'none'}; give those of one robot"
            )
        if missing := sorted(set(calibrations) - set(taken)):
            raise InputError(f"{', '.join(missing)}: no exposure is given; give a Taken(exposure_s=...) each")
        if not period_s > 0.0:
            raise InputError(f"period_s is {period_s!r}; give the time from one set of pictures to the next")
        (self.robot,) = robots
        self.clock_s: int | None = None
        self._calibrations = calibrations
        self._taken = dict(taken)
        self._half_s = 0.5 * period_s
        self._pipeline = Pipeline(calibrations) if pipeline is None else pipeline
        self._told = told
        self._count = dict.fromkeys(calibrations, 0)
        self._set: list[RawFrame] = []
        self._odometry: deque[Odometry] = deque()

    def attach(
        self,
        node: Node,
        topics: Mapping[str, str] | None = None,
        odometry: str | None = None,
        message_of: Callable[[str], MakeMessage] | None = None,
        quality: Any = None,
    ) -> None:
        """Have a node's topics fed to this, and publish on it what comes out.

        That is on `/ROBOT/tracks` and `/ROBOT/messages` JSON in `std_msgs/String`, `tracks` the lines of
        `tracks.NAME.jsonl` and `messages` those of `messages.NAME.jsonl`, so that no package of messages need
        be built; on `/ROBOT/markers` the same tracks as `visualization_msgs/MarkerArray`.

        Parameters
        ----------
        topics
            Of each camera's `sensor_msgs/Image`, by its name; `/ROBOT/CAMERA/image_raw` where none is given.
        odometry
            The topic of the robot's `nav_msgs/Odometry`; without one the robot stands still.
        message_of
            The class of a message by its name, `package/Name`; by default that of the installed ROS.
        quality
            Of service for what is heard; by default ROS's own for data of sensors.

        Raises
        ------
        InputError
            ROS is not installed or not sourced; a topic is of no camera.
        """
        message_of = _on_ros if message_of is None else message_of
        if quality is None:
            quality = _quality_of_sensors()
        if unknown := sorted(set(topics or {}) - set(self._calibrations)):
            raise InputError(f"topics: {', '.join(unknown)}: no such camera is calibrated")
        for camera in self._calibrations:
            usual = f"/{camera.replace('.', '/')}/image_raw"
            node.create_subscription(
                message_of(_IMAGE), (topics or {}).get(camera, usual), self._taker(camera), quality
            )
        if odometry is not None:
            node.create_subscription(message_of(_ODOMETRY), odometry, self.take_odometry, quality)
        publish = {
            what: node.create_publisher(message_of(kind), f"/{self.robot}/{what}", _QUEUED).publish
            for what, kind in (("tracks", _TEXT), ("messages", _TEXT), ("markers", _MARKERS))
        }
        own = self._told

        def told(outcome: Outcome) -> None:
            own(outcome)
            publish["tracks"](_made(_TEXT, {"data": outcome.tracks_json()}, message_of))
            if outcome.messages:
                publish["messages"](_made(_TEXT, {"data": outcome.messages_json()}, message_of))
            markers = ros.to_markers(outcome.tracks, self.robot, outcome.clock_s + outcome.time_s)
            publish["markers"](_made(_MARKERS, markers, message_of))

        self._told = told

    def set_taken(self, camera: str, taken: Taken) -> None:
        """Say how a camera takes its pictures from now on, as an automatic exposure has it."""
        self._taken[camera] = taken

    def take_image(self, camera: str, message: Any) -> None:
        """Take a `sensor_msgs/Image` of a camera: raw counts, mono8 or mono16.

        Raises
        ------
        InputError
            It is of colours, cut off, or of another size than the camera is calibrated for.
        """
        known, taken = self._calibrations[camera], self._taken[camera]
        try:
            data_dn = counts_of(
                message.height, message.width, message.encoding, message.is_bigendian, message.step,
                bytes(message.data),
            )  # fmt: skip
        except ValueError as error:
            raise InputError(f"{camera}: {error}") from None
        if data_dn.shape != (known.height_px, known.width_px):
            rows, columns = data_dn.shape
            raise InputError(
                f"{camera}: a picture has {columns} × {rows} px, its calibration {known.width_px} × "
                f"{known.height_px}; calibrate it as it is driven"
            )
        time_s = self._time_s(message.header.stamp)
        if taken.stamped == "middle":
            time_s -= 0.5 * (taken.exposure_s + taken.line_time_s * (known.height_px - 1))
        frame = RawFrame(
            camera, self._count[camera], time_s, taken.exposure_s, data_dn.astype(np.uint16),
            known.black_level_dn, taken.line_time_s, taken.gain,
        )  # fmt: skip
        self._count[camera] += 1
        if self._set and (
            any(camera == other.camera for other in self._set)
            or abs(time_s - self._set[0].time_s) > self._half_s
        ):
            self._push()
        self._set.append(frame)
        if len(self._set) == len(self._calibrations):
            self._push()

    def take_odometry(self, message: Any) -> None:
        """Take a `nav_msgs/Odometry` of the robot; one that is not later than the last begins anew."""
        pose = message.pose.pose
        sigma = np.sqrt(np.maximum(np.diag(np.reshape(message.pose.covariance, (6, 6))), 0.0))
        place, turn = pose.position, pose.orientation
        time_s = self._time_s(message.header.stamp)
        if self._odometry and time_s <= self._odometry[-1].time_s:
            self._odometry.clear()
        self._odometry.append(
            Odometry(
                self.robot,
                time_s,
                np.array([place.x, place.y, place.z]),
                Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix(),
                position_sigma_m=float(sigma[:3].max()),
                rotation_sigma_rad=float(sigma[3:].max()),
            )
        )

    def finish(self) -> None:
        """Take in the set that is not whole, and tell what can be read as no more will come."""
        if self._set:
            self._push()
        said = self._pipeline.finish()
        if said and self.clock_s is not None:
            self._told(Outcome(self.clock_s, max(one.end_s for one in said), (), said))

    def _taker(self, camera: str) -> Callable[[Any], None]:
        return partial(self.take_image, camera)

    def _time_s(self, stamp: Any) -> float:
        """Return a stamp by the stack's clock: float64 has not the digits for ROS's."""
        if self.clock_s is None:
            self.clock_s = int(stamp.sec)
        return (int(stamp.sec) - self.clock_s) + 1e-9 * int(stamp.nanosec)

    def _push(self) -> None:
        frames, self._set = sorted(self._set, key=lambda frame: frame.time_s), []
        heard: Heard = self._pipeline.push(frames, tuple(self._odometry))
        while len(self._odometry) > 2 and self._odometry[1].time_s < heard.time_s - _KEPT_S:
            self._odometry.popleft()
        assert self.clock_s is not None
        self._told(Outcome(self.clock_s, heard.time_s, heard.tracks, heard.messages))


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a set of pictures told: tracks at its time, and messages that it completed.

    `time_s` is by the stack's clock, which is `clock_s` at its 0 by ROS's.
    """

    clock_s: int
    time_s: float
    tracks: tuple[Track, ...]
    messages: tuple[Message, ...]

    def tracks_json(self) -> str:
        """Return the tracks as published."""
        return self._json("tracks", map(track_record, self.tracks))

    def messages_json(self) -> str:
        """Return the messages as published."""
        return self._json("messages", map(message_record, self.messages))

    def _json(self, what: str, records: Iterable[Mapping[str, Any]]) -> str:
        head = {"format": 1, "clock_s": self.clock_s, "time_s": self.time_s}
        return json.dumps({**head, what: list(records)}, allow_nan=False)


def _made(kind: str, value: Any, message_of: Callable[[str], MakeMessage]) -> Any:
    """Return a message with fields as `ros_messages` has them, and those within it, of ROS's own classes."""
    if kind not in DEFINITIONS:
        return value
    fields: dict[str, Any] = {}
    for field in cdr.fields_of(kind):
        content = value[field.name]
        nested = isinstance(content, Sequence) and not isinstance(content, str | bytes)
        if nested and field.kind in DEFINITIONS:
            content = [_made(field.kind, one, message_of) for one in content]
        elif not nested:
            content = _made(field.kind, content, message_of)
        fields[field.name] = content
    return message_of(kind)(**fields)


def _on_ros(kind: str) -> MakeMessage:
    """Return the class of a message of the installed ROS."""
    package, _, name = kind.partition("/")
    try:
        made: MakeMessage = getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise InputError(
            f"{kind} is not to be had: run this where ROS 2 is installed and sourced "
            f"(source /opt/ros/…/setup.bash), with the package {package}"
        ) from None
    return made


def _quality_of_sensors() -> Any:
    try:
        return importlib.import_module("rclpy.qos").qos_profile_sensor_data
    except ImportError:
        raise InputError(
            "rclpy is not to be had: run this where ROS 2 is installed and sourced "
            "(source /opt/ros/…/setup.bash)"
        ) from None
