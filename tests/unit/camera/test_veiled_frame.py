"""Frames of lights made by hand through a lens with glare, ghosts and a focus."""

import dataclasses

import numpy as np
import pytest

from nir_render import Scene, load_scene
from nir_render.camera.mean_frame import mean_frame
from nir_render.camera.optics.veil import veil
from nir_render.light.light import DirectTable, Indirect, Light
from tests.paths import SCENES

SPREAD = "robots.r1.rig.cameras.front.point_spread"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(SCENES / "one_source.yaml")


def _light() -> Light:
    """Two sources, 2 and 6 m away, off the axis, and the light of the second from everywhere."""
    directions = np.array([[0.2, 0.1, 1.0], [-0.4, 0.3, 1.0]])
    table = DirectTable(
        group=np.array([0, 1]), facet=np.array([-1, -1]), seen=np.ones((2, 64), dtype=bool),
        direction=directions / np.linalg.norm(directions, axis=1, keepdims=True), distance_m=np.array([2.0, 6.0]),
        angular_radius_rad=np.array([0.005, 0.0017]), visible_fraction=np.ones(2),
        irradiance_per_w=np.array([[0.02], [0.002]]), visibility_rays=64,
    )  # fmt: skip
    radiance = np.zeros((2, 1, 960, 1280), dtype=np.float32)
    radiance[1] = 1e-4
    return Light(
        "r1.front", 0.0, 1, ("r1.top", "r2.top"), (940e-9,), table, Indirect(radiance, radiance, 1, 16)
    )


@pytest.mark.parametrize("with_indirect", [True, False])
def test_a_frame_is_core_and_veil(scene: Scene, with_indirect: bool) -> None:
    """All electrons of the core, each light's share of it, and of these the veil: float32 keeps 1e-6.

    One source is dimmed to a half by its drive: so is its veil, with it.
    """
    light = _light() if with_indirect else dataclasses.replace(_light(), indirect=None)
    changes = {
        f"{SPREAD}.glare": {"share": "5 %", "core_radius": "12 px", "exponent": 1.5},
        f"{SPREAD}.ghosts": [{"share": "1 %", "radius": "30 px"}],
    }
    plain, veiled = (
        mean_frame(light, scene.at(0.0), 1e-3),
        mean_frame(light, scene.with_(changes).at(0.0), 1e-3),
    )
    _, camera = scene.with_(changes).camera("r1.front")
    core_e = 0.94 * plain.electrons
    np.testing.assert_allclose(veiled.electrons, core_e + veil(camera, core_e), rtol=2e-6, atol=1e-6)
    assert veiled.windows[0].total == pytest.approx(plain.windows[0].total)
    half = {**changes, "robots.r1.rig.sources.top.drive": 0.5, "robots.r2.rig.sources.top.drive": 0.5}
    dimmed = mean_frame(light, scene.with_(half).at(0.0), 1e-3)
    np.testing.assert_allclose(dimmed.electrons, 0.5 * veiled.electrons, rtol=2e-6, atol=1e-6)


def test_what_is_out_of_focus_is_so_by_its_own_distance(scene: Scene) -> None:
    """Focused at 6 m: the source there is as sharp as ever, that at 2 m a disc of f²/N (1/z − 1/z_f).

    z is the depth: 2 m / √1.05 here. The variance of the core grows by D²/16 on each axis.
    """
    focal_m = 5e-3
    lens = "robots.r1.rig.cameras.front.lens"
    depth_m = 6.0 / float(np.sqrt(1.25))
    sharp = scene.with_({f"{lens}.focal_length": f"{focal_m} m"})
    focused = sharp.with_({f"{lens}.focus_distance": f"{depth_m!r} m"})
    moments = []
    for one in (sharp, focused):
        windows = mean_frame(dataclasses.replace(_light(), indirect=None), one.at(0.0), 1e-3).windows
        found = []
        for window in windows:
            u_px = np.arange(window.values.shape[1])
            of_column = window.values.sum(axis=0) / window.values.sum()
            found.append(of_column @ (u_px - of_column @ u_px) ** 2)
        moments.append(found)
    near_m = 2.0 / np.sqrt(1.05)
    circle_px = focal_m / 2.0 * focal_m * (depth_m - near_m) / (near_m * (depth_m - focal_m)) / 3.75e-6
    assert moments[1][1] == pytest.approx(moments[0][1], rel=1e-6)
    assert moments[1][0] - moments[0][0] == pytest.approx(circle_px**2 / 16.0, rel=2e-3)
    assert circle_px > 1.0
