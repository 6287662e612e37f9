"""Lamps: lux on a plane, tables that end at 780 nm, flicker; against sums by hand."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from nir_render.camera.timing.drive import mean_level
from nir_render.errors import InputError
from nir_render.run.manifest import ambient_facts
from nir_render.scene.documents.ambient.lamps import Lamp
from nir_render.scene.documents.times.drives import Drive
from nir_render.scene.emission import emission_spectrum, emission_units
from nir_render.scene.load import load_scene
from nir_render.scene.scene import Scene, parse_scene
from nir_render.spectra.illuminants import planck_shape
from nir_render.spectra.lambert import polygon_share
from tests.paths import SCENES
from tests.unit.spectra.test_illuminants import V_LAMBDA

Array = NDArray[np.float64]

LAMP = {"center": "[0, 0, 2] m", "size": "[0.5, 0.5] m", "luminous_flux": "1000 lm"}


def _lumens(lamp: Lamp) -> float:
    """Return the luminous flux of the watts that are rendered, by the published V(λ) in steps of 10 nm."""
    seen_nm = np.linspace(380.0, 770.0, 40)
    spectrum = emission_spectrum(lamp)
    return float(683.0 * np.sum(np.array(V_LAMBDA) * spectrum(seen_nm * 1e-9)) * 10e-9 * emission_units(lamp))


def _patch_sum_lx(lamp: Lamp, at_m: Array, facing: Array, steps: int = 200) -> float:
    """Return what a lamp brings to a plane: lumens · cos · cos′ / (π r²), summed over 200 × 200 patches."""
    normal = np.array(lamp.normal) / np.linalg.norm(lamp.normal)
    across = np.cross([0.0, 0.0, 1.0], normal)
    across = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(across) < 1e-9 else across / np.linalg.norm(across)
    up = np.cross(normal, across)
    along = (np.arange(steps) + 0.5) / steps - 0.5
    u, v = (grid.ravel()[:, None] for grid in np.meshgrid(along * lamp.size_m[0], along * lamp.size_m[1]))
    to_lamp = np.array(lamp.center_m) + u * across + v * up - at_m
    distance = np.linalg.norm(to_lamp, axis=1)
    cosines = np.clip(to_lamp @ facing, 0, None) * np.clip(-to_lamp @ normal, 0, None) / distance**2
    return float(_lumens(lamp) / (np.pi * steps**2) * np.sum(cosines / distance**2))


@pytest.mark.parametrize("level_lx", [300.0, 500.0, 800.0])
def test_the_workshop_has_the_lux_that_it_asks_for(level_lx: float) -> None:
    """Sum over patches of all lamps, from the watts that are rendered: within 1 %."""
    scene = load_scene(SCENES / "workshop.yaml").with_({"illuminance.level": f"{level_lx} lx"})
    at_m, up = np.array([2.0, 0.0, 0.8]), np.array([0.0, 0.0, 1.0])
    lamps = [lamp for lamp in scene.emitters().values() if isinstance(lamp, Lamp)]
    assert len(lamps) == 3
    assert sum(_patch_sum_lx(lamp, at_m, up) for lamp in lamps) == pytest.approx(level_lx, rel=0.01)
    snapshot = scene.at(0.0)
    assert dict(snapshot.lamps) == {
        name.removeprefix("lamps."): lamp for name, lamp in scene.emitters().items() if "lamps." in name
    }


@pytest.mark.parametrize(
    ("at_m", "facing", "normal"),
    [
        ((0.3, -0.2, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)),
        ((1.0, 0.0, 1.9), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),  # the plane's own horizon cuts the lamp
        ((0.1, 0.0, 1.0), (0.96, 0.0, 0.28), (0.3, 0.2, -1.0)),
        ((0.0, 0.0, 3.0), (0.0, 0.0, -1.0), (0.0, 0.0, -1.0)),  # from behind
    ],
)
def test_lamberts_formula_is_the_sum_over_patches(
    at_m: tuple[float, ...], facing: tuple[float, ...], normal: tuple[float, ...]
) -> None:
    lamp = Lamp.model_validate({**LAMP, "normal": normal, "temperature": "2856 K"})
    axis = np.array(normal) / np.linalg.norm(normal)
    across = np.cross([0.0, 0.0, 1.0], axis)
    across = across / np.linalg.norm(across) if np.linalg.norm(across) > 1e-9 else np.array([1.0, 0.0, 0.0])
    up = np.cross(axis, across)
    signs = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    corners_m = np.array([np.array(lamp.center_m) + 0.25 * (u * across + v * up) for u, v in signs])
    share = polygon_share(corners_m, axis, np.array(at_m), np.array(facing))
    wanted = _patch_sum_lx(lamp, np.array(at_m), np.array(facing), steps=800) / (_lumens(lamp) / 0.25)
    assert share == pytest.approx(wanted, rel=2e-4, abs=1e-12)


def test_a_flickering_lamp_counts_with_its_mean_and_a_chopped_one_with_its_duty() -> None:
    scene = _lit({})
    lumens = scene.document.shining_lamps["one"].luminous_flux_lm
    flickering = _lit({"drive": {"flicker": {"mains": "50 Hz", "modulation": 0.4}}})
    chopped = _lit({"drive": {"square": {"frequency": "100 Hz", "duty": 0.25}}})
    assert flickering.document.shining_lamps["one"].luminous_flux_lm == lumens
    assert chopped.document.shining_lamps["one"].luminous_flux_lm == pytest.approx(4.0 * lumens, rel=1e-12)


def test_a_scaled_scene_loads_again_to_the_same_watts() -> None:
    scene = _lit({})
    again = parse_scene({**_yaml(scene)}, scene.folder)
    assert again.document.shining_lamps == scene.document.shining_lamps
    facts = ambient_facts(scene)
    assert facts is not None
    assert facts["illuminance"]["interreflection"] is False
    assert facts["illuminance"]["factor_of_lamps"] == pytest.approx(
        500.0 / scene.document.written_illuminance_lx, abs=1e-6
    )


def test_a_led_sends_within_its_table_and_beyond_what_is_stated() -> None:
    """LED-B3: 0.014 of the flux within the table lies beyond 780 nm, flat; lumens as rated."""
    lamp = Lamp.model_validate({**LAMP, "preset": "white_led"})
    spectrum = emission_spectrum(lamp)
    beyond_m, within_m = np.linspace(781e-9, 1100e-9, 5000), np.linspace(380e-9, 780e-9, 4001)
    beyond = np.trapezoid(spectrum(beyond_m), beyond_m) * 320.0 / 319.0
    assert beyond / np.trapezoid(spectrum(within_m), within_m) == pytest.approx(0.014, rel=1e-4)
    assert spectrum(940e-9) == pytest.approx(0.014 / 1.014 / 320e-9, rel=1e-4)
    assert _lumens(lamp) == pytest.approx(1000.0, rel=0.003)
    held = float(spectrum(780e-9)) * 320e-9 * 1.014
    assert lamp.infrared is not None
    assert lamp.infrared.most == pytest.approx(held, rel=0.02)


def test_a_halogen_lamp_is_hundreds_of_times_a_leds_at_940_nm() -> None:
    """Watts from 935 to 945 nm for each lumen: halogen by Planck, and at most 1/100 of it by the LED's bound."""
    band_m, seen_m = np.linspace(935e-9, 945e-9, 101), np.linspace(380e-9, 770e-9, 40)
    lumens = 683.0 * float(np.sum(np.array(V_LAMBDA) * planck_shape(seen_m, 2856.0)) * 10e-9)
    per_lm = float(np.trapezoid(planck_shape(band_m, 2856.0), band_m)) / lumens

    def rendered(changes: dict[str, Any]) -> float:
        lamp = Lamp.model_validate({**LAMP, **changes})
        return float(np.trapezoid(emission_spectrum(lamp)(band_m), band_m)) * emission_units(lamp) / 1000.0

    assert rendered({"preset": "halogen"}) == pytest.approx(per_lm, rel=0.002)
    bound = {"preset": "white_led", "infrared": {"share": 0.028, "least": 0, "most": 0.028}}
    assert 100.0 < per_lm / rendered(bound) < 300.0


REFUSED: list[tuple[dict[str, Any], str]] = [
    ({"preset": "fluorescent"}, "the table ends at 780 nm, and what the lamp sends from there to 1100 nm is unknown"),
    ({"illuminant": {"points": [["400 nm", 1], ["900 nm", 1]]}}, "the table ends at 900 nm"),
    ({"illuminant": {"points": [["850 nm", 1], ["1100 nm", 1]]}}, "write it among the 'beacons', by its 'flux'"),
    ({"illuminant": {"points": [["300 nm", 1], ["600 nm", 1]]}}, "give values from 400 to 700 nm"),
    ({"illuminant": {"points": [["300 nm", 0], ["800 nm", 0], ["940 nm", 1], ["1100 nm", 0]]}}, "the eye sees 1.5e-05 lm of a watt"),
    ({"illuminant": {"points": [["300 nm", 0], ["699 nm", 1e-9], ["940 nm", 1], ["1100 nm", 0]]}}, "the eye sees 0.013 lm"),
    ({"illuminant": "FL99"}, "there is no table 'FL99'; known are FL2, FL7"),
    ({"temperature": "950 K"}, "greater than or equal to 1000"),
    ({"temperature": "2856 K", "infrared": {"share": 0, "least": 0, "most": 1}}, "this spectrum reaches 1100 nm"),
    ({}, "wanted one of 'temperature'"),
    ({"temperature": "2856 K", "illuminant": "FL11"}, "wanted one of 'temperature'"),
    ({"illuminant": "FL2", "infrared": {"share": 0.1, "least": 0.2, "most": 1}}, "share 0.1 lies outside least 0.2"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "told"), REFUSED)
def test_what_is_not_known_is_refused(changes: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        load_scene(SCENES / "workshop.yaml").with_({"lamps.one": {**LAMP, **changes}})


def test_no_plane_without_light_and_none_for_lamps_that_speak() -> None:
    with pytest.raises(InputError, match="no lamp shines on the plane"):
        _lit({}, normal="down")
    with pytest.raises(InputError, match="'one' sends messages, which have no mean"):
        _lit({"drive": {"bits": {"pattern": "01", "rate": "10 Hz"}}})


@pytest.mark.parametrize("duration_s", [0.0, 1e-4, 3.7e-3, 0.01, 0.1234])
def test_flicker_is_the_mean_of_its_sine(duration_s: float) -> None:
    """1 + 0.3 sin(2π · 100 Hz · t) for 50 Hz mains, its mean over exposures by fine sums."""
    drive = Drive.model_validate({"flicker": {"mains": "50 Hz", "modulation": 0.3, "phase": "1 ms"}})
    starts_s = np.array([-0.013, 0.0, 0.0017, 3.3])
    middles = (np.arange(20_000) + 0.5) / 20_000
    times_s = starts_s[:, None] + middles * duration_s
    wanted = (1.0 + 0.3 * np.sin(2.0 * np.pi * 100.0 * (times_s - 1e-3))).mean(axis=1)
    assert mean_level(drive, starts_s, duration_s) == pytest.approx(wanted, abs=1e-7)


def test_a_robots_source_does_not_flicker() -> None:
    scene, flicker = load_scene(SCENES / "workshop.yaml"), {"flicker": {"mains": "60 Hz", "modulation": 0.3}}
    with pytest.raises(InputError, match="a robot's source does not"):
        scene.with_({"robots.r2.rig.sources.top.drive": flicker})
    with pytest.raises(InputError, match="a robot's source does not"):
        scene.at(0.0).sending({"r2.top": flicker})


def _lit(lamp: dict[str, Any], normal: str = "up") -> Scene:
    plane = {"level": "500 lx", "at": "[0.2, 0.1, 0.8] m", "normal": normal}
    lamps = {"one": {**LAMP, "temperature": "2856 K", **lamp}}
    return load_scene(SCENES / "workshop.yaml").with_({"lamps": lamps, "illuminance": plane})


def _yaml(scene: Scene) -> dict[str, Any]:
    from nir_render.scene.text.yaml_text import parse_yaml

    read: dict[str, Any] = parse_yaml(scene.resolved_yaml(), "resolved")
    return read
