"""The direct table and the camera against Mitsuba's own path tracer.

Set up: a source 1 m before a pinhole camera of the preset `infra_swarm`, on axis and 40° off it. Once through
`render` and `expected_electrons`; once as an area light on a sphere under Mitsuba's `path` in a spectral
variant, with the camera's spectral sensitivity as the one band of a `specfilm`, on a crop around the image.

Why: nothing of our table, projection, cos⁴ or spectral folding is in Mitsuba's render, so power and centroid
agree only if both are right. Expected: power within 0.5 %, centroid within 0.02 px.
"""

import json
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from scipy import constants

from nir_render import expected_electrons, render
from nir_render.camera.optics.lens import intrinsics_of
from nir_render.camera.optics.response import incidence
from nir_render.transport.backend.variant import backend
from tests.physics.conftest import SceneMaker, source_at

pytestmark = pytest.mark.mitsuba

_CROP_PX = 48
_SAMPLES = 1024
_LOW_NM, _HIGH_NM = 900.0, 980.0

# Another process: a variant can be chosen once only, and this one is not the program's.
_STOCK = """
import json, sys
import numpy as np
import mitsuba as mi
case = json.loads(sys.stdin.read())
mi.set_variant(case["variant"])
film = {"type": "specfilm", "width": case["width"], "height": case["height"], "component_format": "float32",
        "crop_width": case["crop"], "crop_height": case["crop"],
        "crop_offset_x": case["crop_x"], "crop_offset_y": case["crop_y"], "rfilter": {"type": "box"},
        "band": {"type": "regular", "wavelength_min": case["low_nm"], "wavelength_max": case["high_nm"],
                 "values": ",".join(map(repr, case["sensitivity"]))}}
up = mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=[0, 0, 1], up=[0, -1, 0])
scene = mi.load_dict({
    "type": "scene", "integrator": {"type": "path", "max_depth": 2},
    "source": {"type": "sphere", "center": case["centre_m"], "radius": case["radius_m"],
               "emitter": {"type": "area", "radiance": {
                   "type": "regular", "wavelength_min": case["low_nm"], "wavelength_max": case["high_nm"],
                   "values": ",".join(map(repr, case["radiance"]))}}},
    "sensor": {"type": "perspective", "fov": case["fov_deg"], "fov_axis": "x", "to_world": up, "film": film,
               "near_clip": 0.01}})
image = np.array(mi.render(scene, spp=case["samples"], seed=7), dtype=np.float64)
print(json.dumps(image.reshape(case["crop"], case["crop"]).tolist()))
"""


def _stock_electrons(
    scene: Any, direction: np.ndarray, distance_m: float, exposure_s: float
) -> tuple[np.ndarray, int, int]:
    """Render the source by Mitsuba; returns electrons per pixel of the crop, and its first column and row."""
    _, camera = scene.camera("r1.front")
    source = scene.sources()["r2.top"][1]
    intrinsics = intrinsics_of(camera)
    u_px, v_px = intrinsics.project(direction)
    column, row = round(u_px) - _CROP_PX // 2, round(v_px) - _CROP_PX // 2
    nm = np.linspace(_LOW_NM, _HIGH_NM, 801)
    cosines, weights = incidence(camera, np.array([np.arccos(direction[2])]))
    filtered = weights @ camera.filter.transmission(nm[None, :] * 1e-9, cosines[0][:, None])
    sensitivity = 0.9 * filtered * 0.15 * nm * 1e-9 / (constants.h * constants.c)
    sigma_nm = 42.0 / np.sqrt(8.0 * np.log(2.0))
    density_per_nm = np.exp(-0.5 * ((nm - 940.0) / sigma_nm) ** 2) / (sigma_nm * np.sqrt(2.0 * np.pi))
    radiance = source.flux_w / (4.0 * np.pi**2 * source.radius_m**2) * density_per_nm
    scale = 1e-17  # keeps electrons per joule within float32's comfort
    case = {
        "variant": "llvm_ad_spectral" if backend().vectorised else "scalar_spectral",
        "width": intrinsics.width_px,
        "height": intrinsics.height_px,
        "crop": _CROP_PX,
        "crop_x": column,
        "crop_y": row,
        "low_nm": _LOW_NM,
        "high_nm": _HIGH_NM,
        "sensitivity": (scale * sensitivity).tolist(),
        "radiance": radiance.tolist(),
        "centre_m": (distance_m * direction).tolist(),
        "radius_m": source.radius_m,
        "fov_deg": float(np.degrees(2.0 * np.arctan(0.5 * intrinsics.width_px / intrinsics.fx_px))),
        "samples": _SAMPLES,
    }
    done = subprocess.run(
        [sys.executable, "-c", _STOCK], input=json.dumps(case), capture_output=True, text=True, check=True
    )
    radiance_in_band = np.array(json.loads(done.stdout)) / scale
    # Radiance to electrons, by the camera equation: E = π L cos⁴θ / (4 N²) on each pixel of 3.75 µm.
    rows, columns = np.mgrid[row : row + _CROP_PX, column : column + _CROP_PX]
    x = (columns - intrinsics.cx_px) / intrinsics.fx_px
    y = (rows - intrinsics.cy_px) / intrinsics.fy_px
    cos4 = (1.0 + x**2 + y**2) ** -2
    pixel_m2 = (3.75e-6) ** 2
    electrons = radiance_in_band * np.pi * cos4 / (4.0 * 2.0**2) * pixel_m2 * exposure_s
    return electrons, column, row


def _centroid(image: np.ndarray) -> tuple[float, float]:
    rows, columns = np.indices(image.shape)
    return float((columns * image).sum() / image.sum()), float((rows * image).sum() / image.sum())


@pytest.mark.parametrize("angle_deg", [0.0, 40.0])
def test_power_and_centroid_agree_with_stock_path(scene_with: SceneMaker, angle_deg: float) -> None:
    scene = scene_with(source_at(1.0, angle_deg))
    light = render(scene, "r1.front")
    ours = expected_electrons(light, scene, 1e-3)
    stock, column, row = _stock_electrons(
        scene, light.direct.direction[0], float(light.direct.distance_m[0]), 1e-3
    )
    crop = ours[row : row + _CROP_PX, column : column + _CROP_PX]
    assert crop.sum() == pytest.approx(ours.sum(), rel=1e-6)
    assert crop.sum() == pytest.approx(stock.sum(), rel=0.005)
    assert _centroid(crop) == pytest.approx(_centroid(stock), abs=0.02)
