"""Poses between records, and beyond them."""

import math

import numpy as np
import pytest

from perception.odometry import pose_at
from perception.types import Odometry
from tests.unit.perception.track.world import turn


def _record(time_s: float, x_m: float, yaw: float, sigma: float = 0.0) -> Odometry:
    return Odometry("a", time_s, np.array([x_m, 0.0, 0.0]), turn(yaw), sigma, 0.5 * sigma, 0.01, 0.02)


RECORDS = [_record(0.0, 0.0, 0.0, 0.02), _record(1.0, 2.0, 0.6, 0.02), _record(3.0, 2.0, 1.0, 0.02)]


@pytest.mark.parametrize(
    ("time_s", "x_m", "yaw"),
    [(0.25, 0.5, 0.15), (1.0, 2.0, 0.6), (2.0, 2.0, 0.8), (3.5, 2.0, 1.1), (-0.5, -1.0, -0.3)],
)
def test_between_and_beyond(time_s: float, x_m: float, yaw: float) -> None:
    pose = pose_at(RECORDS, time_s)
    assert pose.position_m[0] == pytest.approx(x_m)
    np.testing.assert_allclose(pose.rotation, turn(yaw), atol=1e-12)


def test_errors_weigh_in_as_their_records_do() -> None:
    assert pose_at(RECORDS, 0.25).position_sigma_m == pytest.approx(0.02 * math.hypot(0.75, 0.25))
    assert pose_at(RECORDS, 3.5).rotation_sigma_rad == pytest.approx(0.01 * math.hypot(0.25, 1.25))
    assert pose_at(RECORDS, 0.5).position_walk_m_per_sqrt_s == 0.01


def test_one_record_or_none() -> None:
    assert pose_at(RECORDS[1:2], 5.0).position_m[0] == 2.0
    np.testing.assert_array_equal(pose_at((), 5.0).rotation, np.eye(3))


def test_records_out_of_order() -> None:
    with pytest.raises(ValueError, match="order of time"):
        pose_at(RECORDS[::-1], 0.5)
