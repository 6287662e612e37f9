"""A reference without any renderer, and its parts."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import nir_render as nr
from nir_render.light.light import DirectTable, Indirect, Light
from nir_render.regress.reference import Reference, ReferenceLight, ReferenceShot, document_of
from nir_render.scene.load import load_scene
from nir_render.scene.scene import Scene
from perception import Detection, RawFrame

SCENE = """
format: 1
name: small
seed: 3
observe: [r1.front]
render: {indirect: {scale: 1, samples: 16, max_depth: 2}}
robots:
  r1:
    rig:
      cameras:
        front:
          position: "[0, 0, 0.3] m"
          lens: {model: rectilinear, focal_length: 2.4 mm, f_number: 2.0, transmission: 0.9}
          filter: bp940_10nm_behind
          sensor: {columns: 32, rows: 24, pixel_pitch: 100 um, quantum_efficiency: 0.15, full_well: 5700 e, read_noise: 10 e,
                   system_gain: 0.69 DN/e, black_level: 64 DN, bit_depth: 12 bit}
          point_spread: {sigma: 0.7 px}
          exposure: 0.1 ms
  r2: {rig: infra_swarm, position: "[1.5, 0.2, 0] m"}
materials:
  paint: {type: diffuse, reflectance: 0.7}
shapes:
  wall: {type: rectangle, center: "[2.5, 0, 0.3] m", size: "[4, 3] m", normal: [-1, 0, 0], material: paint}
"""


def suite(folder: Path, **scenes: str) -> Path:
    """Write scenes into a folder."""
    folder.mkdir(exist_ok=True)
    for name, text in (scenes or {"small": SCENE}).items():
        (folder / f"{name}.yaml").write_text(text)
    return folder


def scene(tmp_path: Path) -> Scene:
    return load_scene(suite(tmp_path / "scene") / "small.yaml")


def table(**fields: Any) -> DirectTable:
    values: dict[str, Any] = {
        "group": np.array([0]),
        "facet": np.array([-1]),
        "direction": np.array([[-0.1, 0.0, 0.995]]),
        "distance_m": np.array([1.5]),
        "angular_radius_rad": np.array([0.0067]),
        "seen": np.ones((1, 1024), dtype=bool),
        "visible_fraction": np.array([1.0]),
        "irradiance_per_w": np.array([[0.0354]]),
        "visibility_rays": 1024,
    }
    return DirectTable(**(values | fields))


def light(direct: DirectTable | None = None, level: float = 0.05, noise: float = 0.0, seed: int = 0) -> Light:
    """An even wall, with a relative noise of its pixels."""
    draw = np.random.default_rng(seed).standard_normal((1, 1, 24, 32))
    mean = (level * (1.0 + noise * draw)).astype(np.float32)
    variance = np.full_like(mean, (noise * level) ** 2)
    indirect = Indirect(mean, variance, 1, 16)
    return Light("r1.front", 5e-5, 3, ("r2.top",), (940e-9,), direct or table(), indirect)


def detection(**fields: Any) -> Detection:
    values: dict[str, Any] = {
        "camera": "r1.front", "index": 0, "time_s": 0.0, "u_px": 12.25, "v_px": 11.5, "u_sigma_px": 0.02, "v_sigma_px": 0.02,
        "flux_dn": 5000.0, "mean_dn": 700.0, "background_dn": 70.0, "area_px": 9, "saturated": False, "merged": False,
        "ghost": False, "range_m": 1.5, "range_sigma_m": 0.01, "bearing_body": (0.995, 0.0998749, 0.0),
    }  # fmt: skip
    return Detection(**(values | fields))


def reference(of: Scene) -> Reference:
    """A reference whose light is even, whose frame is flat."""
    mean = light(noise=0.01)
    assert mean.indirect is not None
    many = replace(mean, indirect=replace(mean.indirect, samples=256))
    electrons = np.full((24, 32), 1000.0, dtype=np.float32)
    frame = RawFrame("r1.front", 0, 0.0, 1e-4, np.full((24, 32), 754, dtype=np.uint16), 64.0)
    calibrations = {"r1.front": nr.calibration(of, "r1.front")}
    return Reference(
        document=document_of(of),
        seed=3,
        renders=16,
        made_by={"transport": {"variant": "llvm_ad_mono"}, "other": {"python": "3"}},
        lights=(ReferenceLight(many, np.zeros((1, 3, 4)), None, "a" * 64, mean.indirect.radiance_per_w),),
        shots=(ReferenceShot(0, electrons, frame),),
        calibrations=calibrations,
        detections={"robust": (detection(), detection(u_px=3.5, range_sigma_m=float("nan"))), "paper": ()},
        history=({"time": "then", "reason": "created"},),
    )
