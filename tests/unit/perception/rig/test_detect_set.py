"""From raw frames of four cameras to robots: frames by brute force, photons and read noise by numpy."""

import numpy as np
import pytest

from perception.rig.measure_set import detect_set
from tests.unit.perception.rig.world import Array, frames_of, rig, seen_by
from tests.unit.perception.simulation import random

RIG = rig()
RANGES_M = (0.5, 0.8, 1.3, 2.0, 3.2, 5.0, 10.0)


def _ring(step_deg: float, turn: int) -> list[Array]:
    """Twelve robots 30 degrees apart, each at another range; `turn` deals the ranges out."""
    places = []
    for k in range(12):
        azimuth = np.radians(30.0 * k + step_deg)
        range_m = RANGES_M[(k + turn) % len(RANGES_M)]
        places.append(np.array([range_m * np.cos(azimuth), range_m * np.sin(azimuth), 0.24]))
    return places


def _off(places: list[Array], exposure_s: float, *key: int) -> tuple[int, list[float]]:
    """How many robots were found just once, and the NEES of those that two cameras see in full."""
    seen = detect_set(frames_of(RIG, places, random(*key), exposure_s), RIG)
    once, nees = 0, []
    for place in places:
        near = [
            one
            for one in seen.measurements
            if float(np.linalg.norm(one.position_body_m - place)) < 0.05 * float(np.linalg.norm(place))
        ]
        once += len(near) == 1
        whole = sum(seen_by(camera, place, 25.0) is not None for camera in RIG.values()) == 2
        if len(near) == 1 and whole:
            assert len(near[0].cameras) == 2
            off_m = place - near[0].position_body_m
            nees.append(float(off_m @ np.linalg.solve(near[0].position_covariance_m2, off_m)))
    assert len(seen.measurements) == once
    return once, nees


def test_robots_all_around_are_found_once() -> None:
    """Twelve robots at 0.5 to 10 m, two of them at seams."""
    once, nees = _off(_ring(14.0, 0), 2.5e-4, 1530)
    assert once == 12
    assert len(nees) >= 2


@pytest.mark.verify
def test_none_is_lost_over_a_full_turn() -> None:
    """Every third degree of a turn at every range, 0.5 to 10 m: 840 robots, each found once."""
    for turn in range(len(RANGES_M)):
        for step in range(0, 30, 3):
            once, _ = _off(_ring(float(step), turn), 2.5e-4, 1531, turn, step)
            assert once == 12, (turn, step)


@pytest.mark.verify
def test_what_two_cameras_say_together_is_as_good_as_it_claims() -> None:
    """Two robots at each seam, 0.8 to 10 m: their NEES is 3 within 10 % or four standard errors."""
    pulls: list[float] = []
    for number in range(40):
        rng = random(1532, number)
        places = []
        for k in range(8):
            azimuth = np.radians(45.0 + 90.0 * (k // 2) + (3.0 if k % 2 else -3.0) + rng.uniform(-1.5, 1.5))
            range_m = np.exp(rng.uniform(np.log(0.8), np.log(10.0)))
            places.append(np.array([range_m * np.cos(azimuth), range_m * np.sin(azimuth), 0.24]))
        once, nees = _off(places, 2.5e-4, 1533, number)
        assert once == 8, number
        pulls += nees
    assert len(pulls) >= 250
    assert np.mean(pulls) == pytest.approx(3.0, abs=max(0.3, 4.0 * np.sqrt(6.0 / len(pulls))))
