"""A tracker of one's own: what works, and the one line that each mistake gets."""

from pathlib import Path

import numpy as np
import pytest

from perception.track import TrackerError, load_tracker
from perception.types import Odometry
from tests.unit.perception.simulation import random
from tests.unit.perception.track.world import measurement, turn

HEAD = """
import numpy as np
from perception.types import Track

def nearest(measurements, odometry, state):
    state["sets"] = state.get("sets", 0) + 1
    return (
        Track(m.robot, m.time_s, k + 1, m.position_body_m, np.array([0.0, state["sets"], 0.0]), np.eye(6))
        for k, m in enumerate(measurements)
    )
"""


def _written(folder: Path, text: str) -> str:
    (folder / "mine.py").write_text(HEAD + text)
    return f"{folder / 'mine.py'}"


def test_state_lives_on_and_is_each_ones_own(tmp_path: Path) -> None:
    file = _written(tmp_path, "")
    one, other = load_tracker(f"{file}:nearest"), load_tracker(f"{file}:nearest")
    seen = [measurement(np.array([2.0, 0.0, 0.0]), 0.0, random(1630))]
    assert one.update(0.0, seen)[0].velocity_body_m_per_s[1] == 1.0
    assert one.update(0.1, seen)[0].velocity_body_m_per_s[1] == 2.0
    assert other.update(0.1, seen)[0].velocity_body_m_per_s[1] == 1.0


def test_prediction_goes_on_in_the_odometrys_frame(tmp_path: Path) -> None:
    own = load_tracker(f"{_written(tmp_path, '')}:nearest")
    one = measurement(np.array([2.0, 0.0, 0.0]), 0.0, random(1631))
    path = [Odometry("a", t, np.array([t, 0.0, 0.0]), turn(0.5 * t)) for t in (0.0, 1.0)]
    own.update(0.0, [one], path)
    there = own.predicted(1.0, path)[0]
    expected = turn(0.5).T @ (one.position_body_m + np.array([0.0, 1.0, 0.0]) - np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(there.position_body_m, expected, atol=1e-12)
    np.testing.assert_allclose(
        there.velocity_body_m_per_s, turn(0.5).T @ np.array([0.0, 1.0, 0.0]), atol=1e-12
    )
    assert (there.unseen_s, there.detections) == (1.0, ())


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("def f(m, o, s): return 3", "returned an object of type int; wanted a list of tracks"),
        ("def f(m, o, s): return [3]", "returned an object of type int among its tracks"),
        ("def f(m, o, s): return 1 / 0", r"ZeroDivisionError: division by zero \(mine.py, line 11\)"),
        ("def f(m, o, s): return [*nearest(m, o, s)] * 2", "two tracks have one number"),
        (
            "def f(m, o, s): return [Track('a', 0.0, 1, np.zeros(2), np.zeros(3), np.eye(6))]",
            r"shape \(2,\); wanted \(3,\)",
        ),
    ],
)
def test_what_comes_back_is_checked(tmp_path: Path, text: str, line: str) -> None:
    own = load_tracker(f"{_written(tmp_path, text)}:f")
    with pytest.raises(TrackerError, match=line):
        own.update(0.0, [measurement(np.array([2.0, 0.0, 0.0]), 0.0, random(1632))])


def test_what_cannot_be_loaded(tmp_path: Path) -> None:
    file = _written(tmp_path, "three = 3\n")
    for reference, line in [
        ("nearest", "wanted file.py:function"),
        (f"{tmp_path}/none.py:f", "there is no file"),
        (f"{file}:far", "there is no 'far' in the file; it has nearest"),
        (f"{file}:three", "cannot be called"),
        (f"{file}:sound", "is a tracker that is built in"),
    ]:
        with pytest.raises(TrackerError, match=line):
            load_tracker(reference)
