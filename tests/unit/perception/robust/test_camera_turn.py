"""Cameras that turn while they are exposed, by brute force."""

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

import perception
from perception.model.bearing import direction_camera, turn_slopes_px
from perception.model.lens import project
from perception.model.window import Camera, Turn
from perception.robust.clusters import candidates, clusters
from perception.robust.flare import MeasuredFlare
from perception.robust.measure import measure
from perception.robust.search.blobs import blobs_at
from perception.robust.search.prepare import prepare
from perception.types import Calibration, Detections
from tests.moving_flares import CAMERA, drawn_out_e, lit_for
from tests.unit.perception import simulation
from tests.unit.perception.simulation import expose, random

Array = NDArray[np.float64]

EXPOSURE_S = 5e-4
KNOWN = replace(CAMERA, **(lit_for(EXPOSURE_S) | {"sigma": {}}))
PAN_1_PX = (-0.6 / KNOWN.fx_px, 0.8 / KNOWN.fx_px, 0.0)


def flares(number: np.random.Generator, nearest_m: float = 1.2, farthest_m: float = 3.0) -> Array:
    """Return u, v and range of 20 flares, 100 px or more apart."""
    columns, rows = np.meshgrid(np.arange(70.0, 600.0, 125.0), np.arange(60.0, 480.0, 120.0))
    places = np.column_stack([columns.ravel(), rows.ravel()]) + number.uniform(-10.0, 10.0, (20, 2))
    return np.column_stack([places, number.uniform(nearest_m, farthest_m, 20)])


def swept_px(places: Array, turn_rad: tuple[float, float, float]) -> Array:
    """Return the way of what rests at places in the middle of a turn, by the camera's place at both its ends."""
    tangent = (places - (KNOWN.cx_px, KNOWN.cy_px)) / (KNOWN.fx_px, KNOWN.fy_px)
    direction = np.column_stack([tangent, np.ones(len(places))])
    half = 0.5 * np.array(turn_rad)
    before, beyond = (
        simulation.project(Rotation.from_rotvec(turn).inv().apply(direction), KNOWN) for turn in (-half, half)
    )
    return np.asarray(beyond - before)


def told_of(
    sources: Array,
    ways_px: Array,
    *key: int,
    through: Calibration = CAMERA,
    ground_e: Array | float = 10.0,
) -> Detections:
    """Return what is told of flares that move so, seen through a lens, and asserted to be one each."""
    mean_e = ground_e + np.zeros((KNOWN.height_px, KNOWN.width_px))
    for (u, v, range_m), way in zip(sources.tolist(), ways_px.tolist(), strict=True):
        left, top, light_e = drawn_out_e(through, u, v, range_m, (way[0], way[1]))
        mean_e[top : top + len(light_e), left : left + len(light_e)] += light_e
    told = perception.detect(expose(mean_e, KNOWN, random(*key), EXPOSURE_S), KNOWN)
    order = [
        min(range(len(told)), key=lambda k: math.hypot(told[k].u_px - u, told[k].v_px - v))
        for u, v, _ in sources
    ]
    assert sorted(order) == list(range(len(sources)))
    told[:] = [told[k] for k in order]
    return told


def pulls(told: Detections, sources: Array) -> Array:
    """Return the errors of ranges in σ."""
    return np.array(
        [
            (one.range_m - range_m) / one.range_sigma_m
            for one, (_, _, range_m) in zip(told, sources, strict=True)
        ]
    )


@pytest.mark.parametrize(
    ("turn_rad", "tolerance"),
    [
        (PAN_1_PX, 0.06),
        ((1.5 / KNOWN.fx_px, 0.0, 0.0), 0.03),
        ((0.0, 0.0, 0.008), 0.03),
        ((0.4 / KNOWN.fx_px, 3.0 / KNOWN.fx_px, -0.003), 0.02),
    ],
)
def test_flares_are_one_each_and_ranges_as_exact_as_from_a_camera_at_rest(
    turn_rad: tuple[float, float, float], tolerance: float
) -> None:
    """Turns at 4 to 16 rad/s, of which each flare alone believes none: half of them were perhaps two, and
    ranges off by three times as much as here."""
    sources = flares(random(311))
    ways_px = swept_px(sources[:, :2], turn_rad)
    told, at_rest = told_of(sources, ways_px, 312), told_of(sources, 0.0 * ways_px, 312)
    assert at_rest.swept_px == 0.0
    assert told.swept_px == pytest.approx(float(np.median(np.hypot(*ways_px.T))), rel=tolerance)
    assert not any(one.merged for one in told)
    off = pulls(told, sources)
    assert float(np.mean(off**2)) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / len(off)))
    wider = [one.range_sigma_m / still.range_sigma_m for one, still in zip(told, at_rest, strict=True)]
    assert 1.0 < np.median(wider) < 1.25
    assert max(wider) < 1.6


@pytest.mark.parametrize(
    "camera",
    [
        KNOWN,
        replace(KNOWN, lens_model="brown_conrady", distortion=(-0.2, 0.05, 0.001, -0.002)),
        replace(KNOWN, lens_model="fisheye", distortion=(0.02, -0.01, 0.0, 0.0)),
    ],
)
def test_places_move_as_the_camera_turns(camera: Calibration) -> None:
    """By differences of what is seen before and after small rotations, through each lens."""
    places = np.array([(319.5, 239.5), (30.0, 50.0), (600.0, 300.0)])
    direction = direction_camera(places, camera)
    told = turn_slopes_px(places, camera)
    for axis in np.eye(3):
        before, beyond = (
            project(Rotation.from_rotvec(turn * axis).inv().apply(direction), camera)
            for turn in (-1e-4, 1e-4)
        )
        assert told @ axis == pytest.approx((beyond - before) / 2e-4, rel=1e-4, abs=0.01)


def test_flares_that_move_themselves_or_past_the_camera_are_no_turn() -> None:
    """Each 1.2 px some way; a third of them, all alike; and all alike, by 3 px at one metre."""
    sources, number = flares(random(321), 0.9), random(322)
    angle_rad = number.uniform(0.0, math.pi, len(sources))
    any_way_px = 1.2 * np.column_stack([np.cos(angle_rad), np.sin(angle_rad)])
    few_px = np.where(np.arange(len(sources)) % 3 == 0, 1.2, 0.0)[:, None] * (0.6, 0.8)
    past_px = (3.0 / sources[:, 2])[:, None] * (1.0, 0.0)
    for key, ways_px in enumerate((any_way_px, few_px, past_px)):
        assert told_of(sources, ways_px, 323, key).swept_px == 0.0


def test_flares_on_texture_are_not_lost_as_the_camera_turns() -> None:
    """On 10 % hills of 6 px, swept by 2 px: all 20 were taken for leaves and slits, which are long, too."""
    hills = gaussian_filter(random(361).normal(size=(KNOWN.height_px, KNOWN.width_px)), 6.0, mode="wrap")
    sources = flares(random(362))
    ways_px = 2.0 * swept_px(sources[:, :2], PAN_1_PX)
    told = told_of(sources, ways_px, 363, ground_e=100.0 + 10.0 * hills / hills.std())
    assert told.swept_px == pytest.approx(float(np.median(np.hypot(*ways_px.T))), rel=0.04)
    off = pulls(told, sources)
    assert float(np.mean(off**2)) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / len(off)))


def test_one_flare_of_few_tells_of_no_turn() -> None:
    """Of three two move by 1.5 px, each its own way; near the axis the third would not contradict a roll."""
    told = 0
    for key in range(12):
        number = random(325, key)
        sources = flares(number)[[0, 7, 17]]
        angle_rad = number.uniform(0.0, math.pi, 2)
        ways_px = 1.5 * np.array([[math.cos(one), math.sin(one)] for one in angle_rad] + [[0.0, 0.0]])
        told += told_of(sources, ways_px[[0, 2, 1]], 326, key).swept_px > 0.0
    assert told <= 1


@pytest.mark.parametrize("longer", [0.03, 0.06, 0.1])
def test_a_point_spread_that_is_not_round_is_no_turn(longer: float) -> None:
    """σ² larger along u by a share, and smaller along v: a turn is as wide as the calibration says across."""
    across = replace(CAMERA, psf_sigma_px=CAMERA.psf_sigma_px * math.sqrt(1.0 - longer))
    way_px = math.sqrt(12.0 * 2.0 * longer) * CAMERA.psf_sigma_px
    sources = flares(random(327), 1.5, 5.0)
    ways_px = np.full((len(sources), 2), (way_px, 0.0))
    assert told_of(sources, ways_px, 328, through=across).swept_px == 0.0


@pytest.mark.parametrize(("range_m", "sigma_k"), [(2.5, 0.0), (0.9, 0.0), (0.6, 0.1)])
def test_what_own_motions_change_of_a_range_is_what_other_turns_find(range_m: float, sigma_k: float) -> None:
    """A flare swept by 2 px, without noise: by its fits where it is swept by 0.1 px more or less along u and v.

    Told is that of robots that cross the view at 0.7 m/s, in quadrature with a turn known to 0.1 px.
    """
    sigma = {"range_constant_dn_m2_per_s": sigma_k * KNOWN.range_constant_dn_m2_per_s}
    camera = replace(CAMERA, cx_px=320.2, cy_px=240.3)
    known = replace(KNOWN, sigma=sigma, cx_px=320.2, cy_px=240.3)
    left, top, light_e = drawn_out_e(camera, 320.2, 240.3, range_m, (1.6, 1.2))
    mean_e = np.full((known.height_px, known.width_px), 10.0)
    mean_e[top : top + len(light_e), left : left + len(light_e)] += light_e
    counts = np.rint(known.system_gain_dn_per_e * mean_e + known.black_level_dn).astype(np.uint16)
    prepared = prepare(replace(expose(mean_e, known, random(341), EXPOSURE_S), data_dn=counts), known)
    found = clusters(
        candidates(blobs_at(prepared.lit_at, prepared.lit_e, known.width_px), prepared), prepared
    )

    def measured(along_u_px: float, along_v_px: float) -> MeasuredFlare:
        turn = np.array([along_v_px, -along_u_px, 0.0]) / known.fx_px
        known_turn = Turn(turn, np.diag([0.1, 0.1, 0.0]) ** 2 / known.fx_px**2)
        ((_, one),), _ = measure(found, prepared, Camera(known, EXPOSURE_S, 1.0, turn=known_turn))
        return one

    slopes = []
    for along_u, along_v in ((0.1, 0.0), (0.0, 0.1)):
        more, less = measured(1.6 + along_u, 1.2 + along_v), measured(1.6 - along_u, 1.2 - along_v)
        slopes.append(math.log(more.range_m / less.range_m) / 0.2)
    moved_px = math.hypot(known.fx_px * EXPOSURE_S * 0.7 / range_m, 0.1)
    assert measured(1.6, 1.2).log_range_of_model == pytest.approx(math.hypot(*slopes) * moved_px, rel=0.04)


def test_a_time_limit_leaves_no_flare_at_rest() -> None:
    """The brightest eight, measured first, are near, clipped, and tell nothing of the turn."""
    sources = flares(random(351), 1.5, 3.0)
    sources[::3, 2] = 0.35
    ways_px = 1.3 * swept_px(sources[:, :2], PAN_1_PX)
    mean_e = np.full((KNOWN.height_px, KNOWN.width_px), 10.0)
    for (u, v, range_m), way in zip(sources.tolist(), ways_px.tolist(), strict=True):
        left, top, light_e = drawn_out_e(CAMERA, u, v, range_m, (way[0], way[1]))
        mean_e[top : top + len(light_e), left : left + len(light_e)] += light_e
    frame = expose(mean_e, KNOWN, random(352), EXPOSURE_S)
    told, limited = perception.detect(frame, KNOWN), perception.detect(frame, KNOWN, limit_s=1e3)
    assert len(told) == len(limited) == len(sources)
    assert limited.swept_px == pytest.approx(told.swept_px, rel=0.03)
    assert sum(one.merged for one in limited) == sum(one.merged for one in told)


@pytest.mark.verify
def test_own_motions_beside_a_turn_are_within_what_is_told() -> None:
    """Robots that cross the view at 0.7 m/s, one standard deviation of each part, from a camera that turns."""
    off = []
    for key in range(12):
        number = random(331, key)
        sources = flares(number, 0.8, 3.0)
        own_px = number.normal(size=(len(sources), 2)) * (KNOWN.fx_px * EXPOSURE_S * 0.7 / sources[:, 2:])
        told = told_of(sources, swept_px(sources[:, :2], PAN_1_PX) * 1.6 + own_px, 332, key)
        assert told.swept_px > 1.2
        off.append(pulls(told, sources))
    assert float(np.mean(np.square(off))) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.0 / np.size(off)))
