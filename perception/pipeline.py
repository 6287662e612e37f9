"""The whole stack, fed as it goes: a set of frames in, who is where and who says what out.

    pipeline = perception.Pipeline(calibrations)
    for frames, odometry in sets:                # what a robot's cameras took within half a period
        heard = pipeline.push(frames, odometry)
        heard.tracks, heard.messages

Frames become detections (an estimator), these measurements (`rig`), these tracks (`track`); each track's
brightness is measured in every frame, dark or lit (`photometry`), and read (`messages`).
"""

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from perception.estimators import Estimator, detect_frames
from perception.messages.decoder import Decoder
from perception.messages.paper import PaperDecoder
from perception.pairs import PairReader, SumSample, inseparable, sample_of_sum
from perception.photometry import (
    Expected,
    Sample,
    expected_images,
    sample_at,
    sample_of_detection,
    signal_of,
)
from perception.rig.frame_sets import mid_exposure_s, robot_of, set_time_s
from perception.rig.measure_set import measure_set
from perception.track.settings import TrackerSettings
from perception.track.tracker import Tracker
from perception.types import (
    Calibration,
    Detection,
    Measurement,
    Message,
    Odometry,
    RawFrame,
    SetMeasurements,
    Signal,
    Track,
)

_AS_THE_PAPER = TrackerSettings(filter="paper", association="paper", overlap="paper")

Takers = dict[tuple[str, int, int], set[int]]
"""The tracks that took each detection, by its camera, frame and place among those of the frame."""

_SET_BACK_S = 1.0
_AT_ONCE_S = 1e-3
"""Frames are of one time if they are no further apart."""


class Follows(Protocol):
    """What makes tracks of measurements: `Tracker`, or one's own."""

    def update(
        self, time_s: float, measurements: Sequence[Measurement], odometry: Sequence[Odometry]
    ) -> tuple[Track, ...]:
        """Take the measurements of a set; return the tracks at its time."""

    def predicted(self, time_s: float, odometry: Sequence[Odometry]) -> tuple[Track, ...]:
        """Return the tracks at another time, by what is known so far."""


class Reads(Protocol):
    """What makes messages of one track's signal: `Decoder`, or one's own."""

    def push(self, signal: Signal) -> Iterable[Message]:
        """Take further samples; return the messages that are complete."""

    def finish(self) -> Iterable[Message]:
        """Return what can be said of the rest, as no more will come."""


@dataclass(frozen=True, eq=False)
class Heard:
    """What a set of frames says, and all before it: measurements, tracks, messages that it completed."""

    time_s: float
    measurements: SetMeasurements
    tracks: tuple[Track, ...]
    messages: tuple[Message, ...]


class Pipeline:
    """The stack of one robot, with what it remembers.

    Parameters
    ----------
    calibrations
        Of each camera, by its name.
    estimator
        As for `detect`.
    tracker
        What follows; by default a `Tracker` as it comes.
    decoder
        Makes what reads one track, of the observer's name and the track's number; by default `Decoder`,
        which is helped by a `PairReader` while two tracks are in one place of the image.
    keep_signals
        Whether `signals` is to know them all: a robot that runs for days has no use for that.
    limit_s
        As for `detect`, of each frame.
    detector
        What finds the flares of a set's frames, in place of `estimator` and `limit_s`, such as
        `DetectorProcesses.detect_frames`.
    """

    def __init__(
        self,
        calibrations: Mapping[str, Calibration],
        estimator: str | Estimator = "robust",
        tracker: Follows | None = None,
        decoder: Callable[[str, int], Reads] = Decoder,
        keep_signals: bool = False,
        limit_s: float = math.inf,
        detector: Callable[[Sequence[RawFrame]], Sequence[Sequence[Detection]]] | None = None,
    ) -> None:
        self._calibrations = calibrations
        self._limit_s = limit_s
        self._estimator = estimator
        self._detector = detector
        self._tracker: Follows = Tracker() if tracker is None else tracker
        self._decoder = decoder
        self._readers: dict[int, Reads] = {}
        self._pairs = PairReader() if decoder is Decoder else None
        self._latest_s = -math.inf
        self._robot: str | None = None
        self._extinction_per_m: float | None = None
        self._last_s: dict[int, float] = {}
        self._taken: set[tuple[str, int, float]] = set()
        self._keeps_signals = keep_signals
        self._samples: dict[int, list[Sample]] = {}

    @staticmethod
    def of(
        name: str,
        calibrations: Mapping[str, Calibration],
        tracker: Follows | None = None,
        decoder: Callable[[str, int], Reads] | None = None,
        keep_signals: bool = False,
    ) -> "Pipeline":
        """Return the stack that goes with an estimator: the paper's own parts where it is `paper`.

        `tracker` and `decoder` take the place of those that belong to it.
        """
        paper = name == "paper"
        if tracker is None:
            tracker = Tracker(_AS_THE_PAPER if paper else None)
        if decoder is None:
            decoder = PaperDecoder if paper else Decoder
        return Pipeline(calibrations, "paper" if paper else "robust", tracker, decoder, keep_signals)

    def push(self, frames: Sequence[RawFrame], odometry: Sequence[Odometry] = ()) -> Heard:
        """Take the next set of frames.

        Parameters
        ----------
        frames
            What the robot's cameras took within half a period (`frame_sets`). Cameras of one time may also
            come one after the other; a frame that was pushed before is left out.
        odometry
            What it knows of its own motion, from before the last set on to now or beyond; without any it
            stands still.

        Raises
        ------
        ValueError
            There are no frames, or those of another robot than before; as for `detect`, or its own detector.
        """
        if self._detector is not None:
            return self.follow(frames, self._detector(frames), odometry)
        found = detect_frames(frames, self._calibrations, self._estimator, limit_s=self._limit_s)
        return self.follow(frames, found, odometry)

    def follow(
        self,
        frames: Sequence[RawFrame],
        detections: Sequence[Sequence[Detection]],
        odometry: Sequence[Odometry] = (),
    ) -> Heard:
        """As `push`, from detections of each frame that were made elsewhere.

        Raises
        ------
        ValueError
            As for `push`.
        """
        robots = {robot_of(frame.camera) for frame in frames} | {self._robot or ""} - {""}
        if not frames or len(robots) != 1:
            raise ValueError(
                f"a pipeline follows one robot, not {', '.join(sorted(robots)) or 'none'}: give it "
                "the frames of one set of one robot"
            )
        (self._robot,) = robots
        frames, detections = self._new(frames, detections)
        if not frames:
            tracks = self._tracker.predicted(self._latest_s, odometry)
            return Heard(self._latest_s, measure_set([], [], self._calibrations), tracks, ())
        seen = measure_set(frames, detections, self._calibrations, odometry=odometry)
        time_s = set_time_s(frames)
        tracks = self._tracker.update(time_s, seen.measurements, odometry)
        messages = self._listen(time_s, frames, seen, tracks, odometry)
        return Heard(time_s, seen, tracks, messages)

    def _new(
        self, frames: Sequence[RawFrame], detections: Sequence[Sequence[Detection]]
    ) -> tuple[Sequence[RawFrame], Sequence[Sequence[Detection]]]:
        """Leave out frames that were taken in before: what is pushed twice is no new evidence."""
        keys = [(frame.camera, frame.index, frame.time_s) for frame in frames]
        if not self._taken.isdisjoint(keys):
            new = [k for k, key in enumerate(keys) if key not in self._taken]
            frames, detections = [frames[k] for k in new], [detections[k] for k in new]
        latest_s = max(time_s for _, _, time_s in keys)
        self._taken = {key for key in (*self._taken, *keys) if abs(latest_s - key[2]) < _SET_BACK_S}
        return frames, detections

    def finish(self) -> tuple[Message, ...]:
        """Return the messages that can be told as no more frames will come."""
        said = [message for reader in self._readers.values() for message in reader.finish()]
        self._readers.clear()
        if self._pairs is not None:
            said += self._pairs.finish(self._robot or "", said)
        return tuple(said)

    def signals(self) -> tuple[Signal, ...]:
        """Return how bright every track was so far; none where they are not kept."""
        return tuple(
            signal_of(self._robot or "", track, samples)
            for track, samples in self._samples.items()
            if samples
        )

    def _listen(
        self,
        time_s: float,
        frames: Sequence[RawFrame],
        seen: SetMeasurements,
        tracks: Sequence[Track],
        odometry: Sequence[Odometry],
    ) -> tuple[Message, ...]:
        """Measure the brightness of each track in a set, and read on."""
        said: list[Message] = []
        detections = seen.detections
        if math.isfinite(seen.extinction_per_m):
            self._extinction_per_m = seen.extinction_per_m
        for number in set(self._readers) - {track.track for track in tracks}:
            said += self._readers.pop(number).finish()
        now = {track.track for track in tracks}
        self._last_s = {number: last_s for number, last_s in self._last_s.items() if number in now}
        if time_s < self._latest_s - _SET_BACK_S:  # the clock was set back: tracks and signals begin anew
            said += self.finish()
            self._last_s.clear()
        elif time_s < self._latest_s:  # what comes late is followed, if the tracker can, but not read
            return tuple(said)
        self._latest_s = time_s
        by_key = {
            (hit.camera, hit.index, number): hit for found in detections for number, hit in enumerate(found)
        }
        takers: Takers = {}
        for track in tracks:
            for key in track.detections:
                takers.setdefault(key, set()).add(track.track)
        places = [self._expected(frame, time_s, tracks, odometry) for frame in frames]
        together = [
            _together(there, tracks, frame, takers) for there, frame in zip(places, frames, strict=True)
        ]
        for track in tracks:
            samples = [
                self._sample(track, there.get(track.track), frame, found, by_key, takers, mixed)
                for there, frame, found, mixed in zip(places, frames, detections, together, strict=True)
            ]
            known = [sample for sample in samples if sample is not None]
            if not known:
                continue
            best = min(known, key=lambda sample: sample.sigma_lit)
            if best.time_s <= self._last_s.get(track.track, -math.inf):
                continue
            self._last_s[track.track] = best.time_s
            if self._keeps_signals:
                self._samples.setdefault(track.track, []).append(best)
            if track.ghost == "yes":  # it says what its robot says
                continue
            if track.track not in self._readers:
                self._readers[track.track] = self._decoder(track.robot, track.track)
            reader = self._readers[track.track]
            said += reader.push(signal_of(self._robot or "", track.track, [best]))
        if self._pairs is not None:
            sums = self._sums(frames, places, detections, together, takers)
            said += self._pairs.push(self._robot or "", time_s, sums, said)
        return tuple(said)

    def _sums(
        self,
        frames: Sequence[RawFrame],
        places: Sequence[Mapping[int, Expected]],
        detections: Sequence[Sequence[Detection]],
        together: Sequence[Collection[tuple[int, int]]],
        takers: Takers,
    ) -> dict[tuple[int, int], SumSample]:
        """Return how bright pairs are that are one image, each in the first frame that says it."""
        sums: dict[tuple[int, int], SumSample] = {}
        for there, frame, found, mixed in zip(places, frames, detections, together, strict=True):
            taken = _taken_in(frame, takers)
            for pair in mixed:
                others = {number for number, tracks in taken.items() if not tracks.issubset(pair)}
                one, other = (there[track] for track in pair)
                calibration = self._calibrations[frame.camera]
                total = sample_of_sum(one, other, found, others, frame, calibration)
                if total is not None:
                    sums.setdefault(pair, total)
        return sums

    def _expected(
        self, frame: RawFrame, time_s: float, tracks: Sequence[Track], odometry: Sequence[Odometry]
    ) -> dict[int, Expected]:
        """Return where the tracks in view must be in a frame, and how bright, by number."""
        now = self._at(frame, time_s, tracks, odometry)
        there = [now.get(track.track, track) for track in tracks]
        images = expected_images(
            np.array([track.position_body_m for track in there]).reshape(-1, 3),
            np.array([track.covariance[:3, :3] for track in there]).reshape(-1, 3, 3),
            frame,
            self._calibrations[frame.camera],
            self._extinction_per_m,
        )
        return {track.track: image for track, image in zip(tracks, images, strict=True) if image is not None}

    def _at(
        self, frame: RawFrame, time_s: float, tracks: Sequence[Track], odometry: Sequence[Odometry]
    ) -> dict[int, Track]:
        """Return where tracks are in the middle of a frame, by number; none where that is the set's time."""
        middle_s = mid_exposure_s(frame, self._calibrations[frame.camera].height_px)
        if not tracks or abs(middle_s - time_s) < _AT_ONCE_S:
            return {}
        return {track.track: track for track in self._tracker.predicted(middle_s, odometry)}

    def _sample(
        self,
        track: Track,
        expected: Expected | None,
        frame: RawFrame,
        found: Sequence[Detection],
        by_key: Mapping[tuple[str, int, int], Detection],
        takers: Takers,
        together: Collection[tuple[int, int]],
    ) -> Sample | None:
        """Return the brightness of a track in a frame; None where nothing is known of its own light."""
        calibration = self._calibrations[frame.camera]
        if expected is None or any(track.track in pair for pair in together):
            return None
        own = [key for key in track.detections if key[:2] == (frame.camera, frame.index)]
        if own:
            hit = by_key.get(own[0])
            if hit is None or hit.merged or len(takers[own[0]]) > 1:
                return None
            return sample_of_detection(hit, expected, frame, calibration)
        claimed = [(frame.camera, frame.index, number) in takers for number in range(len(found))]
        return sample_at(expected, found, frame, calibration, claimed)


def _taken_in(frame: RawFrame, takers: Takers) -> dict[int, set[int]]:
    """Return the tracks that took each detection of a frame, by its place among them."""
    here = (frame.camera, frame.index)
    return {number: tracks for (camera, index, number), tracks in takers.items() if (camera, index) == here}


def _together(
    expected: Mapping[int, Expected],
    tracks: Sequence[Track],
    frame: RawFrame,
    takers: Takers,
) -> list[tuple[int, int]]:
    """Return the pairs of tracks that are one image in a frame: no mirror images, none found as two."""
    alone = {track for who in _taken_in(frame, takers).values() if len(who) == 1 for track in who}
    robots = {track.track for track in tracks if track.ghost != "yes"}
    of_robots = {number: one for number, one in expected.items() if number in robots}
    return [pair for pair in inseparable(of_robots) if not alone.issuperset(pair)]
