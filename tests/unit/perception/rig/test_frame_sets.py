"""Which frames belong together."""

import pytest

from perception.files.recording import FrameRecord
from perception.rig.frame_sets import frame_sets


def _record(camera: str, index: int, time_s: float, exposure_s: float = 1e-3) -> FrameRecord:
    return FrameRecord(camera, index, time_s, exposure_s, 0.0, 1.0, 64.0, f"{camera}/{index}.png")


def _names(sets: list[list[FrameRecord]]) -> list[list[str]]:
    return [[f"{each.camera} {each.index}" for each in own] for own in sets]


def test_cameras_that_run_together_are_one_set_each_period() -> None:
    """Ten frames a second, the left camera 20 ms late; a frame that was dropped leaves a smaller set."""
    front = [_record("r1.front", k, 0.1 * k) for k in range(4)]
    left = [_record("r1.left", k, 0.1 * k + 0.02) for k in range(4) if k != 2]
    assert _names(frame_sets([*left, *front])) == [
        ["r1.front 0", "r1.left 0"],
        ["r1.front 1", "r1.left 1"],
        ["r1.front 2"],
        ["r1.front 3", "r1.left 3"],
    ]


def test_robots_never_share_a_set() -> None:
    frames = [_record("r1.front", 0, 0.0), _record("r2.front", 0, 0.0), _record("r1.left", 0, 0.0)]
    assert _names(frame_sets(frames)) == [["r1.front 0", "r1.left 0"], ["r2.front 0"]]


def test_exposures_of_a_bracket_are_one_set_where_its_period_is_said() -> None:
    """Three exposures 2 ms apart, ten times a second."""
    frames = [
        _record("r1.front", 3 * k + j, 0.1 * k + 0.002 * j, 1e-4 * 4**j) for k in range(2) for j in range(3)
    ]
    assert [len(own) for own in frame_sets(frames, period_s=0.1)] == [3, 3]
    with pytest.raises(ValueError, match=r"period_s is 0\.0; wanted a time above 0"):
        frame_sets(frames, period_s=0.0)


def test_times_that_say_nothing_make_sets_of_one_frame_a_camera() -> None:
    """All at time 0, as of pictures without times; and one frame of each camera, ten seconds apart."""
    still = [_record(camera, k, 0.0) for k in range(3) for camera in ("r1.front", "r1.left")]
    assert sorted(len(own) for own in frame_sets(still)) == [2, 2, 2]
    assert len(frame_sets([_record("r1.front", 0, 0.0), _record("r1.left", 0, 10.0)])) == 2
