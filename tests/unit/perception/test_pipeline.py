"""The whole stack on frames made by brute force: who is where, and who says what."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from perception import Heard, Message, Odometry, Pipeline, RawFrame
from perception.messages.uart import encode
from tests.unit.perception.stage import CAMERAS, EXPOSURE_S, RATE_HZ, frame_of

Array = NDArray[np.float64]

WORDS = {"near": 8, "far": 65}
START_S = {"near": 1.23, "far": 1.71}


def _place_m(who: str, time_s: float) -> Array:
    """Two that pass each other, more than a metre apart in depth, while both send."""
    if who == "near":
        return np.array([2.0 + 0.05 * time_s, -0.6 + 0.12 * time_s, 0.1])
    return np.array([4.0, 1.2 - 0.2 * time_s, 0.3])


def _lit(who: str, time_s: float) -> bool:
    bit = int(np.floor((time_s - START_S[who]) * 10.0))
    bits = encode(WORDS[who])
    return not 0 <= bit < len(bits) or bool(bits[bit])


def _frame(index: int, turned_rad: float = 0.0, empty: bool = False) -> RawFrame:
    """Return a frame of an observer that has turned to the left by an angle."""
    middle_s = index / RATE_HZ + 0.5 * EXPOSURE_S
    cosine, sine = np.cos(turned_rad), np.sin(turned_rad)
    turn = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    return frame_of(
        index, [turn @ _place_m(who, middle_s) for who in WORDS if _lit(who, middle_s) and not empty]
    )


@pytest.fixture(scope="module")
def frames() -> list[RawFrame]:
    """Eight and a half seconds; every twentieth frame was dropped."""
    return [_frame(index) for index in range(255) if index % 20 != 7]


def _heard(frames: Sequence[RawFrame]) -> tuple[list[Heard], list[Message]]:
    pipeline = Pipeline(CAMERAS)
    heard = [pipeline.push([frame]) for frame in frames]
    return heard, [*(message for one in heard for message in one.messages), *pipeline.finish()]


def test_two_that_cross_are_followed_and_understood(frames: list[RawFrame]) -> None:
    heard, messages = _heard(frames)
    assert {one.track for each in heard for one in each.tracks} == {1, 2}
    near = next(one.track for one in heard[20].tracks if one.position_body_m[0] < 3.0)
    said = {("near" if one.track == near else "far"): one for one in messages}
    assert {who: one.word for who, one in said.items()} == WORDS
    assert len(messages) == 2
    for who, one in said.items():
        assert one.start_s == pytest.approx(START_S[who], abs=0.02)
        assert one.end_s - one.start_s == pytest.approx(5.5, abs=0.05)
        assert one.confidence > 0.999
    pulls, speeds = [], []
    for each in heard[45:]:
        for track in each.tracks:
            who = "near" if track.track == near else "far"
            off_m = track.position_body_m - _place_m(who, each.time_s)
            pulls.append(off_m @ np.linalg.solve(track.covariance[:3, :3], off_m))
            speeds.append(
                track.velocity_body_m_per_s - np.diff([_place_m(who, t) for t in (0.0, 1.0)], axis=0)[0]
            )
    assert 1.0 < np.mean(pulls) < 6.0  # three, but errors last for seconds
    assert np.sqrt(np.mean(np.square(speeds))) < 0.06


def test_dark_samples_are_dark_and_lit_ones_lit(frames: list[RawFrame]) -> None:
    pipeline = Pipeline(CAMERAS, keep_signals=True)
    for frame in frames:
        pipeline.push([frame])
    signals = pipeline.signals()
    assert len(signals) == 2
    for signal in signals:
        lit = signal.level > 0.5
        assert np.abs(signal.level[lit] - 1.0).max() < 0.15
        assert np.abs(signal.level[~lit]).max() < 0.1
        assert len(signal.time_s) > 0.9 * len(frames)


def test_an_observer_that_turns_knows_it_by_its_odometry() -> None:
    turning = 0.3
    pipeline, numbers, off_m = Pipeline(CAMERAS), set(), []
    for index in range(60):
        yaw = turning * index / RATE_HZ - 0.3
        at = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        pose = Odometry("r1", index / RATE_HZ, np.zeros(3), at)
        later = replace(pose, time_s=pose.time_s + 1e-3)
        for one in pipeline.push([_frame(index, yaw)], [pose, later]).tracks:
            numbers.add(one.track)
            there = min(
                (at.T @ _place_m(who, index / RATE_HZ) for who in WORDS),
                key=lambda place: np.linalg.norm(place - one.position_body_m),
            )
            off_m.append(np.linalg.norm(one.position_body_m - there))
    assert numbers == {1, 2}
    assert np.max(off_m[20:]) < 0.05


def test_a_frame_that_comes_late_and_an_empty_second_break_nothing(frames: list[RawFrame]) -> None:
    pipeline = Pipeline(CAMERAS)
    for frame in frames[:30]:
        pipeline.push([frame])
    assert len(pipeline.push([frames[20]]).tracks) == 2
    for index in range(33, 60):
        tracks = pipeline.push([_frame(index, empty=True)]).tracks
    assert len(tracks) == 2
    assert all(one.unseen_s > 0.8 for one in tracks)
    assert pipeline.signals() == ()  # who does not ask for them needs no memory for them


def test_frames_of_two_robots_are_refused(frames: list[RawFrame]) -> None:
    pipeline = Pipeline(CAMERAS)
    with pytest.raises(ValueError, match="none"):
        pipeline.push([])
    pipeline.push(frames[:1])
    with pytest.raises(ValueError, match="one robot"):
        pipeline.follow([replace(frames[1], camera="r2.front")], [[]])


def test_a_clock_that_is_set_back_begins_anew_and_is_heard() -> None:
    late = [replace(_frame(index), time_s=1000.0 + index / RATE_HZ) for index in range(12)]
    pipeline = Pipeline(CAMERAS, keep_signals=True)
    for frame in late:
        pipeline.push([frame])
    for index in range(12):
        tracks = pipeline.push([_frame(index)]).tracks
    assert {one.track for one in tracks} == {3, 4}
    assert {signal.track: len(signal.time_s) > 5 for signal in pipeline.signals()} == dict.fromkeys(
        (1, 2, 3, 4), True
    )


def test_a_set_that_is_pushed_twice_is_evidence_once() -> None:
    once, twice = Pipeline(CAMERAS), Pipeline(CAMERAS)
    for index in range(12):
        frame = _frame(index)
        (first, second) = (pipeline.push([frame]) for pipeline in (once, twice))
        again = twice.push([frame])
        assert again.messages == ()
        assert [track.track for track in again.tracks] == [track.track for track in first.tracks]
    for one, other in zip(first.tracks, second.tracks, strict=True):
        np.testing.assert_array_equal(one.covariance, other.covariance)
