"""What time adds to a run: tracks and messages of each robot that takes frames, by each estimator."""

import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

from nir_render.errors import InputError
from nir_render.run import folder as run_folder
from perception import (
    Calibration,
    Detection,
    Odometry,
    Pipeline,
    RawFrame,
    SetMeasurements,
    measurement_record,
    message_record,
    mirror_record,
    robot_record,
    signal_record,
    track_record,
)
from perception.messages.own import DecoderError, OwnDecoder, OwnReader, load_decoder
from perception.rig.frame_sets import robot_of
from perception.track.own import TrackerError, load_tracker
from perception.types import Message

Line = dict[str, Any]

_BEFORE_S, _AFTER_S = 2.0, 0.5


@dataclass(frozen=True)
class OwnParts:
    """The tracker and the decoder that the user brings, `file.py:function`, in place of those built in."""

    tracker: str | None = None
    decoder: OwnDecoder | None = None

    @staticmethod
    def of(tracker: str | None, decoder: str | None) -> "OwnParts":
        """Load what `--tracker` and `--decoder` name.

        Raises
        ------
        InputError
            One of them cannot be loaded.
        """
        for option, reference, load in (
            ("--tracker", tracker, load_tracker),
            ("--decoder", decoder, load_decoder),
        ):
            if reference is not None:
                try:
                    load(reference)
                except (TrackerError, DecoderError) as error:
                    raise InputError(f"{option} {error}") from None
        return OwnParts(tracker, None if decoder is None else load_decoder(decoder))

    def pipeline(self, name: str, calibrations: Mapping[str, Calibration]) -> Pipeline:
        """Return the stack of one robot that goes with an estimator."""
        decoder = self.decoder
        return Pipeline.of(
            name,
            calibrations,
            # Loaded anew for each robot: what a tracker keeps in its file is one robot's.
            tracker=None if self.tracker is None else load_tracker(self.tracker),
            keep_signals=True,
            decoder=None if decoder is None else lambda robot, track: OwnReader(decoder, calibrations),  # noqa: ARG005
        )


class Follower:
    """Follows what one estimator finds, set by set, and keeps the lines that are written of it at the end."""

    def __init__(
        self,
        name: str,
        calibrations: Mapping[str, Calibration],
        odometry: Mapping[str, Sequence[Odometry]],
        own: OwnParts,
    ) -> None:
        self._name = name
        self._own = own
        self._calibrations = calibrations
        self._odometry = odometry
        self._pipelines: dict[str, Pipeline] = {}
        self._latest_s: dict[str, float] = {}
        self._lines: dict[str, list[Line]] = {
            kind: [] for kind in ("measurements", "mirrors", "robots", "fog", "tracks", "messages")
        }

    def take(self, frames: Sequence[RawFrame], detections: Sequence[Sequence[Detection]]) -> None:
        """Take the frames of one set, and what was found in each of them."""
        robot, begin_s = robot_of(frames[0].camera), frames[0].time_s
        if robot not in self._pipelines:
            self._pipelines[robot] = self._own.pipeline(self._name, self._calibrations)
        heard = self._pipelines[robot].follow(frames, detections, self._known(robot, begin_s))
        self._note_set(robot, begin_s, heard.measurements)
        self._lines["tracks"] += map(track_record, heard.tracks)
        self._latest_s[robot] = heard.time_s
        self._note_messages(heard.messages, heard.time_s)

    def _known(self, robot: str, time_s: float) -> Sequence[Odometry]:
        """Return what a robot knows of its motion around a time."""
        records = self._odometry.get(robot, ())
        first = bisect_left(records, time_s - _BEFORE_S, key=attrgetter("time_s"))
        last = bisect_right(records, time_s + _AFTER_S, key=attrgetter("time_s"))
        return records[max(first - 1, 0) : last + 1]

    def _note_set(self, robot: str, time_s: float, seen: SetMeasurements) -> None:
        self._lines["measurements"] += map(measurement_record, seen.measurements)
        self._lines["mirrors"] += [mirror_record(plane, robot, time_s) for plane in seen.planes]
        self._lines["robots"] += map(robot_record, seen.robots)
        if math.isfinite(seen.extinction_per_m):
            told = {
                "extinction_per_m": seen.extinction_per_m,
                "extinction_sigma_per_m": seen.extinction_sigma_per_m,
            }
            self._lines["fog"].append({"format": 1, "robot": robot, "time_s": time_s, **told})

    def finish(self) -> None:
        """Read what was said to the end."""
        for robot, pipeline in self._pipelines.items():
            self._note_messages(pipeline.finish(), self._latest_s[robot])

    def _note_messages(self, messages: Iterable[Message], told_s: float) -> None:
        self._lines["messages"] += [{**message_record(message), "told_s": told_s} for message in messages]

    def lines(self) -> dict[str, list[Line]]:
        """Return what was found so far, by what it is of: as `KIND.NAME.jsonl` holds it."""
        signals = [
            signal_record(signal) for pipeline in self._pipelines.values() for signal in pipeline.signals()
        ]
        return {**self._lines, "signals": signals}

    def write(self, folder: Path) -> None:
        """Write the files of an estimator: of tracks and what they say only where there were any."""
        always = ("measurements", "mirrors") + (("messages",) if self._lines["tracks"] else ())
        for kind, lines in self.lines().items():
            if lines or kind in always:
                run_folder.write_lines(folder / f"{kind}.{self._name}.jsonl", lines)
            else:  # of an earlier call
                (folder / f"{kind}.{self._name}.jsonl").unlink(missing_ok=True)
