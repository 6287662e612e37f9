"""Lamps, sun and sky on a pixel by hand: lumens to watts, π L/4 N², and what a filter of OD 4 keeps out."""

import math
from typing import Any

import numpy as np
import pytest

from nir_render import load_scene
from nir_render.budget.ambient import Ambient
from nir_render.budget.budget import CameraBudget, photon_budget
from tests.paths import SCENES

RESTING = {"robots.r2.motion": [], "robots.r2.position": "[2, 0, 0] m"}  # sources at x = 0 and 2, z = 0.28


def _camera(changes: dict[str, Any]) -> CameraBudget:
    return photon_budget(load_scene(SCENES / "one_source.yaml").with_({**RESTING, **changes})).cameras[0]


def _one(changes: dict[str, Any]) -> Ambient:
    (ambient,) = _camera(changes).ambient
    return ambient


def _in_lux(level: str, reflectance: float) -> float:
    """Electrons in 1.5 ms of a wall in so many lux of halogen, by the formula of a lens's image."""
    nm = np.linspace(300.0, 1100.0, 16_001)
    planck = nm**-5.0 / np.expm1(1.4387769e7 / (nm * 2856.0))
    # 0.388 mW per lumen from 935 to 945 nm (docs/physics.md, Lamps).
    band = (nm >= 935.0) & (nm < 945.0)
    band_share = float(planck[band].sum() / planck.sum())
    tan2 = (np.arange(60) + 0.5) / 60 / 16.0
    centre_nm = 940.0 * np.sqrt(1.0 - tan2 / (1.0 + tan2) / 4.0)
    passed = np.mean([np.maximum(0.92 / (1.0 + ((nm - one) / 5.0) ** 6), 1e-4) for one in centre_nm], axis=0)
    photons_per_j = (
        float((planck * passed * nm).sum() / planck.sum()) * 1e-9 / (6.62607015e-34 * 299_792_458.0)
    )
    irradiance = float(level) * 0.3884e-3 / band_share
    sensor_w_per_m2 = math.pi * reflectance * irradiance / math.pi / (4.0 * 2.0**2)
    return sensor_w_per_m2 * 3.75e-6**2 * 1.5e-3 * 0.9 * 0.15 * photons_per_j


def test_a_white_wall_in_500_lux_of_halogen() -> None:
    """About 157 e in 1.5 ms through the filter; lux stand on the level plane that looks up to the lamp."""
    changes = {
        "lamps.top": {"preset": "halogen", "center": "[1, 0, 3] m"},
        "illuminance": {"level": "500 lx", "at": "[1, 0, 0.28] m"},
    }
    found = _one(changes)
    assert 2.0 * found.wall_e_per_s * 1.5e-3 == pytest.approx(_in_lux("500", 1.0), rel=0.002)
    assert found.rejection == pytest.approx(0.9775, abs=1e-4)
    assert found.out_of_band_low_e_per_j < found.out_of_band_e_per_j < found.out_of_band_high_e_per_j


def test_a_lamp_seen_itself_is_brighter_by_its_size() -> None:
    """Far away, E = Φ/π d² before a Lambertian lamp: its own radiance over a wall's is π d²/(ρ A)."""
    found = _one({"lamps.top": {"preset": "halogen", "center": "[1, 0, 30.28] m"}})
    assert found.seen_e_per_s is not None
    assert found.seen_e_per_s / found.wall_e_per_s == pytest.approx(math.pi * 900.0 / (0.5 * 0.09), rel=1e-3)


def test_sun_and_sky() -> None:
    """The sun's disc over the wall that faces it: 1/(ρ sin² α); the even sky over level ground: 1/ρ."""
    changes = {
        "sun": {"azimuth": "30 deg", "elevation": "40 deg", "irradiance": "0.305 W/m^2/nm"},
        "sky": {"cie": 5, "irradiance": "0.02 W/m^2/nm"},
    }
    sun, sky = _camera(changes).ambient
    assert (sun.kind, sky.kind) == ("sun", "sky")
    assert sun.irradiance_w_per_m2 == pytest.approx(0.305 * 800.0)
    assert sun.seen_e_per_s is not None
    assert sky.seen_e_per_s is not None
    assert sun.seen_e_per_s / sun.wall_e_per_s == pytest.approx(2.0 / math.sin(math.radians(0.2666)) ** 2)
    assert sky.seen_e_per_s / sky.wall_e_per_s == pytest.approx(2.0)
    assert sun.wall_e_per_s / sky.wall_e_per_s == pytest.approx(0.305 / 0.02)


def test_a_beacon_lights_the_wall_by_its_pattern() -> None:
    """A bare sphere of 1 W at 2 m: E = 1/(16π), half of it as it blinks."""
    beacon = {
        "preset": "infra_swarm",
        "flux": "1 W",
        "position": "[1, 0, 2.28] m",
        "drive": {"square": {"frequency": "1 kHz", "duty": 0.5}},
    }
    found = _one({"beacons.lamp": beacon})
    assert found.kind == "beacon"
    assert found.irradiance_w_per_m2 == pytest.approx(0.5 / (16.0 * math.pi), rel=1e-9)
    assert found.seen_e_per_s is None


def test_walls_are_the_background_of_flares() -> None:
    """The limit's square grows by the background's part of it, and a little more: weights shift to other pixels."""
    lamp = {"lamps.top": {"preset": "halogen", "center": "[1, 0, 3] m", "luminous_flux": "40000 lm"}}
    camera = _camera(lamp)
    assert camera.background_e_per_s == camera.ambient[0].wall_e_per_s
    dark, lit = _camera({}).sources[0].curves[0], camera.sources[0].curves[0]
    index = lit.range_m.index(10.0)
    dark_m, lit_m = dark.range_limit_m[index], lit.range_limit_m[index]
    assert dark_m is not None
    assert lit_m is not None
    background_m = lit.causes_m["background_m"][index]
    assert background_m is not None
    assert 1.0 <= (lit_m**2 - dark_m**2) / background_m**2 < 1.2
