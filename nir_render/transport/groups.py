"""Indirect light of all light groups in one pass: the light-group integrator.

The conductor: it gathers a scene's numbers, brings them to the device, has `kernel.paths` walk the samples of
each pixel in batches, and makes mean and variance of what comes back. The film is cut into parts whose arrays
fit into a bounded memory; as every random number is keyed by pixel, batch and sample, the cuts change nothing.
"""

import hashlib
import tempfile
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.lens import corner_directions
from nir_render.scene.devices import Camera
from nir_render.scene.load import Scene
from nir_render.scene.motion import Pose
from nir_render.scene.world import Box, Dielectric, Pane
from nir_render.transport import world
from nir_render.transport.backend import backend
from nir_render.transport.emitters import emitters
from nir_render.transport.facets import PANE, Facets, facets
from nir_render.transport.guide import guide
from nir_render.transport.kernel.draws import draws
from nir_render.transport.kernel.paths import Film, World, walk
from nir_render.transport.kernel.tables import upload_fog, upload_guide, upload_lights, upload_surfaces
from nir_render.transport.light import Indirect
from nir_render.transport.medium import medium
from nir_render.transport.pattern import pattern_of

BATCHES = 8
_VALUES_AT_ONCE = 2**25  # float32 numbers of one launch: 128 MiB
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
    scene: Scene, rays: Rays, time_s: float, seed: int, power: NDArray[np.float64], values_at_once: int = _VALUES_AT_ONCE
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
    values_at_once
        Float32 numbers that one launch may fill.
    """
    if not scene.document.has_indirect_light():
        return None
    settings = scene.document.render.indirect
    built = _world(scene, time_s, power)
    groups = len(world.groups(scene))
    batches = min(BATCHES, settings.samples)
    rows, columns = (count - 1 for count in rays.corners.shape[:2])
    pixels = (rows // settings.scale) * (columns // settings.scale)
    part = int(np.clip(values_at_once // (groups * batches), 1, pixels))
    radiance = _array((groups, pixels))
    variance = _array((groups, pixels))
    for first in range(0, pixels, part):
        count = min(part, pixels - first)
        film = _film(rays, settings.scale, first, count)
        mean, spread = _part(built, film, seed, groups, batches, settings.samples // batches, settings.max_depth)
        radiance[:, first : first + count] = mean
        variance[:, first : first + count] = spread
    shape = (groups, 1, rows // settings.scale, columns // settings.scale)
    return Indirect(
        radiance_per_w=radiance.reshape(shape),
        variance=variance.reshape(shape),
        scale=settings.scale,
        samples=settings.samples,
    )


def light_seed(*key: object) -> int:
    """Return a seed of 64 bits for a key."""
    text = "|".join(repr(part) for part in key)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


def _part(
    built: World, film: Film, seed: int, groups: int, batches: int, samples: int, max_depth: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return mean and variance of the mean for a part of the film, shape (groups, pixels)."""
    mi, dr = backend().mi, backend().dr
    pixels = film.pixel_count
    lanes = pixels * batches
    lane = dr.arange(mi.UInt32, lanes)
    draw = draws(film.first_pixel + lane % film.pixels, lane // film.pixels, seed, dr.opaque(mi.UInt32, samples))
    sums = walk(built, film, draw, lanes, groups, dr.opaque(mi.UInt32, max_depth))
    place = dr.arange(mi.UInt32, groups * pixels)
    group = place // film.pixels
    first = group * dr.opaque(mi.UInt32, lanes) + (place - group * film.pixels)
    estimates = [
        dr.gather(mi.Float, sums, first + batch * film.pixels) / mi.Float(draw.samples)
        for batch in range(batches)
    ]
    mean = sum(estimates[1:], estimates[0]) / batches
    square = sum((dr.square(one - mean) for one in estimates), mi.Float(0))
    variance = square / max(batches * (batches - 1), 1)
    dr.eval(mean, variance)
    return tuple(np.array(array).reshape(groups, pixels) for array in (mean, variance))


def _film(rays: Rays, scale: int, first: int, count: int) -> Film:
    mi, dr = backend().mi, backend().dr
    return Film(
        origin=mi.Point3f(*(dr.opaque(mi.Float, float(value)) for value in rays.origin_m)),
        corners=mi.Float(rays.corners.astype(np.float32).ravel()),
        columns=dr.opaque(mi.UInt32, rays.corners.shape[1] - 1),
        scale=dr.opaque(mi.UInt32, scale),
        first_pixel=dr.opaque(mi.UInt32, first),
        pixels=dr.opaque(mi.UInt32, count),
        pixel_count=count,
    )


def _world(scene: Scene, time_s: float, power: NDArray[np.float64]) -> World:
    """Bring a scene to the device."""
    bodies = world.build(scene, time_s)
    flat = facets(scene)
    shining = emitters(scene, time_s, flat)
    panes = bool((flat.kind == PANE).any())
    box = bodies.bbox()
    low_m, high_m = np.array(box.min, dtype=np.float64).ravel(), np.array(box.max, dtype=np.float64).ravel()
    sources = scene.sources()
    patterns, axes = [], []
    turns = world.source_rotations(scene, time_s)
    for name in world.groups(scene):
        patterns.append(pattern_of(sources[name][1]) if name in sources else None)
        axes.append(turns.get(name, np.eye(3)))
    fog = medium(scene)
    return World(
        bodies=bodies,
        opaque=world.build(scene, time_s, panes=False) if panes else bodies,
        lights=upload_lights(shining, power, patterns, np.array(axes)),
        surfaces=upload_surfaces(flat, _shape_columns(scene, bodies, flat)),
        choice=upload_guide(guide(shining, flat, power, low_m, high_m)),
        fog=None if fog is None else upload_fog(fog),
    )


def _shape_columns(scene: Scene, bodies: object, flat: Facets) -> dict[str, NDArray[np.int64]]:
    """Return what each of Mitsuba's shapes is, by its number in Mitsuba."""
    mi, dr = backend().mi, backend().dr
    numbers = {
        shape.id(): int(np.array(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape)))[0])
        for shape in bodies.shapes()  # type: ignore[attr-defined]
    }
    size = max(numbers.values(), default=0) + 1
    columns = {name: np.full(size, -1, dtype=np.int64) for name in ("light", "facet")}
    columns |= {name: np.zeros(size, dtype=np.int64) for name in ("box", "glass", "pane")}
    for group, name in enumerate(world.groups(scene)):
        body = f"lamp_{name.removeprefix('lamps.')}" if name.startswith("lamps.") else f"source_{group}"
        if body in numbers:  # the sun has none
            columns["light"][numbers[body]] = group
    first_facet = {name: index for index, name in reversed(list(enumerate(flat.name)))}
    for name, shape in scene.document.shapes.items():
        material = scene.document.materials[shape.material]
        box = isinstance(shape, Box)
        for body in (key for key in numbers if key.rpartition("_")[0] == f"shape_{name}"):
            number = numbers[body]
            columns["facet"][number] = first_facet.get(f"shapes.{name}.0" if box else f"shapes.{name}", -1)
            columns["box"][number] = box
            columns["glass"][number] = isinstance(material, Dielectric)
            columns["pane"][number] = isinstance(material, Pane)
    return columns


def _array(shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return an array of zeros; a large one is mapped from a file that vanishes with it."""
    if 4 * shape[0] * shape[1] < _MAPPED_FROM_BYTES:
        return np.zeros(shape, dtype=np.float32)
    with tempfile.TemporaryFile(prefix="nir_render-light-") as file:
        return np.memmap(file, dtype=np.float32, mode="w+", shape=shape)
