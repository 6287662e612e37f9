"""What a stack says of who is where over time, track by track, against truth.

A source counts while it is countable (`match`) and through gaps of up to a second: it was dark, or hidden.
One that was gone for longer counts as a new one when it comes back, as no track can know better. Tracks of
what does not count at the time (gone, mirror images, not seen yet) are neither hits nor false alarms.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from nir_render.evaluate.match import countable
from nir_render.evaluate.sets import position_body_m
from nir_render.evaluate.track_metrics import Instant, gospa_m, track_scores
from nir_render.truth.sources import SourceTruth
from perception.types import Calibration, FrameKey, Track

Values = NDArray[np.float64]

LONGEST_GAP_S = 1.0
"""A source that does not count for longer is a new one afterwards."""

REACH_M = 1.0
"""Similarity of a track and a source falls from 1 to 0 at this distance."""

_COASTING_S = 2.0
"""So long after a source was last in an image tracks of it are no false alarms."""

SourceName = tuple[str, str, str | None]
"""Robot, source, and `robot.source` of whom a mirror image shows."""


@dataclass(frozen=True, eq=False)
class Present:
    """One source, or mirror image, at one instant.

    `life` numbers its appearances: it is None where it does not count; `lit` is its share of the exposure.
    """

    name: SourceName
    position_body_m: Values
    life: int | None
    lit: float


@dataclass(frozen=True, eq=False)
class Moment:
    """One instant of one observer: who is there, and each estimator's tracks, each with whom it follows."""

    robot: str
    time_s: float
    present: tuple[Present, ...]
    tracks: Mapping[str, tuple[tuple[Track, SourceName | None], ...]]


@dataclass(frozen=True, eq=False)
class TrackEvaluation:
    """All instants, in the order of time, and each estimator's numbers in `summary.json`."""

    moments: tuple[Moment, ...]
    summary: Mapping[str, Mapping[str, Any]]


def evaluate_tracks(
    sets: Sequence[tuple[str, float, Sequence[FrameKey]]],
    truth: Iterable[SourceTruth],
    calibrations: Mapping[str, Calibration],
    tracks: Mapping[str, Sequence[Track]],
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
    """
    present = _present(sets, truth, calibrations)
    said = {name: _by_time(found) for name, found in tracks.items()}
    moments = []
    for (robot, time_s, _), there in zip(sets, present, strict=True):
        followed = {
            name: _followed(there, by_time.get((robot, _tick(time_s)), [])) for name, by_time in said.items()
        }
        moments.append(Moment(robot, time_s, there, followed))
    return TrackEvaluation(tuple(moments), {name: _numbers(moments, name) for name in tracks})


def _tick(time_s: float) -> int:
    """Return a time in whole microseconds: as written and as reckoned they may differ."""
    return round(time_s * 1e6)


def _by_time(tracks: Iterable[Track]) -> dict[tuple[str, int], list[Track]]:
    sorted_in: dict[tuple[str, int], list[Track]] = defaultdict(list)
    for track in tracks:
        sorted_in[track.robot, _tick(track.time_s)].append(track)
    return sorted_in


@dataclass
class _Row:
    """A source in the frames of one set."""

    places_m: list[Values]
    counts: bool
    lit: float


def _present(
    sets: Sequence[tuple[str, float, Sequence[FrameKey]]],
    truth: Iterable[SourceTruth],
    calibrations: Mapping[str, Calibration],
) -> list[tuple[Present, ...]]:
    """Return who is there in each set, with the numbers of their lives."""
    of_frame = {key: number for number, (_, _, keys) in enumerate(sets) for key in keys}
    rows: dict[tuple[str, SourceName], dict[int, _Row]] = defaultdict(dict)
    for row in truth:
        number = of_frame[row.camera, row.index]
        name = (row.robot, row.source, row.ghost_of)
        own = rows[sets[number][0], name].setdefault(number, _Row([], counts=False, lit=0.0))
        own.places_m.append(position_body_m(row, calibrations[row.camera]))
        own.counts |= countable(row, calibrations[row.camera])
        own.lit = max(own.lit, row.on_fraction)
    by_robot: dict[str, list[int]] = defaultdict(list)
    for number, (robot, _, _) in enumerate(sets):
        by_robot[robot].append(number)
    present: list[list[Present]] = [[] for _ in sets]
    for (robot, name), own_rows in rows.items():
        times_s = {number: sets[number][1] for number in by_robot[robot]}
        for number, one in _lives(name, own_rows, times_s):
            present[number].append(one)
    return [tuple(there) for there in present]


def _lives(
    name: SourceName, rows: Mapping[int, _Row], times_s: Mapping[int, float]
) -> Iterable[tuple[int, Present]]:
    """Yield a source in the sets of its observer: in images, and for a while after it has left them."""
    counting = [number for number in times_s if number in rows and rows[number].counts]
    life_of: dict[int, int] = {}
    life = 0
    for k, number in enumerate(counting):
        before = counting[k - 1] if k else None
        if before is not None:
            if times_s[number] - times_s[before] > LONGEST_GAP_S:
                life += 1
            else:
                gap = (other for other in times_s if times_s[before] < times_s[other] < times_s[number])
                life_of |= dict.fromkeys(gap, life)
        life_of[number] = life
    last: list[tuple[float, Values]] = []
    for number, time_s in times_s.items():
        if number in rows:
            place_m = np.mean(rows[number].places_m, axis=0)
            last = [*last[-1:], (time_s, place_m)]
            yield number, Present(name, place_m, life_of.get(number), rows[number].lit)
        elif last and time_s - last[-1][0] <= _COASTING_S:
            (first_s, first_m), (then_s, then_m) = last[0], last[-1]
            pace = (then_m - first_m) / (then_s - first_s) if then_s > first_s else np.zeros(3)
            yield number, Present(name, then_m + pace * (time_s - then_s), None, 0.0)


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


def _numbers(moments: Sequence[Moment], name: str) -> dict[str, Any]:
    """Return an estimator's numbers; those of several observers are taken together."""
    lives: dict[tuple[str, SourceName, int], int] = {}
    numbers: dict[tuple[str, int], int] = {}
    instants, gospas_m = [], []
    errors: list[tuple[Values, Values, Values]] = []
    not_told, told = 0, 0
    for moment in moments:
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
                if follows is not None and track.ghost != "yes":
                    there_m = by_name[follows].position_body_m
                    errors.append((track.position_body_m - there_m, track.covariance[:3, :3], there_m))
        # What calls itself a mirror image, and is none, is like nobody.
        real = np.array([track.ghost != "yes" for track in kept], dtype=bool)
        apart_m = np.where(real[None, :], _apart_m(counted, kept), np.inf)
        instants.append(
            Instant(
                np.array(
                    [
                        lives.setdefault((moment.robot, one.name, one.life or 0), len(lives))
                        for one in counted
                    ],
                    dtype=np.int64,
                ),
                np.array(
                    [numbers.setdefault((moment.robot, one.track), len(numbers)) for one in kept],
                    dtype=np.int64,
                ),
                np.maximum(0.0, 1.0 - apart_m / REACH_M),
            )
        )
        gospas_m.append(gospa_m(apart_m))
    scores = track_scores(instants)
    return {
        "track_sources": len(lives),
        "tracks": len(numbers),
        "track_hota": _or_none(scores.hota),
        "track_detection_accuracy": _or_none(scores.detection_accuracy),
        "track_association_accuracy": _or_none(scores.association_accuracy),
        "track_idf1": _or_none(scores.idf1),
        "track_mota": _or_none(scores.mota),
        "track_switches": scores.switches,
        "track_fragments": scores.fragments,
        "track_false_alarms_per_set": scores.false_alarms / len(moments) if moments else None,
        "track_gospa_m": _or_none(float(np.mean(gospas_m)) if gospas_m else math.nan),
        **_error_numbers(errors),
        "track_ghosts_told": told,
        "track_ghosts_not_told": not_told,
    }


def _error_numbers(errors: Sequence[tuple[Values, Values, Values]]) -> dict[str, float | None]:
    off_m = np.array([error for error, _, _ in errors]).reshape(-1, 3)
    there_m = np.array([place for _, _, place in errors]).reshape(-1, 3)
    range_m = np.linalg.norm(there_m, axis=1)
    along_m = (off_m * there_m).sum(axis=1) / range_m
    across = np.sqrt(np.maximum((off_m**2).sum(axis=1) - along_m**2, 0.0)) / range_m
    pulls = [float(error @ np.linalg.solve(of, error)) / 3.0 for error, of, _ in errors if _sound(of)]
    return {
        "track_position_rmse_m": _rms(np.linalg.norm(off_m, axis=1)),
        "track_range_rmse_m": _rms(along_m),
        "track_bearing_rms_deg": _rms(np.degrees(across)),
        "track_nees": float(np.mean(pulls)) if pulls else None,
    }


def _sound(covariance: Values) -> bool:
    return bool(np.isfinite(covariance).all() and np.linalg.det(covariance) > 0.0)


def _rms(values: Values) -> float | None:
    return math.sqrt(float(np.mean(values**2))) if values.size else None


def _or_none(value: float) -> float | None:
    return None if math.isnan(value) else value
