"""What time adds to a job's rows: how well robots were followed, and which packets were received.

A sequence is one observer's sets of frames. It is followed as `nir-render run` does it, and scored likewise;
sequences of fewer than ten sets say nothing of tracks, and have no rows.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

from nir_render.evaluate.messages import evaluate_messages, parse_told
from nir_render.evaluate.tracks import FEW_SETS, evaluate_tracks, sets_in_time
from nir_render.run.follow import Follower, OwnParts
from nir_render.scene.scene import Scene
from nir_render.simulation.odometry import odometry_by_robot, true_poses
from nir_render.simulation.sent import sent_packets
from nir_render.truth.sources import SourceTruth
from perception import Calibration, Detection, RawFrame, frame_sets, parse_signal, parse_track

Row = dict[str, Any]


class Sequences:
    """Follows the frames of a job, those of one index after those of another, without keeping them."""

    def __init__(
        self, scene: Scene, estimators: Sequence[str], calibrations: Mapping[str, Calibration]
    ) -> None:
        self._scene, self._calibrations = scene, calibrations
        # What is too short to say anything is not followed.
        followed = estimators if scene.document.clock.frames >= FEW_SETS else ()
        odometry = odometry_by_robot(scene) if followed else {}
        self._followers = {name: Follower(name, calibrations, odometry, OwnParts()) for name in followed}
        self._waiting: list[tuple[RawFrame, Mapping[str, Sequence[Detection]]]] = []
        self._records: list[RawFrame] = []
        self._truth: list[SourceTruth] = []

    def take(
        self, frame: RawFrame, truth: Sequence[SourceTruth], found: Mapping[str, Sequence[Detection]]
    ) -> None:
        """Take the next frame, its truth, and what each estimator found in it."""
        if not self._followers:
            return
        if self._waiting and frame.index != self._waiting[0][0].index:
            self._follow()
        self._waiting.append((frame, found))
        self._truth += truth

    def _follow(self) -> None:
        found = {(frame.camera, frame.index): hits for frame, hits in self._waiting}
        for frames in frame_sets([frame for frame, _ in self._waiting]):
            for name, follower in self._followers.items():
                follower.take(frames, [found[frame.camera, frame.index][name] for frame in frames])
        self._records += [replace(frame, data_dn=frame.data_dn[:1, :1].copy()) for frame, _ in self._waiting]
        self._waiting = []

    def rows(self) -> Iterator[Row]:
        """Yield a row for each sequence and for each packet that was in view, by estimator."""
        if self._waiting:
            self._follow()
        sets, taken_s = sets_in_time(self._records, self._calibrations)
        if len(sets) < FEW_SETS:
            return
        for follower in self._followers.values():
            follower.finish()
        lines = {name: follower.lines() for name, follower in self._followers.items()}
        followed = evaluate_tracks(
            sets,
            self._truth,
            self._calibrations,
            {name: list(map(parse_track, own["tracks"])) for name, own in lines.items()},
            true_poses(self._scene),
            taken_s,
        )
        heard = evaluate_messages(
            followed.moments,
            sent_packets(self._scene),
            {name: list(map(parse_told, own["messages"])) for name, own in lines.items()},
            {name: list(map(parse_signal, own["signals"])) for name, own in lines.items()},
        )
        for name in self._followers:
            for robot, numbers in followed.by_observer[name].items():
                said = heard.by_observer[name][robot]
                yield {
                    "estimator": name,
                    "kind": "sequence",
                    "camera": robot,
                    "track_hota": numbers["track_hota"],
                    "track_idf1": numbers["track_idf1"],
                    "track_switches": numbers["track_switches"],
                    "message_wrong": said["message_wrong"],
                    "message_bit_error_rate": said["message_bit_error_rate"],
                }
            for packet in heard.receptions:
                yield {
                    "estimator": name,
                    "kind": "packet",
                    "camera": packet.observer,
                    "time_s": packet.sent.start_s,
                    "robot": packet.sent.robot,
                    "source": packet.sent.source,
                    "received": name in packet.heard,
                }
