"""Tracks against truth, with every score summed by hand."""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import pytest

from nir_render.errors import InputError
from nir_render.evaluate.presence import TimedSet
from nir_render.evaluate.tracks import TrackEvaluation, evaluate_tracks
from nir_render.truth.poses import PoseTruth, parse_pose
from nir_render.truth.sources import SourceTruth
from perception.types import Track
from tests.unit.report.cases import calibration, truth

STEP_S = 0.1
AHEAD, FAR_AHEAD = 2.0, 4.0
YAW_90 = (0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5))


def _track(k: int, number: int, place_m: Sequence[float], robot: str = "r1", ghost: str = "no") -> Track:
    covariance = np.diag([0.04, 0.04, 0.04, 0.01, 0.01, 0.01])
    found = Track(robot, STEP_S * k, number, np.array(place_m), np.zeros(3), covariance)
    return dataclasses.replace(found, ghost=ghost)  # type: ignore[arg-type]


def _source(k: int, robot: str, range_m: float, **changes: object) -> SourceTruth:
    return truth(index=k, time_s=STEP_S * k, robot=robot, range_m=range_m, **changes)


def _sets(count: int, robot: str = "r1") -> list[TimedSet]:
    return [(robot, STEP_S * k, [(f"{robot}.front", k)]) for k in range(count)]


def _scored(rows: Sequence[SourceTruth], tracks: Sequence[Track], count: int = 5) -> TrackEvaluation:
    return evaluate_tracks(_sets(count), rows, {"r1.front": calibration()}, {"robust": tracks})


def _five_frames() -> tuple[list[SourceTruth], list[Track]]:
    """Two sources, 2 m and 4 m ahead; one switch and one miss of the first, one false track."""
    rows = [_source(k, robot, at) for k in range(5) for robot, at in (("r2", AHEAD), ("r3", FAR_AHEAD))]
    first = [_track(k, 1 if k < 2 else 2, (AHEAD, 0, 0)) for k in range(4)]
    second = [_track(k, 3, (FAR_AHEAD + (0.2 if k == 3 else 0.0), 0, 0)) for k in range(5)]
    return rows, [*first, *second, _track(1, 9, (0.0, 5.0, 0.0))]


def test_five_frames_by_hand() -> None:
    """Ten times a source is there, ten times a track; nine pairs, one of them 0.2 m off: similarity 0.8.

    Up to α = 0.8 (16 of 19) DetA = 9/11; AssA: four pairs with tracks of two of the first source's five
    frames, 2/5, and five with the second's, 1. Beyond, that pair falls out: DetA = 8/12, AssA of the second
    4/6. IDF1 pairs the first source with one of its halves: 2 + 5 of 10 and 10. MOTA takes off miss, false
    track and switch.
    """
    numbers = _scored(*_five_frames()).summary["robust"]
    near, far = 9 / 11 * (4 * 0.4 + 5) / 9, 8 / 12 * (4 * 0.4 + 4 * 4 / 6) / 8
    assert numbers["track_hota"] == pytest.approx((16 * math.sqrt(near) + 3 * math.sqrt(far)) / 19)
    assert numbers["track_detection_accuracy"] == pytest.approx((16 * 9 / 11 + 3 * 8 / 12) / 19)
    assert numbers["track_idf1"] == pytest.approx(2 * 7 / 20)
    assert numbers["track_mota"] == pytest.approx(1 - 3 / 10)
    assert (numbers["track_switches"], numbers["track_fragments"], numbers["track_misses"]) == (1, 0, 1)
    assert numbers["track_false_alarms_per_set"] == pytest.approx(1 / 5)
    assert (numbers["track_sources"], numbers["tracks"]) == (2, 4)
    # A false one and a missed one each cost √(1/2) m, the pair that is 0.2 m off that much; of five sets.
    assert numbers["track_gospa_m"] == pytest.approx((2 * math.sqrt(0.5) + 0.2) / 5)
    assert numbers["track_position_rmse_m"] == pytest.approx(0.2 / 3)
    assert numbers["track_range_rmse_m"] == pytest.approx(0.2 / 3)
    assert numbers["track_range_bias_m"] == pytest.approx(0.2 / 9)
    assert numbers["track_bearing_rms_deg"] == pytest.approx(0.0, abs=1e-9)
    assert numbers["track_nees"] == pytest.approx(0.2**2 / 0.04 / 3 / 9)
    # Nobody said how fast they are.
    assert numbers["track_velocity_rmse_m_per_s"] is numbers["track_state_nees"] is None


def test_two_observers_are_two_sequences() -> None:
    """Each sees its own source all the while: the other's sets in between break nothing."""
    sets = [each for pair in zip(_sets(5), _sets(5, "r9"), strict=True) for each in pair]
    rows = [_source(k, "r2", AHEAD, camera=camera) for k in range(5) for camera in ("r1.front", "r9.front")]
    tracks = [_track(k, 1, (AHEAD, 0, 0), robot) for k in range(5) for robot in ("r1", "r9")]
    # The second changes its track once.
    tracks[-1] = _track(4, 2, (AHEAD, 0, 0), "r9")
    known = {name: calibration(name) for name in ("r1.front", "r9.front")}
    found = evaluate_tracks(sets, rows, known, {"robust": tracks})
    both, own = found.summary["robust"], found.by_observer["robust"]
    assert (both["track_fragments"], both["track_switches"], both["track_sources"]) == (0, 1, 2)
    assert both["track_mota"] == pytest.approx(1 - 1 / 10)
    assert both["track_idf1"] == pytest.approx(9 / 10)
    assert [own[robot]["track_switches"] for robot in ("r1", "r9")] == [0, 1]
    assert [own[robot]["track_mota"] for robot in ("r1", "r9")] == pytest.approx([1.0, 0.8])
    assert own["r1"]["track_hota"] == pytest.approx(1.0)


@pytest.mark.parametrize(("gone_s", "sources"), [(1.0, 1), (1.01, 2)])
def test_who_was_gone_for_more_than_a_second_is_a_new_one(gone_s: float, sources: int) -> None:
    """Three sets in view, one hidden, three in view; hidden for long it is not missed, nor its track false."""
    times_s = [0.0, 0.1, 0.2, 0.7, 0.2 + gone_s, 0.3 + gone_s, 0.4 + gone_s]
    sets = [("r1", time_s, [("r1.front", k)]) for k, time_s in enumerate(times_s)]
    rows = [
        truth(index=k, time_s=time_s, visible_fraction=0.0 if k == 3 else 1.0)
        for k, time_s in enumerate(times_s)
    ]
    tracks = [dataclasses.replace(_track(0, 1, (AHEAD, 0, 0)), time_s=time_s) for time_s in times_s]
    found = evaluate_tracks(sets, rows, {"r1.front": calibration()}, {"robust": tracks})
    numbers = found.summary["robust"]
    assert numbers["track_sources"] == sources
    assert numbers["track_false_alarms_per_set"] == numbers["track_misses"] == 0
    assert numbers["track_idf1"] == pytest.approx(1.0 if sources == 1 else 2 * 3 / (6 + 6))


def test_images_in_two_mirrors_are_two() -> None:
    """The images of one source, 2 m apart: tracks at both that call themselves ghosts are none of them false."""
    places = ((2.0, 1.0), (2.0, -1.0))
    rows = [
        _source(k, "r2", math.sqrt(5.0), ghost_of="r2.top", bearing_body=(x / 5**0.5, y / 5**0.5, 0.0))
        for k in range(5)
        for x, y in places[:: 1 if k % 2 else -1]
    ]
    tracks = [
        _track(k, number, (*place, 0.0), ghost="yes" if number == 1 else "no")
        for k in range(5)
        for number, place in enumerate(places, 1)
    ]
    numbers = _scored(rows, tracks).summary["robust"]
    assert (numbers["track_ghosts_told"], numbers["track_ghosts_not_told"]) == (5, 5)
    assert numbers["tracks"] == numbers["track_false_alarms_per_set"] == 0


def test_velocity_is_that_of_the_source_over_ground_in_body_axes() -> None:
    """The observer looks along y. A robot goes along x at 1 m/s and turns left at 2 rad/s, its source 0.1 m
    from its centre along x: v + ω × r = (1, 0.2, 0), in body axes (0.2, −1, 0).
    """
    still = (0.0, 0.0, 0.0)
    poses = [
        pose
        for time_s in (0.0, 1.0)
        for pose in (
            PoseTruth("r1", time_s, still, YAW_90, still, still),
            PoseTruth("r2", time_s, (0.0, 2.0, 0.0), YAW_90, (1.0, 0.0, 0.0), (0.0, 0.0, 2.0)),
        )
    ]
    place = (2.0, -0.1, 0.0)
    range_m = math.hypot(*place)
    row = _source(1, "r2", range_m, bearing_body=tuple(x / range_m for x in place))
    said = dataclasses.replace(_track(1, 1, place), velocity_body_m_per_s=np.array([0.5, -1.0, 0.0]))
    found = evaluate_tracks(_sets(2), [row], {"r1.front": calibration()}, {"robust": [said]}, poses)
    numbers = found.summary["robust"]
    assert numbers["track_velocity_rmse_m_per_s"] == pytest.approx(0.3)
    assert numbers["track_velocity_nees"] == pytest.approx(0.3**2 / 0.01 / 3)
    assert numbers["track_state_nees"] == pytest.approx(0.3**2 / 0.01 / 6)
    assert numbers["track_nees"] == pytest.approx(0.0, abs=1e-12)


def test_a_covariance_that_is_none_is_left_out() -> None:
    """A correlation of 1.5 between x and y, and between ẋ and ẏ: variances above 0, but no covariance."""
    bad = np.diag([0.04, 0.04, 0.04, 0.01, 0.01, 0.01])
    bad[0, 1] = bad[1, 0] = 1.5 * 0.04
    bad[3, 4] = bad[4, 3] = 1.5 * 0.01
    tracks = [_track(0, 1, (2.2, 0, 0)), dataclasses.replace(_track(1, 1, (2.2, 0, 0)), covariance=bad)]
    numbers = _scored([_source(k, "r2", AHEAD) for k in range(2)], tracks, 2).summary["robust"]
    assert numbers["track_nees"] == pytest.approx(1 / 3)


def test_who_says_nothing_has_no_errors() -> None:
    """Ten sources missed; without tracks there is no error, and without sets no score."""
    numbers = _scored([_source(k, robot, AHEAD) for k in range(5) for robot in ("r2", "r3")], []).summary[
        "robust"
    ]
    assert (numbers["track_misses"], numbers["track_hota"], numbers["track_mota"]) == (10, 0.0, 0.0)
    assert numbers["track_position_rmse_m"] is numbers["track_range_bias_m"] is numbers["track_nees"] is None
    assert numbers["track_gospa_m"] == pytest.approx(1.0)
    assert _scored([], [], 0).summary["robust"]["track_hota"] is None


def test_tracks_that_stand_nowhere_or_twice_are_refused() -> None:
    rows = [_source(k, "r2", AHEAD) for k in range(5)]
    with pytest.raises(
        InputError, match=r"tracks.robust.jsonl: track 1 of r1 is at 0.05 s, when it took no set"
    ):
        _scored(rows, [dataclasses.replace(_track(0, 1, (2, 0, 0)), time_s=0.05)])
    with pytest.raises(InputError, match="track 1 of r7 is at"):
        _scored(rows, [_track(0, 1, (2, 0, 0), robot="r7")])
    with pytest.raises(InputError, match=r"track 1 of r1 stands twice at 0.1 s"):
        _scored(rows, [_track(1, 1, (2, 0, 0)), _track(1, 1, (3, 0, 0))])


def test_poses_are_read_as_written() -> None:
    pose = PoseTruth("r1", 0.5, (1.0, 2.0, 3.0), YAW_90, (0.1, 0.0, 0.0), (0.0, 0.0, 0.2))
    assert parse_pose(pose.record()) == pose
    broken = {**pose.record(), "quaternion_xyzw": [0, 0, 0, 2], "robot": "r1"}
    with pytest.raises(InputError, match="length 1"):
        parse_pose(broken)
    with pytest.raises(InputError, match=r"position_m is .*; wanted 3 numbers"):
        parse_pose({**pose.record(), "position_m": [1.0, math.nan, 2.0]})


def test_sources_stand_where_they_are_at_the_time_of_their_set() -> None:
    """A frame taken 0.2 s before its set's time: a source that goes 1 m/s to the left of one who turns 0.5 rad/s.

    At the set's time it is at (2, 0.2) m in the world, which has turned by 0.1 rad in body axes.
    """
    still, level, turned = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, math.sin(0.05), math.cos(0.05))
    poses = [
        PoseTruth("r1", 0.0, still, level, still, (0.0, 0.0, 0.5)),
        PoseTruth("r1", 0.2, still, turned, still, (0.0, 0.0, 0.5)),
        PoseTruth("r2", 0.0, (2.0, 0.0, 0.0), level, (0.0, 1.0, 0.0), still),
        PoseTruth("r2", 0.2, (2.0, 0.2, 0.0), level, (0.0, 1.0, 0.0), still),
    ]
    row = _source(0, "r2", 2.0, bearing_body=(1.0, 0.0, 0.0))
    known = {"r1.front": dataclasses.replace(calibration(), position_body_m=np.zeros(3))}
    cosine, sine = math.cos(0.1), math.sin(0.1)
    there = (2.0 * cosine + 0.2 * sine, 0.2 * cosine - 2.0 * sine, 0.0)
    said = dataclasses.replace(_track(0, 1, there), time_s=0.2)
    sets = [("r1", 0.2, [("r1.front", 0)])]
    found = evaluate_tracks(sets, [row], known, {"robust": [said]}, poses, {("r1.front", 0): 0.0})
    assert found.summary["robust"]["track_position_rmse_m"] == pytest.approx(0.0, abs=1e-9)
    found = evaluate_tracks(sets, [row], known, {"robust": [said]}, poses)
    assert found.summary["robust"]["track_position_rmse_m"] == pytest.approx(math.dist(there, (2, 0, 0)))


def test_an_error_beyond_a_metre_counts_while_its_track_goes_on() -> None:
    """1.5 m off in the middle of three frames: a miss and a false track, and an error like the others."""
    rows = [_source(k, "r2", AHEAD) for k in range(3)]
    tracks = [_track(k, 1, (AHEAD + (1.5 if k == 1 else 0.0), 0, 0)) for k in range(3)]
    numbers = _scored(rows, tracks, 3).summary["robust"]
    assert (numbers["track_misses"], numbers["track_false_alarms_per_set"]) == (1, pytest.approx(1 / 3))
    assert numbers["track_position_rmse_m"] == pytest.approx(1.5 / math.sqrt(3))
    assert numbers["track_nees"] == pytest.approx(1.5**2 / 0.04 / 3 / 3)
