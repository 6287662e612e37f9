"""One robot in several cameras is one measurement, as good as it says. Detections are drawn from their own σ."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from perception.rig.measure_set import measure_set
from perception.types import Calibration, Detection, Measurement
from tests.unit.perception.rig.world import Array, detection, frame_without_pixels, rig, seen_by
from tests.unit.perception.simulation import random

RIG = rig()


def _at_seams(rng: np.random.Generator, count: int) -> list[Array]:
    """Places that two cameras see, 0.5 to 10 m away."""
    places: list[Array] = []
    while len(places) < count:
        azimuth = 0.25 * np.pi + 0.5 * np.pi * rng.integers(4) + np.radians(rng.uniform(-6.0, 6.0))
        range_m = np.exp(rng.uniform(np.log(0.5), np.log(10.0)))
        place = np.array([range_m * np.cos(azimuth), range_m * np.sin(azimuth), rng.uniform(0.1, 0.4)])
        if sum(seen_by(camera, place) is not None for camera in RIG.values()) == 2:
            places.append(place)
    return places


def _measured(found: dict[str, list[Detection]], cameras: dict[str, Calibration]) -> list[Measurement]:
    frames = [frame_without_pixels(camera) for camera in cameras.values()]
    return list(measure_set(frames, [found[name] for name in cameras], cameras).measurements)


def _seen(places: list[Array], rng: np.random.Generator, **errors: float) -> dict[str, list[Detection]]:
    return {
        name: [hit for place in places if (hit := detection(camera, place, rng, **errors)) is not None]
        for name, camera in RIG.items()
    }


@pytest.mark.parametrize("common", [0.0, 0.02, 0.05])
def test_a_robot_in_two_cameras_is_one_measurement_with_a_true_covariance(common: float) -> None:
    """2 000 robots at seams: mean NEES 3 ± 4 standard errors, none made two.

    Of an error of K half the variance is each camera's own, 1 % of range at most, the rest each robot's.
    """
    rng = random(1501, int(1e3 * common))
    nees = []
    for _ in range(400):
        places = _at_seams(rng, 5)
        # Of each robot's own LED the rest, so that the variance is that of `common`.
        cameras = min(np.sqrt(0.5), 0.01 / common) if common else 0.0
        of_camera = {name: cameras * rng.normal() for name in RIG}
        of_robot = np.sqrt(1.0 - cameras**2) * rng.normal(size=5)
        seen = {
            name: [
                hit
                for place, own in zip(places, of_robot, strict=True)
                if (hit := detection(
                    camera, place, rng, relative=0.004, common=common,
                    common_error=float(own + of_camera[name]),
                )) is not None
            ]
            for name, camera in RIG.items()
        }  # fmt: skip
        found = _measured(seen, RIG)
        assert len(found) == 5
        for one in found:
            place = min(places, key=lambda p: float(np.linalg.norm(p - one.position_body_m)))
            assert len(one.cameras) == len(one.detections) == 2
            off_m = place - one.position_body_m
            nees.append(off_m @ np.linalg.solve(one.position_covariance_m2, off_m))
            assert one.range_sigma_common_m <= np.sqrt(one.covariance[2, 2])
    # The camera's error is that of all five of a set: a factor of √5 at most.
    slack = 4.0 * np.sqrt(6.0 / len(nees)) * (np.sqrt(5.0) if common else 1.0)
    assert np.mean(nees) == pytest.approx(3.0, abs=slack)


def test_fusion_is_the_least_squares_solution() -> None:
    """Place and σ of one pair by SciPy, from the rays themselves, with the shared error as a fourth unknown."""
    rng = random(1502)
    place = np.array([0.9, 0.95, 0.3])
    pair = [(c, h) for c in RIG.values() if (h := detection(c, place, rng, common=0.01)) is not None]
    (one,) = _measured({c.camera: [h for d, h in pair if d is c] for c in RIG.values()}, RIG)

    def residuals(unknown: Array) -> Array:
        parts = [unknown[3:]]
        for camera, hit in pair:
            local = camera.rotation_body_camera.T @ (unknown[:3] - camera.position_body_m)
            u = camera.cx_px + camera.fx_px * local[0] / local[2]
            v = camera.cy_px + camera.fy_px * local[1] / local[2]
            noise = np.sqrt(hit.range_sigma_m**2 - 0.5 * hit.range_sigma_common_m**2) / hit.range_m
            said = np.log(hit.range_m / np.linalg.norm(local)) - np.sqrt(0.5) * 0.01 * unknown[3]
            parts.append(
                np.array([(u - hit.u_px) / hit.u_sigma_px, (v - hit.v_px) / hit.v_sigma_px, said / noise])
            )
        return np.concatenate(parts)

    best = least_squares(residuals, [*place, 0.0], x_scale=[1e-3, 1e-3, 1e-3, 1.0], xtol=1e-14, ftol=1e-14)
    covariance = np.linalg.inv(np.asarray(best.jac).T @ np.asarray(best.jac))[:3, :3]
    np.testing.assert_allclose(one.position_body_m, best.x[:3], atol=2e-6)
    np.testing.assert_allclose(one.position_covariance_m2, covariance, rtol=0.02, atol=1e-9)


def test_two_robots_on_nearly_one_bearing_stay_two() -> None:
    """Half a degree apart at 2 and 4 m, both in both cameras."""
    rng = random(1503)
    places = [
        range_m * np.array([np.cos(a), np.sin(a), 0.0]) + [0.0, 0.0, 0.28]
        for range_m, a in ((2.0, 0.25 * np.pi), (4.0, 0.25 * np.pi + np.radians(0.5)))
    ]
    found = sorted(_measured(_seen(places, rng), RIG), key=lambda each: each.range_m)
    assert [len(each.cameras) for each in found] == [2, 2]
    assert [float(each.position_body_m[0]) for each in found] == pytest.approx([1.414, 2.804], rel=0.015)


def test_rays_without_ranges_are_ranged_where_they_meet() -> None:
    """Clipped in both cameras: 8.5 cm of baseline at 0.8 m, 0.02 px: 0.3 % by triangulation alone."""
    rng = random(1504)
    place = np.array([0.57, 0.57, 0.28])
    found = {
        name: [replace(hit, range_sigma_m=np.nan, saturated=True) for hit in hits]
        for name, hits in _seen([place], rng).items()
    }
    (one,) = _measured(found, RIG)
    assert one.saturated
    assert one.range_m == pytest.approx(float(np.linalg.norm(place - one.origin_body_m)), rel=0.01)
    assert 1e-4 < np.sqrt(one.covariance[2, 2]) / one.range_m < 0.01


def test_a_range_that_nobody_knows_is_none() -> None:
    """At 30 m the baseline tells nothing."""
    rng = random(1505)
    place = np.array([21.0, 21.0, 0.28])
    found = {
        name: [replace(hit, range_m=np.nan, range_sigma_m=np.nan) for hit in hits]
        for name, hits in _seen([place], rng, px=0.5).items()
    }
    (one,) = _measured(found, RIG)
    assert np.isnan(one.range_m)
    assert np.isnan(one.covariance[2, 2])
    assert np.isfinite(one.covariance[:2, :2]).all()


def test_an_image_whose_light_a_pane_took_is_still_one() -> None:
    """Its ranges by flux are 3.5 times where its rays meet, alike in both cameras."""
    rng = random(1506)
    found = _measured(_seen([np.array([1.5, 1.5, 0.28])], rng, factor=3.5), RIG)
    assert [len(each.cameras) for each in found] == [2]


def test_extrinsics_that_are_not_exact_are_part_of_the_covariance() -> None:
    """Cameras turned by 2 mrad each: what a calibration that knows of it claims is true."""
    rng = random(1507)
    known = {name: replace(camera, sigma={"rotation_body_camera": 2e-3}) for name, camera in RIG.items()}
    nees = []
    for _ in range(300):
        (place,) = _at_seams(rng, 1)
        turned = {
            name: replace(camera, rotation_body_camera=_turned(rng) @ camera.rotation_body_camera)
            for name, camera in RIG.items()
        }
        found = {
            name: [_as_believed(hit, RIG[name])] if (hit := detection(camera, place, rng)) is not None else []
            for name, camera in turned.items()
        }
        measured = _measured(found, known)
        assert len(measured) == 1
        off_m = place - measured[0].position_body_m
        nees.append(off_m @ np.linalg.solve(measured[0].position_covariance_m2, off_m))
    assert np.mean(nees) == pytest.approx(3.0, abs=4.0 * np.sqrt(6.0 / len(nees)))


def _turned(rng: np.random.Generator) -> Array:
    a, b, c = 2e-3 * rng.normal(size=3)
    return np.array([[1.0, -c, b], [c, 1.0, -a], [-b, a, 1.0]])


def _as_believed(hit: Detection, camera: Calibration) -> Detection:
    local = np.array(
        [(hit.u_px - camera.cx_px) / camera.fx_px, (hit.v_px - camera.cy_px) / camera.fy_px, 1.0]
    )
    x, y, z = (camera.rotation_body_camera @ (local / np.linalg.norm(local))).tolist()
    return replace(hit, bearing_body=(x, y, z))


def test_a_set_is_of_one_robot() -> None:
    other = replace(RIG["r1.front"], camera="r2.front")
    frames = [frame_without_pixels(RIG["r1.front"]), frame_without_pixels(other)]
    with pytest.raises(ValueError, match="one robot's frames, not of r1, r2"):
        measure_set(frames, [[], []], {"r1.front": RIG["r1.front"], "r2.front": other})


def test_of_a_bracket_the_exposure_that_is_not_clipped_counts() -> None:
    """One camera, three exposures, the longest clipped: one measurement, with the σ of the best."""
    rng = random(1508)
    camera, place = RIG["r1.front"], np.array([2.0, 0.3, 0.25])
    hits = [detection(camera, place, rng, relative=sigma) for sigma in (0.01, 0.004)]
    clipped = detection(camera, place, rng)
    assert clipped is not None
    unknown = float("nan")
    found = [
        *([hit] for hit in hits if hit is not None),
        [replace(clipped, saturated=True, range_sigma_m=unknown, u_sigma_px=unknown, v_sigma_px=unknown)],
    ]
    frames = [
        replace(frame_without_pixels(camera, 0.25 + 0.002 * k), exposure_s=1e-3 * 4**k) for k in range(3)
    ]
    (one,) = measure_set(frames, found, {camera.camera: camera}).measurements
    assert len(one.detections) == 3
    assert not one.saturated
    assert float(np.sqrt(one.covariance[2, 2])) == pytest.approx(0.004 * one.range_m, rel=0.01)


def test_what_claims_perfection_or_nothing_is_taken_as_it_is() -> None:
    """σ of 0, a bearing of NaN, a range of 1e200 m: one measurement, and the numbers that there are."""
    rng = random(1509)
    place = np.array([1.2, 1.25, 0.25])
    nan = float("nan")
    changes: list[dict[str, object]] = [
        {"u_sigma_px": 0.0, "v_sigma_px": 0.0, "range_sigma_m": 0.0},
        {"bearing_body": (nan, nan, nan)},
        {"range_m": 1e200, "range_sigma_m": 1.0},
    ]
    for change in changes:
        found = {
            name: [replace(hit, **change) for hit in hits]  # type: ignore[arg-type]
            for name, hits in _seen([place], rng, px=1e-4, relative=1e-6).items()
        }
        (one,) = _measured(found, RIG)
        assert np.isfinite([one.time_s, *one.bearing_body, *one.covariance[:2, :2].ravel()]).all()


def test_a_camera_without_calibration_is_named() -> None:
    with pytest.raises(ValueError, match=r"no calibration for r1\.left"):
        measure_set([frame_without_pixels(RIG["r1.left"])], [[]], {"r1.front": RIG["r1.front"]})
