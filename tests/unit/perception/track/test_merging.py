"""Several robots in one flare: who is who when they part."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from perception.track import TrackerSettings
from tests.unit.perception.track.world import Observer, Robot, run, sets, switches

CAMERA_M = (0.06, 0.0, 0.2)


def _along_a_line(
    range_m: float, side: float, together: tuple[float, float]
) -> Callable[[float], NDArray[np.float64]]:
    """Move sideways at the camera's height, to its axis for a while, and on or back; `side` is where to, in m."""
    begin_s, end_s = together

    def place_m(time_s: float) -> NDArray[np.float64]:
        left_s = max(begin_s - time_s, time_s - end_s, 0.0)
        return np.array([CAMERA_M[0] + range_m, side * min(0.1 * left_s, 0.4) * range_m, CAMERA_M[2]])

    return place_m


@pytest.mark.parametrize(("fps", "seconds"), [(30.0, 0.6), (30.0, 6.0), (100.0, 2.0)])
def test_two_in_one_flare_part_again(fps: float, seconds: float) -> None:
    """Seen from a camera beside the body's origin, from where they are 19 mrad apart, for as long as 6 s."""
    for key in range(3):
        together = (7.0, 7.0 + seconds)
        robots = [Robot(_along_a_line(2.0, 1.0, together)), Robot(_along_a_line(2.5, -1.0, together))]
        simulated = sets(robots, 11.0 + seconds, fps, 40 + key, Observer(camera_m=CAMERA_M))
        out = run(simulated)
        assert {track.track for tracks in out for track in tracks} == {1, 2}
        assert switches(simulated, out) == 0
        assert len(out[-1]) == 2


def test_three_in_one_flare_pass() -> None:
    """At 1.1 degrees a second: they are one flare for half a second, and two for a while before and after."""

    def passing(range_m: float, side: float) -> Callable[[float], NDArray[np.float64]]:
        return lambda t: np.array([0.06 + range_m, side * 0.02 * (t - 6.0) * range_m, CAMERA_M[2]])

    for key in range(3):
        robots = [Robot(passing(2.0, 1.0)), Robot(passing(2.5, 0.0)), Robot(passing(3.2, -1.0))]
        simulated = sets(robots, 12.0, 30.0, 50 + key, Observer(camera_m=CAMERA_M))
        out = run(simulated)
        assert {track.track for tracks in out for track in tracks} == {1, 2, 3}
        assert switches(simulated, out) == 0


def test_who_was_never_seen_alone_for_long_does_not_live_on_in_anothers_flare() -> None:
    """Seen for a second, then gone behind another for good: the flare is one robot's, and it ends."""
    gone_s = 4.0
    robots = [
        Robot(_along_a_line(2.0, 0.0, (0.0, 0.0))),
        Robot(_along_a_line(2.5, 1.0, (gone_s, 99.0)), seen=lambda t: 2.5 < t < gone_s),
    ]
    simulated = sets(robots, 12.0, 30.0, 60, Observer(camera_m=CAMERA_M))
    out = run(simulated)
    ended_s = max(track.time_s for tracks in out for track in tracks if track.track == 2)
    assert ended_s < gone_s + TrackerSettings().life_s + 0.1
    assert math.isclose(float(out[-1][0].position_body_m[0]), 2.06, abs_tol=0.1)
