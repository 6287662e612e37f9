"""What changes the key of a light, field by field, and what does not."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from nir_render import Scene, load_scene
from nir_render.scene.documents.shapes import Rectangle
from nir_render.transport.backend.llvm.choice import choose, cpu_name
from nir_render.transport.backend.variant import backend
from nir_render.transport.cache_key import Site, digest, geometry_key, light_key, plan_key, versions

CAMERA = "robots.r1.rig.cameras.c"
SOURCE = "robots.r2.rig.sources.s"

SCENE = """
format: 1
observe: [r1.c]
render: {indirect: {scale: 2, samples: 16, max_depth: 6}}
robots:
  r1: {rig: {cameras: {c: {
    lens: {focal_length: 1.8 mm, f_number: 2.0, transmission: 0.9},
    filter: {placement: behind_lens, centre: 940 nm, fwhm: 10 nm, peak_transmission: 0.9, effective_index: 2, cavities: 3,
             blocking_od: 4, chief_ray_angle_at_corner: 12 deg},
    sensor: {columns: 16, rows: 12, pixel_pitch: 225 um, quantum_efficiency: 0.15, full_well: 1.0e+5 e,
             read_noise: 1 e, system_gain: 0.042 DN/e, black_level: 10 DN, bit_depth: 12 bit},
    point_spread: {sigma: 0.7 px}, exposure: 1 ms}}}, position: "[0, 0, 1] m"}
  r2: {rig: {sources: {s: {flux: 1 W, radius: 8 cm, position: "[0, 0, 0.1] m", spectrum: {gaussian: {centroid: 940 nm, fwhm: 42 nm}},
    pattern: {points: [[0 deg, 1], [90 deg, 0.5], [180 deg, 0.5]]}}}}, position: "[2, 1, 1] m"}
  r3: {rig: {sources: {even: {flux: 1 W, radius: 8 cm, spectrum: {gaussian: {centroid: 940 nm, fwhm: 42 nm}}}}}, position: "[3, 1, 1] m"}
materials:
  matt: {type: diffuse, reflectance: 0.5}
  metal: {type: rough_conductor, index: 1.4, extinction_index: 9.2, roughness: 0.3}
  mirror: {type: mirror, reflectance: 0.9}
  glass: {type: dielectric, index: 1.5}
  gloss: {type: plastic, index: 1.5, reflectance: 0.3, roughness: 0.2}
  window: {type: pane, index: 1.5, transmission: 0.9}
  spare: {type: diffuse, reflectance: 0.1}
shapes:
  floor: {type: rectangle, center: "[0, 0, 0] m", size: "[8, 8] m", normal: [0, 0, 1], rotation: 0 deg, material: matt}
  crate: {type: box, center: "[4, 0, 0] m", size: "[1, 1, 1] m", orientation: {yaw: 10 deg}, material: metal}
  ball: {type: sphere, center: "[4, 2, 1] m", radius: 0.3 m, material: glass}
  post: {type: cylinder, start: "[5, 0, 0] m", end: "[5, 0, 2] m", radius: 0.1 m, material: gloss}
  pane: {type: rectangle, center: "[6, 0, 0] m", size: "[1, 1] m", normal: [1, 0, 0], material: window}
  back: {type: rectangle, center: "[7, 0, 0] m", size: "[1, 1] m", normal: [-1, 0, 0], material: mirror}
  thing: {type: mesh, file: thing.obj, scale: 1.0, position: "[3, -2, 0] m", orientation: {yaw: 0 deg}, material: matt}
lamps:
  one: {center: "[2, 0, 3] m", size: "[1, 1] m", normal: [0, 0, -1], luminous_flux: 3000 lm, temperature: 2856 K}
sun: {azimuth: 10 deg, elevation: 45 deg, irradiance: 0.3 W/m^2/nm}
fog: {extinction: "0.05 /m", albedo: 0.99, phase: {type: henyey_greenstein, g: 0.85}, top: 3 m}
"""

DETERMINING: list[dict[str, Any]] = [
    {"shapes.floor.center": "[0, 0, 0.001] m"},
    {"shapes.floor.size": "[8, 8.001] m"},
    {"shapes.floor.normal": [0, 0.001, 1]},
    {"shapes.floor.rotation": "1 deg"},
    {"shapes.floor.material": "spare"},
    {"shapes.crate.center": "[4, 0, 0.1] m"},
    {"shapes.crate.size": "[1, 1, 1.1] m"},
    {"shapes.crate.orientation": {"yaw": "11 deg"}},
    {"shapes.ball.center": "[4, 2, 1.1] m"},
    {"shapes.ball.radius": "0.31 m"},
    {"shapes.post.start": "[5, 0, 0.1] m"},
    {"shapes.post.end": "[5, 0, 2.1] m"},
    {"shapes.post.radius": "0.11 m"},
    {"shapes.thing.scale": 1.1},
    {"shapes.thing.position": "[3, -2.1, 0] m"},
    {"shapes.thing.orientation": {"yaw": "1 deg"}},
    {"shapes.more": {"type": "sphere", "center": "[4, -2, 1] m", "radius": "0.3 m", "material": "matt"}},
    {"materials.matt.reflectance": 0.51},
    {"materials.metal.index": 1.5},
    {"materials.metal.extinction_index": 9.3},
    {"materials.metal.roughness": 0.31},
    {"materials.mirror.reflectance": 0.8},
    {"materials.glass.index": 1.6},
    {"materials.gloss.index": 1.6},
    {"materials.gloss.reflectance": 0.31},
    {"materials.gloss.roughness": 0.21},
    {"materials.window.index": 1.6},
    {"materials.window.transmission": 0.8},
    {"lamps.one.center": "[2, 0, 3.1] m"},
    {"lamps.one.size": "[1, 1.1] m"},
    {"lamps.one.normal": [0, 0.1, -1]},
    {"sun.azimuth": "11 deg"},
    {"sun.elevation": "46 deg"},
    {"fog.extinction": "0.051 /m"},
    {"fog.albedo": 0.98},
    {"fog.phase": {"type": "henyey_greenstein", "g": 0.8}},
    {"fog.phase": {"type": "table", "points": [["0 deg", 1], ["180 deg", 1]]}},
    {"fog.top": "4 m"},
    {f"{SOURCE}.position": "[0, 0, 0.11] m"},
    {f"{SOURCE}.radius": "8.1 cm"},
    {f"{SOURCE}.orientation": {"yaw": "1 deg"}},
    {f"{SOURCE}.pattern.points": [["0 deg", 1], ["90 deg", 0.6], ["180 deg", 0.5]]},
    {f"{SOURCE}.pattern": None},
    {"robots.r2.position": "[2, 1, 1.1] m"},
    {"robots.r2.orientation": {"roll": "1 deg"}},
    {"robots.r3.position": "[3, 1, 1.1] m"},
    {"robots.r1.position": "[0, 0, 1.1] m"},
    {"robots.r1.orientation": {"yaw": "1 deg"}},
    {f"{CAMERA}.position": "[0, 0, 0.1] m"},
    {f"{CAMERA}.orientation": {"yaw": "1 deg"}},
    {f"{CAMERA}.lens.focal_length": "1.81 mm"},
    {f"{CAMERA}.sensor.columns": 18},
    {f"{CAMERA}.sensor.rows": 14},
    {f"{CAMERA}.sensor.pixel_pitch": "226 um"},
    {"render.indirect.scale": 1},
    {"render.indirect.max_depth": 7},
    {"render.visibility_rays": 512},
]  # fmt: skip

AFTERWARDS: list[dict[str, Any]] = [
    {f"{SOURCE}.flux": "0.5 W"},
    {f"{SOURCE}.spectrum": {"gaussian": {"centroid": "930 nm", "fwhm": "30 nm"}}},
    {"robots.r3.orientation": {"yaw": "90 deg"}},  # its source stands in its middle and shines evenly
    {"lamps.one.luminous_flux": "300 lm"},
    {"lamps.one.temperature": "3000 K"},
    {"sun.irradiance": "0.1 W/m^2/nm"},
    {"sun.clouds": 0.5},
    {"lamps.one.illuminant": "LED-B3", "lamps.one.infrared": {"share": 0.01, "least": 0, "most": 0.02}},
    {"lamps.one.drive": {"flicker": {"mains": "50 Hz", "modulation": 0.3}}},
    {"illuminance": {"level": "500 lx", "at": "[2, 0, 0.8] m"}},
    {"materials.spare.reflectance": 0.2},
    {f"{CAMERA}.exposure": "2 ms"},
    {f"{CAMERA}.auto_exposure": {"target": 0.7, "shortest": "20 us", "longest": "2 ms"}},
    {f"{CAMERA}.bracket": ["1 ms", "2 ms"]},
    {f"{CAMERA}.gain": 2},
    {f"{CAMERA}.shutter": {"type": "rolling", "line_time": "10 us"}},
    {f"{SOURCE}.drive": {"square": {"frequency": "1 kHz"}}},
    {"lamps.one.drive": 0.5},
    {f"{CAMERA}.lens.f_number": 2.8},
    {f"{CAMERA}.lens.transmission": 0.8},
    {f"{CAMERA}.filter": None},
    {f"{CAMERA}.filter.centre": "935 nm"},
    {f"{CAMERA}.filter.fwhm": "12 nm"},
    {f"{CAMERA}.point_spread.sigma": "0.9 px"},
    {f"{CAMERA}.sensor.quantum_efficiency": 0.2},
    {f"{CAMERA}.sensor.full_well": "9.0e+4 e"},
    {f"{CAMERA}.sensor.read_noise": "2 e"},
    {f"{CAMERA}.sensor.system_gain": "0.044 DN/e"},
    {f"{CAMERA}.sensor.black_level": "20 DN"},
    {"clock.frames": 7},
    {"clock.start": "1 s"},
    {"name": "other"},
    {"seed": 5},  # the run's seed is an argument of its own
]  # fmt: skip


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("scene")
    (folder / "thing.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / "scene.yaml").write_text(SCENE)
    return load_scene(folder / "scene.yaml")


def _site(scene: Scene, time_s: float = 0.0) -> Site:
    return Site(scene.at(time_s), "r1.c")


def _key(scene: Scene, time_s: float = 0.0, **changes: Any) -> str:
    site = _site(scene, time_s)
    rest: dict[str, Any] = {
        "seed": 1,
        "power": np.ones(4),
        "samples": 16,
        "made_by": ("llvm_ad_mono", "mitsuba 3.9.1"),
    }
    return light_key(site, geometry_key(site), **(rest | changes))


@pytest.mark.parametrize("change", DETERMINING, ids=lambda change: next(iter(change)))
def test_what_determines_light_changes_the_key(scene: Scene, change: Mapping[str, Any]) -> None:
    assert _key(scene.with_(change)) != _key(scene)


@pytest.mark.parametrize("change", AFTERWARDS, ids=lambda change: next(iter(change)))
def test_what_is_arithmetic_afterwards_does_not(scene: Scene, change: Mapping[str, Any]) -> None:
    changed = scene.with_(change)
    assert changed.document != scene.document
    assert _key(changed) == _key(scene)


@pytest.mark.parametrize(
    "change",
    [
        {"seed": 2},
        {"power": np.array([1.0, 1.0, 1.0, 0.25])},
        {"samples": 32},
        {"samples": np.full((6, 8), 16)},
        {"samples": "pilot"},
        {"samples": ("pilot", np.array([3, 4]))},
        {"samples": None},
        {"made_by": ("scalar_rgb", "mitsuba 3.9.1")},
        {"made_by": ("llvm_ad_mono", "mitsuba 3.9.2")},
    ],
    ids=str,
)
def test_how_it_is_rendered_changes_the_key(scene: Scene, change: dict[str, Any]) -> None:
    assert _key(scene, **change) != _key(scene)


def test_one_pixel_with_other_samples_changes_the_key(scene: Scene) -> None:
    counts = np.full((6, 8), 16)
    more = counts.copy()
    more[5, 7] = 32
    assert _key(scene, samples=counts) == _key(scene, samples=counts.copy())
    assert _key(scene, samples=more) != _key(scene, samples=counts)


def test_a_mesh_counts_by_what_its_file_holds(tmp_path: Path) -> None:
    keys = []
    for folder, vertex in (("one", "1"), ("two", "1"), ("three", "1.001")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "thing.obj").write_text(f"v 0 0 0\nv {vertex} 0 0\nv 0 1 0\nf 1 2 3\n")
        (tmp_path / folder / "scene.yaml").write_text(SCENE)
        keys.append(_key(load_scene(tmp_path / folder / "scene.yaml")))
    assert keys[0] == keys[1]
    assert keys[0] != keys[2]


def test_the_key_follows_who_moves_and_comes_back(scene: Scene) -> None:
    """Out and back within four seconds, with a rest at the far end."""
    rig = yaml.safe_load(SCENE)["robots"]["r2"]["rig"]
    stops = [("0 s", "2"), ("1 s", "2"), ("2 s", "3"), ("3 s", "3"), ("4 s", "2")]
    motion = [{"time": time, "position": f"[{x}, 1, 1] m"} for time, x in stops]
    moving = scene.with_({"robots.r2": {"rig": rig, "motion": motion}})
    keys = {time_s: _key(moving, time_s) for time_s in (0.0, 0.5, 1.5, 2.25, 2.75, 3.5, 4.0, 5.0)}
    assert keys[0.0] == keys[0.5] == keys[4.0] == keys[5.0]
    assert keys[2.25] == keys[2.75]
    assert len({keys[0.0], keys[1.5], keys[2.25]}) == 3


@pytest.mark.parametrize(
    "change",
    [
        {f"{SOURCE}.flux": "0.5 W"},
        {f"{CAMERA}.exposure": "2 ms"},
        {f"{CAMERA}.sensor.read_noise": "2 e"},
        {f"{CAMERA}.filter.centre": "935 nm"},
        {"lamps.one.luminous_flux": "300 lm"},
        {"render.noise": "1 % of temporal variance"},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_plan_of_samples_follows_what_makes_electrons(scene: Scene, change: dict[str, Any]) -> None:
    changed = scene.with_(change)
    keys = [plan_key(_site(one), geometry_key(_site(one)), 1, ("llvm_ad_mono",)) for one in (scene, changed)]
    assert keys[0] != keys[1]
    assert keys[0] == plan_key(_site(scene), geometry_key(_site(scene)), 1, ("llvm_ad_mono",))


def test_the_versions_name_the_variant_the_packages_the_machine_and_this_code() -> None:
    """Lights of another compiler or processor may have other bits: they are no lights of the same key."""
    variant, compiler, *packages, processor, own = versions("llvm_ad_mono", "LLVM 19.1.7")
    assert (variant, compiler) == ("llvm_ad_mono", "LLVM 19.1.7")
    assert [package.split()[0] for package in packages] == [
        "nir-render",
        "mitsuba",
        "drjit",
        "numpy",
    ]
    assert processor == cpu_name() != ""
    assert len(own) == 64


@pytest.mark.mitsuba
def test_the_compiler_is_the_one_that_was_chosen() -> None:
    used = backend()
    expected = f"LLVM {choose().version}" if used.variant.startswith("llvm") else ""
    assert used.compiler == expected


def test_a_sky_is_in_the_key_by_its_kind_not_by_its_strength(scene: Scene) -> None:
    """A beacon by its place: its flux, spectrum and drive are arithmetic too."""
    sky = {"sky.cie": 12, "sky.irradiance": "0.01 W/m^2/nm"}
    under_it = scene.with_(sky)
    assert _key(under_it) != _key(scene)
    assert _key(scene.with_({**sky, "sky.cie": 13})) != _key(under_it)
    for stronger in ({"sky.irradiance": "0.02 W/m^2/nm"}, {"sky.clouds": 0.5}, {"sun.clouds": 0.1}):
        assert _key(scene.with_({**sky, **stronger})) == _key(under_it)
    beacon = {"beacons.one": {"preset": "tof_camera_940", "position": "[1, 1, 1] m"}}
    with_it = scene.with_(beacon)
    assert _key(with_it) != _key(scene)
    assert _key(with_it.with_({"beacons.one.position": "[1, 1, 1.1] m"})) != _key(with_it)
    assert _key(with_it.with_({"beacons.one.flux": "1 W"})) == _key(with_it)


def test_the_bytes_of_plain_data_stay() -> None:
    """Random numbers follow from them. Taken from the program before texts and shapes were kept."""
    shape = {"type": "rectangle", "center": "[1, 2, 3] m", "size": "[4, 5] m", "material": "m"}
    known = digest(
        {
            "shape": Rectangle.model_validate(shape),
            "plain": ("ä", 1.5, -0.0, None, True, 3, np.int64(7), [np.float64(0.1), ()]),
            "array": np.arange(6.0).reshape(2, 3),
        }
    )
    assert known == "d17e571fdd14a704e11773de7fed1042af384860081075c59cdf085b3c210ce9"
