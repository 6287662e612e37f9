"""Light of many turns in fog, averaged over blocks: what is averaged, whether it is right, and what noise says.

A room in fog with a source and a lamp, a curved post, a mirror and a box, seen by a small camera.
"""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nir_render import Scene, load_scene, render
from nir_render.camera.by_spectrum import group_fluxes
from nir_render.camera.diffuse_images import diffuse_image
from nir_render.camera.mean_frame import mean_frame
from nir_render.camera.optics.apertures import Aperture
from nir_render.camera.render_noise import aperture_variances_e2, render_variance_e2, temporal_variance_e2
from nir_render.light.light import Light
from nir_render.light.npz import read_light, write_light
from nir_render.transport.backend.variant import backend
from nir_render.transport.indirect import groups
from nir_render.transport.indirect.averaging import averaging_of, narrow_versine
from nir_render.transport.indirect.enlarging_error import _squares, upsampling_error
from nir_render.transport.indirect.labels import labels_of

pytestmark = pytest.mark.mitsuba
SIZE = ROWS, COLUMNS = 120, 160
SCALE = 4
EXPOSURE_S = 2e-4
ROOM = """
format: 1
observe: [r1.c]
render: {indirect: {scale: 4, samples: 32}}
fog: {extinction: 0.15 /m, albedo: 0.9995, phase: {type: henyey_greenstein, g: 0.85}}
robots:
  r1:
    rig: {cameras: {c: {preset: infra_swarm, sensor: {preset: mt9m031, columns: 160, rows: 120, pixel_pitch: 30 um}}}}
  r2: {rig: {sources: {s: infra_swarm}}, position: "[2, 0.3, 0] m"}
materials:
  paint: {type: diffuse, reflectance: 0.6}
  silver: {type: mirror, reflectance: 0.9}
shapes:
  floor: {type: rectangle, center: "[3, 0, -0.5] m", size: "[8, 6] m", normal: [0, 0, 1], material: paint}
  wall: {type: rectangle, center: "[6, 0, 1] m", size: "[6, 3] m", normal: [-1, 0, 0], material: paint}
  glass: {type: rectangle, center: "[4, -1.5, 0.5] m", size: "[1, 1] m", normal: [-1, 0, 0], material: silver}
  post: {type: cylinder, start: "[3, 1, -0.5] m", end: "[3, 1, 1.5] m", radius: 0.2 m, material: paint}
lamps:
  one: {center: "[1.5, -0.5, 2.5] m", size: "[0.3, 0.3] m", normal: [0, 0, -1], luminous_flux: 4000 lm, temperature: 2856 K}
"""


@pytest.fixture(autouse=True)
def _grouped() -> None:
    if not backend().vectorised:
        pytest.skip("light is averaged where LLVM is")


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    path = tmp_path_factory.mktemp("averaging") / "room.yaml"
    path.write_text(ROOM)
    return load_scene(path)


def _rays(scene: Scene) -> groups.Rays:
    placed = scene.at(0.0).camera("r1.c")
    return groups.rays_of(placed.camera, placed.pose)


def _parts(scene: Scene, narrow: float | None, max_depth: int = 0) -> list[np.ndarray]:
    """Return the arrays of some pixels."""
    snapshot, rays = scene.at(0.0), _rays(scene)
    built = groups.world_on_device(snapshot, np.ones(len(snapshot.groups)))
    built = replace(built, max_depth=max_depth or built.max_depth)
    pixels = np.arange(0, 1200, 7)
    counts = np.full(pixels.size, 32)
    return groups.render_pixels(snapshot, built, rays, 5, pixels, counts, SCALE, narrow=narrow)


def test_light_of_many_turns_is_what_longer_paths_bring(room: Scene, tmp_path: Path) -> None:
    """By the same random numbers; in fog without surfaces every vertex is a turn, and the second is one too many."""
    path = tmp_path / "fog.yaml"
    path.write_text(ROOM[: ROOM.index("shapes:")] + ROOM[ROOM.index("lamps:") :])
    fog = load_scene(path)
    plain, short = _parts(fog, None), _parts(fog, None, max_depth=2)
    whole, variance, multiple, of_multiple, covariance = _parts(fog, 0.0)
    largest = float(whole.max())
    np.testing.assert_allclose(whole, plain[0], rtol=1e-4, atol=1e-6 * largest)
    np.testing.assert_allclose(whole - multiple, short[0], rtol=1e-4, atol=2e-6 * largest)
    assert multiple.sum() > 0.2 * whole.sum()
    of_rest = variance - of_multiple - 2.0 * covariance
    assert of_rest.min() > -1e-4 * float(variance.max())
    # Whatever counts as a turn, after one scattering light has not turned twice.
    for narrow in (0.0, 0.05):
        assert not _parts(room, narrow, max_depth=2)[2].any()
    # The wider a turn must be, the more has turned once at most; and where nothing is one, all.
    rest = [
        float((whole - multiple).sum())
        for whole, _, multiple, *_ in (_parts(fog, one) for one in (0.0, 0.01, 0.2))
    ]
    assert 1.02 * rest[0] < 1.01 * rest[1] < rest[2] < float(whole.sum())
    assert not _parts(fog, 2.0)[2].any()


def test_narrow_turns_are_none_however_light_is_found(room: Scene) -> None:
    """Of fog of g = 0.99 0.65 % is turned by more than 0.9 rad; all others are no turns, and walls are black.

    The lamp is large: paths find it by themselves, too, and both ways to it are weighted.
    """
    scene = room.with_(
        {"fog.phase.g": 0.99, "materials.paint.reflectance": 1e-6, "materials.silver.reflectance": 1e-6}
    )
    whole, _, multiple, *_ = _parts(scene, 1.0 - float(np.cos(0.9)))
    assert 0.0 <= multiple.sum() < 0.02 * whole.sum()
    assert _parts(scene, 0.0)[2].sum() > 0.1 * whole.sum()


def test_what_surfaces_alone_turn_is_not_averaged(room: Scene) -> None:
    """In air with next to no fog, though the light of the walls is turned by them time and again."""
    scene = room.with_({"fog.extinction": "1e-7 /m"})
    whole, _, multiple, *_ = _parts(scene, 0.0)
    assert multiple.sum() < 1e-4 * whole.sum()


def test_what_is_averaged_are_flat_matt_surfaces_of_one_reflectance_and_empty_fog(room: Scene) -> None:
    def surface_of(scene: Scene) -> np.ndarray:
        snapshot, rays = scene.at(0.0), _rays(scene)
        built = groups.world_on_device(snapshot, np.ones(len(snapshot.groups)))
        labels = labels_of(built, rays.origin_m, rays.corners)
        found = averaging_of(snapshot, labels, rays.origin_m, rays.corners, SCALE)
        assert found is not None
        return found.surface

    surface = surface_of(room)
    # 60 px to a radian-tangent: the wall 6 m off, the mirror 4 m off, 15 to 30 px to the right of the axis,
    # the post 1 m to the left in 3 m, 24 px wide at most.
    at = {name: (int((59.5 - 60.0 * up) // 4), int((79.5 - 60.0 * left) // 4)) for name, left, up in (
        ("wall", 0.1, 0.15), ("glass", -0.37, 0.1), ("post", 1 / 3, 0.1), ("floor", 0.2, -0.5), ("above", 0.1, 0.9),
    )}  # fmt: skip
    assert surface[at["wall"]] >= 0
    assert surface[at["floor"]] >= 0
    assert surface[at["above"]] >= 0
    assert len({int(surface[at[name]]) for name in ("wall", "floor", "above")}) == 3
    assert surface[at["glass"]] == surface[at["post"]] == -1
    assert 0.6 < (surface >= 0).mean() < 0.95
    glossy = room.with_(
        {"materials.paint": {"type": "plastic", "reflectance": 0.6, "roughness": 0.2, "index": 1.5}}
    )
    assert surface_of(glossy)[at["wall"]] == -1
    # One block of four pixels of 30 µm at 1.8 mm is 3.8° wide, five of them 19°.
    assert narrow_versine(_rays(room).corners, SCALE) == pytest.approx(1.0 - np.cos(20.0 / 60.0), rel=0.01)


def test_fog_over_height_seen_against_nothing_has_a_depth(room: Scene) -> None:
    changes = {"fog": {"extinction": "0.1 /m", "profile": [["0 m", 1.0], ["2 m", 0.2]]}}
    scene = room.with_({**changes, "shapes.wall.center": "[6, 0, -4] m"})
    light = render(scene, "r1.c", seed=1)
    assert light.indirect is not None
    assert light.indirect.multiple is not None
    assert np.isfinite(light.indirect.multiple.averages.of(np.ones((ROWS // SCALE, COLUMNS // SCALE)))).all()
    surface = light.indirect.multiple.surface
    # Far off it thickens quickly towards the horizon: there blocks stand alone, high above it they do not.
    assert (surface[2] >= 0).all()


def test_clear_air_and_full_resolution_are_as_they_are(room: Scene) -> None:
    for changes in ({"fog": None}, {"render.indirect.scale": 1}):
        light = render(room.with_(changes), "r1.c", seed=1)
        assert light.indirect is not None
        assert light.indirect.multiple is None


def test_a_light_with_averages_is_kept_in_a_file(room: Scene, tmp_path: Path) -> None:
    light = render(room, "r1.c", seed=1)
    write_light(tmp_path / "light.npz", light)
    again = pickle.loads(pickle.dumps(read_light(tmp_path / "light.npz")))
    flux = group_fluxes(light, room.at(0.0))
    assert light.indirect is not None
    assert again.indirect is not None
    one, other = (diffuse_image(light, part, room.at(0.0), flux) for part in (light.indirect, again.indirect))
    np.testing.assert_array_equal(one, other)
    plain = diffuse_image(light, replace(light.indirect, multiple=None), room.at(0.0), flux)
    assert np.abs(one - plain).max() > 0.01 * plain.max()


def _frames(scene: Scene, lights: list[Light], *, averaged: bool) -> np.ndarray:
    snapshot = scene.at(0.0)
    images = []
    for light in lights:
        assert light.indirect is not None
        indirect = light.indirect if averaged else replace(light.indirect, multiple=None)
        images.append(EXPOSURE_S * diffuse_image(light, indirect, snapshot, group_fluxes(light, snapshot)))
    return np.stack(images)


@pytest.mark.verify
def test_the_noise_is_what_the_light_says_and_half_of_what_it_was(room: Scene) -> None:
    """Of 96 renders: summed over the frame, and of sums over discs of 3 to 20 pixels across.

    Half, as in so coarse an image light that is turned by 9° goes as if it were not; in those of the library
    it is a quarter.
    """
    finer = room.with_({"render.indirect.scale": 2, "render.indirect.samples": 16})
    lights = [render(finer, "r1.c", seed=seed) for seed in range(96)]
    snapshot = room.at(0.0)
    averaged, plain = (_frames(room, lights, averaged=how) for how in (True, False))
    said = np.mean([render_variance_e2(light, snapshot, EXPOSURE_S) for light in lights], axis=0)
    seen, before = averaged.var(axis=0, ddof=1), plain.var(axis=0, ddof=1)
    assert np.median(seen / before) < 0.5
    assert said.sum() == pytest.approx(seen.sum(), rel=0.06)
    assert np.median(said) == pytest.approx(np.median(seen) * 1.007, rel=0.1)
    discs = []
    for row, column, radius in ((60, 60, 1.5), (30, 90, 4.0), (90, 80, 10.0), (62, 85, 6.0)):
        down, across = np.mgrid[-12:13, -12:13]
        rows, columns = slice(row - 12, row + 13), slice(column - 12, column + 13)
        discs.append(Aperture(rows, columns, down**2 + across**2 <= radius**2))
    sums = np.array([[disc.sum(image) for disc in discs] for image in averaged])
    of_discs = np.mean([aperture_variances_e2(one, snapshot, EXPOSURE_S, discs) for one in lights], axis=0)
    # Averages are as bright, in tiles of 20 pixels.
    bright, before_bright = (
        images.mean(axis=0).reshape(ROWS // 20, 20, COLUMNS // 20, 20).mean(axis=(1, 3))
        for images in (averaged, plain)
    )
    np.testing.assert_allclose(bright, before_bright, rtol=0.02)
    assert bright.sum() == pytest.approx(before_bright.sum(), rel=0.002)
    # A variance of 96 numbers is known to 14.5 %.
    np.testing.assert_allclose(sums.var(axis=0, ddof=1) / of_discs, 1.0, atol=3.5 * 0.145)


@pytest.mark.verify
def test_averages_are_right_within_a_hundredth_of_the_sensors_noise(room: Scene) -> None:
    """Against the full render of every third pixel, and a run's own measure of it says as much."""
    light = render(room.with_({"render.indirect.samples": 64}), "r1.c", seed=3)
    mean = mean_frame(light, room.at(0.0), EXPOSURE_S)
    sensor_e2 = float(temporal_variance_e2(mean).mean())
    assert light.indirect is not None
    assert light.indirect.edges is not None
    some = np.setdiff1d(np.arange(0, ROWS * COLUMNS, 3), light.indirect.edges.enlargement.patch)
    shares = _squares(mean, group_fluxes(light, room.at(0.0)), some, 512) / sensor_e2
    share, sigma = float(shares.mean()), float(shares.std() / shares.size**0.5)
    told = upsampling_error(mean)
    assert not isinstance(told, str)
    assert abs(told.share - share) < 4.0 * np.hypot(told.standard_error, sigma)
    assert share - 3.0 * sigma < 0.01
    assert sigma < 0.005
