"""What detections say as rays, against the same by NumPy, and sets in which nothing is seen."""

import math
from dataclasses import replace

import numpy as np

from perception.model.bearing import pixel_turn
from perception.model.lens import unproject, unproject_each
from perception.rig.measure_set import measure_set
from perception.rig.rays import UNKNOWN_RANGE
from perception.rig.sightings import sightings_of
from perception.types import Detection, bearing_axes
from tests.unit.perception.rig.world import detection, frame_without_pixels, rig
from tests.unit.perception.simulation import random

NAN, INF = math.nan, math.inf
# Range, its σ and the common part of it, σ of u and v; whether it is saturated.
CASES = [
    (2.0, 0.02, 0.01, 0.03, 0.05, False),
    (2.0, 0.02, 0.0, 0.03, 0.05, False),
    (3.0, 0.3, 0.25, 0.03, 0.05, False),
    (3.0, 1e-6, 0.0, 1e-6, 1e-6, False),
    (2.0, 0.02, NAN, NAN, 0.05, False),
    (2.0, NAN, NAN, 0.03, INF, False),
    (2.0, NAN, NAN, 0.03, 0.05, True),
    (2.0, 0.1, 0.02, 0.03, 0.05, True),
    (NAN, NAN, NAN, 0.03, 0.05, False),
    (INF, INF, INF, 0.03, 0.05, False),
    (0.0, 0.1, 0.0, 0.03, 0.05, False),
    (2e4, 0.1, 0.0, 0.03, 0.05, False),
]


def test_rays_are_what_the_detections_say() -> None:
    """With a rolling shutter and uncertain mountings; the axes of a bearing as the contract has them."""
    sigma = {"rotation_body_camera": 2e-3, "position_body_m": 3e-3}
    cameras = {name: replace(camera, sigma=sigma) for name, camera in rig().items()}
    taken, found = [], []
    for number, camera in enumerate(cameras.values()):
        frame = frame_without_pixels(camera)
        taken.append(replace(frame, time_s=0.1 * number, exposure_s=2e-3, line_time_s=1e-5))
        place = camera.position_body_m + camera.rotation_body_camera @ np.array([0.3, -0.1, 2.0])
        seen = detection(camera, place, random(1801, number))
        assert seen is not None
        own = [
            replace(
                seen, range_m=range_m, range_sigma_m=sigma_m, range_sigma_common_m=common_m, u_sigma_px=u,
                v_sigma_px=v, saturated=saturated, v_px=seen.v_px + 7.0 * row, merged=row == 3, ghost=row == 4,
            )
            for row, (range_m, sigma_m, common_m, u, v, saturated) in enumerate(CASES)
        ]  # fmt: skip
        found.append(own[number:])
    told = sightings_of(taken, found, cameras)
    hits = [(frame, hit) for frame, own in zip(taken, found, strict=True) for hit in own]
    assert told.keys[1] == (hits[1][1].camera, hits[1][1].index, 1)
    for row, (frame, hit) in enumerate(hits):
        camera = cameras[hit.camera]
        known = 0.0 < hit.range_m < 1e4 and (math.isfinite(hit.range_sigma_m) or not hit.saturated)
        claimed = known and math.isfinite(hit.range_sigma_m)
        at_m = hit.range_m if known else 1.0
        common = np.nan_to_num(hit.range_sigma_common_m) / at_m if claimed else 0.0
        own2 = common**2 - min(0.5 * common**2, 0.01**2)
        noise = math.sqrt(max((hit.range_sigma_m / at_m) ** 2 - own2, 1e-8)) if claimed else 0.3
        np.testing.assert_allclose(told.rays.range_m[row], hit.range_m if known else NAN, rtol=1e-14)
        np.testing.assert_allclose(told.rays.noise[row], noise if known else UNKNOWN_RANGE, rtol=1e-13)
        np.testing.assert_allclose(told.rays.common[row], math.sqrt(own2), rtol=1e-13)
        assert told.rays.time_s[row] == frame.time_s + 1e-3 + 1e-5 * hit.v_px
        axes = bearing_axes(np.array(hit.bearing_body))
        np.testing.assert_allclose(told.rays.axes[row], axes, atol=1e-15)
        np.testing.assert_array_equal(told.rays.origin_m[row], camera.position_body_m)
        sigmas = [s if math.isfinite(s) else 1.0 for s in (hit.u_sigma_px, hit.v_sigma_px)]
        (turn,) = pixel_turn([[hit.u_px, hit.v_px]], camera)
        slope = axes[:2] @ (turn @ camera.rotation_body_camera.T).T * np.maximum(sigmas, 1e-3)
        mounting_rad2 = 2e-3**2 + (3e-3 / at_m) ** 2
        wanted = slope @ slope.T + mounting_rad2 * np.eye(2)
        np.testing.assert_allclose(told.rays.angular_rad2[row], wanted, rtol=1e-11)
        np.testing.assert_allclose(told.mounting_rad2[row], mounting_rad2, rtol=1e-14)
        assert told.claimed[row] == (np.isfinite(hit.u_sigma_px + hit.v_sigma_px) and (claimed or not known))
        assert (told.saturated[row], told.merged[row], told.ghost[row]) == (
            hit.saturated, hit.merged, hit.ghost,
        )  # fmt: skip


def test_points_of_unlike_lenses_go_through_their_own() -> None:
    laws = [
        ("brown_conrady", (-0.2, 0.05, 1e-3, -1e-3)), ("fisheye", (0.01, -0.02, 0.0, 0.0)), ("rectilinear", ()),
        ("fisheye", (0.01, -0.02, 0.0, 0.0)),
    ]  # fmt: skip
    cameras = [
        replace(camera, lens_model=model, distortion=distortion, cx_px=camera.cx_px + 3.0 * number)
        for number, (camera, (model, distortion)) in enumerate(zip(rig().values(), laws, strict=True))
    ]
    draw = random(1802)
    camera = draw.integers(0, 4, 60)
    points_px = draw.uniform([300.0, 200.0], [900.0, 700.0], (60, 2))
    found = unproject_each(points_px, cameras, camera)
    for point, number, direction in zip(points_px, camera, found, strict=True):
        np.testing.assert_allclose(direction, unproject(point[None], cameras[number])[0], atol=1e-14)


def test_sets_in_which_nothing_is_seen_measure_nothing() -> None:
    cameras = rig(own_source=True)
    nothing: list[list[Detection]] = [[] for _ in cameras]
    assert measure_set([], [], cameras).measurements == ()
    assert measure_set([frame_without_pixels(one) for one in cameras.values()], nothing, cameras).planes == ()
