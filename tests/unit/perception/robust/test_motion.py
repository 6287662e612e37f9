"""Flares that move while they are exposed, by brute force."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

import perception
from perception.model.fisher import flare_limits
from perception.model.window import Camera, motion_cost
from perception.robust.goodness import drawn_out
from perception.types import Calibration, Detections
from tests.moving_flares import CAMERA, LIT_S, drawn, drawn_out_e, lit_for
from tests.unit.perception.simulation import expose, random

Array = NDArray[np.float64]

EXPOSURE_S = 0.01
KNOWN = replace(CAMERA, **lit_for(EXPOSURE_S))
AT_PX, BACKGROUND_E = (319.8, 239.2), 20.0


def found_in(mean_e: Array, *key: int) -> Detections:
    return perception.detect(expose(mean_e, CAMERA, random(*key), EXPOSURE_S), KNOWN)


def test_drawn_out_flares_are_one_each_and_their_errors_are_as_claimed() -> None:
    """48 flares that move by 0 to 5 px: 3 · 48 pulls of mean square 1 within 4 σ of χ².

    As flares at rest one in seven is two, and ranges are off by 3.5 of the σ claimed.
    """
    mean_e, sources = drawn(3)
    hits = found_in(mean_e, 21, 1)
    place = np.array([(hit.u_px, hit.v_px) for hit in hits])
    apart_px = np.hypot(*(place[:, None] - sources[:, :2]).transpose(2, 0, 1))
    assert ((apart_px < 25.0).sum(axis=0) == 1).all()
    assert len(hits) == len(sources)
    assert not any(hit.merged for hit in hits)
    pulls = []
    for (u, v, range_m, _), k in zip(sources, apart_px.argmin(axis=0), strict=True):
        hit = hits[int(k)]
        pulls += [(hit.u_px - u) / hit.u_sigma_px, (hit.v_px - v) / hit.v_sigma_px]
        pulls.append((hit.range_m - range_m) / hit.range_sigma_m)
    assert float(np.mean(np.square(pulls))) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / len(pulls)))


@pytest.mark.parametrize(("times", "key"), [(20.0, 1), (60.0, 2)])
def test_near_balls_that_clip_and_move_are_found(times: float, key: int) -> None:
    """35 at .55 to 1.65 m, 3 to 60 times as bright as what clips, that move by 1 to 5 px.

    What clips is as wide as a larger ball at rest, and from there the way to the one that moves may be barred.
    """
    number = random(101, key, round(times))
    mean_e = np.full((CAMERA.height_px, CAMERA.width_px), 5.0)
    balls: list[tuple[float, float, float]] = []
    for row in range(45, 440, 80):
        for column in range(45, 600, 80):
            range_m, length = 0.55 * 3.0 ** number.random(), number.uniform(1.0, 5.0)
            angle = number.uniform(0.0, math.pi)
            place = column + number.uniform(-0.5, 0.5), row + number.uniform(-0.5, 0.5)
            way_px = length * math.cos(angle), length * math.sin(angle)
            left, top, light_e = drawn_out_e(CAMERA, *place, range_m, way_px)
            mean_e[top : top + len(light_e), left : left + len(light_e)] += times * light_e
            balls.append((*place, range_m))
    hits = perception.detect(expose(mean_e, CAMERA, random(102, key, round(times)), times * LIT_S), CAMERA)
    assert len(hits) == len(balls)
    for u, v, range_m in balls:
        (hit,) = (one for one in hits if math.hypot(one.u_px - u, one.v_px - v) < 1.5)
        assert abs(hit.range_m - range_m) < 4.5 * hit.range_sigma_m


def numerical_sigmas(range_m: float, way_px: tuple[float, float], camera: Calibration) -> Array:
    """Return the Cramér–Rao sigmas of u, v and ln range; both parts of the motion and the background free too."""

    def image(step: Array) -> Array:
        u_px, v_px = AT_PX[0] + step[0], AT_PX[1] + step[1]
        moved_px = (way_px[0] + step[3], way_px[1] + step[4])
        return drawn_out_e(camera, u_px, v_px, range_m * math.exp(step[2]), moved_px)[2].ravel()

    steps = np.diag([0.05, 0.05, 0.01, 0.05, 0.05])
    slopes = [(image(step) - image(-step)) / (2.0 * step.sum()) for step in steps]
    jacobian = np.stack([*slopes, np.ones(slopes[0].size)])
    dark_e2 = camera.read_noise_e**2 + 1.0 / (12.0 * camera.system_gain_dn_per_e**2)
    information = (jacobian / (image(np.zeros(5)) + BACKGROUND_E + dark_e2)) @ jacobian.T
    return np.asarray(np.sqrt(np.diagonal(np.linalg.inv(information))[:3]))


@pytest.mark.parametrize(("range_m", "way_px"), [(1.5, (2.0, 1.0)), (4.0, (1.5, 0.0))])
def test_the_bound_of_a_moving_flare_is_that_of_numerical_derivatives(
    range_m: float, way_px: tuple[float, float]
) -> None:
    """To 1.5 %, by differences of the brute-force image; to know that it rests gains 3 to 20 %."""
    camera = replace(CAMERA, sigma={})
    cosine = 1.0 / math.sqrt(
        1.0 + sum(((at - c) / camera.fx_px) ** 2 for at, c in zip(AT_PX, (319.5, 239.5), strict=True))
    )
    flux_e = 1.4e9 * 2e-4 * cosine / range_m**2
    (limit,) = flare_limits(camera, [(*AT_PX, range_m, flux_e)], BACKGROUND_E, motions_px=[way_px])
    (at_rest,) = flare_limits(camera, [(*AT_PX, range_m, flux_e)], BACKGROUND_E)
    told = (limit.u_sigma_px, limit.v_sigma_px, limit.range_sigma_m / range_m)
    assert told == pytest.approx(numerical_sigmas(range_m, way_px, camera).tolist(), rel=0.015)
    assert limit.range_sigma_m > 1.01 * at_rest.range_sigma_m
    assert limit.u_sigma_px > 1.05 * at_rest.u_sigma_px


def test_what_a_residual_asks_for_is_the_motion() -> None:
    """A flare drawn out by 0.5 px at 30°, without noise, against the same at rest: 14 % of its length, 2°.

    Pixels beside each other tell a coarse second derivative, broader by a variance of 1/6 px² than the true
    one: against a point's image of 0.57 px² that makes its amplitude, m², up to 29 % too large.
    """
    way_px = (0.5 * math.cos(math.pi / 6.0), 0.5 * math.sin(math.pi / 6.0))
    moved_e, still_e = (drawn_out_e(CAMERA, *AT_PX, 3.0, way)[2] for way in (way_px, (0.0, 0.0)))
    state = np.ones(moved_e.shape, dtype=np.uint8)
    chi2, along_u, along_v, _ = drawn_out(moved_e + 5.0, state, still_e + 5.0, still_e, 100.0, 0.0)
    assert math.degrees(math.atan2(along_v, along_u)) == pytest.approx(30.0, abs=2.0)
    assert math.hypot(along_u, along_v) == pytest.approx(0.5, rel=0.14)
    assert chi2 > 0.0


def test_no_explanation_gains_more_than_a_residual_has_to_give() -> None:
    """The truth's χ² is n ± √(2n) over the pixels that stand out: 3 √(2n) above it, 400 draws."""
    moved_e, still_e = (drawn_out_e(CAMERA, *AT_PX, 3.0, way)[2] for way in ((1.2, 0.5), (0.0, 0.0)))
    state, number, over = np.ones(moved_e.shape, dtype=np.uint8), random(23), []
    stands_out = still_e[1:-1, 1:-1] > np.sqrt(still_e[1:-1, 1:-1] + 105.0)
    count = int(stands_out.sum())
    for _ in range(400):
        image_e = number.normal(moved_e + 5.0, np.sqrt(still_e + 105.0))
        left2 = [
            ((image_e - 5.0 - each_e) ** 2 / (still_e + 105.0))[1:-1, 1:-1] for each_e in (still_e, moved_e)
        ]
        most_gain = drawn_out(image_e, state, still_e + 5.0, still_e, 100.0, 0.0)[3]
        over.append(most_gain - float((left2[0] - left2[1])[stands_out].sum()))
    spread = math.sqrt(2.0 * count)
    assert np.mean(over) == pytest.approx(3.0 * spread, abs=4.0 * spread / math.sqrt(400.0))
    assert np.std(over) == pytest.approx(spread, rel=0.2)


def test_motions_cost_what_their_prior_says() -> None:
    """480 px · 10 ms · √(0.5² + (0.7/2)²)/s = 2.93 px a side; 1 px costs −2 ln (2π · 2 N(1; σ)), which is 3.03.

    A motion beyond belief costs 2 ln(25 · 10⁸), and none less than its own estimate's width is worth.
    """
    sigma2 = (4.8**2) * (0.25 + 0.1225)
    ordinary = 1.0 / sigma2 - 2.0 * math.log(2.0 / sigma2)
    narrow, at_2_m = np.eye(2)[None] * 1e-4, np.log([2.0])
    camera = Camera(KNOWN, EXPOSURE_S, 1.0)
    assert motion_cost(np.array([[1.0, 0.0]]), at_2_m, narrow, camera) == pytest.approx(ordinary, abs=1e-6)
    quick = Camera(KNOWN, 1e-5, 1.0)
    beyond = 2.0 * math.log(25.0 * 1e8)
    assert motion_cost(np.array([[3.0, 0.0]]), at_2_m, narrow, quick) == pytest.approx(beyond, rel=1e-6)
    wide = np.eye(2)[None] * 64.0
    assert motion_cost(np.array([[0.0, 0.0]]), at_2_m, wide, camera) == pytest.approx(2.0 * math.log(64.0))


def test_two_that_cross_are_two_each_drawn_out_along_its_own_way() -> None:
    """5 px apart, 2 and 3 px of motion at right angles: two, their places and ranges within 4 σ."""
    mean_e = np.full((CAMERA.height_px, CAMERA.width_px), 5.0)
    sources = ((300.2, 240.1, 2.0, (2.0, 0.5)), (304.0, 243.3, 2.8, (-0.7, 2.9)))
    for u_px, v_px, range_m, way_px in sources:
        left, top, flare_e = drawn_out_e(CAMERA, u_px, v_px, range_m, way_px)
        mean_e[top : top + len(flare_e), left : left + len(flare_e)] += flare_e
    hits = sorted(found_in(mean_e, 22, 1), key=lambda hit: hit.u_px)
    assert len(hits) == 2
    for hit, (u_px, v_px, range_m, _) in zip(hits, sources, strict=True):
        assert abs(hit.u_px - u_px) < 4.0 * hit.u_sigma_px
        assert abs(hit.v_px - v_px) < 4.0 * hit.v_sigma_px
        assert abs(hit.range_m - range_m) < 4.0 * hit.range_sigma_m
        assert hit.range_sigma_m < 0.02 * range_m


@pytest.mark.parametrize(("exposure_s", "told"), [(EXPOSURE_S, 20), (1e-4, 0)])
def test_what_is_long_on_texture_is_told_only_if_robots_move_so(exposure_s: float, told: int) -> None:
    """Twenty flares drawn out by 6 px on hills of 8 %, exposed for 10 ms, as robots move, and for 0.1 ms.

    In 0.1 ms a robot would have to pass by at a hundred metres a second: on what has texture that is a leaf.
    """
    camera = replace(CAMERA, **lit_for(exposure_s))
    rows, _columns = np.indices((camera.height_px, camera.width_px))
    hills = gaussian_filter(random(41).normal(size=rows.shape), 3.0, mode="wrap")
    mean_e = 300.0 * (1.0 + 0.08 * hills / hills.std())
    for k in range(20):
        u_px, v_px = 60.3 + 130.0 * (k % 5), 60.2 + 120.0 * (k // 5)
        turn_rad = random(42, k).uniform(0.0, math.pi)
        way_px = 6.0 * math.cos(turn_rad), 6.0 * math.sin(turn_rad)
        left, top, light_e = drawn_out_e(CAMERA, u_px, v_px, 3.0, way_px)
        mean_e[top : top + len(light_e), left : left + len(light_e)] += light_e
    hits = perception.detect(expose(mean_e, CAMERA, random(43), exposure_s), camera)
    assert len(hits) == told
