"""Scene files: what they become, and what a careless user is told."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nir_render import InputError, Scene, load_scene
from nir_render.scene.documents.camera import Rig
from nir_render.scene.scene import parse_scene
from tests.paths import SCENES

FRONT = "robots.r1.rig.cameras.front"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(SCENES / "one_source.yaml")


def _wall(**changes: Any) -> dict[str, Any]:
    return {"type": "rectangle", "center": "[3, 0, 0] m", "size": "[1, 1] m", "material": "black", **changes}


def _box(material: str) -> dict[str, Any]:
    return {"type": "box", "center": "[5, 0, 0] m", "size": "[1, 1, 1] m", "material": material}


def _table(*points: Any) -> dict[str, Any]:
    return {"type": "table", "points": list(points)}


PATTERN = "robots.r2.rig.sources.top.pattern"
FOG = {"extinction": "0.05 /m"}
SUN = {"azimuth": "30 deg", "elevation": "40 deg", "irradiance": "0.305 W/m^2/nm"}
GRID = {"polar": "[0, 90, 180] deg", "azimuth": "[0, 180] deg", "values": ["[1, 1]", "[0.5, 0.7]", "[0, 0]"]}
BAD: list[tuple[Mapping[str, Any], str]] = [
    ({f"{FRONT}.exposur": "1 ms"}, f"{FRONT}: unknown key 'exposur'; did you mean 'exposure'?"),
    ({"clok": {}}, "'clok' is no part of a scene"),
    ({f"{FRONT}.exposure": 3}, f"{FRONT}.exposure: 3 is a bare number; write it with its unit, such as '1.5 ms'"),
    ({"robots.r1.position": "[1, 2, 3] kg"}, "robots.r1.position: '[1, 2, 3] kg' is a mass; wanted a length"),
    ({"robots.r1.position": [1, 2, 3]}, "robots.r1.position: [1, 2, 3] is a vector without a unit"),
    ({"robots.r2.rig.sources.top.flux": "-1 W"}, "robots.r2.rig.sources.top.flux: input should be greater than 0"),
    ({"robots.r2.rig.sources.top.flux": "nan W"}, "'nan W' is not a finite number"),
    ({"robots.r2.rig": "infra_swrm"}, "no preset 'infra_swrm' in rigs; did you mean 'infra_swarm'?"),
    ({f"{FRONT}.sensor": "mine.yaml"}, f"{FRONT}.sensor: there is no file 'mine.yaml' beside the scene"),
    ({"shapes.w": _wall(colour=[1, 0, 0])}, "shapes.w: 'colour': RGB colours have no meaning at 940 nm"),
    ({"shapes.w": _wall(size="[-1, 1] m")}, "shapes.w.size: each extent must be greater than 0"),
    ({"shapes.w": _wall(normal=[0, 0, 0])}, "shapes.w.normal: a direction must not be [0, 0, 0]"),
    ({"shapes.w": _wall(material="blakc")}, "shapes.w.material: there is no material 'blakc'; did you mean 'black'?"),
    ({"shapes.w": _wall(type="rectangel")}, "shapes.w: there is no type 'rectangel'; did you mean 'rectangle'?"),
    ({"materials.m": {"type": "diffuse", "reflectance": [0.8, 0.1, 0.1]}}, "RGB colours have no meaning at 940 nm"),
    ({"materials.m": {"type": "diffuse", "reflectance": "#ff0000"}}, "RGB colours have no meaning at 940 nm"),
    ({"materials.m": {"type": "diffuse", "reflectance": 1.2}}, "materials.m.reflectance: input should be less than"),
    ({"shapes.m": {"type": "mesh", "file": "no.ply", "material": "black"}}, "there is no file 'no.ply'"),
    ({"shapes.m": {"type": "mesh", "file": "no.dae", "material": "black"}}, "none of .ply, .obj, .stl, .glb, .gltf"),
    ({f"{FRONT}.sensor.bit_depth": "17 bit"}, f"{FRONT}.sensor.bit_depth: input should be less than or equal to 16"),
    ({f"{FRONT}.sensor.bit_depth": "10.5 bit"}, "10.5 is not a whole number of bits"),
    ({f"{FRONT}.sensor.full_well": "-5 e"}, f"{FRONT}.sensor.full_well: input should be greater than 0"),
    ({f"{FRONT}.sensor.quantum_efficiency": 1.5}, "a quantum efficiency is at most 1"),
    ({f"{FRONT}.sensor.saturation_capacity": "-5 e"}, f"{FRONT}.sensor.saturation_capacity: input should be greater"),
    ({f"{FRONT}.sensor.quantum_efficiency": {"points": [["800 nm", 0.5], ["1000 nm", 1.1]]}}, "at most 1"),
    ({f"{FRONT}.sensor.system_gain": "0.1 DN/e"}, "only to 639 of 4095 DN, so full scale is never reached; it takes 0.701"),
    ({f"{FRONT}.sensor.system_gain": "0.75 DN/e"}, "takes the ADC to full scale at 5374.7 e, before the 5748.3 e at which"),
    ({f"{FRONT}.sensor": {"preset": "mt9m031", "saturation_capacity": None}}, "one of 'saturation_capacity'"),
    ({f"{FRONT}.sensor.read_noise": "700 e"}, "read_noise 700 e and dsnu 4.219 e leave less than ten steps of noise"),
    ({f"{FRONT}.sensor.dsnu": "3000 e"}, "dsnu 3000 e leave less than ten steps of noise"),
    ({f"{FRONT}.sensor.temperature": "25 K"}, f"{FRONT}.sensor.temperature: input should be greater than or equal to 150 K"),
    ({f"{FRONT}.sensor.quantum_efficiency": 0}, "a quantum efficiency of 0 everywhere sees nothing"),
    ({f"{FRONT}.serial": 12345}, f"{FRONT}.serial: 12345 is a number; write the serial number in quotes"),
    ({f"{FRONT}.sensor.nonlinearity": {"loss": "20 %", "exponent": 4}}, "makes brighter pixels read darker"),
    ({f"{FRONT}.sensor.prnu": "30 %"}, f"{FRONT}.sensor.prnu.pixel: input should be less than or equal to"),
    ({f"{FRONT}.sensor.dsnu": 4}, "dsnu.pixel: 4 is a bare number; write it with its unit, such as '5500 e'"),
    ({f"{FRONT}.sensor.dark_current": "20 e"}, "dark_current: '20 e' is a number of electrons; wanted a dark current"),
    ({f"{FRONT}.sensor.blooming": 1.5}, f"{FRONT}.sensor.blooming: input should be less than or equal to 1"),
    ({f"{FRONT}.sensor.defects": {"dead": "60 %"}}, f"{FRONT}.sensor.defects.dead: input should be less than"),
    ({f"{FRONT}.sensor.black_level": "5000 DN"}, "not below full scale"),
    (
        {f"{FRONT}.sensor.quantum_efficiency": {"points": [["400 nm", 0.5], ["900 nm", 0.1]]}},
        "sensor.quantum_efficiency: covers 400 to 900 nm, but robots.r1.rig.sources.top.spectrum shines from 835",
    ),
    (
        {"robots.r2.rig.sources.top.spectrum": {"points": [["900 nm", 0.0], ["940 nm", 1.0], ["960 nm", 0.5]]}},
        "ends at 960 nm with 50 % of its largest value",
    ),
    (
        {f"{FRONT}.filter.table": {"points": [["930 nm", 0.4], ["940 nm", 0.9], ["960 nm", 0.0]]}},
        "ends at 930 nm with 44 % of its largest value",
    ),
    (
        {"robots.r2.rig.sources.top.spectrum": {"points": [["840 nm", 0.0], ["850 nm", 1.0], ["860 nm", 0.0]]}},
        "robots.r2.rig.sources.top.spectrum: covers 840 to 860 nm, not 940 nm",
    ),
    ({"robots.r2.rig.sources.top.spectrum": {"points": [["960 nm", 1], ["940 nm", 1]]}}, "increasing wavelength"),
    ({"observe": ["r9"]}, "observe: there is no robot or camera 'r9'; known cameras: r1.front"),
    ({"observe": []}, "observe"),
    ({"robots.r1.motion": [{"time": "0 s", "position": "[0, 0, 0] m"}]}, "either 'position' and 'orientation', or"),
    ({"clock.frames": 0}, "clock.frames: input should be greater than or equal to 1"),
    ({"robots.r2.motion.7.time": "1 s"}, "'7' is no index of a list of 2"),
    (
        {"shapes.b": {"type": "box", "center": "[0, 0, 0.2] m", "size": "[0.2, 0.2, 0.2] m", "material": "black"}},
        f"{FRONT}: the camera is inside shapes.b at 0 s, at [0.06, 0, 0.2] m",
    ),
    (
        {"shapes.s": {"type": "sphere", "center": "[0.1, 0, 0.2] m", "radius": "0.05 m", "material": "black"}},
        f"{FRONT}: the camera is inside shapes.s",
    ),
    (
        {
            "shapes.c": {
                "type": "cylinder", "start": "[0.06, 0, 0] m", "end": "[0.06, 0, 1] m", "radius": "1 cm",
                "material": "black",
            }
        },
        f"{FRONT}: the camera is inside shapes.c",
    ),
    (
        {"materials.g": {"type": "pane"}, "shapes.b": _box("g")},
        "shapes.b.material: 'g' is a pane, a thin sheet: only a rectangle can be of it, not a box",
    ),
    (
        {"materials.g": {"type": "dielectric", "index": 1.5}, "shapes.w": _wall(material="g")},
        "shapes.w.material: 'g' is a solid dielectric, and a rectangle has no inside; use the type 'pane'",
    ),
    ({"materials.g": {"type": "pane", "index": 0.9}}, "materials.g.index: input should be greater than or equal to 1"),
    ({"materials.g": {"type": "pane", "transmission": 1.1}}, "materials.g.transmission: input should be less than"),
    ({"fog": {}}, "fog: wanted one of 'extinction' and 'visibility', not none"),
    ({"fog": {"extinction": "1 /m", "visibility": "9 m"}}, "fog: wanted one of 'extinction' and 'visibility', not ["),
    ({"fog": {"extinction": 0.05}}, "fog.extinction: 0.05 is a bare number; write it with its unit, such as '0.05 /m'"),
    ({"fog": {"extinction": "20 m"}}, "is a length; wanted an extinction coefficient such as '0.05 /m'"),
    ({"fog": {"extinction": "-1 /m"}}, "fog.extinction: input should be greater than or equal to 0"),
    ({"fog": {"visibility": "50 /m"}}, "fog: visibility: '50 /m' is an extinction coefficient; wanted a length"),
    ({"fog": {"visibility": "0 m"}}, "fog: visibility: '0 m' is not greater than 0"),
    ({"fog": {"visibility": "9 m", "droplets": "smoke", "albedo": 0.9}}, "fog: wanted either 'droplets', which tell albedo and phase"),
    ({"fog": {"visibility": "9 m", "droplets": "smok"}}, "there is no preset 'smok' in droplets; did you mean 'smoke'?"),
    ({"fog": {"visibility": "9 m", "phase": {"type": "mie"}}}, "fog: phase: the type 'mie' needs 'droplets', such as droplets: advection_heavy"),
    ({"fog": {"visibility": "9 m", "droplets": {"sizes": {"type": "modified_gamma", "power": 6, "slope": "1 /mm"}}}}, "mm in radius count here; wanted at most 0.299 mm"),
    ({"fog": {**FOG, "albedo": 1.1}}, "fog.albedo: input should be less than or equal to 1"),
    ({"fog": {**FOG, "phase": {"type": "henyey_greenstein", "g": 1.0}}}, "fog.phase.g: input should be less than"),
    ({"fog": {**FOG, "phase": {"type": "isotropic"}}}, "fog.phase: there is no type 'isotropic'; known: henyey_greenstein, table, mie; write it such as"),
    ({"fog": {**FOG, "phase": _table(["0 deg", 1], ["90 deg", 1])}}, "wanted angles from 0 to 180 deg, not from 0 to 90"),
    ({"fog": {**FOG, "phase": _table(["5 deg", 1], ["180 deg", 1])}}, "not from 5 to 180 deg"),
    ({"fog": {**FOG, "phase": _table(["0 deg", 1], ["0 deg", 2], ["180 deg", 1])}}, "increasing angles"),
    ({"fog": {**FOG, "phase": _table(["0 deg", -1], ["180 deg", 1])}}, "fog.phase.points: values must be finite and not"),
    ({"fog": {**FOG, "phase": _table(["0 deg", 0], ["180 deg", 0])}}, "fog.phase.points: the values are 0 everywhere"),
    ({"fog": {**FOG, "phase": _table([0, 1], [180, 1])}}, "0 is a bare number; write it with its unit"),
    ({"fog": {**FOG, "phase": {"type": "table"}}}, "fog.phase: wanted one of 'points' and 'file', not none"),
    ({"fog": {**FOG, "center": "[1, 0, 0] m"}}, "fog: a fog bank needs both 'center' and 'size'"),
    (
        {"fog": {**FOG, "top": "2 m", "center": "[1, 0, 0] m", "size": "[1, 1, 1] m"}},
        "fog: wanted either 'top' (all below it) or 'center' and 'size' (a bank of fog), not both",
    ),
    ({"fog": {**FOG, "center": "[1, 0, 0] m", "size": "[1, 0, 1] m"}}, "fog: size: each extent must be greater than 0"),
    ({"fog": FOG, "sun": SUN}, "fog: has no end on the way to the sun, so that the sun is black; give it a 'top'"),
    ({"sun": {**SUN, "elevation": "0 deg"}}, "sun.elevation: input should be greater than 0"),
    ({"sun": {**SUN, "elevation": "91 deg"}}, "sun.elevation: input should be less than or equal to 90 deg, not '91 deg'"),
    ({"sun": "bright"}, "sun: 'bright' stands where keys with values are wanted, such as {azimuth: 30 deg, elevation: 40 deg"),
    ({"sun": {**SUN, "azimut": "1 deg"}}, "sun: unknown key 'azimut'; did you mean 'azimuth'?"),
    ({"fog": "heavy"}, "fog: 'heavy' stands where keys with values are wanted, such as {visibility: 50 m}"),
    ({"fog": {"extintion": "0.05 /m"}}, "fog: unknown key 'extintion'; did you mean 'extinction'?"),
    ({"fog": {"visibility": "50 m", "density": 3}}, "fog: unknown key 'density'; known keys: albedo, center, droplets, extinction, phase, profile, size, top, visibility"),
    ({"fog": {"visibility": 50}}, "fog: visibility: 50 is a bare number; write it with its unit, such as '50 m'"),
    ({"fog": {**FOG, "phase": "hg"}}, "fog.phase: 'hg' stands where keys with values are wanted, 'type' among them; known: henyey_greenstein, table"),
    ({"fog": {**FOG, "phase": {"g": 0.9}}}, "fog.phase: the key 'type' is missing; known: henyey_greenstein, table, mie; write it such as {type: henyey"),
    ({"fog": {**FOG, "phase": {"type": "table", "pionts": []}}}, "fog.phase: unknown key 'pionts'; did you mean 'points'?"),
    ({"fog": {**FOG, "phase": _table(["180 deg"])}}, "such as ['0 deg', 1.0]: ['180 deg'] is no such pair"),
    ({"fog": {**FOG, "phase": _table("180 deg")}}, "'180 deg' is no such pair"),
    ({PATTERN: {"pionts": []}}, f"{PATTERN}: unknown key 'pionts'; did you mean 'points'?"),
    ({PATTERN: "lambertian"}, f"{PATTERN}: 'lambertian' stands where 'points', 'grid' or 'file' is wanted, such as"),
    ({"materials.m": {"type": "chrome"}}, "materials.m: there is no type 'chrome'; known: diffuse, rough_conductor, mirror,"),
    ({"render.indirect.samples": 48}, "render.indirect.samples: 48 is no power of two: only these render to the same bits on any machine; take 32 or 64"),
    ({"render.indirect.samples": 2}, "render.indirect.samples: input should be greater than or equal to 4, not 2"),
    ({"render.indirect": 64}, "render.indirect: 64 stands where keys with values are wanted, such as {samples: 64}"),
    ({"render.noise": False}, "render: 'noise' is a target, no switch: write it such as '5 % of temporal variance', or leave it out and fix"),
    ({"robots.r2.rig.sources.top.flux": "-3 mW"}, "top.flux: input should be greater than 0 mW, not '-3 mW'"),
    ({"seed": True}, "'seed' is true; nothing here is true or false; to do without it, leave the key out"),
    ({"sun": {**SUN, "irradiance": "3.05 W/m^2"}}, "sun.irradiance: '3.05 W/m^2' is an irradiance; wanted a spectral irradiance"),
    ({PATTERN: {}}, f"{PATTERN}: wanted one of 'points', 'grid' and 'file', not none"),
    ({PATTERN: {"points": [["0 deg", 1], ["90 deg", 1]]}}, "wanted polar angles from 0 to 180 deg, not from 0 to 90 deg"),
    ({PATTERN: {"points": [["0 deg", 0], ["180 deg", 0]]}}, f"{PATTERN}.points: the values are 0 everywhere"),
    ({PATTERN: {"points": [["0 deg", "a"], ["180 deg", 0]]}}, "wanted a list of [polar angles, value]"),
    ({PATTERN: {"file": "no.csv"}}, "there is no file 'no.csv' beside the scene"),
    ({PATTERN: {"grid": {**GRID, "polar": "[0, 90] deg"}}}, f"{PATTERN}.grid.polar: wanted polar angles from 0 to 180"),
    ({PATTERN: {"grid": {**GRID, "azimuth": "[0, 360] deg"}}}, "wanted azimuths from 0 up to less than 360 deg: 360 is 0"),
    ({PATTERN: {"grid": {**GRID, "azimuth": "[180, 0] deg"}}}, f"{PATTERN}.grid.azimuth: wanted increasing angles"),
    ({PATTERN: {"grid": {**GRID, "values": ["[1, 1]", "[1, 1]"]}}}, "wanted 3 rows of 2 values"),
    ({PATTERN: {"grid": {**GRID, "values": ["[1]", "[1, 1]", "[1, 1]"]}}}, "wanted 3 rows of 2 values"),
    ({PATTERN: {"grid": {**GRID, "values": "[1, 1]"}}}, "wanted a list of rows, each written as text"),
    ({PATTERN: {"grid": {**GRID, "values": ["[-1, 1]", "[1, 1]", "[1, 1]"]}}}, "values must be finite and not negative"),
]  # fmt: skip


@pytest.mark.parametrize(("changes", "said"), BAD)
def test_bad_input_is_named_with_its_place_and_a_fix(
    scene: Scene, changes: Mapping[str, Any], said: str
) -> None:
    with pytest.raises(InputError) as caught:
        scene.with_(changes)
    assert said in str(caught.value)


def _write(folder: Path, text: str) -> Path:
    path = folder / "scene.yaml"
    path.write_text(text, encoding="utf-8")
    return path


GOOD = """format: 1
observe: [a]
robots:
  a: {rig: infra_swarm}
"""


def test_errors_name_file_and_line(tmp_path: Path) -> None:
    path = _write(tmp_path, GOOD.replace("{rig: infra_swarm}", "{rig: infra_swarm, position: 3}"))
    with pytest.raises(InputError, match=r"scene\.yaml:4: robots\.a\.position: 3 is not a vector"):
        load_scene(path)


def test_a_bad_override_is_not_laid_at_a_line_of_the_file(tmp_path: Path) -> None:
    """The file's line holds another, good value; a bad value beside it keeps its line."""
    path = _write(tmp_path, GOOD + "seed: 3\nclock: {frames: 0}\n")
    with pytest.raises(InputError) as caught:
        load_scene(path, {"seed": -1})
    assert caught.value.problems == (
        f"{path} with --set: seed: input should be greater than or equal to 0, not -1",
        f"{path}:6: clock.frames: input should be greater than or equal to 1, not 0",
    )


def test_a_bound_that_a_preset_is_beyond_is_in_its_unit(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("{preset: infra_swarm, flux: -3 mW}")
    scene = _write(tmp_path, GOOD.replace("rig: infra_swarm", "rig: {cameras: {}, sources: {s: mine.yaml}}"))
    with pytest.raises(InputError, match=r"flux: input should be greater than 0 mW, not '-3 mW'"):
        load_scene(scene)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("format: 1\nformat: 1\n", "line 2: key 'format' stands twice"),
        ("a: [1,\n", "scene.yaml"),
        ("- 1\n", "wanted a mapping"),
        ("", "wanted a mapping"),
        (GOOD.replace("format: 1", "format: 2"), "format"),
        ("include: [nowhere.yaml]\n" + GOOD, "there is no file 'nowhere.yaml'"),
        ("include: [scene.yaml]\n" + GOOD, "includes itself"),
        ("include: scene.yaml\n" + GOOD, "wanted a list of file names"),
        (GOOD.replace("observe: [a]\n", ""), "observe: this key is missing"),
    ],
)
def test_broken_files_are_refused(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(InputError) as caught:
        load_scene(_write(tmp_path, text))
    assert said in str(caught.value)


def test_a_missing_scene_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no such scene file"):
        load_scene(tmp_path / "nowhere.yaml")


def test_includes_lie_under_the_file_that_includes_them(tmp_path: Path) -> None:
    (tmp_path / "ground.yaml").write_text(GOOD + "name: ground\nseed: 5\n", encoding="utf-8")
    scene = load_scene(
        _write(tmp_path, "include: [ground.yaml]\nname: over\nrobots: {a: {position: '[1, 0, 0] m'}}\n")
    )
    assert (scene.document.name, scene.document.seed) == ("over", 5)
    assert scene.document.robots["a"].position_m == (1.0, 0.0, 0.0)
    assert list(scene.document.robots["a"].rig.cameras) == ["front", "left", "back", "right"]


def test_presets_and_curves_may_be_files_beside_the_scene(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(
        "{preset: mt9m031, read_noise: 3 e, quantum_efficiency: {file: qe.csv}}"
    )
    (tmp_path / "qe.csv").write_text("wavelength_nm,value\n800,0.3\n940,0.1\n1100,0.02\n")
    text = GOOD.replace(
        "{rig: infra_swarm}", "{rig: {preset: infra_swarm, cameras: {front: {sensor: mine.yaml}}}}"
    )
    sensor = load_scene(_write(tmp_path, text)).document.robots["a"].rig.cameras["front"].sensor
    assert sensor.read_noise_e == 3.0
    assert sensor.saturation_capacity_e == 5500.0
    assert np.array(sensor.quantum_efficiency.points) == pytest.approx(
        np.array([[800e-9, 0.3], [940e-9, 0.1], [1100e-9, 0.02]])
    )


def test_parts_that_are_written_alike_are_read_once_but_not_those_that_follow_from_files(
    tmp_path: Path,
) -> None:
    """A file that has changed between two scenes of one process is read again, however deep it is named."""
    document = {
        "format": 1,
        "name": "two",
        "observe": ["r1.front"],
        "robots": {
            "r1": {"rig": "infra_swarm"},
            "r2": {"rig": "infra_swarm", "position": "[1, 0, 0] m"},
            "r3": {
                "rig": {"preset": "infra_swarm", "sources": {"top": "mine.yaml"}},
                "position": "[2, 0, 0] m",
            },
        },
    }
    seen = []
    for flux in ("0.1 W", "0.2 W"):
        (tmp_path / "mine.yaml").write_text(
            f'preset: infra_swarm\nposition: "[0, 0, 0.28] m"\nflux: {flux}\n'
        )
        seen.append(parse_scene(document, tmp_path).document.robots)
    assert seen[0]["r1"].rig is seen[0]["r2"].rig is seen[1]["r1"].rig
    assert [robots["r3"].rig.sources["top"].flux_w for robots in seen] == [0.1, 0.2]
    other = parse_scene(document, tmp_path).with_({"robots.r2.rig.sources.top.flux": "0.3 W"})
    assert other.document.robots["r2"].rig.sources["top"].flux_w == 0.3
    assert other.document.robots["r1"].rig is seen[0]["r1"].rig


@pytest.mark.parametrize("name", ["qe", "qe.csv.2", "qe-2.0", "qe.csv"])
def test_a_file_is_read_again_whatever_it_is_called(tmp_path: Path, name: str) -> None:
    seen = []
    for value in (0.1, 0.2):
        (tmp_path / name).write_text(f"wavelength_nm,value\n800,{value}\n1100,{value}\n")
        sensor = {"preset": "mt9m031", "quantum_efficiency": {"file": name}}
        rig = {"preset": "infra_swarm", "cameras": {"front": {"sensor": sensor}}}
        document = {"format": 1, "name": "one", "observe": ["r1.front"], "robots": {"r1": {"rig": rig}}}
        robots = parse_scene(document, tmp_path).document.robots
        points = robots["r1"].rig.cameras["front"].sensor.quantum_efficiency.points
        assert points is not None
        seen.append(points[0][1])
    assert seen == [0.1, 0.2]


def test_parts_whose_keys_only_look_alike_are_two() -> None:
    rig = {"sources": {"null": {"preset": "infra_swarm", "position": "[0, 0, 0.2] m"}}}
    Rig.model_validate(rig)
    with pytest.raises(ValueError, match="None"):
        Rig.model_validate({"sources": {None: rig["sources"]["null"]}})


def test_an_override_inside_a_preset_changes_that_part_only(scene: Scene) -> None:
    changed = scene.with_({f"{FRONT}.sensor.read_noise": "5 e"})
    cameras = changed.document.robots["r1"].rig.cameras
    assert cameras["front"].sensor.read_noise_e == 5.0
    assert cameras["front"].sensor.saturation_capacity_e == 5500.0
    assert cameras["left"].sensor.read_noise_e == 10.0
    assert scene.document.robots["r1"].rig.cameras["front"].sensor.read_noise_e == 10.0


def test_the_resolved_document_loads_to_the_same_scene(scene: Scene, tmp_path: Path) -> None:
    changed = scene.with_({"shapes.w": _wall(), "materials.m": {"type": "mirror", "reflectance": "90 %"}})
    again = load_scene(_write(tmp_path, changed.resolved_yaml()))
    assert again.document == changed.document
    assert again.resolved_yaml() == changed.resolved_yaml()


def test_a_resolved_curve_loads_to_the_same_curve(scene: Scene, tmp_path: Path) -> None:
    """Points of a curve carry their unit in the resolved document too."""
    points = {"points": [["800 nm", 0.3], ["940 nm", 0.15], ["1100 nm", 0.02]]}
    changed = scene.with_({f"{FRONT}.sensor.quantum_efficiency": points})
    again = load_scene(_write(tmp_path, changed.resolved_yaml()))
    assert again.document == changed.document


def test_the_world_of_the_models(scene: Scene) -> None:
    """All bodies, materials and lamps of a scene file load, and keep their figures in SI units."""
    changed = scene.with_(
        {
            "materials": {
                "paint": {"type": "diffuse", "reflectance": 0.8},
                "steel": {"type": "rough_conductor", "index": 2.9, "extinction_index": 3.3, "roughness": 0.1},
                "glass": {"type": "dielectric", "index": 1.51},
                "floor": {"type": "plastic", "index": 1.5, "reflectance": 0.3, "roughness": 0.2},
                "silver": {"type": "mirror", "reflectance": 0.95},
            },
            "shapes": {
                "wall": _wall(material="paint"),
                "box": {"type": "box", "center": "[5, 0, 0] m", "size": "[10, 10, 10] cm", "material": "steel"},
                "ball": {"type": "sphere", "center": "[5, 1, 0] m", "radius": "5 cm", "material": "glass"},
                "pole": {
                    "type": "cylinder", "start": "[5, 2, 0] m", "end": "[5, 2, 1] m", "radius": "5 cm",
                    "material": "silver",
                },
                "ground": _wall(material="floor", center="[0, 0, -1] m"),
            },
            "lamps": {
                "one": {
                    "center": "[0, 0, 3] m", "size": "[60, 60] cm", "luminous_flux": "4000 lm", "temperature": "2856 K",
                }
            },
        }
    )  # fmt: skip
    assert changed.document.lamps["one"].size_m == pytest.approx((0.6, 0.6))
    assert changed.document.shapes["box"].material == "steel"


def test_cameras_are_selected_by_robot_or_by_name(scene: Scene) -> None:
    assert scene.cameras() == ["r1.front"]
    assert scene.with_({"observe": ["r1", "r1.front", "r2.back"]}).cameras() == [
        "r1.front", "r1.left", "r1.back", "r1.right", "r2.back",
    ]  # fmt: skip
    with pytest.raises(InputError, match=r"there is no camera 'r1\.fornt'; known: r1\.front"):
        scene.camera("r1.fornt")


def test_the_largest_scene_loads_again_when_all_is_written_out(tmp_path: Path) -> None:
    """Thirty robots with all that presets stand for: 17 000 lines, which a run keeps as scene.yaml."""
    scene = load_scene(SCENES / "swarm_30.yaml")
    (tmp_path / "scene.yaml").write_text(scene.resolved_yaml(), encoding="utf-8")
    assert load_scene(tmp_path / "scene.yaml").document == scene.document


def test_a_newer_format_is_refused_whole_and_says_how_to_mend(tmp_path: Path) -> None:
    file = tmp_path / "scene.yaml"
    file.write_text("format: 2\nkeys_of_tomorrow: 1\n")
    with pytest.raises(InputError) as caught:
        load_scene(file)
    assert str(caught.value) == (
        f"{file}: format: 2 is newer than this nir_render reads, which is 1; "
        "install a newer nir_render, or write the scene in that format"
    )
