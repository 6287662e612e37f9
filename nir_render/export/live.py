"""The stack of one robot on ROS 2, live: pictures of its cameras in, whom it follows and what they say out.

    rclpy.init()
    node = rclpy.create_node("nir")
    live = Live(perception.read_calibrations("recording"), {"r1.front": Taken(exposure_s=2e-4)})
    live.attach(node)
    rclpy.spin(node)

It was not tried on ROS itself: what stands in for a node is in `tests/unit/export/test_live.py`.
"""

import json
import logging
import math
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
from perception.model.sensor import without_offsets
from perception.rig.frame_sets import robot_of

_IMAGE, _ODOMETRY = "sensor_msgs/Image", "nav_msgs/Odometry"
_TEXT, _MARKERS = "std_msgs/String", "visualization_msgs/MarkerArray"
_KEPT_S, _MOST_KEPT_S = 2.0, 30.0  # of the robot's own motion, before the last set; where none comes
_JUMP_S = 1.0  # back: then a clock was set, or a bag begins again
_QUEUED = 10
_LOG = logging.getLogger(__name__)


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


@dataclass(frozen=True)
class OdometryError:
    """How far odometry is off, per axis: each record by itself, and how that grows with the root of time.

    A message's own covariance says what has been gathered since the start, or a large number for axes that
    are not measured: neither is asked for here. The defaults are those of a small wheeled robot.
    """

    position_sigma_m: float = 0.001
    rotation_sigma_rad: float = 0.002
    position_walk_m_per_sqrt_s: float = 0.01
    rotation_walk_rad_per_sqrt_s: float = 0.0035


class Live:
    """What takes a robot's pictures as they come, and tells whom it follows and what they say.

    Pictures that begin within half a period of the first of a set are one set. Each camera's come in their
    order, those of several at their own pace: a set goes through the stack when all cameras are in it or have
    sent later pictures, or some `patience_s` after it. What comes later still is left out, and counted in
    `late`; where that is more than a second, a clock was set back, and sets begin anew. Exposures of a
    bracket are no set here. Times of the stack count from the first message's whole second on, `clock_s`.

    Parameters
    ----------
    calibrations
        Of each camera, by its name, `robot.camera`; all of one robot.
    taken
        How each takes its pictures, by its name.
    period_s
        From one set to the next.
    odometry_error
        How far the odometry is off.
    patience_s
        How long a camera that sends nothing is waited for.
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
        odometry_error: OdometryError = OdometryError(),
        patience_s: float = 0.25,
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
        self.late = dict.fromkeys(calibrations, 0)
        self._odometry_error, self._patience_s = odometry_error, patience_s
        self._sets: list[list[RawFrame]] = []
        self._latest_s: dict[str, float] = {}
        self._pushed_s = -math.inf
        self._odometry: deque[Odometry] = deque()

    def attach(
        self,
        node: Node,
        topics: Mapping[str, str] | None = None,
        odometry: str | None = None,
        message_of: Callable[[str], cdr.MakeMessage] | None = None,
        quality: Any = None,
        warn: Callable[[str], None] = _LOG.warning,
    ) -> None:
        """Have a node's topics fed to this, and publish on it what comes out.

        A message that cannot be taken is left out, and told by `warn`.

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
        warn
            Takes what is wrong with messages, such as `node.get_logger().warning`.

        Raises
        ------
        InputError
            ROS is not installed or not sourced; a topic is of no camera.
        """
        message_of = cdr.class_of if message_of is None else message_of
        if quality is None:
            quality = cdr.quality_of_sensors()
        if unknown := sorted(set(topics or {}) - set(self._calibrations)):
            raise InputError(f"topics: {', '.join(unknown)}: no such camera is calibrated")
        for camera in self._calibrations:
            usual = f"/{camera.replace('.', '/')}/image_raw"
            node.create_subscription(
                message_of(_IMAGE),
                (topics or {}).get(camera, usual),
                _safely(partial(self.take_image, camera), warn),
                quality,
            )
        if odometry is not None:
            node.create_subscription(
                message_of(_ODOMETRY), odometry, _safely(self.take_odometry, warn), quality
            )
        publish = {
            what: node.create_publisher(message_of(kind), f"/{self.robot}/{what}", _QUEUED).publish
            for what, kind in (("tracks", _TEXT), ("messages", _TEXT), ("markers", _MARKERS))
        }
        own = self._told

        def told(outcome: Outcome) -> None:
            own(outcome)
            publish["tracks"](cdr.made(_TEXT, {"data": outcome.tracks_json()}, message_of))
            if outcome.messages:
                publish["messages"](cdr.made(_TEXT, {"data": outcome.messages_json()}, message_of))
            markers = ros.to_markers(outcome.tracks, self.robot, outcome.clock_s + outcome.time_s)
            publish["markers"](cdr.made(_MARKERS, markers, message_of))

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
        full_scale_dn = 2**known.bit_depth - 1
        if int(data_dn.max()) > full_scale_dn or (
            message.encoding.lower() == "mono8" and full_scale_dn > 255
        ):
            raise InputError(
                f"{camera}: a picture of {message.encoding} counts to {int(data_dn.max())}, its calibration "
                f"has {known.bit_depth} bit; send counts as the sensor made them, neither shifted nor cut"
            )
        time_s = self._time_s(message.header.stamp)
        if taken.stamped == "middle":
            time_s -= 0.5 * (taken.exposure_s + taken.line_time_s * (known.height_px - 1))
        frame = RawFrame(
            camera, self._count[camera], time_s, taken.exposure_s, data_dn.astype(np.uint16),
            known.black_level_dn, taken.line_time_s, taken.gain,
        )  # fmt: skip
        self._count[camera] += 1
        if time_s < self._pushed_s - _JUMP_S:
            self._push(whole_only=False)
            self._pushed_s = -math.inf
            self._latest_s.clear()
        self._latest_s[camera] = max(time_s, self._latest_s.get(camera, -math.inf))
        if time_s <= self._pushed_s + self._half_s:
            self.late[camera] += 1
            return
        for taken_together in self._sets:
            near = abs(time_s - _begin_s(taken_together)) <= self._half_s
            if near and all(camera != other.camera for other in taken_together):
                taken_together.append(without_offsets(frame, known))
                break
        else:
            self._sets.append([without_offsets(frame, known)])
            self._sets.sort(key=_begin_s)
        self._push(whole_only=True)

    def take_odometry(self, message: Any) -> None:
        """Take a `nav_msgs/Odometry`; what is not later is passed over, a jump back begins anew."""
        pose = message.pose.pose
        place, turn = pose.position, pose.orientation
        time_s = self._time_s(message.header.stamp)
        if self._odometry and time_s <= self._odometry[-1].time_s:
            if self._odometry[-1].time_s - time_s <= _JUMP_S:
                return
            self._odometry.clear()
        error = self._odometry_error
        self._odometry.append(
            Odometry(
                self.robot,
                time_s,
                np.array([place.x, place.y, place.z]),
                Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix(),
                error.position_sigma_m,
                error.rotation_sigma_rad,
                error.position_walk_m_per_sqrt_s,
                error.rotation_walk_rad_per_sqrt_s,
            )
        )
        self._forget(time_s - _MOST_KEPT_S)

    def finish(self) -> None:
        """Take in the sets that are not whole, and tell what can be read as no more will come."""
        self._push(whole_only=False)
        said = self._pipeline.finish()
        if said and self.clock_s is not None:
            self._told(Outcome(self.clock_s, max(one.end_s for one in said), (), said))

    def _time_s(self, stamp: Any) -> float:
        """Return a stamp by the stack's clock: float64 has not the digits for ROS's."""
        if self.clock_s is None:
            self.clock_s = int(stamp.sec)
        return (int(stamp.sec) - self.clock_s) + 1e-9 * int(stamp.nanosec)

    def _push(self, whole_only: bool) -> None:
        """Put sets through, in their order: those to which nothing comes any more, or all."""
        while self._sets and (not whole_only or self._is_whole(self._sets[0])):
            frames = sorted(self._sets.pop(0), key=lambda frame: frame.time_s)
            self._pushed_s = frames[0].time_s
            heard: Heard = self._pipeline.push(frames, tuple(self._odometry))
            self._forget(heard.time_s - _KEPT_S)
            assert self.clock_s is not None
            self._told(Outcome(self.clock_s, heard.time_s, heard.tracks, heard.messages))

    def _is_whole(self, frames: Sequence[RawFrame]) -> bool:
        """Tell whether all cameras are in a set, have sent later pictures, or are not waited for any more."""
        begin_s, there = _begin_s(frames), {frame.camera for frame in frames}
        given_up = max(self._latest_s.values()) > begin_s + self._half_s + self._patience_s
        return given_up or all(
            camera in there or self._latest_s.get(camera, -math.inf) > begin_s + self._half_s
            for camera in self._calibrations
        )

    def _forget(self, before_s: float) -> None:
        while len(self._odometry) > 2 and self._odometry[1].time_s < before_s:
            self._odometry.popleft()


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


def _begin_s(frames: Sequence[RawFrame]) -> float:
    return min(frame.time_s for frame in frames)


def _safely(take: Callable[[Any], None], warn: Callable[[str], None]) -> Callable[[Any], None]:
    """Return a callback that tells of what it cannot take: an exception would end the node."""

    def called(message: Any) -> None:
        try:
            take(message)
        except ValueError as error:  # InputError is one
            warn(f"a message is left out: {error}")

    return called
