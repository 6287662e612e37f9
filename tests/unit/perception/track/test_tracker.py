"""The tracker on simulated sets: who is who through darkness, crossings, merged lights, clutter; odd streams."""

import dataclasses
import math

import numpy as np
import pytest

from perception.track import Tracker, TrackerSettings
from perception.types import Measurement, Odometry, Track
from tests.unit.perception.simulation import random
from tests.unit.perception.track.world import (
    COMMON,
    MOVING,
    TURNING,
    Observer,
    Robot,
    blinking,
    bounce,
    clutter,
    covered,
    crossing,
    dark_crossing,
    matched,
    measurement,
    occlusion,
    relative_noise,
    run,
    sets,
    straight,
    swarm,
    switches,
    turn,
)  # fmt: skip

RUNS = {
    "crossing": (crossing(), MOVING),
    "dark_crossing": (dark_crossing(), MOVING),
    "bounce through": (bounce(back=False), TURNING),
    "bounce back": (bounce(back=True), TURNING),
    "occlusion": (occlusion(), MOVING),
}


SLOW_100 = [
    pytest.param(name, 100.0, marks=[] if name == "crossing" else pytest.mark.verify) for name in RUNS
]


@pytest.mark.parametrize(("name", "fps"), [*((name, 30.0) for name in RUNS), *SLOW_100])
def test_nobody_takes_anothers_number(name: str, fps: float) -> None:
    robots, observer = RUNS[name]
    simulated = sets(robots, 10.0, fps, 1, observer)
    out = run(simulated)
    assert switches(simulated, out) == 0
    assert covered(simulated, out, 1.0) == 1.0
    assert {track.track for tracks in out for track in tracks} == set(range(1, len(robots) + 1))


@pytest.mark.verify
@pytest.mark.parametrize("name", RUNS)
@pytest.mark.parametrize("key", range(2, 7))
def test_nobody_takes_anothers_number_again(name: str, key: int) -> None:
    robots, observer = RUNS[name]
    simulated = sets(robots, 10.0, 30.0, key, observer, dropped=0.05, jitter_s=1e-3)
    assert switches(simulated, run(simulated)) == 0


def test_swarm_of_30() -> None:
    simulated = sets(swarm(30, 12), 10.0, 30.0, 1, MOVING)
    out = run(simulated)
    assert switches(simulated, out) == 0
    assert covered(simulated, out, 1.0) == 1.0
    assert max(len(tracks) for tracks in out) == 30


@pytest.mark.parametrize(("robots", "false"), [(5, 200), (20, 200)])
def test_tracks_among_false_detections(robots: int, false: int) -> None:
    simulated = sets(swarm(robots, 9), 3.0, 30.0, 1, MOVING, false)
    out = run(simulated)
    assert len({track.track for tracks in out for track in tracks}) <= 1.1 * robots
    assert covered(simulated, out, 1.0) > 0.99
    assert switches(simulated, out) == 0


def test_noise_alone_has_no_tracks() -> None:
    rng = random(1650)
    tracker = Tracker()
    assert not any(tracker.update(k / 30.0, clutter(200, k / 30.0, rng)) for k in range(45))


def test_born_within_a_second_of_blinking() -> None:
    # Zeros but for the start of each bit group: the darkest word, parity 0: one light bit pair in eleven.
    simulated = sets(
        [Robot(straight([3.0, 1.0, 0.0], [0.1, 0.0, 0.0]), blinking([0] * 9 + [1, 1]))], 3.0, 30.0, 3
    )
    out = run(simulated)
    first_s = next(one.time_s for one, tracks in zip(simulated, out, strict=True) if tracks)
    lit_s = next(one.time_s for one in simulated if one.measurements)
    assert first_s - lit_s <= 0.1
    assert switches(simulated, out) == 0
    assert {track.track for tracks in out for track in tracks} == {1}


def test_a_track_outlives_the_longest_dark_run_and_no_more() -> None:
    def lit(time_s: float) -> float:
        return float(time_s < 1.0 or time_s >= 1.96)

    for back, expected in ((lit, {1}), (lambda t: float(t < 1.0 or t >= 2.5), {1, 2})):
        simulated = sets([Robot(straight([3.0, 1.0, 0.0], [0.1, 0.1, 0.0]), back)], 4.0, 30.0, 4)
        out = run(simulated)
        assert {track.track for tracks in out for track in tracks} == expected
        life_s = max(track.unseen_s for tracks in out for track in tracks)
        assert life_s <= TrackerSettings().life_s


# --- consistency with shared errors ---


def test_nees_with_a_wrong_range_constant_and_unlike_robots() -> None:
    # Range by flux: K off by 2 % (of range), each robot's flux by up to ±5 %: 2.5 % of range.
    rng = random(1651)
    claim = math.hypot(0.02, 0.025)
    nees: list[float] = []
    naive: list[float] = []
    robots = crossing()
    for k in range(20):
        robot = robots[k % 2]
        factor = 1.02 * (1.0 + rng.uniform(-0.05, 0.05)) ** -0.5
        for claimed, errors in ((claim, nees), (1e-4, naive)):
            tracker = Tracker(TrackerSettings(acceleration_psd_m2_per_s3=1e-4))
            last: tuple[Track, ...] = ()
            for n in range(45):
                time_s = n / 30.0
                place = robot.path(time_s)
                seen = measurement(place, time_s, rng, common=factor - 1.0, claimed_common=claimed)
                last = tracker.update(time_s, [seen])
            truth = np.concatenate([place, (robot.path(1.0) - robot.path(0.0))])
            error = np.concatenate([last[0].position_body_m, last[0].velocity_body_m_per_s]) - truth
            errors.append(float(error @ np.linalg.solve(last[0].covariance, error)))
    assert np.mean(nees) <= 1.3 * 6.0
    assert np.mean(naive) > 20.0


def test_the_shared_error_is_never_averaged_away() -> None:
    rng = random(1652)
    tracker = Tracker()
    for n in range(300):
        seen = measurement(np.array([3.0, 0.0, 0.0]), n / 30.0, rng, common=0.0)
        tracks = tracker.update(n / 30.0, [seen])
    sigma_m = math.sqrt(tracks[0].covariance[0, 0])
    assert sigma_m == pytest.approx(COMMON * 3.0, rel=0.03)


def test_claims_hold_for_an_observer_that_drives_and_drifts() -> None:
    # One robot is dark for a while; χ² of three in body axes, mean over runs and times.
    observer = dataclasses.replace(MOVING, position_walk=0.01, rotation_walk=5e-3)
    errors = []
    for key in range(6):
        robot = Robot(straight([3.0, 1.0, 0.2], [0.1, -0.2, 0.0]), lambda t: float(not 1.5 < t < 2.0))
        simulated = sets([robot], 3.0, 30.0, 100 + key, observer)
        for one, tracks in zip(simulated, run(simulated), strict=True):
            if one.time_s > 0.5:
                error = tracks[0].position_body_m - one.truth_m[0]
                errors.append(float(error @ np.linalg.solve(tracks[0].covariance[:3, :3], error)))
    # Robots here move evenly, the filter allows for more: it may claim less than it knows, not more.
    assert 0.8 < np.mean(errors) < 3.9


# --- odd streams ---


def _steady(
    tracker: Tracker, begin_s: float, count: int, place: tuple[float, float, float] = (3.0, 0.5, 0.0)
) -> tuple[Track, ...]:
    rng = random(1660, count)
    out: tuple[Track, ...] = ()
    for n in range(count):
        when = begin_s + n / 30.0
        out = tracker.update(when, [measurement(np.array(place), when, rng)])
    return out


def test_a_late_set_changes_nothing() -> None:
    tracker, other = Tracker(), Tracker()
    _steady(tracker, 0.0, 20)
    _steady(other, 0.0, 20)
    late = tracker.update(0.5, [measurement(np.array([1.0, 1.0, 0.0]), 0.5, random(1661))])
    assert [(t.time_s, t.track) for t in late] == [(0.5, 1)]
    one, two = (t.update(0.7, [])[0] for t in (tracker, other))
    np.testing.assert_array_equal(one.position_body_m, two.position_body_m)


def test_a_clock_set_back_ends_all_tracks_and_numbers_go_on() -> None:
    tracker = Tracker()
    _steady(tracker, 100.0, 20)
    assert [t.track for t in _steady(tracker, 5.0, 20)] == [2]


def test_a_clock_that_jumps_ahead_is_a_time_without_light() -> None:
    tracker = Tracker()
    _steady(tracker, 0.0, 20)
    assert [t.track for t in _steady(tracker, 1.6, 5)] == [1]
    assert [t.track for t in _steady(tracker, 100.0, 5)] == [2]


def test_an_empty_second() -> None:
    tracker = Tracker()
    _steady(tracker, 0.0, 20)
    for n in range(30):
        tracks = tracker.update(0.65 + n / 30.0, [])
        assert [(t.track, t.detections) for t in tracks] == [(1, ())]
        assert tracks[0].unseen_s == pytest.approx(0.65 + n / 30.0 - 19 / 30.0)
    assert [t.track for t in _steady(tracker, 1.65, 5)] == [1]


def test_500_false_detections_in_one_set() -> None:
    tracker = Tracker()
    _steady(tracker, 0.0, 20)
    tracks = tracker.update(20 / 30.0, clutter(500, 20 / 30.0, random(1662)))
    assert [t.track for t in tracks] == [1]
    assert [t.track for t in _steady(tracker, 21 / 30.0, 10)] == [1]


def test_times_and_names_that_cannot_be() -> None:
    tracker = Tracker()
    with pytest.raises(ValueError, match="wanted seconds"):
        tracker.update(math.nan, [])
    _steady(tracker, 0.0, 1)
    other = dataclasses.replace(measurement(np.array([1.0, 0.0, 0.0]), 0.1, random(1663)), robot="b")
    with pytest.raises(ValueError, match="a and b"):
        tracker.update(0.1, [other])


def test_predictions_leave_the_tracker_as_it_was() -> None:
    tracker = Tracker()
    rng = random(1664)
    for n in range(30):
        tracker.update(n / 30.0, [measurement(np.array([3.0, 0.5 * n / 30.0, 0.0]), n / 30.0, rng)])
    ahead = tracker.predicted(1.5)[0]
    assert ahead.position_body_m[1] == pytest.approx(0.75, abs=0.05)
    assert ahead.unseen_s == pytest.approx(1.5 - 29 / 30.0)
    again = tracker.predicted(1.5)[0]
    np.testing.assert_array_equal(ahead.covariance, again.covariance)


def test_cameras_that_take_turns_range_as_well_as_one() -> None:
    """Each sees one robot in every second set: no set between makes its light a first one after darkness."""
    rng = random(1666)
    tracker = Tracker()
    for n in range(120):
        when = n / 60.0
        place, camera = (([3.0, 0.0, 0.0], "a.front"), ([-3.0, 0.3 * when, 0.0], "a.back"))[n % 2]
        seen = measurement(np.array(place), when, rng, common=0.0, claimed_common=0.0)
        tracks = tracker.update(when, [dataclasses.replace(seen, cameras=(camera,))])
    assert [track.track for track in tracks] == [1, 2]
    for track in tracks:
        along = track.position_body_m / np.linalg.norm(track.position_body_m)
        assert np.sqrt(along @ track.covariance[:3, :3] @ along) < relative_noise(3.0) * 3.0


@pytest.mark.parametrize("fps", [0.25, 0.5, 2.0])
def test_rare_sets_make_tracks_too(fps: float) -> None:
    rng = random(1667)
    tracker = Tracker()
    for n in range(12):
        tracks = tracker.update(n / fps, [measurement(np.array([3.0, 0.0, 0.0]), n / fps, rng)])
    assert [track.track for track in tracks] == [1]
    assert tracker.update(12 / fps, [])[0].track == 1
    assert tracker.update(12 / fps + 3.0 / fps, []) == ()


# --- ranges that are not known, ghosts, partial light ---


def test_followed_by_bearing_alone() -> None:
    rng = random(1665)
    tracker = Tracker()
    for n in range(60):
        when = n / 30.0
        seen = measurement(np.array([3.0, 0.3 * when, 0.0]), when, rng)
        if n >= 30:
            seen = _without_range(seen)
        tracks = tracker.update(when, [seen])
    assert [t.track for t in tracks] == [1]
    assert tracks[0].unseen_s == 0.0
    assert tracks[0].position_body_m[1] / tracks[0].position_body_m[0] == pytest.approx(
        0.3 * 59 / 30 / 3.0, abs=5e-4
    )


def _without_range(seen: Measurement) -> Measurement:
    covariance = seen.covariance.copy()
    covariance[2, :] = covariance[:, 2] = math.nan
    return dataclasses.replace(seen, range_m=math.nan, covariance=covariance, range_sigma_common_m=math.nan)


def test_born_by_bearing_alone_and_ranged_later() -> None:
    rng = random(1666)
    tracker = Tracker()
    for n in range(40):
        seen = measurement(np.array([2.0, 0.2, 0.0]), n / 30.0, rng, common=0.0)
        tracks = tracker.update(n / 30.0, [_without_range(seen) if n < 20 else seen])
    assert len(tracks) == 1
    assert np.linalg.norm(tracks[0].position_body_m) == pytest.approx(2.01, rel=0.02)


def test_ghosts_are_told_by_all_that_was_seen() -> None:
    rng = random(1667)
    tracker = Tracker()
    labels = []
    for n in range(60):
        doubt = 0.9 if n < 30 else 0.02
        seen = measurement(np.array([2.0, 0.2, 0.0]), n / 30.0, rng, ghost_probability=doubt)
        labels.append([t.ghost for t in tracker.update(n / 30.0, [seen])])
    assert labels[29] == ["yes"]
    assert labels[59] == ["no"]
    # From the ceiling of 6 down to −2 in steps of 1, by way of "possible".
    assert [one[0] for one in labels[30:40]] == ["yes"] * 4 + ["possible"] * 3 + ["no"] * 3


def test_light_of_an_edge_is_no_robot_behind() -> None:
    # At 100 frames per second every tenth falls on an edge, always alike: half the flux, 1.4 times the range.
    rng = random(1668)
    tracker = Tracker()
    for n in range(300):
        level = (0.5, *[1.0] * 9, 0.5, *[0.0] * 9)[n % 20]
        place = np.array([2.0, 0.2, 0.0])
        tracks = tracker.update(
            n / 100.0, [measurement(place, n / 100.0, rng, flux=level, common=0.0)] if level else []
        )
    assert [t.track for t in tracks] == [1]
    assert np.linalg.norm(tracks[0].position_body_m) == pytest.approx(2.01, rel=0.01)


def test_paper_forms_run_and_switch_where_ours_does_not() -> None:
    how = TrackerSettings(filter="paper", association="paper", overlap="paper", confirm_odds=1.0)
    simulated = sets(swarm(10, 3), 3.0, 30.0, 1, MOVING)
    out = run(simulated, how)
    assert covered(simulated, out, 1.0) > 0.5
    assert switches(simulated, run(simulated)) == 0


def test_trackers_are_independent_and_repeatable() -> None:
    simulated = sets(crossing(), 2.0, 30.0, 5, Observer(yaw=lambda t: 0.1 * t))
    one, other = run(simulated), run(simulated)
    for tracks, again in zip(one, other, strict=True):
        assert [t.track for t in tracks] == [t.track for t in again]
        for a, b in zip(tracks, again, strict=True):
            np.testing.assert_array_equal(a.covariance, b.covariance)
    assert matched(simulated[-1], one[-1], 0.4)
    assert turn(0.0)[0, 0] == 1.0


@pytest.mark.parametrize("bearing_sigma_rad", [3e-4, 2e-3])
def test_bearings_alone_leave_the_range_where_it_was(bearing_sigma_rad: float) -> None:
    """Two seconds with ranges, three with bearings alone: the track neither falls in nor claims to know."""
    tracker, place_m = Tracker(), np.array([3.0, 0.0, 0.0])
    for step in range(150):
        one = measurement(place_m, step / 30.0, random(1701, step), bearing_sigma_rad=bearing_sigma_rad)
        if step >= 60:
            one = dataclasses.replace(one, range_m=math.nan)
        tracks = tracker.update(step / 30.0, [one])
    (track,) = tracks
    off_m = track.position_body_m - place_m
    sigma_m = math.sqrt(track.covariance[0, 0])
    assert 0.2 < sigma_m < 2.0
    assert abs(off_m[0]) < 3.0 * sigma_m
    assert np.abs(off_m[1:]).max() < 0.02


def test_what_says_nowhere_is_left_out() -> None:
    tracker = Tracker()
    good, bad = np.array([3.0, 0.0, 0.0]), np.array([2.0, 1.0, 0.0])
    for step in range(40):
        rng = random(1702, step)
        nowhere = dataclasses.replace(measurement(bad, step / 30.0, rng), origin_body_m=(math.nan, 0.0, 0.0))
        tracks = tracker.update(step / 30.0, [measurement(good, step / 30.0, rng), nowhere])
    assert [(track.track, track.unseen_s) for track in tracks] == [(1, 0.0)]


def test_a_set_without_odometry_goes_on_with_the_last() -> None:
    tracker = Tracker()
    pose = Odometry("r1", 0.0, np.array([5.0, 0.0, 0.0]), np.eye(3))
    for step in range(40):
        time_s = step / 30.0
        known = [] if step == 30 else [dataclasses.replace(pose, time_s=time_s)]
        one = measurement(np.array([3.0, 0.0, 0.0]), time_s, random(1703, step))
        for track in tracker.update(time_s, [one], known):
            assert abs(track.position_body_m[0] - 3.0) < 0.2
            assert track.track == 1
