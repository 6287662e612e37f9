"""A measuring bench after EMVA 1288 for cameras of a scene: uniform light, raw frames, the standard's own code.

The frames are those that `nir_render.expose` makes of a scene whose whole field shows one radiance of 940 nm
light, through a long lens at f/8: as the standard asks for, cos⁴ θ is 1 to 1e-5. What the standard's code is
told of the light is the closed form n_p = A t E λ / (h c) (docs/physics.md, From source to pixel), E = π L / (4 N²).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import nir_render as nr
from nir_render.light.light import DirectTable, Indirect, Light
from nir_render.scene.documents.camera import Camera

Frame = NDArray[np.uint16]
Distort = Callable[[Frame, int], Frame]
"""What a faulty camera does to its frames; the number is the frame's own, to seed noise with."""

ROWS, COLUMNS = 480, 640
F_NUMBER = 8.0
PHOTONS_PER_J = 940e-9 / (6.62607015e-34 * 299_792_458.0)
DARK_SHARE = 1e-3  # of the saturation capacity that dark current fills in the longest exposure

# Exposures in units of that which reaches the saturation capacity: the line, then the peak of the variance. They end where
# some variance is left: the standard's code seeks its peak from above, and stops at any step up among clipped frames.
LEVELS = np.concatenate([np.linspace(0.02, 0.92, 40), np.arange(0.93, 1.032, 0.005)])
STACK = 32  # frames of the spatial measurement, bright and dark


@dataclass(frozen=True)
class Sheet:
    """What the standard's code says of a camera."""

    system_gain_dn_per_e: float
    quantum_efficiency: float
    read_noise_e: float
    dark_current_e_per_s: float
    saturation_capacity_e: float
    linearity_error_percent: float
    prnu_percent: float
    dsnu_e: float
    black_level_dn: float


def bench_scene(tmp_path: Path, sensor: str, **changes: Any) -> nr.Scene:
    """Return a scene with a camera of a sensor's preset behind a long lens, `eye.c`, and a source."""
    path = tmp_path / "bench.yaml"
    path.write_text(f"""
format: 1
observe: [eye.c]
robots:
  eye:
    rig:
      sources:
        s: {{flux: 1 W, radius: 1 cm, position: "[-1, 0, 0] m", spectrum: {{gaussian: {{centroid: 940 nm, fwhm: 1 nm}}}}}}
      cameras:
        c: {{lens: {{focal_length: 1 m, f_number: {F_NUMBER}, transmission: 1}}, exposure: 1 ms,
             sensor: {{preset: {sensor}, rows: {ROWS}, columns: {COLUMNS}}}, point_spread: {{sigma: 0.7 px}}}}
""")
    changes = {f"robots.eye.rig.cameras.c.{key}": value for key, value in changes.items()}
    return nr.load_scene(path).with_(changes)


def uniform_light(radiance_w_per_m2_sr: float) -> Light:
    """Return light of one radiance all over the field."""
    none = DirectTable(
        group=np.empty(0, dtype=np.int64),
        facet=np.empty(0, dtype=np.int64),
        direction=np.empty((0, 3)),
        distance_m=np.empty(0),
        angular_radius_rad=np.empty(0),
        seen=np.empty((0, 16), dtype=np.bool_),
        visible_fraction=np.empty(0),
        irradiance_per_w=np.empty((0, 1)),
        visibility_rays=16,
    )
    radiance = np.full((1, 1, ROWS, COLUMNS), radiance_w_per_m2_sr, dtype=np.float32)
    return Light(
        camera="eye.c",
        time_s=0.0,
        seed=0,
        groups=("eye.s",),
        wavelengths_m=(940e-9,),
        direct=none,
        indirect=Indirect(radiance, np.zeros_like(radiance), scale=1, samples=1),
    )


@cache
def standard() -> Any:
    """Return the modules of the standard's own code; version 1.0.2 asks NumPy 1 for one name."""
    if not hasattr(np, "asfarray"):
        np.asfarray = lambda values: np.asarray(values, dtype=np.float64)  # type: ignore[attr-defined]  # noqa: NPY201
    from emva1288.process import data, loader, results

    return data, loader, results


def measure(scene: nr.Scene, seed: int, distort: Distort | None = None) -> Sheet:
    """Measure the camera of a bench scene as the standard says: exposures varied, irradiance constant."""
    camera: Camera = scene.camera("eye.c")[1]
    sensor = camera.sensor
    capacity_e, efficiency = sensor.saturation_capacity_e, sensor.quantum_efficiency.constant
    assert capacity_e is not None
    assert efficiency is not None
    longest_s = DARK_SHARE * capacity_e / sensor.dark_rate_e_per_s
    photons_per_s = capacity_e / efficiency / longest_s
    irradiance = photons_per_s / (PHOTONS_PER_J * sensor.pixel_pitch_m**2)
    lit, dark = uniform_light(irradiance * 4.0 * F_NUMBER**2 / math.pi), uniform_light(0.0)
    count = 0

    def frames(light: Light, exposure_s: float, number: int) -> list[Frame]:
        nonlocal count
        taken = []
        for _ in range(number):
            frame = nr.expose(light, scene, exposure_s=exposure_s, seed=seed, index=count).data_dn
            taken.append(frame if distort is None else distort(frame, count))
            count += 1
        return taken

    def pair(exposure_s: float, number: int) -> dict[float, list[Frame]]:
        photons = sensor.pixel_pitch_m**2 * exposure_s * irradiance * PHOTONS_PER_J  # n_p = A t E λ/(hc)
        return {0.0: frames(dark, exposure_s, number), photons: frames(lit, exposure_s, number)}

    return _evaluate(
        {
            "temporal": [(s, pair(s, 2)) for s in LEVELS * longest_s],
            "spatial": [(0.5 * longest_s, pair(0.5 * longest_s, STACK))],
        }
    )


def _evaluate(images: dict[str, list[tuple[float, dict[float, list[Frame]]]]]) -> Sheet:
    """Hand frames to the standard's code, as integer sums, the form in which it takes them in."""
    data, loader, results = standard()
    sums: dict[str, Any] = {"height": ROWS, "width": COLUMNS, "temporal": {}, "spatial": {}}
    for kind, exposures in images.items():
        for exposure_s, by_photons in exposures:
            of_exposure = sums[kind].setdefault(exposure_s * 1e9, {})
            for photons, taken in by_photons.items():
                stack = loader.routines.get_int_imgs(taken)
                if kind == "temporal":
                    stack = {"sum": stack["sum"].sum(), "pvar": stack["pvar"].sum(), "dmean": stack["dmean"]}
                of_exposure[photons] = stack
    found = results.Results1288(data.Data1288(sums).data)
    gain = found.K
    return Sheet(
        system_gain_dn_per_e=gain,
        quantum_efficiency=found.QE / 100.0,
        read_noise_e=found.sigma_d,
        dark_current_e_per_s=found.u_I_mean,
        saturation_capacity_e=found.u_e_sat,
        linearity_error_percent=max(abs(found.LE_min), abs(found.LE_max)),
        prnu_percent=found.PRNU1288,
        dsnu_e=found.DSNU1288,
        black_level_dn=float(np.polyfit(found.temporal["texp"], found.temporal["u_ydark"], 1)[1]),
    )
