"""Fog, sun and emission patterns: what their documents become, and that a resolved one loads to the same."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nir_render import InputError, Scene, load_scene
from nir_render.scene.documents.fog import Fog, HenyeyGreenstein, TabulatedPhase
from tests.paths import SCENES

PATTERN = "robots.r2.rig.sources.top.pattern"
SUN = {"azimuth": "30 deg", "elevation": "40 deg", "irradiance": "0.305 W/m^2/nm"}


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(SCENES / "one_source.yaml")


def _fog(scene: Scene, **keys: Any) -> Fog:
    fog = scene.with_({"fog": keys}).document.fog
    assert fog is not None
    return fog


def _again(scene: Scene, folder: Path) -> Scene:
    path = folder / "resolved.yaml"
    path.write_text(scene.resolved_yaml(), encoding="utf-8")
    return load_scene(path)


@pytest.mark.parametrize(
    ("text", "per_m"),
    [("0.05 /m", 0.05), ("50 /km", 0.05), ("0.05 1/m", 0.05), ("5 %/m", 0.05), ("0 /m", 0.0)],
)
def test_extinction_is_per_metre(scene: Scene, text: str, per_m: float) -> None:
    assert _fog(scene, extinction=text).extinction_per_m == pytest.approx(per_m, rel=1e-15)


def test_visibility_becomes_extinction(scene: Scene) -> None:
    """docs/physics.md, Fog: 3.912/V at 550 nm; at 940 nm 1.028 of it, or what droplets have: 29.1 per km at 136 m."""
    assert _fog(scene, visibility="136 m").extinction_per_m == pytest.approx(0.028765 * 1.0275, rel=5e-4)
    fog = _fog(scene, visibility="136.1 m", droplets="advection_heavy")
    assert fog.extinction_per_m == pytest.approx(0.0291, rel=0.002)
    facts = fog.facts()
    assert facts["visibility_m"] == pytest.approx(136.1, rel=1e-12)
    assert facts["droplets_per_cm3"] == pytest.approx(20.0, rel=0.002)
    assert facts["volume_cm3_per_m3"] == pytest.approx(0.372, rel=0.003)
    assert (facts["ratio_of"], facts["ratio_sigma"], facts["phase"]) == ("advection_heavy", None, "mie")
    unnamed = _fog(scene, visibility="50 m").facts()
    assert (unnamed["ratio_of"], unnamed["ratio_sigma"]) == ("radiation_heavy (assumed)", 0.014)
    assert (unnamed["asymmetry"], unnamed["droplets_per_cm3"]) == (0.85, None)


def test_droplets_and_what_else_may_be_said_of_light_replace_each_other(scene: Scene) -> None:
    """By a change of one key: droplets take albedo and phase away, a phase takes droplets away."""
    plain = scene.with_(
        {"fog": {"visibility": "50 m", "albedo": 0.9, "phase": {"type": "henyey_greenstein", "g": 0.3}}}
    )
    smoke = plain.with_({"fog.droplets": "smoke"})
    assert smoke.document.fog is not None
    assert smoke.document.fog.droplets is not None
    assert smoke.document.fog.albedo == pytest.approx(0.784, abs=0.002)
    assert smoke.document.fog.extinction_per_m * 50.0 / 3.912 == pytest.approx(0.2604, abs=0.001)
    coarse = smoke.with_(
        {
            "fog.droplets": {
                "preset": "smoke",
                "sizes": {"type": "lognormal", "median": "0.5 um", "spread": 1.2},
            }
        }
    )
    assert coarse.document.fog is not None
    assert coarse.document.fog.facts()["ratio_of"] == "the scene's droplets"
    again = smoke.with_({"fog.phase": {"type": "henyey_greenstein", "g": 0.3}}).document.fog
    assert again is not None
    assert again.droplets is None
    assert again.albedo == 0.9995


def test_g_of_a_table_is_told(scene: Scene) -> None:
    """1 at 0 deg falling to 0 at 180 deg: mean cosine ¼."""
    phase = {"type": "table", "points": [["0 deg", 1], ["180 deg", 0]]}
    assert _fog(scene, extinction="0.1 /m", phase=phase).facts()["asymmetry"] == pytest.approx(0.25, rel=1e-3)


def test_fog_without_more_has_the_phase_function_of_heavy_fog(scene: Scene) -> None:
    fog = _fog(scene, extinction="0.05 /m")
    assert fog.albedo == 0.9995
    assert isinstance(fog.phase, HenyeyGreenstein)
    assert fog.phase.g == 0.85


@pytest.mark.parametrize(
    ("where", "low", "high"),
    [
        ({}, [-np.inf] * 3, [np.inf] * 3),
        ({"top": "4 m"}, [-np.inf] * 3, [np.inf, np.inf, 4.0]),
        ({"center": "[1, 2, 3] m", "size": "[2, 1, 4] m"}, [0.0, 1.5, 1.0], [2.0, 2.5, 5.0]),
    ],
)
def test_where_fog_lies(scene: Scene, where: dict[str, str], low: list[float], high: list[float]) -> None:
    region_m = _fog(scene, extinction="0.05 /m", **where).region_m()
    np.testing.assert_array_equal(region_m, [low, high])


def test_either_way_to_write_fog_replaces_the_other(scene: Scene, tmp_path: Path) -> None:
    """By an override, and over an included file."""
    thick = scene.with_({"fog": {"extinction": "0.5 /m", "albedo": 0.9}})
    thin = thick.with_({"fog.visibility": "391.2 m"}).document.fog
    assert thin is not None
    assert thin.extinction_per_m == pytest.approx(0.010275, rel=5e-4)
    assert thin.albedo == 0.9
    (tmp_path / "ground.yaml").write_text(
        "format: 1\nobserve: [a]\nrobots: {a: {rig: infra_swarm}}\nfog: {visibility: 50 m, albedo: 0.9}\n"
    )
    (tmp_path / "over.yaml").write_text("include: [ground.yaml]\nfog: {extinction: 0.01 /m}\n")
    over = load_scene(tmp_path / "over.yaml").document.fog
    assert over is not None
    assert (over.extinction_per_m, over.albedo) == (0.01, 0.9)


def test_a_phase_function_is_points_or_a_file(scene: Scene, tmp_path: Path) -> None:
    (tmp_path / "phase.csv").write_text("# Mie\nangle_deg,value\n0,1200\n0.3,700.5\n10,3\n180,0.1\n")
    for phase in (
        {"type": "table", "points": [["0 deg", 1200], ["0.3 deg", 700.5], ["10 deg", 3], ["180 deg", 0.1]]},
        {"type": "table", "file": str(tmp_path / "phase.csv")},
    ):
        table = _fog(scene, extinction="0.05 /m", phase=phase).phase
        assert isinstance(table, TabulatedPhase)
        angles_rad, values = zip(*table.points, strict=True)
        assert (angles_rad[0], angles_rad[-1]) == (0.0, math.pi)
        assert angles_rad[1] == pytest.approx(math.radians(0.3), rel=1e-15)
        assert values == (1200.0, 700.5, 3.0, 0.1)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("angle,value\n0,1\n180,1\n", "the first line must be the header 'angle_deg,value'"),
        ("angle_deg,value\n0,1\n90\n180,1\n", "each line must hold 2 numbers"),
        ("angle_deg,value\n0,1\n180,x\n", "each line must hold 2 numbers"),
        ("angle_deg,value\n0,1\n179.9,1\n", "wanted angles from 0 to 180 deg, not from 0 to 179.9 deg"),
    ],
)
def test_broken_phase_files_are_refused(scene: Scene, tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "phase.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        _fog(scene, extinction="0.05 /m", phase={"type": "table", "file": str(tmp_path / "phase.csv")})
    assert said in str(caught.value)


def test_the_sun_stands_where_its_angles_say(scene: Scene) -> None:
    sun = scene.with_({"sun": SUN}).document.sun
    assert sun is not None
    assert sun.direction == pytest.approx(
        (math.sqrt(3) / 2 * 0.7660444, 0.5 * 0.7660444, 0.6427876), rel=1e-6
    )
    assert sun.irradiance_w_per_m3 == pytest.approx(0.305e9, rel=1e-12)
    assert math.degrees(sun.angular_radius_rad) == pytest.approx(0.2666)


def test_a_sun_brighter_than_the_sun_is_refused(scene: Scene) -> None:
    """287 for 0.287, units a thousand times too small: the sun sends 0.84 W/m²/nm at 940 nm before any air."""
    scene.with_({"sun": {**SUN, "irradiance": "1.04 W/m^2/nm"}})
    for changes in (
        {"sun": {**SUN, "irradiance": "1.05 W/m^2/nm"}},
        {"sun": SUN, "sky": {"irradiance": "287 W/m^2/nm"}},
    ):
        with pytest.raises(InputError, match="is more than the sun sends at 940 nm"):
            scene.with_(changes)


GRID_CSV = "polar_deg,azimuth_deg,value\n" + "\n".join(
    f"{polar},{azimuth},{value}"
    for polar, row in ((180, (0, 0)), (0, (1, 1)), (90, (0.7, 0.5)))
    for azimuth, value in zip((180, 0), row, strict=True)
)


def test_a_pattern_is_points_a_grid_or_a_file(scene: Scene, tmp_path: Path) -> None:
    """Lines of a file may come in any order."""
    (tmp_path / "pattern.csv").write_text(GRID_CSV)
    read = scene.with_({PATTERN: {"file": str(tmp_path / "pattern.csv")}})
    written = {
        "polar": "[0, 90, 180] deg",
        "azimuth": "[0, 180] deg",
        "values": ["[1, 1]", "[0.5, 0.7]", "[0, 0]"],
    }
    assert read.document == scene.with_({PATTERN: {"grid": written}}).document
    pattern = read.document.robots["r2"].rig.sources["top"].pattern
    assert pattern is not None
    assert pattern.grid is not None
    assert (pattern.grid.polar_rad[0], pattern.grid.polar_rad[-1]) == (0.0, math.pi)
    assert pattern.grid.polar_rad[1] == pytest.approx(math.pi / 2)
    assert list(pattern.grid.azimuth_rad) == pytest.approx([0.0, math.pi])
    assert pattern.grid.values == ((1.0, 1.0), (0.5, 0.7), (0.0, 0.0))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            GRID_CSV.replace("polar_deg,azimuth_deg", "azimuth_deg,polar_deg"),
            "header 'polar_deg,azimuth_deg,value'",
        ),
        (GRID_CSV + "\n90,180,0.7\n", "polar 90, azimuth 180 deg stands twice"),
        (GRID_CSV.replace("90,180,0.7\n", ""), "no value at polar 90, azimuth 180 deg; wanted a full grid"),
        ("polar_deg,azimuth_deg,value\n", "holds no values"),
    ],
)
def test_broken_pattern_files_are_refused(scene: Scene, tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "pattern.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        scene.with_({PATTERN: {"file": str(tmp_path / "pattern.csv")}})
    assert said in str(caught.value)


def test_a_preset_of_a_source_may_have_its_pattern_replaced(scene: Scene, tmp_path: Path) -> None:
    """A pattern in another form replaces the first, as the other curves do."""
    (tmp_path / "led.yaml").write_text(
        "{preset: infra_swarm, pattern: {points: [[0 deg, 1], [180 deg, 0]]}, orientation: {yaw: 90 deg}}"
    )
    (tmp_path / "pattern.csv").write_text(GRID_CSV)
    (tmp_path / "scene.yaml").write_text(
        "format: 1\nobserve: [a]\nrobots: {a: {rig: {preset: infra_swarm, sources: {top: "
        "{preset: led.yaml, pattern: {file: pattern.csv}}}}}}\n"
    )
    source = load_scene(tmp_path / "scene.yaml").document.robots["a"].rig.sources["top"]
    assert source.pattern is not None
    assert source.pattern.points is None
    assert source.pattern.grid is not None
    assert source.orientation.yaw_rad == pytest.approx(math.pi / 2)


@pytest.mark.parametrize(
    "changes",
    [
        {"fog": {"visibility": "50 m", "top": "4 m"}, "sun": SUN},
        {"fog": {"extinction": "0.07 /m", "center": "[1, 2, 3] m", "size": "[2, 1, 4] m"}},
        {"fog": {"extinction": "0.07 /m", "phase": {"type": "table", "points": [["0 deg", 9], ["1.1 deg", 3], ["180 deg", 1]]}}},
        {"fog": {"extinction": "0.07 /m", "phase": {"type": "henyey_greenstein", "g": 0.5}}},
        {"fog": {"visibility": "60 m", "droplets": "radiation_heavy", "top": "4 m"}},
        {PATTERN: {"points": [["0 deg", 1.0], ["33.3 deg", 0.3], ["180 deg", 0]]}},
        {
            PATTERN: {"grid": {"polar": "[0, 33.3, 180] deg", "azimuth": "[0, 120.1] deg", "values": ["[1, 1]", "[0.3, 0.7]", "[0, 0]"]}},
            "robots.r2.rig.sources.top.orientation": {"pitch": "20 deg"},
        },
        {"materials.g": {"type": "pane"}, "shapes.w": {"type": "rectangle", "center": "[3, 0, 0] m", "size": "[1, 1] m", "material": "g"}},
    ],
    ids=["fog with a top, sun", "bank", "phase table", "g", "droplets", "pattern", "pattern on a grid", "pane"],
)  # fmt: skip
def test_a_resolved_scene_loads_to_the_same(scene: Scene, changes: dict[str, Any], tmp_path: Path) -> None:
    changed = scene.with_(changes)
    again = _again(changed, tmp_path)
    assert again.document == changed.document
    assert again.resolved_yaml() == changed.resolved_yaml()


@pytest.mark.parametrize(
    ("changes", "has"),
    [
        ({}, False),
        ({"sun": SUN}, False),  # it lights nothing that would throw its light on
        ({"fog": {"extinction": "0.05 /m"}}, True),
        ({"fog": {"extinction": "0.05 /m", "albedo": 0}}, False),
        ({"fog": {"extinction": "0 /m"}}, False),
    ],
)
def test_what_scatters_needs_rendering(scene: Scene, changes: dict[str, Any], has: bool) -> None:
    assert scene.with_(changes).document.has_indirect_light() is has
