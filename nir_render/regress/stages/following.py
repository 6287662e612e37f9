"""Tracks and messages against their reference, from the reference's own frames, detections and odometry.

Numbers are names, and may be others: tracks are the same where one-to-one renaming makes them so, throughout
the sequence. Nothing is drawn and nothing iterated to a tolerance in between: it is float64 arithmetic.
"""

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from nir_render.regress.findings import Finding
from nir_render.regress.following import ByRobot, Followed
from perception import Message, Track, message_record, track_record

_ROUNDING = 1e-6
"""Of σ, of seconds, of a probability: other instructions (no AVX2, no FMA) moved tracks by 1e-13 σ."""

_Key = tuple[str, float]


@dataclass(frozen=True)
class _Number:
    """A track by its observer and number."""

    robot: str
    track: int


def compare_odometry(before: ByRobot, after: ByRobot, *, exact: bool) -> Finding:
    """Compare what robots know of their own way with what they knew."""
    worst, seen, same = 0.0, "equal", True
    if set(before) != set(after) or any(len(before[name]) != len(after[name]) for name in before):
        return Finding("camera", "odometry", "fail", "records are others in number", same_bits=False)
    for name, records in before.items():
        for one, other in zip(records, after[name], strict=True):
            pairs = [(getattr(one, key), getattr(other, key)) for key in vars(one) if key != "robot"]
            off = float(np.max([np.max(np.abs(np.subtract(new, old))) for old, new in pairs]))
            same = same and off == 0.0
            if not off <= worst:  # NaN too
                worst, seen = off, f"{name} at {one.time_s:g} s: {off:.3g} in SI units"
    return Finding(
        "camera",
        "odometry",
        "fail" if not worst <= _ROUNDING or (exact and not same) else "pass",
        seen,
        f"{_ROUNDING:.0e} in SI units",
        same_bits=same,
    )


def compare_followed(name: str, before: Followed, after: Followed, *, exact: bool) -> list[Finding]:
    """Compare tracks and messages that go with an estimator with what they were."""
    same = [
        _lines(before.tracks, track_record) == _lines(after.tracks, track_record),
        _lines(before.messages, message_record) == _lines(after.messages, message_record),
    ]
    problem, renamed = _tracks(before.tracks, after.tracks)
    said = "" if problem else _messages(before.messages, after.messages, renamed)
    allowed = f"{_ROUNDING:.0e} of σ; numbers may be others, one for one"
    return [
        _finding(f"tracks of {name}", problem, len(_numbers(after.tracks)), "track", allowed, same[0], exact),
        _finding(
            f"messages of {name}",
            said,
            len(after.messages),
            "message",
            f"word and track; {_ROUNDING:.0e} s, {_ROUNDING:.0e} of confidence",
            same[1],
            exact,
        ),
    ]


def _finding(
    what: str, problem: str, count: int, unit: str, allowed: str, same: bool, exact: bool
) -> Finding:
    number = f"{count} {unit}{'' if count == 1 else 's'}"
    fails = bool(problem) or (exact and not same)
    seen = problem or f"{number}, {'equal' if same else 'the same'}"
    return Finding("perception", what, "fail" if fails else "pass", seen, allowed, same_bits=same)


def _lines(found: Iterable[Any], record: Callable[[Any], Mapping[str, Any]]) -> list[str]:
    """Return what files hold of it: the same where all bits are."""
    return [json.dumps(record(one)) for one in found]


def _numbers(tracks: Sequence[Track]) -> set[_Number]:
    return {_Number(one.robot, one.track) for one in tracks}


def _tracks(before: Sequence[Track], after: Sequence[Track]) -> tuple[str, dict[_Number, int]]:
    """Return what is unlike, or nothing; and by which number each track goes now."""
    renamed: dict[_Number, int] = {}
    was: dict[_Number, int] = {}
    old, new = _by_set(before), _by_set(after)
    if old.keys() != new.keys():
        key = min(old.keys() ^ new.keys(), key=lambda each: each[1])
        return f"{key[0]} at {key[1]:g} s: tracks {'are gone' if key in old else 'are new'}", renamed
    for (robot, time_s), olds in old.items():
        news, where = new[robot, time_s], f"{robot} at {time_s:g} s"
        if len(olds) != len(news):
            return f"{where}: {len(olds)} → {len(news)} tracks", renamed
        for one, other in _assigned(olds, news, renamed):
            number = _Number(robot, one.track)
            if renamed.setdefault(number, other.track) != other.track:
                return f"{where}: track {one.track} goes on as another one", renamed
            if was.setdefault(_Number(robot, other.track), one.track) != one.track:
                return f"{where}: two tracks have become one", renamed
            if said := _unlike(one, other):
                return f"{where}: track {one.track}: {said}", renamed
    return "", renamed


def _by_set(tracks: Sequence[Track]) -> dict[_Key, list[Track]]:
    sets: dict[_Key, list[Track]] = defaultdict(list)
    for one in tracks:
        sets[one.robot, one.time_s].append(one)
    return sets


def _assigned(
    olds: Sequence[Track], news: Sequence[Track], renamed: Mapping[_Number, int]
) -> list[tuple[Track, Track]]:
    """Return pairs of tracks of one set: by the numbers that are known, else those whose places fit best."""
    by_number = {one.track: one for one in news}
    known = [
        (one, by_number[number])
        for one in olds
        if (number := renamed.get(_Number(one.robot, one.track))) in by_number
    ]
    rest = [one for one in olds if one not in [pair[0] for pair in known]]
    free = [one for one in news if one not in [pair[1] for pair in known]]
    if not rest:
        return known
    off = np.array([[np.linalg.norm(_state(one) - _state(other)) for other in free] for one in rest])
    rows, columns = linear_sum_assignment(off)
    return known + [(rest[row], free[column]) for row, column in zip(rows, columns, strict=True)]


def _state(track: Track) -> NDArray[np.float64]:
    return np.concatenate([track.position_body_m, track.velocity_body_m_per_s])


def _unlike(before: Track, after: Track) -> str:
    """Say what differs of a track at one time, or nothing."""
    for field in ("detections", "identity", "ghost"):
        if getattr(before, field) != getattr(after, field):
            return f"{field} {getattr(before, field)} → {getattr(after, field)}"
    if not abs(after.unseen_s - before.unseen_s) <= _ROUNDING:
        return f"unseen_s {before.unseen_s:g} → {after.unseen_s:g}"
    sigma = np.sqrt(np.diag(before.covariance))
    pulls = np.abs(_state(after) - _state(before)) / sigma
    if not np.max(pulls) <= _ROUNDING:
        place = int(np.argmax(pulls))
        what = ("x", "y", "z", "speed along x", "speed along y", "speed along z")[place]
        return f"{what} moved by {pulls[place]:.3g} σ"
    off = np.max(np.abs(after.covariance - before.covariance) / np.outer(sigma, sigma))
    return "" if off <= _ROUNDING else f"covariance differs by {off:.3g} of σ²"


def _messages(before: Sequence[Message], after: Sequence[Message], renamed: Mapping[_Number, int]) -> str:
    """Say what is unlike, or nothing; tracks may go by other numbers."""
    if len(before) != len(after):
        return f"{len(before)} → {len(after)} messages"
    olds = [(_order(one, renamed.get(_Number(one.robot, one.track), one.track)), one) for one in before]
    news = [(_order(one, one.track), one) for one in after]
    pairs = zip(sorted(olds, key=itemgetter(0)), sorted(news, key=itemgetter(0)), strict=True)
    for (_, one), (_, other) in pairs:
        where = f"{one.robot}, track {one.track}, {one.start_s:.2f} s"
        if one.word != other.word:
            return f"{where}: word {one.word} → {other.word}"
        numbers = [(one.track, other.track), (one.ambiguous_with, other.ambiguous_with)]
        for old, new in numbers:
            if (None if old is None else renamed.get(_Number(one.robot, old), old)) != new:
                return f"{where}: said by track {other.track}"
        for field in ("command", "frames", "identity"):
            if getattr(one, field) != getattr(other, field):
                return f"{where}: {field} {getattr(one, field)} → {getattr(other, field)}"
        for field in ("start_s", "end_s", "confidence"):
            off = getattr(other, field) - getattr(one, field)
            if not abs(off) <= _ROUNDING:
                return f"{where}: {field} moved by {off:.3g}"
    return ""


def _order(message: Message, track: int) -> tuple[str, int, float, int]:
    return message.robot, track, message.start_s, message.word
