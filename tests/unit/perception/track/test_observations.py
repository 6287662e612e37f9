"""Measurements as the filter takes them: axes, noise at the predicted range, bias, what is not known."""

import dataclasses
import math

import numpy as np
import pytest

from perception.odometry import poses_at
from perception.track.bank import newborn
from perception.track.kalman import States, predicted
from perception.track.observations import innovations, observed
from perception.track.settings import TrackerSettings
from perception.types import Odometry
from tests.unit.perception.simulation import random
from tests.unit.perception.track.world import measurement, turn

STILL = poses_at((), np.zeros(1))


def _states(place_m: list[float], velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> States:
    return States(np.array([[*place_m, *velocity]]), 1e-4 * np.eye(6)[None], np.zeros((1, 6)))


def test_noise_stands_at_the_predicted_range() -> None:
    one = measurement(np.array([4.0, 0.0, 0.0]), 0.0, random(1620))
    seen = observed([one], STILL, 0.0, TrackerSettings())
    found = innovations(_states([4.4, 0.0, 0.0]), seen)
    own2 = one.covariance[2, 2] - one.range_sigma_common_m**2
    growth = 4.4 / one.range_m
    assert found.noise_m2[0, 2, 2] == pytest.approx(own2 * growth**6, rel=1e-6)
    assert found.noise_m2[0, 0, 0] == pytest.approx(one.covariance[0, 0] * 4.4**2, rel=1e-4)
    assert found.load_m[0, 2] == pytest.approx(one.range_sigma_common_m * growth, rel=1e-6)


def test_bias_is_three_eighths_of_the_flux_noise_squared() -> None:
    # r̂ = r / √(1 + ε): second order gives ⅜ ε² r; σ_w = ½ r σ_F / F.
    one = measurement(np.array([4.0, 0.0, 0.0]), 0.0, random(1621))
    noise = 0.05
    one = dataclasses.replace(
        one, range_m=4.0, covariance=np.diag([1e-8, 1e-8, (0.5 * 4.0 * noise) ** 2]), range_sigma_common_m=0.0
    )
    found = innovations(_states([4.0, 0.0, 0.0]), observed([one], STILL, 0.0, TrackerSettings()))
    assert found.residual_m[0, 2] == pytest.approx(-3.0 / 8.0 * noise**2 * 4.0, rel=1e-3)


def test_a_measurement_counts_at_its_own_time() -> None:
    one = measurement(np.array([3.0, 0.5, 0.0]), 0.01, random(1622))
    seen = observed([one], STILL, 0.0, TrackerSettings())
    here = innovations(_states([3.0, 0.5, 0.0], (0.0, 2.0, 0.0)), seen).residual_m[0]
    there = innovations(_states([3.0, 0.52, 0.0]), seen._replace(after_s=np.zeros(1))).residual_m[0]
    np.testing.assert_allclose(here, there, atol=1e-5)


def test_a_track_that_begins_does_not_know_how_far_it_moved_since() -> None:
    one = measurement(np.array([3.0, 0.5, 0.0]), 0.02, random(1625), common=0.0, claimed_common=0.0)
    how = TrackerSettings(speed_sigma_m_per_s=0.5)
    at_once, later = (newborn(observed([one], STILL, when, how), when, how).states for when in (0.02, 0.0))
    # Brought to the measurement's own time, the track is the one that began there.
    there = predicted(later, 0.02, 0.0)
    np.testing.assert_allclose(there.covariance, at_once.covariance, atol=1e-12)
    assert later.covariance[0, 1, 1] - at_once.covariance[0, 1, 1] == pytest.approx(1e-4, rel=1e-6)


def test_what_claims_nothing_gets_the_defaults() -> None:
    one = dataclasses.replace(
        measurement(np.array([3.0, 0.5, 0.0]), 0.0, random(1623)),
        covariance=np.full((3, 3), math.nan), range_sigma_common_m=math.nan,
    )  # fmt: skip
    how = TrackerSettings()
    seen = observed([one], STILL, 0.0, how)
    assert seen.noise_m2[0] == pytest.approx((how.range_sigma_relative * one.range_m) ** 2)
    assert seen.common_m[0] == pytest.approx(how.range_common_relative * one.range_m)
    assert seen.angle_rad2[0, 0, 0] == how.bearing_sigma_rad**2
    dark = observed([dataclasses.replace(one, range_m=math.nan)], STILL, 0.0, how)
    found = innovations(_states([3.0, 0.5, 0.0]), dark)
    assert all(np.isfinite(part).all() for part in found)
    assert found.residual_m[0, 2] == 0.0


def test_the_observers_pose_turns_and_shakes() -> None:
    one = measurement(np.array([3.0, 0.5, 0.2]), 0.0, random(1624))
    pose = Odometry("a", 0.0, np.array([1.0, 2.0, 3.0]), turn(0.7), 0.004, 0.003)
    seen = observed([one], poses_at([pose], np.zeros(1)), 0.0, TrackerSettings())
    np.testing.assert_allclose(seen.place_m[0], turn(0.7) @ one.position_body_m + pose.position_m, atol=1e-12)
    assert seen.angle_rad2[0, 0, 0] == pytest.approx(one.covariance[0, 0] + 0.003**2)
    assert seen.shaken_m2[0] == pytest.approx(0.004**2)
