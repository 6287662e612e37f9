"""Headings of robots with several LEDs from raw frames: nearly end-on, and of unlike power in one calibration."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from perception.rig.measure_set import detect_set
from perception.rig.moving import at_one_time
from perception.rig.pose.sights import sights_of
from perception.rig.sightings import sightings_of
from perception.types import Layout
from tests.unit.perception.rig.poses import (
    ALIKE,
    COMMON,
    THREE,
    UNLIKE,
    against_bound,
    between,
    figures,
)
from tests.unit.perception.rig.raw_poses import cropped, frames_of_robot, photographed, places_of
from tests.unit.perception.rig.world import detection, frame_without_pixels, rig
from tests.unit.perception.simulation import FLUX_PER_S_AT_1_M

BROAD: dict[str, Any] = {"sigma": {"range_constant_dn_m2_per_s": 0.3 * 0.74 * FLUX_PER_S_AT_1_M}}
KNOWN = replace(UNLIKE, flux_sigma_common=2.0 * COMMON)


@pytest.mark.parametrize(
    ("range_m", "off_deg"), [(1.5, 5.0), (2.7, -3.9), (2.9, 2.2), (3.9, -4.4), (4.7, 4.8)]
)
def test_two_leds_nearly_end_on_are_two_in_their_places(range_m: float, off_deg: float) -> None:
    """One hides a part of the other. As discs that add up they were one flare too near, and others at 5 to 9 m."""
    cameras = {name: replace(camera, layouts=(ALIKE,)) for name, camera in rig().items()}
    pose = np.array([range_m, 0.1 * range_m, 0.05, math.atan(0.1) + math.radians(off_deg)])
    around = cropped(cameras, ALIKE, pose)
    seen = detect_set(frames_of_robot(around, ALIKE, pose, np.random.default_rng(1540)), around)
    assert len(seen.measurements) == 2
    for place in places_of(ALIKE, pose):
        pulls2 = [
            float((place - one.position_body_m) @ np.linalg.solve(one.position_covariance_m2, place - one.position_body_m))
            for one in seen.measurements
        ]  # fmt: skip
        assert min(pulls2) < 20.0  # of three degrees of freedom
    (robot,) = seen.robots
    best = robot.hypotheses[0]
    assert abs(between(best.heading_rad - pose[3], math.pi)) < 4.0 * math.sqrt(best.covariance[3, 3])
    assert best.covariance[3, 3] < math.radians(2.0) ** 2


def test_of_unlike_power_fluxes_tell_who_is_who_where_the_range_constant_does_not() -> None:
    """K ± 30 % of both: ranges lean on sizes, which hardly tell near from far at 5 m; the layout's fluxes do."""
    found = figures(KNOWN, 12, seed=7, look=photographed, **BROAD)
    assert found.lost <= 1
    assert (found.right > 0.99).mean() >= 0.9
    assert (found.named > 0.0).all()
    assert np.abs(found.error[~found.astray] / found.sigma[~found.astray]).max() < 4.0


def test_a_range_by_flux_and_size_is_parted_again() -> None:
    """ln d = (ln D / a + ln s / b) / (1 / a + 1 / b) with a of flux and K, b of size; what fits leave of them is here."""
    (name, camera), *_ = rig(**BROAD).items()
    frame = frame_without_pixels(camera)
    hit = detection(camera, np.array([3.0, 0.2, 0.3]), np.random.default_rng(1))
    assert hit is not None
    share, by_size_m, size_sigma = 0.01, 3.1, 0.04
    flux_range_m = 2.5
    axis = camera.rotation_body_camera[:, 2]
    cosine = float(np.array(hit.bearing_body) @ axis)
    flux_dn = camera.range_constant_dn_m2_per_s * frame.exposure_s * cosine / flux_range_m**2
    flux_range_m /= 1.0 + 0.375 * share**2  # as of a range by flux
    a, b = (0.5 * 0.3) ** 2 + (0.5 * share) ** 2, size_sigma**2
    log_range = (math.log(flux_range_m) / a + math.log(by_size_m) / b) / (1.0 / a + 1.0 / b)
    range_m, sigma = math.exp(log_range), math.sqrt(1.0 / (1.0 / a + 1.0 / b))
    hit = replace(
        hit, flux_dn=flux_dn, flux_sigma_dn=share * flux_dn, range_m=range_m, range_sigma_m=range_m * sigma,
        range_sigma_common_m=range_m * 0.15 * sigma**2 / a,
    )  # fmt: skip
    calibrations = {name: camera}
    known = at_one_time(sightings_of([frame], [[hit]], calibrations), ())
    sights = sights_of(known, [frame], [[hit]], calibrations)
    assert sights.size.tolist() == [1]
    assert np.exp(sights.log_range) == pytest.approx([flux_range_m, by_size_m], rel=1e-9)
    assert sights.by_flux.tolist() == [1.0, 0.0]
    assert np.sqrt(sights.own[:, 2, 2]) == pytest.approx([0.5 * share, size_sigma], rel=1e-9)
    assert math.hypot(sights.constant[0], float(sights.shared[0, 2, 6])) == pytest.approx(0.15, rel=1e-9)
    assert sights.constant[1] == 0.0
    assert not sights.shared[1].any()
    # Fluxes of a scale of one's own, as another program may give them, are not listened to.
    other = [[replace(hit, flux_dn=50.0 * flux_dn, flux_sigma_dn=50.0 * share * flux_dn)]]
    assert sights_of(known, [frame], other, calibrations).size.tolist() == [-1]


@pytest.mark.verify
@pytest.mark.parametrize(
    ("layout", "turn", "changes"),
    [(ALIKE, math.pi, {}), (KNOWN, 2.0 * math.pi, BROAD), (THREE, 2.0 * math.pi, {})],
    ids=["alike", "unlike", "three"],
)
def test_headings_from_raw_frames(layout: Layout, turn: float, changes: dict[str, Any]) -> None:
    """40 poses each; `benchmarks/headings.py --raw` takes more.

    One in twenty is within a degree or two of end-on: one flare, no heading. Bounds know nothing of what sources
    hide of each other, so that only of two alike, which hide each other seldom, they are held against.
    """
    found = figures(layout, 40, turn, seed=1541, look=photographed, **changes)
    assert found.lost <= 5
    assert found.astray.sum() <= 1
    if layout is ALIKE:
        right = replace(found, **{
            name: getattr(found, name)[~found.astray] for name in ("error", "sigma", "bound", "pulls2")
        })  # fmt: skip
        assert against_bound(right)[0] < 1.25
