"""Flares before straight edges, as where walls end: found, and measured as well as light allows beside an edge."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr

import perception
from perception.types import Detection
from tests.unit.perception.simulation import calibration, expected_e, expose, random

Array = NDArray[np.float64]

EXPOSURE_S = 3e-4
DARK_E, SLOPE_RAD = 20.0, 0.3
ABOVE_PX = (0.5, 1.5, 2.5, 3.5, 5.0, 6.5, 8.0, 10.0, 13.0, -1.0, -2.5, -4.0)


def step_e(
    bright_e: float, offset_px: float = 0.0, slope_rad: float = SLOPE_RAD, sigma_px: float = 0.7
) -> Array:
    """A background brighter above a straight line through the frame's middle, seen through the point spread."""
    rows, columns = np.mgrid[:960, :1280].astype(np.float64)
    line = 480.0 + offset_px + math.tan(slope_rad) * (columns - 640.0)
    across_px = (line - rows) * math.cos(slope_rad)
    return DARK_E + bright_e * np.asarray(ndtr(across_px / math.hypot(sigma_px, 12**-0.5)))


def places_of(frame: int) -> list[tuple[float, float]]:
    """Twelve flares along the line, each so far above it as `ABOVE_PX` says, in another order in each frame."""
    order = ABOVE_PX[frame % 12 :] + ABOVE_PX[: frame % 12]
    places = []
    for k, above_px in enumerate(order):
        u = 80.0 + 95.0 * k + random(7, frame, k).uniform(-20.0, 20.0)
        v = 480.0 + math.tan(SLOPE_RAD) * (u - 640.0) - above_px + random(8, frame, k).uniform(-0.5, 0.5)
        places.append((u, v))
    return places


def pulls_of(hit: Detection, place: tuple[float, float], range_m: float) -> tuple[float, float, float]:
    return (
        (hit.u_px - place[0]) / hit.u_sigma_px,
        (hit.v_px - place[1]) / hit.v_sigma_px,
        (hit.range_m - range_m) / hit.range_sigma_m,
    )


@pytest.mark.parametrize(
    ("bright_e", "range_m", "frames"),
    [
        (100.0, 7.0, 2),
        (300.0, 4.0, 1),
        pytest.param(30.0, 7.0, 12, marks=pytest.mark.verify),
        pytest.param(100.0, 7.0, 12, marks=pytest.mark.verify),
        pytest.param(300.0, 7.0, 12, marks=pytest.mark.verify),
        pytest.param(300.0, 4.0, 12, marks=pytest.mark.verify),
        pytest.param(300.0, 2.0, 12, marks=pytest.mark.verify),
    ],
)
def test_flares_on_an_edge_are_found_and_their_sigmas_hold(
    bright_e: float, range_m: float, frames: int
) -> None:
    """Sources 0 to 13 px from the edge of a bright half of the frame.

    Expected: at least 99 % are found, none is told that is not there, and pulls of place and range have a root
    mean square of 1 (within 15 %, or what so few show). Without edges in the fit, pulls were 1.8 at a step of
    100 e, 2.6 at 300 e where one in twenty was lost, and nearer sources had up to two false ones a frame.
    """
    camera = calibration()
    pulls, lost, others = [], 0, 0
    background_e = step_e(bright_e)
    for frame in range(frames):
        places = places_of(frame)
        image_e = expected_e(camera, [(u, v, range_m) for u, v in places], EXPOSURE_S) + background_e
        found = perception.detect(
            expose(image_e, camera, random(9, frame, int(bright_e)), EXPOSURE_S), camera
        )
        hits = [[one for one in found if math.hypot(one.u_px - u, one.v_px - v) < 1.0] for u, v in places]
        lost += sum(not each for each in hits)
        others += len(found) - sum(map(len, hits))
        pulls += [pulls_of(each[0], place, range_m) for each, place in zip(hits, places, strict=True) if each]
    assert others == 0
    assert lost <= 0.01 * 12 * frames
    within = max(0.15, 3.0 / math.sqrt(2 * len(pulls)))
    assert np.sqrt(np.mean(np.square(pulls), axis=0)) == pytest.approx([1.0] * 3, abs=within)
    # One of 144 at 2 m shares a cluster with the bright rim of the frame, where no edge is tried.
    assert np.mean(np.abs(pulls) > 5.0) <= 0.003


@pytest.mark.parametrize(
    ("bright_e", "range_m", "apart_px", "frames"),
    [
        (300.0, 4.0, 3.0, 1),
        pytest.param(100.0, 7.0, 3.0, 4, marks=pytest.mark.verify),
        pytest.param(300.0, 4.0, 3.0, 4, marks=pytest.mark.verify),
        pytest.param(100.0, 7.0, 2.0, 4, marks=pytest.mark.verify),
        pytest.param(300.0, 4.0, 2.0, 4, marks=pytest.mark.verify),
    ],
)
def test_pairs_on_an_edge_are_two(bright_e: float, range_m: float, apart_px: float, frames: int) -> None:
    """Two sources side by side, one a tenth farther, in any direction from each other, -4 to 13 px from an edge.

    Expected: at least 97 % are found within half of their distance, none is told that is not there (but two as
    one, `merged`), and pulls of their places have a root mean square of 1; ranges know that one may hide the other.
    One after the other, edges and flares found 81, 56, 61 and 66 of these 96, pulls up to 1.6.
    """
    camera = calibration()
    pulls, lost, others = [], 0, 0
    for frame in range(frames):
        sources = []
        for k, (u, v) in enumerate(places_of(frame)):
            turn_rad = random(21, frame, k).uniform(0.0, 2.0 * math.pi)
            sources.append((u, v, range_m))
            beside = u + apart_px * math.cos(turn_rad), v + apart_px * math.sin(turn_rad)
            sources.append((*beside, 1.1 * range_m))
        image_e = expected_e(camera, sources, EXPOSURE_S) + step_e(bright_e)
        found = perception.detect(
            expose(image_e, camera, random(9, frame, int(bright_e)), EXPOSURE_S), camera
        )
        hits = [
            [one for one in found if math.hypot(one.u_px - u, one.v_px - v) < 0.5 * apart_px]
            for u, v, _ in sources
        ]
        lost += sum(not each for each in hits)
        as_one = [
            one.merged and min(math.hypot(one.u_px - u, one.v_px - v) for u, v, _ in sources) < apart_px
            for one in found
            if not any(one in each for each in hits)
        ]
        others += len(as_one) - sum(as_one)
        pulls += [pulls_of(each[0], (u, v), r) for each, (u, v, r) in zip(hits, sources, strict=True) if each]
    assert lost <= 0.03 * 24 * frames
    assert others == 0
    within = max(0.15, 3.0 / math.sqrt(2 * len(pulls)))
    rms_u, rms_v, rms_range = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert [rms_u, rms_v] == pytest.approx([1.0, 1.0], abs=within)
    assert rms_range < 1.0 + within


@pytest.mark.parametrize(
    ("range_m", "least_found"), [(4.0, 24), pytest.param(7.0, 20, marks=pytest.mark.verify)]
)
def test_flares_on_a_rim_fifty_times_as_bright_as_the_ground_are_found(
    range_m: float, least_found: int
) -> None:
    """A step of 1 000 e over 20, all of whose rim is one blob: of 24 flares 16 at 7 m were found.

    Of those on its dark side, fainter than twice the step, some look like corners of what is bright.
    """
    camera = calibration()
    pulls, others = [], 0
    for frame in range(2):
        places = places_of(frame)
        image_e = expected_e(camera, [(u, v, range_m) for u, v in places], EXPOSURE_S) + step_e(1000.0)
        found = perception.detect(expose(image_e, camera, random(9, frame, 1000), EXPOSURE_S), camera)
        hits = [[one for one in found if math.hypot(one.u_px - u, one.v_px - v) < 1.0] for u, v in places]
        others += len(found) - sum(map(len, hits))
        pulls += [pulls_of(each[0], place, range_m) for each, place in zip(hits, places, strict=True) if each]
    assert others == 0
    assert len(pulls) >= least_found
    within = 3.0 / math.sqrt(2 * len(pulls))
    assert np.sqrt(np.mean(np.square(pulls), axis=0)) == pytest.approx([1.0] * 3, abs=within)


@pytest.mark.parametrize("radius_px", [4.5, 5.0, 5.5, 6.0])
def test_discs_as_large_as_a_hill_are_told_once(radius_px: float) -> None:
    """24 near sources on an even dark ground, each a blob of 180 to 270 pixels."""
    camera = calibration()
    range_m = camera.fx_px * camera.source_radius_m / radius_px
    places = [(120.2 + 200.0 * (k % 6), 120.3 + 200.0 * (k // 6)) for k in range(24)]
    image_e = expected_e(camera, [(u, v, range_m) for u, v in places], 1e-4) + DARK_E
    found = perception.detect(expose(image_e, camera, random(31, int(10 * radius_px)), 1e-4), camera)
    assert len(found) == 24
    assert not any(one.merged for one in found)
    assert [one.range_m for one in found] == pytest.approx([range_m] * 24, rel=0.01)


def test_bright_rectangles_are_no_flares() -> None:
    """Twelve of 3 000 e, turned any way: corners stand out of most of what lies around them."""
    camera = calibration()
    rows, columns = np.mgrid[:960, :1280].astype(np.float64)
    image_e = np.full(rows.shape, DARK_E)
    for k in range(12):
        u, v, turn_rad = 150.0 + 300.0 * (k % 4), 160.0 + 300.0 * (k // 4), 0.5 * k
        along = (columns - u) * math.cos(turn_rad) + (rows - v) * math.sin(turn_rad)
        across = (rows - v) * math.cos(turn_rad) - (columns - u) * math.sin(turn_rad)
        width_px = math.hypot(0.7, 12**-0.5)
        sides = [
            ndtr((half_px - side * at) / width_px)
            for at, half_px in ((along, 20.0), (across, 14.0))
            for side in (-1.0, 1.0)
        ]
        image_e += 3000.0 * np.prod(sides, axis=0)
    assert not perception.detect(expose(image_e, camera, random(32), EXPOSURE_S), camera)


def test_a_bar_behind_a_flare_is_two_edges() -> None:
    """A bright bar 5 px wide, as a door frame or a tube, from which flares stand 0 to 8 px."""
    camera = calibration()
    pulls = []
    for frame in range(2):
        us = [100.0 + 100.0 * k + random(3, frame, k).uniform(-20.0, 20.0) for k in range(11)]
        places = [
            (u, 480.0 + math.tan(SLOPE_RAD) * (u - 640.0) - away)
            for u, away in zip(us, range(-2, 9), strict=True)
        ]
        image_e = expected_e(camera, [(u, v, 6.0) for u, v in places], EXPOSURE_S)
        image_e += step_e(200.0) - step_e(200.0, -5.0) + DARK_E
        found = perception.detect(expose(image_e, camera, random(4, frame), EXPOSURE_S), camera)
        for u, v in places:
            hits = [one for one in found if math.hypot(one.u_px - u, one.v_px - v) < 1.0]
            assert len(hits) == 1
            pulls.append(pulls_of(hits[0], (u, v), 6.0))
        assert len(found) == len(places)
    assert np.sqrt(np.mean(np.square(pulls), axis=0)) == pytest.approx([1.0] * 3, abs=3.0 / math.sqrt(2 * 22))


@pytest.mark.parametrize("above_px", [-2.0, 0.0, 2.0, 5.0])
def test_sigmas_beside_an_edge_are_those_that_light_allows(above_px: float) -> None:
    """The Cramér-Rao bound by differences of the simulator's own images, all of the edge unknown.

    Expected: the σ of place and range that a detection states is within 12 % of the bound of its window, whose
    edge may lie, run and rise as it likes (the stack knows its width a priori, within a third).
    """
    camera, range_m, bright_e = calibration(), 7.0, 300.0
    u, v = 640.0 + 0.3, 480.0 - above_px
    known = np.array([u, v, range_m, 0.0, SLOPE_RAD, 0.0, bright_e, 0.0])

    def image(values: Array) -> Array:
        u, v, range_m, offset, slope, log_width, height, level = values
        background_e = step_e(height, offset, slope, 0.7 * math.exp(log_width)) + level
        near = np.s_[round(known[1]) - 10 : round(known[1]) + 11, 630:651]
        return np.asarray((expected_e(camera, [(u, v, range_m)], EXPOSURE_S) + background_e)[near])

    steps = np.array([0.01, 0.01, 0.01, 0.01, 0.001, 0.01, 1.0, 1.0])
    slopes = np.stack(
        [
            (image(known + h) - image(known - h)).ravel() / (2.0 * s)
            for h, s in zip(np.diag(steps), steps, strict=True)
        ]
    )
    shot = expose(
        image_of_frame(camera, (u, v, range_m), bright_e), camera, random(5, int(above_px) + 9), EXPOSURE_S
    )
    variance_e2 = image(known).ravel() + camera.read_noise_e**2
    information = (slopes / variance_e2) @ slopes.T
    information[5, 5] += 1.0 / 0.3**2
    bound = np.sqrt(np.diagonal(np.linalg.inv(information)))[:3]
    (hit,) = perception.detect(shot, camera)
    assert [hit.u_sigma_px, hit.v_sigma_px, hit.range_sigma_m] == pytest.approx(bound, rel=0.12)


def image_of_frame(
    camera: perception.Calibration, source: tuple[float, float, float], bright_e: float
) -> Array:
    return np.asarray(expected_e(camera, [source], EXPOSURE_S) + step_e(bright_e))
