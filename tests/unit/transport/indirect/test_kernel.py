"""The parts of the integrator, each against what it must be on average."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from nir_render import Scene, load_scene, render
from nir_render.transport.backend.variant import backend
from nir_render.transport.indirect.guide import guide
from nir_render.transport.indirect.kernel.aim import (
    aim_at_light,
    aim_density,
    choose_light,
    guide_cell,
    light_chance,
)
from nir_render.transport.indirect.kernel.draws import lane_draws
from nir_render.transport.indirect.kernel.tables import along_table, upload_guide, upload_lights
from nir_render.transport.world import mitsuba_scene as world
from nir_render.transport.world.emitters import emitters
from nir_render.transport.world.facets import facets

pytestmark = [
    pytest.mark.mitsuba,
    pytest.mark.vectorised,
]

ROOM = """
format: 1
observe: [r1.front]
robots:
  r1: {rig: infra_swarm}
  r2: {rig: infra_swarm, position: "[2, 1, 0] m"}
  r3: {rig: infra_swarm, position: "[-3, 0.5, 0] m"}
materials: {silver: {type: mirror, reflectance: 0.9}, paint: {type: diffuse, reflectance: 0.5}}
shapes:
  floor: {type: rectangle, center: "[0, 0, 0] m", size: "[8, 6] m", normal: [0, 0, 1], material: paint}
  mirror: {type: rectangle, center: "[0, 3, 1] m", size: "[2, 2] m", normal: [0, -1, 0], material: silver}
lamps: {one: {center: "[1, -1, 2.5] m", size: "[0.8, 0.3] m", luminous_flux: 3000 lm, temperature: 2856 K}}
"""


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    path = Path(tmp_path_factory.mktemp("kernel")) / "room.yaml"
    path.write_text(ROOM)
    return load_scene(path)


@pytest.fixture(scope="module")
def lights(room: Scene) -> Any:
    flat = facets(room.at(0.0))
    return upload_lights(emitters(room.at(0.0), flat), np.ones(4), [None] * 4, np.stack([np.eye(3)] * 4))


@pytest.mark.parametrize("use", range(7))
@pytest.mark.parametrize("depth", [0, 1, 3])
def test_numbers_are_even_and_independent_between_pixels_uses_and_batches(use: int, depth: int) -> None:
    """χ² in 64 bins, and no correlation with the next pixel, the next use, the next batch (5 σ of 1/√n)."""
    mi, dr = backend().mi, backend().dr
    count = 2**16
    pixel = dr.arange(mi.UInt32, count)

    def numbers(use: int, batch: int, sample: int = 1) -> np.ndarray:
        draw = lane_draws(pixel, mi.UInt32(batch), 123456789123, dr.opaque(mi.UInt32, 8))
        return np.array(draw.vertex(mi.UInt32(sample), mi.UInt32(depth), use), dtype=float)

    drawn = numbers(use, 0)
    assert drawn.min() >= 0.0
    assert drawn.max() < 1.0
    assert stats.chisquare(np.histogram(drawn, 64, (0.0, 1.0))[0]).pvalue > 1e-4
    for other in (np.roll(drawn, 1), numbers(use + 1, 0), numbers(use, 1)):
        assert abs(np.corrcoef(drawn, other)[0, 1]) < 5.0 / np.sqrt(count)


@pytest.mark.parametrize("samples", [1, 2, 4, 8, 64])
def test_the_first_vertex_is_stratified(samples: int) -> None:
    """Over the samples of a batch each stratum of each use holds one number."""
    mi, dr = backend().mi, backend().dr
    draw = lane_draws(dr.arange(mi.UInt32, 500), mi.UInt32(3), 99, dr.opaque(mi.UInt32, samples))
    for use in range(6):
        drawn = np.stack(
            [np.array(draw.vertex(dr.opaque(mi.UInt32, k), mi.UInt32(0), use)) for k in range(samples)]
        ).astype(float)
        strata = np.floor(np.sort(drawn, axis=0) * samples)
        # float32 rounds a number at a stratum's upper end into the next, once in 10⁵.
        assert (strata != np.arange(samples)[:, None]).mean() < 2e-4


def test_lights_are_chosen_as_often_as_their_chance_says(room: Scene, lights: Any) -> None:
    """At 3 places, 200 000 draws each: χ² over all lights and images; every light has a chance everywhere."""
    mi = backend().mi
    flat = facets(room.at(0.0))
    shining = emitters(room.at(0.0), flat)
    box = world.build(room.at(0.0)).bbox()
    low_m, high_m = np.array(box.min).ravel(), np.array(box.max).ravel()
    chosen = guide(shining, flat, np.array([1.0, 1.0, 4.0, 0.25]), low_m, high_m)
    assert len(shining.kind) == 8  # three sources and a lamp, and their images in the mirror
    assert chosen.chance.min() > 0.0
    np.testing.assert_allclose(chosen.chance.sum(axis=1), 1.0, atol=1e-6)
    choice = upload_guide(chosen)
    u = np.random.default_rng(1).random(200_000).astype(np.float32)
    for place in ([0.5, 0.5, 0.0], [-2.9, 0.4, 0.0], [30.0, 0.0, 0.0]):
        cell = guide_cell(choice, mi.Point3f(*place))
        row, chance = (np.array(value) for value in choose_light(choice, lights, cell, mi.Float(u)))
        counts = np.bincount(row, minlength=8)
        expected = np.array(
            [np.array(light_chance(choice, lights, cell, mi.UInt32(k), mi.Bool(True)))[0] for k in range(8)]
        )
        np.testing.assert_array_equal(chance, expected[row].astype(np.float32))
        shares = expected.astype(float) / expected.astype(float).sum()
        assert stats.chisquare(counts, shares * counts.sum()).pvalue > 1e-4


@pytest.mark.parametrize(
    "place", [[0.0, -1.0, 0.0], [1.0, -1.0, 2.2], [1.5, 0.5, 2.4], [4.0, 3.0, 0.5], [1.05, -1.02, 2.49]]
)
def test_a_lamp_is_aimed_at_evenly_over_its_solid_angle(lights: Any, place: list[float]) -> None:
    """∫ over the lamp's solid angle of 1, and of cos², by its draws and by 10⁶ points of its area: within 0.3 %.

    From 3 m, where it is sampled by area, to 1 cm below it, where it fills half the sphere.
    """
    mi = backend().mi
    random = np.random.default_rng(3)
    count = 400_000
    u, v = (mi.Float(random.random(count).astype(np.float32)) for _ in range(2))
    row = mi.UInt32(3)
    aim = aim_at_light(lights, row, mi.Point3f(*place), u, v, mi.Bool(True))
    direction, density = np.array(aim.direction).T.astype(float), np.array(aim.density).astype(float)
    again = aim_density(lights, row, mi.Point3f(*place), aim.direction, mi.Bool(True))
    np.testing.assert_allclose(np.array(again), density, rtol=2e-4)
    ends = np.array(place) + direction * np.array(aim.reach)[:, None]
    assert np.abs(ends[:, 2] - 2.5).max() < 1e-4
    assert (np.abs(ends[:, :2] - [1.0, -1.0]) < [0.4001, 0.1501]).all() or (
        np.abs(ends[:, :2] - [1.0, -1.0]) < [0.1501, 0.4001]
    ).all()
    along_x = np.ptp(ends[:, 0]) > np.ptp(ends[:, 1])
    half = [0.4, 0.15] if along_x else [0.15, 0.4]
    grid = (np.arange(1000) + 0.5) / 500.0 - 1.0
    x, y = np.meshgrid(1.0 + half[0] * grid, -1.0 + half[1] * grid)
    to = np.stack([x, y, np.full_like(x, 2.5)], axis=-1) - place
    d2 = (to**2).sum(axis=-1)
    patch = 4.0 * half[0] * half[1] / 1e6 * to[..., 2] / d2**1.5
    assert (1.0 / density).mean() == pytest.approx(patch.sum(), rel=0.003)
    slope2 = (to[..., 2] / np.sqrt(d2)) ** 2
    assert (direction[:, 2] ** 2 / density).mean() == pytest.approx((patch * slope2).sum(), rel=0.003)


@pytest.mark.parametrize("before_m", [0.001, 0.005, 0.02])
@pytest.mark.parametrize("aside_m", [0.0, 0.5, 0.9])
def test_a_large_lamp_is_aimed_at_evenly_from_right_before_it(
    room: Scene, before_m: float, aside_m: float
) -> None:
    """From millimetres before a lamp of 2 m, also far off its middle, 1/density is the lamp's solid angle.

    Ω = Σ ± atan(x y / (z r)) over the corners. Sampled by area such places bring nothing but once in 10⁴ draws,
    and then 10⁴ times too much: frames of fog at a lamp were 0.4 % too dark. Expected: the mean of 400 000 draws to
    0.1 %, none above 2π.
    """
    mi = backend().mi
    lamp = room.with_({"lamps.one.size": "[2, 2] m"})
    lights = upload_lights(
        emitters(lamp.at(0.0), facets(lamp.at(0.0))), np.ones(4), [None] * 4, np.stack([np.eye(3)] * 4)
    )
    random = np.random.default_rng(11)
    u, v = (mi.Float(random.random(400_000).astype(np.float32)) for _ in range(2))
    place = mi.Point3f(1.0 + aside_m, -1.0 + 0.5 * aside_m, 2.5 - before_m)
    weight_sr = 1.0 / np.array(aim_at_light(lights, mi.UInt32(3), place, u, v, mi.Bool(True)).density).astype(
        float
    )
    solid_angle_sr = sum(
        np.arctan(x * y / (before_m * np.sqrt(x * x + y * y + before_m**2)))
        for x in (1.0 - aside_m, 1.0 + aside_m)
        for y in (1.0 - 0.5 * aside_m, 1.0 + 0.5 * aside_m)
    )
    assert weight_sr.mean() == pytest.approx(solid_angle_sr, rel=1e-3)
    assert weight_sr.max() < 2.0 * np.pi * (1.0 + 1e-5)


def test_a_lamp_seen_from_its_own_plane_has_rays_too(room: Scene) -> None:
    """From beside a lamp of 2.1 m, 0.1 to 60 µm off its plane, where its solid angle rounds to nothing.

    Such places met one path in 10⁶ in fog; their directions were no numbers, and were lost or read foreign memory.
    """
    mi = backend().mi
    lamp = room.with_({"lamps.one.size": "[2.1, 2.1] m"})
    lights = upload_lights(
        emitters(lamp.at(0.0), facets(lamp.at(0.0))), np.ones(4), [None] * 4, np.stack([np.eye(3)] * 4)
    )
    random = np.random.default_rng(5)
    u, v, along, beside, below = random.random((5, 100_000)).astype(np.float32)
    below_m = 1e-7 * 600.0**below
    place = mi.Point3f(1.0 + 1.05 + 0.01 + 0.2 * beside, -1.0 + 2.1 * (along - 0.5), 2.5 - below_m)
    row, whole = mi.UInt32(3), mi.Bool(True)
    aim = aim_at_light(lights, row, place, mi.Float(u), mi.Float(v), whole)
    for value in (*aim.direction, aim.reach, aim.density):
        assert np.isfinite(np.array(value)).all()
    assert (np.array(aim.density) > 0.0).all()
    assert (np.array(aim_density(lights, row, place, aim.direction, whole)) > 0.0).all()


def test_what_is_no_number_has_the_first_place_in_a_table() -> None:
    mi = backend().mi
    places = mi.Float(float("nan"), float("inf"), -float("inf"), -0.5, 0.25, 3.75, 9.0)
    assert np.array(along_table(places, 3.5)).tolist() == [0.0, 3.5, 0.0, 0.0, 0.25, 3.5, 3.5]


@pytest.mark.parametrize("distance_m", [0.02, 0.5, 10.0, 50.0])
def test_a_sphere_is_aimed_at_evenly_over_its_cone(room: Scene, distance_m: float) -> None:
    """Density 1/(2π(1 − cos α)) to float32, even for 10 mm at 50 m, where 1 − cos α is 2e-8."""
    mi = backend().mi
    near = room.with_({"robots.r2.position": f"[{distance_m}, 0, 0] m"})
    flat = facets(near.at(0.0))
    shining = emitters(near.at(0.0), flat)
    lights = upload_lights(shining, np.ones(4), [None] * 4, np.stack([np.eye(3)] * 4))
    place = shining.center_m[1] - [distance_m, 0.0, 0.0]
    random = np.random.default_rng(5)
    u, v = (mi.Float(random.random(100_000).astype(np.float32)) for _ in range(2))
    aim = aim_at_light(lights, mi.UInt32(1), mi.Point3f(*place.tolist()), u, v, mi.Bool(True))
    half_angle = np.arcsin(0.01 / distance_m)
    versine = 2.0 * np.sin(0.5 * half_angle) ** 2
    np.testing.assert_allclose(np.array(aim.density), 1.0 / (2.0 * np.pi * versine), rtol=1e-5)
    off = np.linalg.norm(np.cross(np.array(aim.direction).T.astype(float), [1.0, 0.0, 0.0]), axis=1)
    shares = (1.0 - np.sqrt(1.0 - np.minimum(off, 1.0) ** 2)) / versine
    if distance_m < 5.0:  # farther off, float32 cannot tell the direction within the cone to a bin
        assert stats.chisquare(np.histogram(shares, 32, (0.0, 1.0))[0]).pvalue > 1e-4
    assert shares.max() < 1.0 + 1e-2


def test_images_stand_behind_their_mirror_and_shine_as_the_light_itself(room: Scene) -> None:
    shining = emitters(room.at(0.0), facets(room.at(0.0)))
    assert shining.lights == 4
    np.testing.assert_array_equal(shining.image, [[4, 5, 6, 7]])
    np.testing.assert_allclose(
        shining.center_m[4:], shining.center_m[:4] * [1, -1, 1] + [0, 6, 0], atol=1e-12
    )
    np.testing.assert_allclose(shining.normal[7], shining.normal[3] * [1, -1, 1], atol=1e-12)
    np.testing.assert_array_equal(shining.radiance[4:], shining.radiance[:4])
    np.testing.assert_array_equal(shining.facet, [-1] * 4 + [0] * 4)


FOG = """
format: 1
observe: [r1.front]
render: {indirect: {scale: 4, samples: 8, max_depth: 6}}
fog: {extinction: 0.5 /m, albedo: 0.9, phase: {type: henyey_greenstein, g: 0.85}, center: "[1, 0, 1] m", size: "[4, 4, 2] m"}
sun: {azimuth: 30 deg, elevation: 40 deg, irradiance: 0.3 W/m^2/nm}
lamps: {one: {center: "[1, -1, 2.5] m", size: "[0.8, 0.3] m", luminous_flux: 3000 lm, temperature: 2856 K}}
robots:
  r1: {rig: infra_swarm}
  r2: {rig: infra_swarm, position: "[2, 1, 0] m"}
materials: {paint: {type: diffuse, reflectance: 0.5}, silver: {type: mirror, reflectance: 0.9}}
shapes:
  floor: {type: rectangle, center: "[0, 0, 0] m", size: "[8, 6] m", normal: [0, 0, 1], material: paint}
  mirror: {type: rectangle, center: "[0, 3, 1] m", size: "[2, 2] m", normal: [0, -1, 0], material: silver}
"""


@pytest.mark.verify
@pytest.mark.parametrize("swarm", [0, 20], ids=["few lights", "many lights"])
def test_no_lane_reads_outside_a_table(swarm: int, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Also lanes that rest: beside the fog, past the last surface. Dr.Jit's debug mode tells each such read."""
    mi, dr = backend().mi, backend().dr
    more = "".join(
        f'  s{k}: {{rig: infra_swarm, position: "[2, {0.1 * k - 1}, 0] m"}}\n' for k in range(swarm)
    )
    path = tmp_path / "fog.yaml"
    path.write_text(FOG.replace("materials:", f"{more}materials:"))
    scene = load_scene(path)
    with dr.scoped_set_flag(dr.JitFlag.Debug, True):
        render(scene, "r1.front")
        assert "out-of-bounds" not in capfd.readouterr().err
        dr.eval(dr.gather(mi.Float, dr.opaque(mi.Float, 1.0, 4), dr.opaque(mi.UInt32, 5)))
        assert "out-of-bounds read from position 5 in an array of size 4" in capfd.readouterr().err
