"""Headings against truth, by hand: an observer turned by 90° at (1, 0, 0) looks at a robot at (1, 2, 0) turned by 120°."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nir_render.evaluate.headings import heading_numbers, stands_of
from nir_render.truth.poses import PoseTruth
from perception import PoseHypothesis, RobotPose

TURN = math.radians(30.0)  # of the robot, seen from the observer, 2 m ahead of it
SIGMA_M, SIGMA = 0.01, math.radians(2.0)


def _pose(robot: str, place: tuple[float, float, float], yaw_deg: float) -> list[PoseTruth]:
    half = math.radians(0.5 * yaw_deg)
    turned = (0.0, 0.0, math.sin(half), math.cos(half))
    return [PoseTruth(robot, time_s, place, turned, (0.0,) * 3, (0.0,) * 3) for time_s in (0.0, 1.0)]


POSES = [*_pose("r1", (1.0, 0.0, 0.0), 90.0), *_pose("r2", (1.0, 2.0, 0.0), 120.0)]


def _hypothesis(odds: float, heading: float, x_m: float = 2.0) -> PoseHypothesis:
    covariance = np.diag([SIGMA_M**2, SIGMA_M**2, SIGMA_M**2, SIGMA**2])
    return PoseHypothesis(odds, (x_m, 0.0, 0.0), heading, covariance, (0, 1))


def _numbers(*hypotheses: PoseHypothesis, owners: tuple[str, str] = ("r2", "r2")) -> dict[str, Any]:
    flares = (("r1.front", 0, 0), ("r1.front", 0, 1))
    scores: Any = [
        SimpleNamespace(
            truth=SimpleNamespace(robot=owner),
            is_ghost=False,
            measurements={"robust": SimpleNamespace(detections=(flare,))},
        )
        for owner, flare in zip(owners, flares, strict=True)
    ]
    told = [RobotPose("r1", 0.5, "two", flares, 1.0, hypotheses)]
    return heading_numbers(stands_of(told, [[("r1.front", 0)]], scores, "robust", POSES))


def test_the_error_and_its_nees() -> None:
    """3° off with σ 2°, and 1 cm off along x with σ 1 cm: (1.5² + 1²)/4."""
    found = _numbers(_hypothesis(1.0, TURN + math.radians(3.0), 2.01))
    assert found["set_heading_rms_deg"] == pytest.approx(3.0)
    assert found["set_heading_nees"] == pytest.approx((1.5**2 + 1.0) / 4.0)
    assert (found["set_robots_told"], found["set_robots_mixed"], found["set_heading_wrong"]) == (1, 0, 0)


def test_twins_count_as_one_and_the_wrong_one_of_unlike_odds_is_told() -> None:
    twin = TURN - math.pi
    even = _numbers(_hypothesis(0.5, twin), _hypothesis(0.5, TURN))
    assert (even["set_heading_rms_deg"], even["set_heading_wrong"]) == (pytest.approx(0.0, abs=1e-9), 0)
    wrong = _numbers(_hypothesis(0.9, twin), _hypothesis(0.1, TURN))
    assert wrong["set_heading_rms_deg"] == pytest.approx(180.0)
    assert (wrong["set_heading_wrong"], wrong["set_heading_unsaid"]) == (1, 0)
    unsaid = _numbers(_hypothesis(1.0, TURN + math.radians(11.0)))
    assert (unsaid["set_heading_wrong"], unsaid["set_heading_unsaid"]) == (1, 1)


def test_flares_of_two_robots_are_mixed() -> None:
    found = _numbers(_hypothesis(1.0, TURN), owners=("r2", "r3"))
    assert (found["set_robots_mixed"], found["set_heading_rms_deg"]) == (1, None)
