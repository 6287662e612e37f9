"""What a stack says of who is where over time, track by track, against truth.

Tracks of what does not count at the time (`presence`: gone, mirror images, not seen yet) are neither hits nor
false alarms. Every observer is one sequence: what several did is taken together as that of several sequences.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from nir_render.errors import InputError
from nir_render.evaluate.presence import Present, SourceName, TimedSet, present_in
from nir_render.evaluate.track_errors import Followed, TrueWays, error_numbers
from nir_render.evaluate.track_metrics import Instant, gospa_m, track_scores
from nir_render.truth.poses import PoseTruth
from nir_render.truth.sources import SourceTruth
from perception.rig.frame_sets import Exposed, frame_sets, mid_exposure_s, robot_of, set_time_s
from perception.types import Calibration, FrameKey, Track

Values = NDArray[np.float64]

REACH_M = 1.0
"""Similarity of a track and a source falls from 1 to 0 at this distance."""

FEW_SETS = 10
"""Tracks begin within three sets: of fewer than these the scores tell nothing, and are not shown."""

_SAME_TIME_S = 1e-3
"""A track stands at the time of its set: as written and as reckoned they may differ."""


@dataclass(frozen=True, eq=False)
class Moment:
    """One instant of one observer: who is there, and each estimator's tracks, each with whom it follows."""

    robot: str
    time_s: float
    present: tuple[Present, ...]
    tracks: Mapping[str, tuple[tuple[Track, SourceName | None], ...]]


@dataclass(frozen=True, eq=False)
class TrackEvaluation:
    """All instants, in the order of time, and each estimator's numbers in `summary.json`.

    `by_observer` has them for each observer by itself, by estimator.
    """

    moments: tuple[Moment, ...]
    summary: Mapping[str, Mapping[str, Any]]
    by_observer: Mapping[str, Mapping[str, Mapping[str, Any]]]


def sets_in_time(
    frames: Iterable[Exposed], calibrations: Mapping[str, Calibration], period_s: float | None = None
) -> tuple[list[TimedSet], dict[FrameKey, float]]:
    """Return the sets of frames, and when each frame was taken: `sets` and `taken_s` of `evaluate_tracks`.

    `period_s` is that of `frame_sets`.
    """
    listed = list(frames)
    sets: list[TimedSet] = [
        (robot_of(each[0].camera), set_time_s(each), [(frame.camera, frame.index) for frame in each])
        for each in frame_sets(listed, period_s)
    ]
    taken_s = {
        (frame.camera, frame.index): mid_exposure_s(frame, calibrations[frame.camera].height_px)
        for frame in listed
    }
    return sets, taken_s


def evaluate_tracks(
    sets: Sequence[TimedSet],
    truth: Iterable[SourceTruth],
    calibrations: Mapping[str, Calibration],
    tracks: Mapping[str, Sequence[Track]],
    poses: Iterable[PoseTruth] = (),
    taken_s: Mapping[FrameKey, float] | None = None,
) -> TrackEvaluation:
    """Score the tracks of each estimator.

    Parameters
    ----------
    sets
        Of each set of frames the observer, its time (that of its tracks) and its frames.
    truth, calibrations
        As for `evaluate`.
    tracks
        By estimator.
    poses
        Where robots truly were, and how fast: without them velocities have no truth.
    taken_s
        When each frame was taken, mid-exposure of its middle row, for which `truth` holds: with that and
        poses, sources stand where they are at the time of their set, as tracks do.

    Raises
    ------
    InputError
        A track stands at a time at which its observer took no set, or twice at one.
    """
    ways = TrueWays(poses)
    present = present_in(sets, truth, calibrations, ways, taken_s or {})
    said = {name: _in_sets(found, sets, name) for name, found in tracks.items()}
    moments = tuple(
        Moment(
            robot,
            time_s,
            there,
            {name: _followed(there, by_set.get(number, [])) for name, by_set in said.items()},
        )
        for number, ((robot, time_s, _), there) in enumerate(zip(sets, present, strict=True))
    )
    observers = list(dict.fromkeys(moment.robot for moment in moments))
    own = {robot: [moment for moment in moments if moment.robot == robot] for robot in observers}
    by_observer = {name: {robot: _numbers(own[robot], name, ways) for robot in observers} for name in tracks}
    in_turn = [moment for robot in observers for moment in own[robot]]
    together = {
        name: numbers[observers[0]] if len(observers) == 1 else _numbers(in_turn, name, ways)
        for name, numbers in by_observer.items()
    }
    return TrackEvaluation(moments, together, by_observer)


def _in_sets(tracks: Iterable[Track], sets: Sequence[TimedSet], name: str) -> dict[int, list[Track]]:
    """Return the tracks of each set, by its number."""
    numbers = {
        robot: sorted((each for each in range(len(sets)) if sets[each][0] == robot), key=lambda k: sets[k][1])
        for robot in {robot for robot, _, _ in sets}
    }
    times_s = {robot: np.array([sets[k][1] for k in own]) for robot, own in numbers.items()}
    found: dict[int, list[Track]] = {}
    for track in tracks:
        own_s = times_s.get(track.robot, np.empty(0))
        at = int(np.searchsorted(own_s, track.time_s - _SAME_TIME_S))
        nearest = min(
            range(at, min(at + 3, len(own_s))), key=lambda k: abs(own_s[k] - track.time_s), default=None
        )
        if nearest is None or abs(own_s[nearest] - track.time_s) > _SAME_TIME_S:
            raise InputError(
                f"tracks.{name}.jsonl: track {track.track} of {track.robot} is at {track.time_s:.6g} s, when "
                "it took no set of frames; write tracks at the time of their set, the mean of the middles of "
                "its exposures (docs/tracking.md, From a set to tracks)"
            )
        here = found.setdefault(numbers[track.robot][nearest], [])
        if any(other.track == track.track for other in here):
            raise InputError(
                f"tracks.{name}.jsonl: track {track.track} of {track.robot} stands twice at "
                f"{track.time_s:.6g} s; give each of a set's tracks a number of its own"
            )
        here.append(track)
    return found


def _followed(
    present: Sequence[Present], tracks: Sequence[Track]
) -> tuple[tuple[Track, SourceName | None], ...]:
    """Return the tracks of an instant, each with whom it follows: one to one, as near as possible in all."""
    apart_m = _apart_m(present, tracks)
    rows, columns = linear_sum_assignment(np.minimum(apart_m, REACH_M))
    near = {
        int(j): present[int(i)].name for i, j in zip(rows, columns, strict=True) if apart_m[i, j] < REACH_M
    }
    return tuple((track, near.get(j)) for j, track in enumerate(tracks))


def _apart_m(present: Sequence[Present], tracks: Sequence[Track]) -> Values:
    there = np.array([one.position_body_m for one in present]).reshape(-1, 1, 3)
    said = np.array([track.position_body_m for track in tracks]).reshape(1, -1, 3)
    return np.asarray(np.linalg.norm(there - said, axis=2))


def _numbers(moments: Sequence[Moment], name: str, ways: TrueWays) -> dict[str, Any]:
    """Return an estimator's numbers; the moments of one observer after those of another."""
    lives: dict[tuple[str, SourceName, int], int] = {}
    numbers: dict[tuple[str, int], int] = {}
    instants, gospas_m = [], []
    followed: list[Followed] = []
    held = _held(moments, name)
    not_told, told = 0, 0
    for at, moment in enumerate(moments):
        counted = [one for one in moment.present if one.life is not None]
        apart = {one.name for one in moment.present if one.life is None}
        by_name = {one.name: one for one in counted}
        kept = []
        for track, follows in moment.tracks[name]:
            if follows is not None and follows[2] is not None:
                told += track.ghost == "yes"
                not_told += track.ghost != "yes"
            elif follows not in apart:
                kept.append(track)
                whom = held.get((at, track.track), follows)
                if whom is not None and track.ghost != "yes":
                    followed.append(Followed(track, whom[0], by_name[whom].position_body_m))
        # What calls itself a mirror image, and is none, is like nobody.
        real = np.array([track.ghost != "yes" for track in kept], dtype=bool)
        apart_m = np.where(real[None, :], _apart_m(counted, kept), np.inf)
        who = [lives.setdefault((moment.robot, one.name, one.life or 0), len(lives)) for one in counted]
        which = [numbers.setdefault((moment.robot, one.track), len(numbers)) for one in kept]
        instants.append(
            Instant(
                np.array(who, dtype=np.int64),
                np.array(which, dtype=np.int64),
                np.maximum(0.0, 1.0 - apart_m / REACH_M),
            )
        )
        gospas_m.append(gospa_m(apart_m))
    scores = track_scores(instants)
    return {
        "track_sets": len(moments),
        "track_sources": len(lives),
        "tracks": len(numbers),
        "track_hota": _or_none(scores.hota),
        "track_detection_accuracy": _or_none(scores.detection_accuracy),
        "track_association_accuracy": _or_none(scores.association_accuracy),
        "track_idf1": _or_none(scores.idf1),
        "track_mota": _or_none(scores.mota),
        "track_switches": scores.switches,
        "track_fragments": scores.fragments,
        "track_misses": scores.misses,
        "track_false_alarms_per_set": scores.false_alarms / len(moments) if moments else None,
        "track_gospa_m": _or_none(float(np.mean(gospas_m)) if gospas_m else math.nan),
        **error_numbers(followed, ways),
        "track_ghosts_told": told,
        "track_ghosts_not_told": not_told,
    }


def _held(moments: Sequence[Moment], name: str) -> dict[tuple[int, int], SourceName]:
    """Return whom tracks are on the way of that are too far off to follow anybody, by moment and track.

    That is whom a track followed the last time before and the first time after, if nobody else follows them
    now. Errors without these would be none above `REACH_M`, and σ that claim too little would look true.
    """
    ways: dict[tuple[str, int], list[tuple[int, SourceName | None]]] = {}
    for at, moment in enumerate(moments):
        for track, follows in moment.tracks[name]:
            ways.setdefault((moment.robot, track.track), []).append((at, follows))
    held = {}
    for (_, number), way in ways.items():
        known = [k for k, (_, follows) in enumerate(way) if follows is not None]
        for before, after in pairwise(known):
            whom = way[before][1]
            if whom is None or whom != way[after][1]:
                continue
            for at, _ in way[before + 1 : after]:
                counts = any(one.name == whom and one.life is not None for one in moments[at].present)
                if counts and all(follows != whom for _, follows in moments[at].tracks[name]):
                    held[at, number] = whom
    return held


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else value
