"""Tracks and messages are judged from the reference's own detections; numbers are names."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from nir_render.regress.following import Followed, followed_of
from nir_render.regress.stages.following import compare_followed, compare_odometry
from perception import Calibration, Detection, Message, Odometry, RawFrame, Track, detect
from perception.track import Tracker
from perception.track.settings import TrackerSettings
from tests.unit.perception.stage import CAMERA, frame_of

_COVARIANCE = np.diag([1e-4, 1e-4, 4e-4, 0.01, 0.01, 0.01])


def _track(number: int, index: int, **fields: object) -> Track:
    values: dict[str, object] = {
        "robot": "r1", "time_s": 0.1 * index, "track": number,
        "position_body_m": np.array([2.0, 0.5 * number - 1.0 + 0.01 * index, 0.1]),
        "velocity_body_m_per_s": np.array([0.0, 0.1, 0.0]), "covariance": _COVARIANCE,
        "detections": (("r1.front", index, number - 1),),
    }  # fmt: skip
    return Track(**(values | fields))  # type: ignore[arg-type]


WORD = Message("r1", 2, 1.25, 6.75, 11, "recover", 0.9999, 5, ambiguous_with=1)
BEFORE = Followed(tuple(_track(number, index) for index in range(4) for number in (1, 2)), (WORD,))

Change = Callable[[Track], Track]


def _changed(change: Change, message: Message = WORD) -> Followed:
    return Followed(tuple(change(one) for one in BEFORE.tracks), (message,))


def _at(index: int, number: int, **fields: object) -> Change:
    def change(one: Track) -> Track:
        there = (one.track, round(10.0 * one.time_s)) == (number, index)
        return replace(one, **fields) if there else one  # type: ignore[arg-type]

    return change


def test_the_same_is_the_same_and_other_numbers_are_too() -> None:
    for finding in compare_followed("robust", BEFORE, BEFORE, exact=True):
        assert (finding.verdict, finding.same_bits) == ("pass", True)
    swapped = _changed(
        lambda one: replace(one, track=3 - one.track), replace(WORD, track=1, ambiguous_with=2)
    )
    swapped = replace(swapped, tracks=swapped.tracks[::-1])
    for finding in compare_followed("robust", BEFORE, swapped, exact=False):
        assert (finding.verdict, finding.same_bits) == ("pass", False)
    assert [one.verdict for one in compare_followed("robust", BEFORE, swapped, exact=True)] == ["fail"] * 2


def test_two_that_follow_each_other_are_not_one() -> None:
    """Track 1 ends, track 2 begins; as one track under a third number it is a drift, and the reverse too."""
    early, late = (_track(1, index) for index in (0, 1)), (_track(2, index) for index in (2, 3))
    apart = Followed((*early, *late), ())
    one = Followed(tuple(replace(each, track=7) for each in apart.tracks), ())
    for before, after, said in (
        (apart, one, "two tracks have become one"),
        (one, apart, "goes on as another"),
    ):
        (tracks, messages) = compare_followed("robust", before, after, exact=False)
        assert tracks.verdict == "fail"
        assert said in tracks.seen
        assert messages.verdict == "pass"


def test_two_may_say_one_word_at_once_under_other_numbers() -> None:
    words = tuple(replace(WORD, track=track, ambiguous_with=None) for track in (1, 2))
    later = replace(words[1], start_s=1.2500004)
    before = Followed(BEFORE.tracks, (words[0], later))
    after = Followed(
        tuple(replace(one, track=3 - one.track) for one in BEFORE.tracks),
        (replace(words[0], track=2), replace(later, track=1)),
    )
    assert [one.verdict for one in compare_followed("robust", before, after, exact=False)] == ["pass"] * 2


@pytest.mark.parametrize(
    ("change", "said"),
    [
        # 1 cm is σ of x: a hundred-thousandth of it.
        (_at(2, 2, position_body_m=np.array([2.0 + 1e-7, 0.02, 0.1])), "r1 at 0.2 s: track 2: x moved by 1e-05 σ"),
        (_at(1, 1, covariance=1.01 * _COVARIANCE), "track 1: covariance differs by 0.01 of σ²"),
        (_at(1, 1, covariance=1.0001 * _COVARIANCE), "covariance differs by 0.0001 of σ²"),
        (_at(3, 1, unseen_s=0.1, detections=()), "detections (('r1.front', 3, 0),) → ()"),
        (_at(3, 2, identity="r2"), "identity None → r2"),
        (_at(3, 2, ghost="yes"), "ghost no → yes"),
        # From 0.2 s on they have changed numbers.
        (lambda one: replace(one, track=3 - one.track) if one.time_s > 0.15 else one, "r1 at 0.2 s: track 1: "),
    ],
)  # fmt: skip
def test_tracks_that_are_others_are_found(change: Change, said: str) -> None:
    tracks, _ = compare_followed("robust", BEFORE, _changed(change), exact=False)
    assert tracks.verdict == "fail"
    assert said in tracks.seen


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"word": 10}, "word 11 → 10"),
        ({"track": 1}, "said by track 1"),
        ({"start_s": 1.25001}, "start_s moved by 1e-05"),
        ({"confidence": 0.9998}, "confidence moved by -0.0001"),
        ({"frames": 4}, "frames 5 → 4"),
        ({"ambiguous_with": None}, "said by track 2"),
    ],
)
def test_messages_that_are_others_are_found(change: dict[str, object], said: str) -> None:
    after = replace(BEFORE, messages=(replace(WORD, **change),))  # type: ignore[arg-type]
    tracks, messages = compare_followed("robust", BEFORE, after, exact=False)
    assert (tracks.verdict, messages.verdict) == ("pass", "fail")
    assert said in messages.seen
    _, gone = compare_followed("robust", BEFORE, replace(BEFORE, messages=()), exact=False)
    assert gone.seen == "1 → 0 messages"


def test_tracks_that_begin_or_end_otherwise_are_found() -> None:
    fewer = replace(BEFORE, tracks=BEFORE.tracks[:-1])
    assert compare_followed("robust", BEFORE, fewer, exact=False)[0].seen == "r1 at 0.3 s: 2 → 1 tracks"
    none = replace(BEFORE, tracks=BEFORE.tracks[:-2])
    assert compare_followed("robust", BEFORE, none, exact=False)[0].seen == "r1 at 0.3 s: tracks are gone"
    assert compare_followed("robust", none, BEFORE, exact=False)[0].seen == "r1 at 0.3 s: tracks are new"


def test_odometry_that_is_another_is_found() -> None:
    before = {"r1": (Odometry("r1", 0.1, np.zeros(3), np.eye(3), 0.01),)}
    assert compare_odometry(before, before, exact=True).same_bits
    moved = {"r1": (replace(before["r1"][0], position_m=np.array([0.0, 1e-5, 0.0])),)}
    assert compare_odometry(before, moved, exact=False).seen == "r1 at 0.1 s: 1e-05 in SI units"
    assert compare_odometry(before, moved, exact=False).verdict == "fail"
    assert compare_odometry(before, {}, exact=False).verdict == "fail"


def test_one_percent_of_the_trackers_noise_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twelve frames of one that drives by, followed as it comes, and by a tracker that expects 1 % more acceleration."""
    calibrations: dict[str, Calibration] = {CAMERA.camera: CAMERA}
    frames: list[RawFrame] = []
    hits: list[Detection] = []
    for index in range(12):
        frame = frame_of(index, [np.array([2.0, -0.4 + 0.02 * index, 0.1])])
        frames.append(frame)
        hits += detect(frame, CAMERA)
    before = followed_of("robust", frames, calibrations, hits, {})
    assert len({one.track for one in before.tracks}) == 1
    again, _ = compare_followed(
        "robust", before, followed_of("robust", frames, calibrations, hits, {}), exact=True
    )
    assert (again.verdict, again.same_bits) == ("pass", True)

    more = TrackerSettings(acceleration_psd_m2_per_s3=1.01 * TrackerSettings().acceleration_psd_m2_per_s3)
    monkeypatch.setattr("perception.pipeline.Tracker", lambda _: Tracker(more))
    drifted, _ = compare_followed(
        "robust", before, followed_of("robust", frames, calibrations, hits, {}), exact=False
    )
    assert drifted.verdict == "fail"
    assert "σ" in drifted.seen
