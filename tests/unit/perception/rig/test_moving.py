"""A robot that turns between the frames of its cameras sees every source once, and as well as it says."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from perception.rig.measure_set import measure_set
from perception.types import Measurement, Odometry
from tests.unit.perception.rig.test_fusion import _at_seams
from tests.unit.perception.rig.world import Array, detection, frame_without_pixels, rig
from tests.unit.perception.simulation import random

RIG = rig()
LATE_S = {"r1.front": 0.0, "r1.left": 5e-3, "r1.back": 10e-3, "r1.right": -8e-3}
TURN_RAD_PER_S, SPEED_M_PER_S = 0.8, 0.3


def _pose(time_s: float) -> tuple[Array, Array]:
    """Where the observer is: it turns to its left and drives along y."""
    yaw, way_m = TURN_RAD_PER_S * (time_s - 0.25), SPEED_M_PER_S * (time_s - 0.25)
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([0.0, way_m, 0.0])


def _in_body(source: Array, time_s: float) -> Array:
    """Return where a source, [p; v] in the middle of the set, is in body axes."""
    turn, at_m = _pose(time_s)
    return turn.T @ (source[:3] + (time_s - 0.25) * source[3:] - at_m)


def _record(time_s: float, rng: np.random.Generator, sigma_m: float, sigma_rad: float) -> Odometry:
    turn, at_m = _pose(time_s)
    tilt = Rotation.from_rotvec(sigma_rad * rng.normal(size=3)).as_matrix()
    return Odometry("r1", time_s, at_m + sigma_m * rng.normal(size=3), turn @ tilt, sigma_m, sigma_rad)


def _measured(
    rng: np.random.Generator, sigma_m: float, sigma_rad: float, told: bool
) -> tuple[list[Array], list[Measurement]]:
    """Return five robots at seams of the cameras, [p; v], and what is measured of them."""
    places = [np.append(place, 0.1 * rng.normal(size=3)) for place in _at_seams(rng, 5)]
    frames, found = [], []
    for name, camera in RIG.items():
        middle_s = 0.25 + LATE_S[name]
        frames.append(replace(frame_without_pixels(camera), time_s=middle_s - 0.5e-3))
        hits = [detection(camera, _in_body(place, middle_s), rng) for place in places]
        found.append([hit for hit in hits if hit is not None])
    records = [_record(k / 30.0, rng, sigma_m, sigma_rad) for k in range(6, 10)]
    seen = measure_set(frames, found, RIG, odometry=records if told else ())
    return places, list(seen.measurements)


def _nees(places: list[Array], seen: list[Measurement]) -> list[float]:
    """Return the squared error of each place over its covariance, at the measurement's time."""
    found = []
    for one in seen:
        off_m = min(
            (_in_body(place, one.time_s) - one.position_body_m for place in places), key=np.linalg.norm
        )
        found.append(float(off_m @ np.linalg.solve(one.position_covariance_m2, off_m)))
    return found


@pytest.mark.parametrize(("sigma_m", "sigma_rad"), [(0.0, 0.0), (1e-3, 2e-3)])
def test_sources_are_one_and_no_surer_than_claimed(sigma_m: float, sigma_rad: float) -> None:
    """None of 500 becomes two; mean NEES 3 at most, less as motion and odometry count as unrelated errors."""
    rng = random(1530, int(1e4 * sigma_rad))
    count, nees = 0, []
    for _ in range(100):
        places, seen = _measured(rng, sigma_m, sigma_rad, told=True)
        count += len(seen)
        nees += _nees(places, seen)
    assert count == 500
    assert 0.7 < np.mean(nees) < 3.0 + 4.0 * np.sqrt(6.0 / len(nees))


def test_who_does_not_know_that_it_turns_sees_a_fifth_twice() -> None:
    rng = random(1531)
    assert sum(len(_measured(rng, 0.0, 0.0, told=False)[1]) for _ in range(40)) > 1.1 * 5 * 40


def test_a_single_camera_says_what_it_said() -> None:
    """Carried to the time of the set and back, a measurement of one camera is the one without odometry."""
    rng, camera = random(1532), RIG["r1.front"]
    frames = [replace(frame_without_pixels(RIG[name]), time_s=0.25 + LATE_S[name]) for name in RIG]
    hit = detection(camera, np.array([2.0, 0.1, 0.3]), rng)
    other = detection(RIG["r1.back"], np.array([-2.0, 0.1, 0.3]), rng)
    assert hit is not None
    assert other is not None
    found = [[hit], [], [other], []]
    records = [_record(k / 30.0, rng, 1e-3, 2e-3) for k in range(6, 10)]
    for plain, turned in zip(
        measure_set(frames, found, RIG).measurements,
        measure_set(frames, found, RIG, odometry=records).measurements,
        strict=True,
    ):
        np.testing.assert_allclose(turned.position_body_m, plain.position_body_m, atol=1e-12)
        np.testing.assert_allclose(turned.covariance, plain.covariance, rtol=1e-12)
        assert turned.time_s == plain.time_s


def test_records_that_lie_far_back_do_not_make_the_motion_surer() -> None:
    """One more record, two seconds before, says nothing of the set: σ of what cameras share stay as they were."""
    rng = random(1533)
    places = [np.append(place, np.zeros(3)) for place in _at_seams(rng, 5)]
    frames, found = [], []
    for name, camera in RIG.items():
        middle_s = 0.25 + LATE_S[name]
        frames.append(replace(frame_without_pixels(camera), time_s=middle_s - 0.5e-3))
        hits = [detection(camera, _in_body(place, middle_s), rng) for place in places]
        found.append([hit for hit in hits if hit is not None])
    near = [_record(k / 100.0, rng, 1e-3, 2e-3) for k in range(20, 31)]
    far = _record(-2.0, rng, 1e-3, 2e-3)
    one, other = (measure_set(frames, found, RIG, odometry=each) for each in (near, [far, *near]))
    assert len(one.measurements) == 5
    for its, same in zip(one.measurements, other.measurements, strict=True):
        assert its.position_covariance_m2 == pytest.approx(same.position_covariance_m2, rel=1e-12)
