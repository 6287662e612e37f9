"""Indirect light against closed forms, its variance against its scatter, and what it must not hold.

All of it for both renderers: the light-group integrator, and Mitsuba's own, which takes its place without LLVM.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from nir_render import InputError, Scene, load_scene, render
from nir_render.light.light import Indirect
from nir_render.transport.backend.variant import backend, dr, mi
from nir_render.transport.direct.table import direct_table
from nir_render.transport.indirect import stock
from nir_render.transport.indirect.kernel import paths

pytestmark = pytest.mark.mitsuba

SCENE = """
format: 1
observe: [r1.c]
robots:
  r1:
    rig:
      cameras:
        c:
          lens: {focal_length: 1.8 mm, f_number: 2.0, transmission: 0.9}
          sensor: {columns: 32, rows: 24, pixel_pitch: 15 um, quantum_efficiency: 0.15, full_well: 1.0e+5 e,
                   read_noise: 10 e, system_gain: 0.04 DN/e, black_level: 10 DN, bit_depth: 12 bit}
          point_spread: {sigma: 0.7 px}
          exposure: 1 ms
  r2: {rig: {sources: {s: infra_swarm}}, position: "[2, 0, 3] m"}
materials:
  paint: {type: diffuse, reflectance: 0.6}
shapes:
  wall: {type: rectangle, center: "[3, 0, 0] m", size: "[40, 40] m", normal: [-1, 0, 0], material: paint}
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    path = tmp_path_factory.mktemp("stock") / "wall.yaml"
    path.write_text(SCENE)
    return load_scene(path, {"render.indirect": {"scale": 1, "samples": 64, "max_depth": 4}})


Renderer = Callable[..., Indirect]


@pytest.fixture(params=["groups", "stock"])
def indirect_of(request: pytest.FixtureRequest) -> Renderer:
    """A renderer: (scene, seed) → the indirect light of r1.c."""
    if request.param == "groups":
        return _by_groups
    return _by_stock


def _by_groups(scene: Scene, seed: int = 0) -> Indirect:
    if not backend().vectorised:
        pytest.skip("the light-group integrator needs an LLVM or CUDA variant")
    light = render(scene, "r1.c", seed=seed)
    assert light.indirect is not None
    return light.indirect


def _by_stock(scene: Scene, seed: int = 0) -> Indirect:
    pose = scene.at(0.0).camera("r1.c").pose
    direct = direct_table(scene.at(0.0), pose, specular=False)
    light = stock.indirect(scene.at(0.0), "r1.c", seed, direct)
    assert light is not None
    return light


def test_a_wall_lit_by_a_source(indirect_of: Renderer, scene: Scene) -> None:
    """L = (ρ/π) cos θ / (4π d²) per watt, at each pixel's centre of view: the middle one within 0.5 %.

    The wall stands 3 m ahead; the source 1 m before it and 3 m up. Where pixel (u, v) looks at the wall,
    d² = 1 + y² + (z − 3)² and cos θ = 1/d.
    """
    radiance = indirect_of(scene).radiance_per_w[0, 0].astype(float)
    rows, columns = np.mgrid[:24, :32]
    y_m, z_m = -3.0 * (columns - 15.5) / 120.0, -3.0 * (rows - 11.5) / 120.0
    d2 = 1.0 + y_m**2 + (z_m - 3.0) ** 2
    expected = 0.6 / math.pi / np.sqrt(d2) / (4.0 * math.pi * d2)
    assert radiance.mean() == pytest.approx(expected.mean(), rel=0.002)
    np.testing.assert_allclose(radiance, expected, rtol=0.01)
    assert radiance[11:13, 15:17].mean() == pytest.approx(expected[11:13, 15:17].mean(), rel=0.005)


@pytest.mark.parametrize("away_m", [0.5, 2.0, 5.0, 10.0])
def test_a_far_source_lights_as_much_as_the_inverse_square_law_says(
    indirect_of: Renderer, scene: Scene, away_m: float
) -> None:
    """A 10 mm source, 0.5 to 10 m before the wall, off the view: Mitsuba's own sphere is 7 % off at 10 m."""
    x_m = 3.0 - away_m
    radiance = indirect_of(scene.with_({"robots.r2.position": f"[{x_m}, 0, 0.4] m"})).radiance_per_w[0, 0]
    d2 = away_m**2 + 0.4**2
    expected = 0.6 / math.pi * (away_m / math.sqrt(d2)) / (4.0 * math.pi * d2)
    assert radiance[11:13, 15:17].astype(float).mean() == pytest.approx(expected, rel=0.003)


def test_a_wall_lit_by_a_lamp(indirect_of: Renderer, scene: Scene) -> None:
    """A small lamp sends I = cos θ'/π per watt of one side: L = (ρ/π) cos θ cos θ' / (π d²).

    It hangs 4 m up, 2 m before the wall, and shines down: to the wall's point ahead, cos θ' = 4/d, cos θ = 2/d.
    """
    lamp = {
        "center": "[1, 0, 4] m",
        "size": "[0.1, 0.1] m",
        "luminous_flux": "1000 lm",
        "temperature": "2856 K",
    }
    lamp_lit = scene.with_({"lamps.one": lamp, "render.indirect.samples": 2048})
    lit = indirect_of(lamp_lit).radiance_per_w[1, 0].astype(float)
    d2 = 4.0 + 16.0
    expected = 0.6 / math.pi * (2.0 / math.sqrt(d2)) * (4.0 / math.sqrt(d2)) / (math.pi * d2)
    assert lit[11:13, 15:17].mean() == pytest.approx(expected, rel=0.005)


def test_the_stated_variance_is_that_of_the_scatter(indirect_of: Renderer, scene: Scene) -> None:
    """Over 24 seeds the scatter of each pixel agrees with the mean of the stated variances, within 10 % in all."""
    few = scene.with_({"render.indirect.samples": 8})
    renders = [indirect_of(few, seed=seed) for seed in range(24)]
    scatter = np.stack([r.radiance_per_w for r in renders]).var(axis=0, ddof=1).mean()
    stated = np.stack([r.variance for r in renders]).mean()
    assert scatter == pytest.approx(stated, rel=0.1)


def test_straight_light_is_not_in_it_but_bodies_hide(indirect_of: Renderer, scene: Scene) -> None:
    """A source in view, 5 cm large, straight ahead: where it stands the wall is hidden and nothing shines.

    Its own light on the wall is 1e-2 per watt, its radiance 10: a trace of it would show.
    """
    near = scene.with_({"robots.r2.position": "[2, 0, 0] m", "robots.r2.rig.sources.s.radius": "5 cm"})
    assert render(near, "r1.c").direct.visible_fraction.tolist() == [1.0]
    radiance = indirect_of(near).radiance_per_w[0, 0]
    assert np.abs(radiance[11:13, 15:17]).max() < 1e-5  # 2.5 cm at 2 m is 3 px of radius
    assert radiance[11, 24] > 0.005


def test_straight_light_cancels_where_the_source_is_a_sphere(indirect_of: Renderer, scene: Scene) -> None:
    """A mirror behind the camera makes the source a sphere in the render: its radiance, 10 per watt, must go.

    What stays is float32 rounding of the difference; the pixel on the wall beside it keeps its light.
    """
    mirror = {
        "type": "rectangle",
        "center": "[-2, 0, 0] m",
        "size": "[1, 1] m",
        "normal": [1, 0, 0],
        "material": "silver",
    }
    near = scene.with_(
        {
            "materials.silver": {"type": "mirror", "reflectance": 0.5},
            "shapes.mirror": mirror,
            "robots.r2.position": "[2, 0, 0] m",
            "robots.r2.rig.sources.s.radius": "5 cm",
        }
    )
    radiance = indirect_of(near).radiance_per_w[0, 0]
    assert np.abs(radiance[11:13, 15:17]).max() < 1e-4
    assert radiance[11, 24] > 0.005


@pytest.mark.parametrize("gap_mm", [-5.0, 0.0, 12.0, 40.0])
def test_a_source_near_a_wall_lights_it(indirect_of: Renderer, scene: Scene, gap_mm: float) -> None:
    """A ball of 10 mm whose centre stands before, on or behind the wall's plane still lights the room.

    Half sunk it sends half its light; 12 mm before the wall nearly half of it falls on the wall, whose mean
    radiance over all directions is ρ/π times the irradiance. Nothing may vanish.
    """
    place = f"[{3.0 - 1e-3 * gap_mm}, 0, 0] m"
    room = scene.with_({"robots.r2.position": place, "render.indirect.samples": 256})
    opposite = {
        "type": "rectangle",
        "center": "[-1, 0, 0] m",
        "size": "[4, 4] m",
        "normal": [1, 0, 0],
        "material": "paint",
    }
    radiance = indirect_of(room.with_({"shapes.opposite": opposite})).radiance_per_w[0, 0]
    assert radiance.mean() > 1e-4


def test_a_room_that_reflects_nothing_has_no_indirect_light(scene: Scene) -> None:
    assert render(scene.with_({"materials.paint.reflectance": 0}), "r1.c").indirect is None
    assert render(scene.with_({"materials.paint.reflectance": 0.01}), "r1.c").indirect is not None


def test_same_seed_same_bits(indirect_of: Renderer, scene: Scene) -> None:
    first, again, other = (indirect_of(scene, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.radiance_per_w, again.radiance_per_w)
    assert (first.radiance_per_w != other.radiance_per_w).any()


def test_a_scale_that_does_not_divide_the_sensor_is_refused(scene: Scene) -> None:
    with pytest.raises(
        InputError, match=r"render\.indirect\.scale: 5 does not divide the sensor of r1\.c, 32 × 24"
    ):
        render(scene.with_({"render.indirect.scale": 5}), "r1.c")


def test_samples_are_a_power_of_two(scene: Scene) -> None:
    with pytest.raises(InputError, match="48 is no power of two"):
        scene.with_({"render.indirect.samples": 48})


def test_half_resolution_keeps_the_light(indirect_of: Renderer, scene: Scene) -> None:
    full, half = indirect_of(scene), indirect_of(scene.with_({"render.indirect.scale": 2}))
    assert half.radiance_per_w.shape == (1, 1, 12, 16)
    assert half.radiance_per_w.mean() == pytest.approx(full.radiance_per_w.mean(), rel=0.005)


MATERIALS: dict[str, dict[str, Any]] = {
    "rough metal": {"type": "rough_conductor", "index": 1.4, "extinction_index": 9.2, "roughness": 0.5},
    "plastic": {"type": "plastic", "index": 1.5, "reflectance": 0.5, "roughness": 0.2},
    "smooth plastic": {"type": "plastic", "index": 1.5, "reflectance": 0.5, "roughness": 0},
    "glass": {"type": "dielectric", "index": 1.5},
    "mirror": {"type": "mirror", "reflectance": 0.9},
}


@pytest.mark.parametrize("name", MATERIALS)
def test_every_material_renders_without_gain(indirect_of: Renderer, scene: Scene, name: str) -> None:
    """A closed white room with a panel of the material, lit by one watt: no surface gives more than it gets.

    In a room of albedo ρ and area A the mean radiance is about ρ / (π A (1 − ρ)) per watt: the room's walls of
    0.6 must stay within a factor of three of that, whatever the panel is.
    """
    walls = {
        side: {"type": "rectangle", "center": f"{center} m", "size": "[8, 8] m", "normal": normal, "material": "paint"}
        for side, center, normal in (
            ("ahead", "[4, 0, 0]", [-1, 0, 0]), ("behind", "[-4, 0, 0]", [1, 0, 0]),
            ("left", "[0, 4, 0]", [0, -1, 0]), ("right", "[0, -4, 0]", [0, 1, 0]),
            ("top", "[0, 0, 4]", [0, 0, -1]), ("bottom", "[0, 0, -4]", [0, 0, 1]),
        )
    }  # fmt: skip
    panel = {"type": "box", "center": "[3, 0, 0] m", "size": "[0.2, 3, 3] m", "material": "special"}
    room = scene.with_(
        {
            "materials": {"paint": {"type": "diffuse", "reflectance": 0.6}, "special": MATERIALS[name]},
            "shapes": {**walls, "panel": panel},
            "robots.r2.position": "[0, 2, 2] m",
            "render.indirect.max_depth": 24,
        }
    )
    radiance = indirect_of(room).radiance_per_w[0, 0]
    assert np.isfinite(radiance).all()
    assert radiance.min() >= -1e-6
    even = 0.6 / (math.pi * 6 * 64 * 0.4)
    assert even / 3.0 < radiance.mean() < 3.0 * even


def test_a_mirror_shows_the_source_behind_it_where_no_table_holds_ghosts(scene: Scene) -> None:
    """A mirror of 90 %, 3 m ahead and turned to the camera: the ghost's power is 0.9 of a source at 5 m."""
    behind = {
        "materials.paint": {"type": "mirror", "reflectance": 0.9},
        "robots.r2.position": "[1, 0.5, 0] m",
        "robots.r2.rig.sources.s.radius": "10 cm",
    }
    radiance = _by_stock(scene.with_(behind)).radiance_per_w[0, 0].astype(float)
    # The image stands at 5 m, 0.5 m to the left; ∫ L dΩ of a sphere at distance D is 1/(4π D²) per watt.
    rows, columns = np.mgrid[:24, :32]
    cos3 = (1.0 + ((columns - 15.5) / 120.0) ** 2 + ((rows - 11.5) / 120.0) ** 2) ** -1.5
    irradiance = float((radiance * cos3 / 120.0**2).sum())
    assert irradiance == pytest.approx(0.9 / (4.0 * math.pi * (25.0 + 0.25)), rel=0.01)
    u_px = float((columns * radiance).sum() / radiance.sum())
    assert u_px == pytest.approx(15.5 - 120.0 * 0.5 / 5.0, abs=0.05)


LED = "robots.r2.rig.sources.s"
LENS = "robots.r1.rig.cameras.c.lens"


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"fog": {"extinction": "0.05 /m"}}, "fog in a scene"),
        (
            {"sun": {"azimuth": "0 deg", "elevation": "40 deg", "irradiance": "0.3 W/m^2/nm"}},
            "the sun in a scene",
        ),
        ({f"{LED}.pattern": {"points": [["0 deg", 1], ["180 deg", 0]]}}, "emission patterns in a scene"),
        ({f"{LENS}.model": "fisheye", f"{LENS}.distortion": [0, 0, 0, 0]}, "a fisheye lens in a scene"),
        ({f"{LENS}.principal_point": "[3, 4] px"}, "a principal point off the sensor's middle in a scene"),
    ],
)
def test_what_it_cannot_render_is_refused(scene: Scene, changes: dict[str, Any], said: str) -> None:
    """Rather than left out: with fog, Mitsuba's path tracer would give the clear scene."""
    changed = scene.with_({LED: {"preset": "infra_swarm"}, **changes})
    pose = changed.at(0.0).camera("r1.c").pose
    table = direct_table(changed.at(0.0), pose, specular=False)
    with pytest.raises(
        InputError, match=f"{said} whose bodies reflect or scatter needs the light-group renderer"
    ):
        stock.indirect(changed.at(0.0), "r1.c", 1, table)


def test_a_value_that_comes_back_not_finite_is_walked_again(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As it would be if memory had lost a bit on the way; where it does not heal, no light comes out."""
    right = _by_groups(scene).radiance_per_w
    walks: list[int] = []

    def spoiled(*what: Any) -> Any:
        sums = paths.walk(*what)
        walks.append(1)
        if len(walks) <= spoils:
            dr.scatter(sums, mi.Float(math.inf), mi.UInt32(7))
        return sums

    monkeypatch.setattr("nir_render.transport.indirect.sample_means.walk", spoiled)
    spoils = 1
    assert np.array_equal(_by_groups(scene).radiance_per_w, right)
    assert "indirect light came back not finite in 1 of its values" in caplog.text
    assert len(walks) == 2
    spoils = 9
    with pytest.raises(InputError, match="not finite in 1 of its values, rendered twice"):
        _by_groups(scene)
