"""Every source and lamp that ships, in a frame, against its own closed form: none is silently black or white."""

import math
from pathlib import Path
from typing import Any

import colour
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

import nir_render
from nir_render import expected_electrons, load_scene, render
from nir_render.camera.optics.lens import aperture_area_m2
from tests.paths import SCENES
from tests.unit.spectra.test_illuminants import V_LAMBDA

pytestmark = pytest.mark.mitsuba

Array = NDArray[np.float64]

DATA = Path(nir_render.__path__[0]) / "data"
DISTANCE_M, EXPOSURE_S, EFFICIENCY = 3.0, 1e-4, 0.15
HC_J_M = 6.62607015e-34 * 2.99792458e8


def _cone_sr(half_deg: float) -> float:
    return 2.0 * math.pi * (1.0 - math.cos(math.radians(half_deg)))


def _on_axis(preset: str) -> float:
    """Return the intensity on the axis in W/sr: the flux over 2π ∫ p sin θ dθ, by a sum over the file's points."""
    document = yaml.safe_load((DATA / "sources" / f"{preset}.yaml").read_text())
    flux, unit = document["flux"].split()
    angles, values = zip(*document["pattern"]["points"], strict=True)
    fine_deg = (np.arange(180_000) + 0.5) / 1000.0
    lobe = np.interp(fine_deg, [float(angle.split()[0]) for angle in angles], values)
    solid_sr = 2.0 * math.pi * np.sum(lobe * np.sin(np.radians(fine_deg))) * math.radians(1e-3)
    return float(flux) * {"W": 1.0, "mW": 1e-3}[unit] * float(values[0]) / float(solid_sr)


# Radiant intensity towards the camera in W/sr, and centroid in nm: data sheets, or the flux over the lobe's solid angle.
SOURCES = {
    "bare": (0.2 / math.pi, 940.0),  # a cosine
    "depth_camera_850": (4.25 / _cone_sr(40.0), 850.0),
    "diffused": (_on_axis("diffused"), 940.0),
    "infra_swarm": (0.2 / (4.0 * math.pi), 940.0),
    "lidar_905": (121.0 / (4.0 * math.pi * math.sin(math.radians(15.0))), 905.0),
    "mocap_strobe_850": (_on_axis("mocap_strobe_850"), 850.0),
    "remote_control_940": (0.036, 940.0),
    "sfh_4545": (0.55, 940.0),
    "tof_camera_940": (2.0 / _cone_sr(35.0), 940.0),
    "vsmy2940": (0.145, 940.0),
}
# Rated lumens, and what the spectrum is: kelvin, or a table of CIE 15 with the share that is stated beyond 780 nm.
LAMPS: dict[str, tuple[float, float | tuple[str, float]]] = {
    "fluorescent": (3350.0, ("FL11", 0.05)),
    "halogen": (1600.0, 2856.0),
    "incandescent": (710.0, 2700.0),
    "white_led": (3600.0, ("LED-B3", 0.014)),
}


def _seen(kind: str, emitter: dict[str, Any]) -> tuple[float, float]:
    """Return the electrons in a frame of one emitter 3 m straight ahead, and the lens's area.

    No filter, a quantum efficiency of 0.15 from 300 to 1100 nm, a bare lens, black surroundings.
    """
    camera = "robots.r1.rig.cameras.front"
    plain = load_scene(SCENES / "one_source.yaml").with_(
        {
            "robots.r2.motion": [],
            "robots.r2.position": "[9, 9, 9] m",
            f"{camera}.filter": None,
            f"{camera}.sensor.quantum_efficiency": {
                "points": [["300 nm", EFFICIENCY], ["1100 nm", EFFICIENCY]]
            },
            f"{camera}.lens.transmission": 1.0,
        }
    )
    place = plain.at(0.0).camera("r1.front").pose.position_m + np.array([DISTANCE_M, 0.0, 0.0])
    at = "center" if kind == "lamps" else "position"
    scene = plain.with_({kind: {"one": {at: f"{place.tolist()} m", **emitter}}})
    light = render(scene, "r1.front", seed=1)
    electrons = float(expected_electrons(light, scene, exposure_s=EXPOSURE_S).sum())
    return electrons, aperture_area_m2(scene.camera("r1.front")[1])


def test_no_emitter_of_the_library_is_left_out() -> None:
    for kind, known in (("sources", SOURCES), ("lamps", LAMPS)):
        assert sorted(path.stem for path in (DATA / kind).glob("*.yaml")) == sorted(known)


@pytest.mark.parametrize("preset", SOURCES)
def test_a_source_brings_its_data_sheets_electrons(preset: str) -> None:
    """I A/d² t η λ/hc, the lens and the light even over its aperture."""
    looks = {} if preset == "lidar_905" else {"yaw": "180 deg", "pitch": "90 deg"}
    emitter = {"preset": preset, "orientation": looks, "drive": 1}
    electrons, lens_m2 = _seen("beacons", emitter)
    intensity, centroid_nm = SOURCES[preset]
    photons_per_j = centroid_nm * 1e-9 / HC_J_M
    expected = intensity * lens_m2 / DISTANCE_M**2 * EXPOSURE_S * EFFICIENCY * photons_per_j
    assert electrons == pytest.approx(expected, rel=0.012)


def _photons_per_lumen(spectrum: float | tuple[str, float]) -> float:
    """Return ∫ S λ/hc dλ over 300 to 1100 nm per 683 ∫ S V dλ, by sums."""
    seen_nm = np.linspace(380.0, 770.0, 40)
    if isinstance(spectrum, float):
        nm = np.linspace(300.0, 1100.0, 8001)

        def planck(at_nm: Array) -> Array:
            return at_nm**-5.0 / np.expm1(0.014387769 / (at_nm * 1e-9) / spectrum)

        lumens = 683.0 * float(np.array(V_LAMBDA) @ planck(seen_nm)) * 10.0
        return float(np.trapezoid(planck(nm) * nm, nm)) * 1e-9 / HC_J_M / lumens
    name, share = spectrum
    table = colour.SDS_ILLUMINANTS[name]
    nm = np.arange(380.0, 780.5, 0.5)
    values = np.interp(nm, table.wavelengths, table.values)
    lumens = 683.0 * float(np.array(V_LAMBDA) @ np.interp(seen_nm, nm, values)) * 10.0
    visible = float(np.trapezoid(values * nm, nm))
    beyond = share * float(np.trapezoid(values, nm)) * (780.0 + 1100.0) / 2.0  # even over 780 to 1100 nm
    return (visible + beyond) * 1e-9 / HC_J_M / lumens


@pytest.mark.parametrize("preset", LAMPS)
def test_a_lamp_brings_its_rated_lumens(preset: str) -> None:
    """Φ/π A/d² t of a small panel that faces the camera, in photons by its spectrum."""
    rated_lm, spectrum = LAMPS[preset]
    emitter: dict[str, Any] = {"preset": preset, "normal": [-1, 0, 0], "size": "[0.05, 0.05] m"}
    share = spectrum[1] if isinstance(spectrum, tuple) else None
    if preset == "fluorescent":  # it ships without: nothing is known beyond its table
        emitter |= {"infrared": {"share": share, "least": 0, "most": 0.1}}
    electrons, lens_m2 = _seen("lamps", {**emitter, "drive": 1})
    expected = (
        rated_lm / math.pi * _photons_per_lumen(spectrum) * lens_m2 / DISTANCE_M**2 * EXPOSURE_S * EFFICIENCY
    )
    assert electrons == pytest.approx(expected, rel=0.01)
