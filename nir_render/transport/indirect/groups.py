"""Indirect light of all light groups in one pass: the light-group integrator.

The conductor: it gathers a scene's numbers, brings them to the device, has `kernel.paths` walk the samples of
each pixel in batches, and makes mean and variance of what comes back. The film is cut into parts whose arrays
fit into a bounded memory; as every random number is keyed by pixel, batch and sample, the cuts change
nothing.
"""

import hashlib
import tempfile
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.optics.lens import corner_directions
from nir_render.light.light import Indirect
from nir_render.scene.bodies import place_of_shape
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.document import CLEAR_DEPTH
from nir_render.scene.documents.materials import Dielectric, Diffuse, Pane, texture_of
from nir_render.scene.documents.shapes import Box, Rectangle
from nir_render.scene.pose import Pose
from nir_render.scene.snapshot import Snapshot
from nir_render.spectra.nodes import BAND_M
from nir_render.spectra.skies import CieSky, cie_sky
from nir_render.transport.backend.variant import dr, mi, shape_number, traces_one_scene
from nir_render.transport.indirect.averaging import Averaging
from nir_render.transport.indirect.guide import guide
from nir_render.transport.indirect.kernel.begin import Film
from nir_render.transport.indirect.kernel.nodes import NodeTable, upload_nodes
from nir_render.transport.indirect.kernel.tables import (
    DeviceScene,
    upload_fog,
    upload_guide,
    upload_lights,
    upload_surfaces,
)
from nir_render.transport.indirect.sample_means import BATCHES, sample_means
from nir_render.transport.indirect.walked import Walked, is_coated, is_glossy, walked
from nir_render.transport.world import mitsuba_scene
from nir_render.transport.world.emitters import emitters
from nir_render.transport.world.facets import PANE, Facets, facets
from nir_render.transport.world.medium import Medium, medium
from nir_render.transport.world.pattern import pattern_of

_DEFAULT_SAMPLES = 16
PILOT_SAMPLES = 16
_PILOT_STEP = 4
_PILOT_PIXELS = 1200
_MOST_DEPTH = 64
_FOG_DEPTH, _OPEN_FOG_DEPTH = (12, 3.0), (24, 5.0)  # and for each optical depth; open under sun or sky
_VALUES_AT_ONCE = 2**27  # float32 numbers of one launch: 512 MiB
_MAPPED_FROM_BYTES = 2**30  # larger arrays lie in a file that the system may page out


@dataclass(frozen=True, eq=False)
class Rays:
    """The rays of a camera.

    Attributes
    ----------
    origin_m
        The lens, shape (3,).
    corners
        Directions in the world at the corners of the pixels, of any length, shape (rows + 1, columns + 1, 3);
        between them directions are interpolated.
    """

    origin_m: NDArray[np.float64]
    corners: NDArray[np.float64]


def rays_of(camera: Camera, pose: Pose) -> Rays:
    """Return the rays of a camera whose axes have a pose in the world."""
    return Rays(pose.position_m, corner_directions(camera) @ pose.rotation.T)


def indirect(
    snapshot: Snapshot,
    rays: Rays,
    seed: int,
    power: NDArray[np.float64],
    samples: NDArray[np.int64] | int | None = None,
    values_at_once: int = _VALUES_AT_ONCE,
    wavelengths_m: tuple[float, ...] = (BAND_M,),
    built: DeviceScene | None = None,
    averaging: Averaging | None = None,
) -> Indirect | None:
    """Return the indirect light of all groups, or None where nothing reflects or scatters and no lamp shines.

    Parameters
    ----------
    rays
        The camera's rays; the render settings' scale must divide rows and columns.
    seed
        64 bits.
    power
        What a unit of each group's emission counts when a light is chosen, shape (groups,). It moves only
        noise from one group to another.
    samples
        Samples in each pixel of the film, powers of two, shape (rows, columns) / scale, or one for all;
        without, the scene's, 16 where it has a target.
    values_at_once
        Float32 numbers that one launch may fill.
    wavelengths_m
        The nodes: all go along the same paths.
    built
        The scene on the device, if it is there: `world_on_device` of the same snapshot, power and nodes.
    averaging
        What of the light is averaged over blocks, None for nothing.
    """
    if not snapshot.has_indirect_light():
        return None
    settings = snapshot.render.indirect
    shape = film_shape(rays, settings.scale)
    if samples is None:
        samples = settings.samples or _DEFAULT_SAMPLES
    counts = np.broadcast_to(samples, shape)
    pixels = np.arange(counts.size)
    if built is None:
        built = world_on_device(snapshot, power, wavelengths_m)
    narrow = None if averaging is None else averaging.narrow
    arrays = render_pixels(
        snapshot, built, rays, seed, pixels, counts.ravel(), settings.scale, values_at_once, narrow
    )
    radiance, variance, *apart = (array.reshape(*array.shape[:2], *shape) for array in arrays)
    return Indirect(
        radiance_per_w=radiance,
        variance=variance,
        scale=settings.scale,
        samples=int(np.median(counts)),
        counts=None if (counts == counts.flat[0]).all() else counts.astype(np.int32),
        multiple=None if averaging is None else averaging.multiple(apart),
    )


def pilot(
    snapshot: Snapshot, built: DeviceScene, rays: Rays, seed: int, averaging: Averaging | None
) -> Indirect | None:
    """Return a few samples in some pixels of the film, every fourth along each axis: what noise there is.

    A small film's are closer, so that there are a thousand. The arguments are those of `indirect`.
    """
    if not snapshot.has_indirect_light():
        return None
    scale = snapshot.render.indirect.scale
    rows, columns = film_shape(rays, scale)
    step = int(np.clip((rows * columns / _PILOT_PIXELS) ** 0.5, 1, _PILOT_STEP))
    row, column = (middles(count, step) for count in (rows, columns))
    pixels = (row[:, None] * columns + column).ravel()
    counts = np.full(pixels.size, PILOT_SAMPLES)
    narrow = None if averaging is None else averaging.narrow
    arrays = render_pixels(snapshot, built, rays, seed, pixels, counts, scale, narrow=narrow)
    radiance, variance, *apart = (array.reshape(*array.shape[:2], row.size, column.size) for array in arrays)
    multiple = None if averaging is None else averaging.multiple(apart)
    return Indirect(radiance, variance, scale * step, PILOT_SAMPLES, multiple=multiple)


def film_shape(rays: Rays, scale: int) -> tuple[int, int]:
    """Return rows and columns of a film of scale × scale sensor pixels each."""
    return (rays.corners.shape[0] - 1) // scale, (rays.corners.shape[1] - 1) // scale


def middles(count: int, step: int) -> NDArray[np.int64]:
    """Return the middles of equal parts of an axis of so many pixels, each part at most a step long."""
    parts = -(-count // step)
    return ((2 * np.arange(parts) + 1) * count) // (2 * parts)


def render_pixels(
    snapshot: Snapshot,
    built: DeviceScene,
    rays: Rays,
    seed: int,
    pixels: NDArray[np.int64],
    counts: NDArray[np.int64],
    scale: int,
    values_at_once: int = _VALUES_AT_ONCE,
    narrow: float | None = None,
) -> list[NDArray[np.float32]]:
    """Return radiance per unit of each group in some pixels of a film, at each node, and its variance.

    Parameters
    ----------
    built
        The scene on the device.
    seed
        64 bits.
    pixels
        Numbers of the pixels, row by row, shape (pixels,).
    counts
        Samples in each, powers of two, shape (pixels,).
    scale
        A pixel of the film is scale × scale of the sensor's.
    values_at_once
        Float32 numbers that one launch may fill.
    narrow
        If given, there are three more arrays, as of `sample_means`.

    Returns
    -------
    Shape (groups, nodes, pixels) each.
    """
    groups = len(snapshot.groups)
    layers = groups * built.node_count * (1 if narrow is None else 2)
    shape = groups, built.node_count, pixels.size
    arrays = [_array((groups * built.node_count, pixels.size)) for _ in range(2 if narrow is None else 5)]
    for count in np.unique(counts):
        places = np.flatnonzero(counts == count)
        batches = min(BATCHES, int(count))
        part = int(np.clip(values_at_once // (layers * batches), 1, places.size))
        for first in range(0, places.size, part):
            some = places[first : first + part]
            film = film_on_device(rays, scale, pixels[some])
            # Neighbours are written as one block: that is a fifth of a render of 512 groups.
            whole = some[-1] - some[0] + 1 == some.size
            there = slice(some[0], some[-1] + 1) if whole else some
            found = sample_means(built, film, seed, groups, int(count), narrow)
            if some.size == pixels.size:  # all at once: no copy
                return [values.reshape(shape) for values in found]
            for array, values in zip(arrays, found, strict=True):
                array[:, there] = values
    return [array.reshape(shape) for array in arrays]


def light_seed(*key: object) -> int:
    """Return a seed of 64 bits for a key."""
    text = "|".join(repr(part) for part in key)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


def film_on_device(rays: Rays, scale: int, pixels: NDArray[np.int64]) -> Film:
    """Bring some pixels, numbered row by row, of a film of scale × scale sensor pixels each to the device."""
    return Film(
        origin=mi.Point3f(*(dr.opaque(mi.Float, float(value)) for value in rays.origin_m)),
        corners=mi.Float(rays.corners.astype(np.float32).ravel()),
        rows=dr.opaque(mi.UInt32, rays.corners.shape[0] - 1),
        columns=dr.opaque(mi.UInt32, rays.corners.shape[1] - 1),
        scale=dr.opaque(mi.UInt32, scale),
        index=mi.UInt32(pixels.astype(np.uint32)),
        pixels=dr.opaque(mi.UInt32, pixels.size),
        pixel_count=pixels.size,
    )


def world_on_device(
    snapshot: Snapshot, power: NDArray[np.float64], wavelengths_m: tuple[float, ...] = (BAND_M,)
) -> DeviceScene:
    """Bring a scene at a time to the device; `power` and `wavelengths_m` as for `indirect`."""
    of_nodes = walked(snapshot, wavelengths_m)
    snapshot = of_nodes.snapshot
    bodies = mitsuba_scene.build(snapshot)
    flat = facets(snapshot)
    shining = emitters(snapshot, flat)
    panes = bool((flat.kind == PANE).any())
    box = bodies.bbox()
    low_m, high_m = np.array(box.min, dtype=np.float64).ravel(), np.array(box.max, dtype=np.float64).ravel()
    patterns, axes = [], []
    for name in snapshot.groups:
        placed = snapshot.sources.get(name)
        patterns.append(None if placed is None else pattern_of(placed.source))
        axes.append(np.eye(3) if placed is None else placed.pose.rotation)
    fog = medium(snapshot)
    opaque = bodies
    if panes:
        opaque = None if traces_one_scene() else mitsuba_scene.build(snapshot, panes=False)
    extinction_per_m = 0.0 if fog is None else fog.mean_extinction_per_m(low_m[2], high_m[2])
    choice = guide(shining, flat, power, low_m, high_m, extinction_per_m)
    columns = _shape_columns(snapshot, (bodies,) if opaque is None else (bodies, opaque), flat)
    return DeviceScene(
        bodies=bodies,
        opaque=opaque,
        lights=upload_lights(shining, power, patterns, np.array(axes), _sky_of(snapshot), choice.tier),
        surfaces=upload_surfaces(flat, columns),
        choice=upload_guide(choice),
        fog=None if fog is None else upload_fog(fog),
        max_depth=snapshot.render.indirect.max_depth or default_depth(snapshot, fog, low_m, high_m),
        pictures=any(texture_of(snapshot.materials[one.material]) for one in snapshot.shapes.values()),
        even_shapes=columns["even"].astype(bool),
        nodes=_node_table(of_nodes, columns["material"], len(wavelengths_m)),
    )


def _node_table(of_nodes: Walked, material: NDArray[np.int64], nodes: int) -> NodeTable | None:
    """Return what nodes keep on the device, None of one; `material` is each shape's, -1 for none."""
    if nodes == 1:
        return None
    materials = of_nodes.snapshot.materials
    whole = np.ones(nodes)
    of_materials = np.array([*(of_nodes.kept.get(name, whole) for name in materials), whole])
    coated, glossy = (
        np.array([*(tells(one) and name in of_nodes.kept for name, one in materials.items()), False])
        for tells in (is_coated, is_glossy)
    )
    return upload_nodes(of_materials[material], of_nodes.of_facets, coated[material], glossy[material])


def default_depth(
    snapshot: Snapshot, fog: Medium | None, low_m: NDArray[np.float64], high_m: NDArray[np.float64]
) -> int:
    """Return the longest path where a scene does not say it: the thicker the fog, the longer.

    `low_m` and `high_m` are corners of the box that holds the bodies; with the robots it says how far light
    goes in fog. That length in optical depths is how often fog turns it on the way, of fog that varies over
    height that of level ways where it is densest; that of sun and sky, which comes in everywhere, goes
    further.
    """
    if fog is None:
        return CLEAR_DEPTH
    places_m = np.array([low_m, high_m, *(robot.pose.position_m for robot in snapshot.robots.values())])
    low_m, high_m = np.maximum(places_m.min(axis=0), fog.low_m), np.minimum(places_m.max(axis=0), fog.high_m)
    across_m = np.maximum(high_m - low_m, 0.0)
    level_per_m = fog.densest_per_m(low_m[2], high_m[2])
    upwards_per_m = fog.mean_extinction_per_m(low_m[2], high_m[2])
    optical_depth = float(np.linalg.norm(across_m * [level_per_m, level_per_m, upwards_per_m]))
    open_air = snapshot.sun is not None or snapshot.skylight is not None
    least, per_turn = _OPEN_FOG_DEPTH if open_air else _FOG_DEPTH
    return int(min(least + per_turn * optical_depth, _MOST_DEPTH))


def _sky_of(snapshot: Snapshot) -> CieSky | None:
    light = snapshot.skylight
    return None if light is None else cie_sky(light.sky.cie, light.sun.direction)


def _shape_columns(
    snapshot: Snapshot, worlds: tuple[object, ...], flat: Facets
) -> dict[str, NDArray[np.int64]]:
    """Return what each of Mitsuba's shapes is, by its number in Mitsuba."""
    numbers = [
        (shape.id(), shape_number(shape))
        for bodies in worlds
        for shape in bodies.shapes()  # type: ignore[attr-defined]
    ]
    size = max((number for _, number in numbers), default=0) + 1
    columns = {name: np.full(size, -1, dtype=np.int64) for name in ("light", "facet", "material")}
    columns |= {name: np.zeros(size, dtype=np.int64) for name in ("box", "glass", "pane", "even")}
    light_of_body = {
        f"lamp_{name.removeprefix('lamps.')}" if name.startswith("lamps.") else f"source_{group}": group
        for group, name in enumerate(snapshot.groups)
    }
    material_number = {name: index for index, name in enumerate(snapshot.materials)}
    first_facet = {name: index for index, name in reversed(list(enumerate(flat.name)))}
    for body, number in numbers:
        columns["light"][number] = light_of_body.get(body, -1)
        name = mitsuba_scene.shape_of_body(snapshot, body)
        if name is None:
            continue
        shape = snapshot.shapes[name]
        material = snapshot.materials[shape.material]
        columns["material"][number] = material_number[shape.material]
        box = isinstance(shape, Box)
        place = place_of_shape(name)
        columns["facet"][number] = first_facet.get(f"{place}.0" if box else place, -1)
        columns["box"][number] = box
        columns["glass"][number] = isinstance(material, Dielectric)
        columns["pane"][number] = isinstance(material, Pane)
        matt = isinstance(material, Diffuse) and texture_of(material) is None
        columns["even"][number] = matt and isinstance(shape, Rectangle | Box)
    return columns


def _array(shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return an array of zeros; a large one is mapped from a file that vanishes with it."""
    if 4 * shape[0] * shape[1] < _MAPPED_FROM_BYTES:
        return np.zeros(shape, dtype=np.float32)
    with tempfile.TemporaryFile(prefix="nir_render-light-") as file:
        return np.memmap(file, dtype=np.float32, mode="w+", shape=shape)
