"""Ranges in fog whose droplets throw a third of the scattered light into the flare: rendered frames, robust fit."""

from dataclasses import replace

import numpy as np
import pytest

import perception
from nir_render import calibration, expose, parse_scene, render

pytestmark = [pytest.mark.mitsuba, pytest.mark.vectorised, pytest.mark.verify]

PLACES = {"r2": (4.0, 0.9), "r3": (6.0, -1.4), "r4": (8.0, 0.6)}


def test_ranges_in_heavy_advection_fog_hold_with_extinction_known_and_unknown() -> None:
    """Three robots 4 to 8 m away in the dark, V = 50 m, the paper's rig, single frames of 1 ms.

    With σ(940) known, ranges by flux are short by what the forward peak brings into the flare, ½ 0.09 σd/(1 + ½ σd): 1.3, 1.8
    and 2.2 %. Expected: each robot's mean within 1 % of that, the median of all errors below 2 %; below 4 % where σ is not known.
    """
    scene = parse_scene(
        {
            "format": 1,
            "observe": ["r1.front"],
            "fog": {"visibility": "50 m", "droplets": "advection_heavy"},
            "render": {"indirect": {"scale": 1, "samples": 64, "max_depth": 5}},
            "robots": {
                "r1": {"rig": {"preset": "infra_swarm", "cameras": {"front": {"exposure": "1 ms", "sensor": {"columns": 400, "rows": 96}}}}},
                **{name: {"rig": "infra_swarm", "position": f"[{x}, {y}, 0] m"} for name, (x, y) in PLACES.items()},
            },
        }
    )  # fmt: skip
    world = scene.at(0.0)
    assert world.fog is not None
    light = render(scene, camera="r1.front", seed=1)
    unknown = calibration(scene, "r1.front")
    known = replace(
        unknown,
        extinction_per_m=world.fog.extinction_per_m,
        sigma={**unknown.sigma, "extinction_per_m": 1e-6},
    )
    pose = world.camera("r1.front").pose
    towards = [
        pose.rotation.T @ (world.sources[f"{name}.top"].pose.position_m - pose.position_m) for name in PLACES
    ]
    errors: dict[str, list[list[float]]] = {"known": [], "unknown": []}
    for seed in range(4):
        frame = expose(light, scene, exposure_s=1e-3, seed=seed)
        for name, camera in (("known", known), ("unknown", unknown)):
            found = perception.detect(frame, camera)
            row = []
            for x, y, z in towards:
                u_px, v_px = camera.fx_px * x / z + camera.cx_px, camera.fy_px * y / z + camera.cy_px
                (hit,) = (one for one in found if np.hypot(one.u_px - u_px, one.v_px - v_px) < 3.0)
                row.append(hit.range_m / float(np.linalg.norm([x, y, z])) - 1.0)
            errors[name].append(row)
    depth = world.fog.extinction_per_m * np.linalg.norm(towards, axis=1)
    expected = -0.5 * 0.09 * depth / (1.0 + 0.5 * depth)
    np.testing.assert_allclose(np.mean(errors["known"], axis=0), expected, atol=0.01)
    assert np.median(np.abs(errors["known"])) < 0.02
    assert np.median(np.abs(errors["unknown"])) < 0.04
