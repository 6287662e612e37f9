"""Light of several wavelength nodes in all that is done with light: blocks, edges, plans, caches, files, motion.

Surfaces of one curve ρ(λ), of which light meets one at most (depth 2): so the light at a node is that of any
other times the ratio of the reflectances, to float32 rounding, as all nodes walk the same paths. What a mirror of a
curve shows goes with it likewise, and what comes through a pane with its transmission.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
import yaml
from numpy.typing import NDArray

import nir_render as nr
from nir_render.camera.mean_frame import electron_rates, mean_frame
from nir_render.camera.optics.response import response
from nir_render.camera.render_noise import render_noise
from nir_render.light.exr import write_light
from nir_render.light.light import Light
from nir_render.run.manifest import wavelength_facts
from nir_render.simulation.clock import Shot
from nir_render.transport.cache import LightCache
from nir_render.transport.indirect import groups
from nir_render.transport.indirect.guide import group_power
from nir_render.transport.indirect.sharpen import rendered_again
from nir_render.transport.render import mean_samples
from tests.paths import SCENES

pytestmark = [pytest.mark.mitsuba, pytest.mark.vectorised]

PLACES_M, PAINT = np.array([900e-9, 936e-9, 945e-9, 980e-9]), np.array([0.8, 0.7, 0.3, 0.5])
CURVE = {
    "points": [[f"{1e9 * place:.0f} nm", float(value)] for place, value in zip(PLACES_M, PAINT, strict=True)]
}

ROOM = """
format: 1
observe: [r1.c]
render: {indirect: {samples: 16, scale: 4, max_depth: 2}, wavelengths: {error: 3 %}}
clock: {frame_rate: 10 Hz, frames: 3}
robots:
  r1: {rig: {cameras: {c: {preset: infra_swarm, sensor: {preset: mt9m031, columns: 80, rows: 60, pixel_pitch: 60 um}, exposure: 1 ms, auto_exposure: null}}}}
  r2: {rig: {sources: {s: {preset: infra_swarm, radius: 5 cm}}}, position: "[1.2, 0.5, 0] m"}
materials:
  paint: {type: diffuse, reflectance: {}}
  black: {type: diffuse, reflectance: 0}
shapes:
  crate: {type: box, center: "[2, 0, 0] m", size: "[0.6, 0.6, 0.6] m", orientation: {yaw: 45 deg}, material: paint}
  end: {type: rectangle, center: "[3, 0, 0] m", size: "[6, 4] m", normal: [-1, 0, 0], material: paint}
"""


@pytest.fixture
def room(tmp_path: Path) -> nr.Scene:
    document = yaml.safe_load(ROOM)
    document["materials"]["paint"]["reflectance"] = CURVE
    return _loaded(document, tmp_path)


def _loaded(document: dict[str, Any], folder: Path) -> nr.Scene:
    (folder / "room.yaml").write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
    return nr.load_scene(folder / "room.yaml")


def _along(light: Light) -> Any:
    """Return the ratios of the paint's reflectance at the nodes to that at the first."""
    assert len(light.wavelengths_m) > 1
    values = np.interp(light.wavelengths_m, PLACES_M, PAINT)
    return (values / values[0])[:, None]


def test_blocks_edges_and_variances_go_with_the_curve(room: nr.Scene) -> None:
    light = nr.render(room, "r1.c", 0.0, seed=1)
    assert light.indirect is not None
    assert light.indirect.edges is not None
    assert light.indirect.edges.enlargement.patch.size > 0
    ratios = _along(light)
    for part in (light.indirect, light.indirect.edges):
        radiance = part.radiance_per_w.reshape(len(light.groups), len(light.wavelengths_m), -1)
        np.testing.assert_allclose(radiance, ratios * radiance[:, :1], rtol=1e-5)
        variance = part.variance.reshape(radiance.shape)
        wanted = ratios[:, 0] ** 2 * variance[:, :1].sum(axis=2)
        np.testing.assert_allclose(variance.sum(axis=2), wanted, rtol=1e-4)


def test_electrons_are_the_responses_of_the_nodes_times_their_light(room: nr.Scene) -> None:
    """The filter here is the same at all angles, so that the lens's blur does not mix responses."""
    world = room.with_({"robots.r1.rig.cameras.c.filter.effective_index": 1e9}).at(0.0)
    light = nr.render(world, "r1.c", seed=1)
    assert light.indirect is not None
    assert light.indirect.edges is not None
    first = replace(
        light.indirect,
        radiance_per_w=light.indirect.radiance_per_w[:, :1],
        variance=light.indirect.variance[:, :1],
        edges=replace(
            light.indirect.edges,
            radiance_per_w=light.indirect.edges.radiance_per_w[:, :1],
            variance=light.indirect.edges.variance[:, :1],
        ),
    )
    direct = replace(light.direct, irradiance_per_w=light.direct.irradiance_per_w[:, :1])
    alone = replace(light, wavelengths_m=(940e-9,), indirect=first, direct=direct)
    camera, source = world.camera("r1.c").camera, world.emitters["r2.s"]
    parts = [response(camera, source, node)(0.0) for node in light.nodes]
    factor = float(_along(light)[:, 0] @ parts / response(camera, source)(0.0))
    images = [electron_rates(one, world).images for one in (light, alone)]
    assert images[0] is not None
    assert images[1] is not None
    assert abs(factor - 1.0) > 0.05
    np.testing.assert_allclose(images[0], factor * images[1], rtol=1e-5)


def test_a_target_for_the_noise_is_kept_by_all_nodes_together(room: nr.Scene) -> None:
    wanted = room.with_({"render.noise": "5 % of temporal variance"})
    light = nr.render(wanted, "r1.c", 0.0, seed=1)
    assert light.indirect is not None
    assert light.indirect.radiance_per_w.shape[1] == len(light.wavelengths_m) > 2
    noise = render_noise(mean_frame(light, wanted.at(0.0), 1e-3))
    assert noise.median_share <= 0.055
    assert noise.aperture_share <= 0.055


def test_the_samples_that_an_estimate_of_time_counts_are_those_of_all_nodes_together(room: nr.Scene) -> None:
    assert mean_samples(room.at(0.0), "r1.c", 1) == 16.0
    assert len(nr.render(room, "r1.c", 0.0, seed=1).wavelengths_m) > 2


def test_the_error_of_enlarging_is_measured_at_every_node(room: nr.Scene) -> None:
    world = room.at(0.0)
    light = nr.render(world, "r1.c", seed=1)
    camera = world.camera("r1.c")
    rays, pixels = groups.rays_of(camera.camera, camera.pose), {4: np.arange(300), 1: np.arange(0, 4800, 50)}
    power = group_power(world, camera.camera)
    for render in rendered_again(world, rays, 3, power, pixels, 16, light.wavelengths_m):
        for of_scale in render.values():
            np.testing.assert_allclose(of_scale, _along(light) * of_scale[:, :1], rtol=1e-5)


def test_a_cache_finds_it_again_unless_the_nodes_are_others(room: nr.Scene, tmp_path: Path) -> None:
    cache = LightCache(tmp_path / "lights")
    light = nr.render(room, "r1.c", 0.0, seed=1, cache=cache)
    again = nr.render(room, "r1.c", 0.1, seed=1, cache=cache)
    assert again.indirect is light.indirect
    assert (cache.missed, cache.reused) == (1, 1)
    from_disk = nr.render(room, "r1.c", 0.0, seed=1, cache=LightCache(tmp_path / "lights"))
    assert from_disk.wavelengths_m == light.wavelengths_m
    assert from_disk.indirect is not None
    assert light.indirect is not None
    np.testing.assert_array_equal(from_disk.indirect.radiance_per_w, light.indirect.radiance_per_w)
    finer = room.with_({"render.wavelengths.error": "0.5 %"})
    other = nr.render(finer, "r1.c", 0.0, seed=1, cache=cache)
    assert len(other.wavelengths_m) > len(light.wavelengths_m)
    assert cache.missed == 2


def test_a_spectral_image_has_a_channel_for_each_node(room: nr.Scene, tmp_path: Path) -> None:
    light = nr.render(room, "r1.c", 0.0, seed=1)
    assert light.indirect is not None
    write_light(tmp_path / "light.exr", light)
    part = next(part for part in OpenEXR.File(str(tmp_path / "light.exr")).parts if part.name() == "r2.s")
    found = {float(name[3:-2].replace(",", ".")): one.pixels for name, one in part.channels.items()}
    for node, wavelength_m in enumerate(light.wavelengths_m):
        key = min(found, key=lambda nm: abs(nm - 1e9 * wavelength_m))
        assert key == pytest.approx(1e9 * wavelength_m, abs=1e-6)
        np.testing.assert_array_equal(found[key], light.indirect.radiance_per_w[0, node])


def _image(shot: Shot) -> NDArray[np.float32]:
    assert shot.mean.rates.images is not None
    return shot.mean.rates.images


def test_while_something_moves_light_is_interpolated_at_every_node(room: nr.Scene) -> None:
    """At the time of a render, the frame is that of the render; between two, indirect light is their mean."""
    path = [{"time": f"{time} s", "position": f"[1.2, {0.5 - time}, 0] m"} for time in (0, 1)]
    moving = room.with_({"robots.r2": {"rig": room.raw["robots"]["r2"]["rig"], "motion": path}})
    coarse = moving.with_({"render.indirect.every": "0.2 s"})
    full, between = (list(nr.simulate(one, seed=1)) for one in (moving, coarse))
    np.testing.assert_allclose(between[0].mean.electrons, full[0].mean.electrons, rtol=1e-6)
    first, middle, last = (_image(shot) for shot in (full[0], between[1], full[2]))
    np.testing.assert_allclose(middle, 0.5 * (first + last), rtol=1e-4, atol=1e-6 * first.max())
    assert between[1].light.wavelengths_m == full[1].light.wavelengths_m


@pytest.mark.parametrize(
    ("of", "shape"),
    [
        ({"type": "mirror", "reflectance": CURVE}, {"center": "[1, 1.5, 0] m", "size": "[3, 2] m", "normal": [0, -1, 0]}),
        ({"type": "pane", "transmission": CURVE}, {"center": "[0.6, 0, 0] m", "size": "[2, 2] m", "normal": [-1, 0, 0]}),
    ],
    ids=["mirror", "pane"],
)  # fmt: skip
def test_straight_light_goes_with_the_curve_of_a_mirror_or_pane(
    tmp_path: Path, of: dict[str, Any], shape: dict[str, Any]
) -> None:
    document = yaml.safe_load(ROOM)
    document["materials"] = {"sheet": of}
    document["shapes"] = {"sheet": {"type": "rectangle", "material": "sheet", **shape}}
    light = nr.render(_loaded(document, tmp_path), "r1.c", 0.0, seed=1)
    of_sheet = light.direct.facet >= 0 if of["type"] == "mirror" else light.direct.facet < 0
    table = light.direct.irradiance_per_w[of_sheet]
    assert (table > 0.0).any()
    np.testing.assert_allclose(table, _along(light)[:, 0] * table[:, :1], rtol=1e-9)
    if of["type"] == "mirror":
        straight = light.direct.irradiance_per_w[light.direct.facet < 0]
        np.testing.assert_allclose(
            straight, straight[:, :1].repeat(len(light.wavelengths_m), axis=1), rtol=1e-12
        )


def test_the_manifest_tells_nodes_and_error(room: nr.Scene) -> None:
    light = nr.render(room, "r1.c", 0.0, seed=1)
    told = wavelength_facts(room)["r1.c"]
    assert told["nodes_nm"] == [round(1e9 * one, 3) for one in light.wavelengths_m]
    assert 0.0 < told["error"] <= 0.03
    plain = nr.load_scene(SCENES / "one_source.yaml")
    assert wavelength_facts(plain)["r1.front"] == {"nodes_nm": [940.0], "error": 0.0}


PLASTIC = {"type": "plastic", "index": 1.5, "reflectance": CURVE}
FOG = {"extinction": "0.2 /m", "albedo": 0.99, "phase": {"type": "henyey_greenstein", "g": 0.85}}
MIRROR = {
    "type": "rectangle",
    "center": "[1, 1.5, 0] m",
    "size": "[3, 2] m",
    "normal": [0, -1, 0],
    "material": "sheet",
}
PANE = {
    "type": "rectangle",
    "center": "[0.6, 0, 0] m",
    "size": "[2, 2] m",
    "normal": [-1, 0, 0],
    "material": "sheet",
}


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"materials.sheet": {"type": "mirror", "reflectance": CURVE}, "shapes.sheet": MIRROR},
        {"materials.paint": {**PLASTIC, "roughness": 0.0}},
        pytest.param(
            {"materials.sheet": {"type": "pane", "transmission": CURVE}, "shapes.sheet": PANE},
            marks=pytest.mark.verify,
        ),
        pytest.param(
            {"materials.paint": {**PLASTIC, "roughness": 0.3}, "fog": FOG}, marks=pytest.mark.verify
        ),
    ],
    ids=["diffuse", "mirror", "coat", "pane", "glossy in fog"],
)
def test_each_node_is_a_render_of_materials_of_numbers(room: nr.Scene, changes: dict[str, Any]) -> None:
    """Nodes along one path of up to five stretches, each against renders of its own at one wavelength.

    The brightest is the same to the bit, as its paths are walked. Renders of others walk by their own reflectances:
    with other chances, of going on where they are dim and of which part of a surface they take, but alike on the
    mean. Over six seeds the mean of the relative differences is within 6.9 of its standard errors (Student, five
    degrees of freedom, 1 in 1000), which are below 0.12 %.
    """
    wanted = {"render.indirect": {"samples": 16, "scale": 1, "max_depth": 5}, **changes}
    world = room.with_(wanted).at(0.0)
    camera = world.camera("r1.c")
    rays, power, nodes_m = groups.rays_of(camera.camera, camera.pose), np.ones(1), (920e-9, 938e-9, 945e-9)
    differences = []
    for seed in range(6):
        light = groups.indirect(world, rays, seed, power, wavelengths_m=nodes_m)
        assert light is not None
        of_seed = []
        for node, wavelength_m in enumerate(nodes_m):
            alone = groups.indirect(world.at_wavelength(wavelength_m), rays, seed, power)
            assert alone is not None
            ours, theirs = light.radiance_per_w[0, node], alone.radiance_per_w[0, 0]
            if node == 0:
                np.testing.assert_array_equal(ours, theirs)
            else:
                of_seed.append(float(ours.sum() / theirs.sum()) - 1.0)
        differences.append(of_seed)
    mean, error = np.mean(differences, axis=0), np.std(differences, axis=0, ddof=1) / 6**0.5
    assert (error < 1.2e-3).all()
    assert (np.abs(mean) <= 6.9 * error + 1e-6).all()
