"""Light rendered in blocks of pixels, enlarged by geometry, against the full render.

Set up: cameras of 320 × 240 with the field of view of the demo's; blocks of 4 × 4 in the arena, of 2 × 2 in the
corridor, whose lamp hangs 1 cm under the ceiling and lights the walls below it in a steep gradient. Two renders
of each kind that are independent of each other: the mean of the product of two differences is the mean square
of the error alone, without the noise of any of them.

Why: perception must not find edges where blocks end. Expected: with labels the error variance is below 1 % of
temporal variance, where plain interpolation is far above it; the figure that a run writes down agrees with it,
also where the error sits in few pixels.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nir_render import Scene, load_scene, render
from nir_render.camera.by_spectrum import group_fluxes
from nir_render.camera.diffuse_images import diffuse_image
from nir_render.camera.mean_frame import MeanFrame, mean_frame
from nir_render.camera.render_noise import temporal_variance_e2
from nir_render.light.enlarge import enlarge
from nir_render.light.light import Light
from nir_render.scene.scene import parse_scene
from nir_render.transport.backend.variant import backend
from nir_render.transport.indirect import groups
from nir_render.transport.indirect.enlargement import Labels
from nir_render.transport.indirect.enlarging_error import _squares, upsampling_error
from nir_render.transport.indirect.labels import labels_of
from tests.paths import SCENES
from tests.physics.documents import (
    camera_document,
    pixel_rays,
    rectangle_document,
    scene_document,
    source_document,
    tile_means,
)

pytestmark = pytest.mark.mitsuba
SMALL = {
    "robots.r1.rig.cameras.front.sensor.columns": 320,
    "robots.r1.rig.cameras.front.sensor.rows": 240,
    "robots.r1.rig.cameras.front.sensor.pixel_pitch": "15 um",
}
EXPOSURE_S = 5e-5  # about what the demo's cameras find for pixels of this size


@pytest.fixture(autouse=True)
def _grouped() -> None:
    if not backend().vectorised:
        pytest.skip("edges are known where LLVM is")


def _scene(name: str, scale: int, samples: int) -> Scene:
    settings = {"render.indirect.scale": scale, "render.indirect.samples": samples}
    return load_scene(SCENES / f"{name}.yaml", SMALL | settings)


def _labels(scene: Scene, camera: str) -> Labels:
    device = scene.camera(camera)[1]
    rays = groups.rays_of(device, scene.at(0.0).camera(camera).pose)
    built = groups.world_on_device(scene.at(0.0), np.ones(len(scene.at(0.0).groups)))
    return labels_of(built, rays.origin_m, rays.corners)


ROOM = """
format: 1
observe: [r1.c]
robots:
  r1: {rig: {cameras: {c: {preset: infra_swarm, sensor: {preset: mt9m031, columns: 320, rows: 240, pixel_pitch: 15 um}}}}}
  r2: {rig: {sources: {s: {preset: infra_swarm, radius: 5 cm}}}, position: "[1, 0.5, 0] m"}
materials:
  white: {type: diffuse, reflectance: 0.8}
  silver: {type: mirror, reflectance: 0.9}
shapes:
  crate: {type: box, center: "[2, 0, 0] m", size: "[0.6, 0.6, 0.6] m", orientation: {yaw: 45 deg}, material: white}
  glass: {type: rectangle, center: "[3, -1.5, 0] m", size: "[2, 2] m", normal: [-1, 0, 0], material: silver}
  behind: {type: rectangle, center: "[-1, -1.5, 0] m", size: "[1, 1] m", normal: [1, 0, 0], material: white}
lamps:
  one: {center: "[2, 1.5, 0] m", size: "[0.3, 0.3] m", normal: [-1, 0, 0], luminous_flux: 100 lm, temperature: 2856 K}
"""


def test_labels_are_where_geometry_has_them(tmp_path: Path) -> None:
    """f = 1.8 mm over 15 µm: 120 px; a point (x, y) is seen in column 159.5 − 120 y / x.

    The crate, turned by 45°, shows two faces that meet dead ahead, between columns 159 and 160; its corners at
    (2, ±0.424) are 25.46 px off: from 134.04 to 184.96. The source, 26.57° off, fills 2.56° to each side: 13.4 px.
    The lamp, 0.3 m at 2 m, fills 18 px. The mirror, (3, −0.5) to (3, −2.5), is seen from 179.5 on; in it stands
    what is 1 m behind the lens, `behind`: as if (7, −1 to −2), from 176.6, hidden by the mirror's end, to 193.8.
    """
    path = tmp_path / "room.yaml"
    path.write_text(ROOM)
    labels = _labels(load_scene(path), "r1.c")
    row = labels.middle[120]
    assert labels.middle[0, 0] == 0
    changes = [int(column) for column in np.flatnonzero(np.diff(row)) + 1]
    assert changes[-4:] == [160, 185, 194, 260]
    assert changes[-5] == 135
    assert (row == row[99]).sum() in (13, 14)
    assert (row == row[70]).sum() == 18
    np.testing.assert_array_equal(np.flatnonzero(labels.shining), [row[70]])
    assert 1.0 / labels.nearness_per_m[120, 70] == pytest.approx(np.hypot(2.0, 2.0 * 90.0 / 120.0), abs=0.02)
    assert {*np.divmod(labels.edge, 320)[1][labels.edge // 320 == 120].tolist()} >= {134, 135, 184, 185}


def _images(
    name: str, scale: int
) -> tuple[Scene, list[Light], list[np.ndarray], list[np.ndarray], list[np.ndarray]]:
    """Return lights in blocks, and electrons of them enlarged, interpolated, and of full renders: two each."""
    scene = _scene(name, scale, 256)
    lights = [render(scene, "r1.front", seed=seed) for seed in (1, 2)]
    full = [render(_scene(name, 1, 64), "r1.front", seed=seed) for seed in (3, 4)]

    def electrons(light: Light, edges: bool) -> np.ndarray:
        assert light.indirect is not None
        indirect = light.indirect
        if not edges:
            indirect = type(indirect)(
                indirect.radiance_per_w, indirect.variance, indirect.scale, indirect.samples
            )
        return EXPOSURE_S * diffuse_image(light, indirect, scene.at(0.0), group_fluxes(light, scene.at(0.0)))

    sharp, plain = ([electrons(light, edges) for light in lights] for edges in (True, False))
    return scene, lights, sharp, plain, [electrons(light, False) for light in full]


@pytest.mark.parametrize(("name", "scale"), [("arena", 4), ("corridor", 2)])
@pytest.mark.verify
def test_the_error_is_below_a_hundredth_of_the_sensors_noise(name: str, scale: int) -> None:
    scene, lights, sharp, plain, full = _images(name, scale)
    assert lights[0].indirect is not None
    edges = lights[0].indirect.edges
    assert edges is not None
    assert edges.enlargement.patch.size <= 0.05 * full[0].size
    mean = mean_frame(lights[0], scene.at(0.0), EXPOSURE_S)
    sensor_e2 = float(temporal_variance_e2(mean).mean())

    def share(images: list[np.ndarray]) -> tuple[float, float]:
        square_e2 = (images[0] - full[0]) * (images[1] - full[1])
        square_e2.ravel()[edges.enlargement.patch] = 0.0  # rendered as in the full render: noise alone
        tiles = square_e2.reshape(60, 4, 80, 4).mean(axis=(1, 3))  # one block's noise is common to its pixels
        return float(tiles.mean()) / sensor_e2, float(tiles.std()) / np.sqrt(tiles.size) / sensor_e2

    (error, sigma), (before, _) = share(sharp), share(plain)
    assert error + 3.0 * sigma < 0.01
    assert before > 5.0 * error
    assert before > 0.003
    # Edges apart, energy is kept: the same total within 0.5 %.
    assert sharp[0].sum() == pytest.approx(full[0].sum(), rel=0.005)
    # What a run measures of itself is that figure.
    told = upsampling_error(mean)
    assert not isinstance(told, str)
    assert told.pixels <= 256
    assert abs(told.share - error) < 4.0 * np.hypot(told.standard_error, sigma)


FLOOR = """
format: 1
observe: [r1.front]
render: {indirect: {scale: %d, samples: 16}}
robots:
  r1:
    rig: {cameras: {front: {preset: infra_swarm, sensor: {preset: mt9m031, columns: 160, rows: 120, pixel_pitch: 30 um}}}}
    position: "[0, 0, 0.3] m"
  r2: {rig: {sources: {top: infra_swarm}}, position: "[2, 0.3, 0.3] m"}
materials:
  white: {type: diffuse, reflectance: 0.7}
shapes:
  floor: {type: rectangle, center: "[2, 0, 0] m", size: "[6, 6] m", normal: [0, 0, 1], material: white}
  wall: {type: rectangle, center: "[4, 0, 1] m", size: "[6, 3] m", normal: [-1, 0, 0], material: white}
"""


@pytest.mark.parametrize("scale", [2, pytest.param(4, marks=pytest.mark.verify)])
def test_an_error_in_few_pixels_is_found(scale: int, tmp_path: Path) -> None:
    """A robot's source 30 cm above the floor: half of the error is in the 20 pixels below it, of 19 200.

    Every pixel compared with the full render gives the truth; statements of 12 seeds, each of 256 pixels, are
    within 4 of their standard errors, which are below a tenth.
    """
    path = tmp_path / "floor.yaml"
    path.write_text(FLOOR % scale)
    scene = load_scene(path)
    camera = scene.camera("r1.front")[1]
    light = render(scene, "r1.front", seed=0)
    mean = mean_frame(light, scene.at(0.0), camera.exposure_s)
    sensor_e2 = float(temporal_variance_e2(mean).mean())
    assert light.indirect is not None
    assert light.indirect.edges is not None
    how = light.indirect.edges.enlargement
    every = np.setdiff1d(np.arange(160 * 120), how.patch)
    square_e2 = _squares(mean, group_fluxes(light, scene.at(0.0)), every, 256)
    truth = float(square_e2.sum()) / (160 * 120) / sensor_e2
    assert np.sort(square_e2)[-20:].sum() > 0.5 * square_e2.sum()
    for seed in range(12):
        told = upsampling_error(_of_light(mean, replace(light, seed=seed)))
        assert not isinstance(told, str)
        assert told.standard_error < 0.1 * truth
        assert abs(told.share - truth) < 4.0 * told.standard_error
        assert told.largest > 1.0


def _of_light(mean: MeanFrame, light: Light) -> MeanFrame:
    """Return the frame as if it had been made of another light."""
    return replace(mean, rates=replace(mean.rates, light=light))


def test_where_there_is_nothing_to_measure_it_says_why() -> None:
    scene = _scene("arena", 1, 8)
    light = render(scene, "r1.front", seed=1)
    assert light.indirect is not None
    assert light.indirect.edges is None
    mean = mean_frame(light, scene.at(0.0), EXPOSURE_S)
    assert upsampling_error(mean) == "rendered at full resolution"
    assert upsampling_error(_of_light(mean, replace(light, indirect=None))) == "no indirect light"


def test_a_dark_frame_is_measured_too(tmp_path: Path) -> None:
    """1 µs: the median count is the black level; the electrons are still known."""
    path = tmp_path / "floor.yaml"
    path.write_text(FLOOR % 2)
    scene = load_scene(path)
    mean = mean_frame(render(scene, "r1.front", seed=0), scene.at(0.0), 1e-6)
    told = upsampling_error(mean)
    assert not isinstance(told, str)
    assert 0.0 < told.share < 1e-4


@pytest.mark.parametrize(
    ("gap_m", "place"),
    [(0.03, (0.0, 0.0)), (0.03, (0.0105, -0.004)), (0.08, (0.0, 0.0)), (0.2, (0.0, 0.0)), (0.4, (0.0, 0.0))],
)
def test_the_glow_of_a_wall_close_behind_a_source_keeps_its_peak(
    gap_m: float, place: tuple[float, float]
) -> None:
    """A source of 1 W, 10 mm, before a white wall 3.43 m away, in blocks of 4 × 4: rings about it, to 0.8 %.

    By hand: I = 1/4π, and at the foot's distance a the wall shines with ρ I h / (π (h² + a²)^(3/2)), but where the
    source hides it. That glow is 4 to 60 px wide. In blocks alone the inmost ring of the nearest lost 57 %.
    """
    columns, rows, focal_px, wall_m, radius_m, reflectance = 96, 80, 490.0, 3.43, 0.01, 0.8
    centre_m = np.array([wall_m - gap_m, *place])
    document = scene_document(
        {"c": camera_document(columns, rows, focal_px)},
        {"r": source_document(tuple(centre_m.tolist()), radius_m)},
        samples=4096,
        max_depth=2,
        materials={"white": {"type": "diffuse", "reflectance": reflectance}},
        shapes={"wall": rectangle_document((wall_m, 0.0, 0.0), (6.0, 6.0), (-1.0, 0.0, 0.0), "white")},
    )
    document["render"]["indirect"]["scale"] = 4
    light = render(parse_scene(document), "eye.c", seed=5).indirect
    assert light is not None
    assert light.edges is not None
    blocks, patch = light.radiance_per_w[0, 0], light.edges.radiance_per_w[0, 0]
    found = enlarge(blocks.astype(np.float64), rows, columns, light.edges.enlargement, patch)

    rays = pixel_rays(columns, rows, focal_px, parts=8)
    on_wall_m = rays * (wall_m / rays[..., :1])
    apart_m = np.linalg.norm(on_wall_m - centre_m, axis=-1)
    radiance = reflectance / np.pi * gap_m / (4.0 * np.pi * apart_m**3)
    along_m = rays @ centre_m
    hidden = np.linalg.norm(rays * along_m[..., None] - centre_m, axis=-1) < radius_m
    expected = tile_means(np.where(hidden, 0.0, radiance), 8)

    foot_px = focal_px * centre_m[1:] / centre_m[0]
    row, column = np.indices((rows, columns))
    off_px = np.hypot(column - (0.5 * columns - 0.5 - foot_px[0]), row - (0.5 * rows - 0.5 - foot_px[1]))
    for inner_px, outer_px in ((0.0, 3.0), (3.0, 6.0), (6.0, 12.0), (12.0, 24.0)):
        ring = (off_px >= inner_px) & (off_px < outer_px)
        assert found[ring].sum() == pytest.approx(expected[ring].sum(), rel=8e-3)
