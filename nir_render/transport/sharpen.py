"""Sharp edges for indirect light that was rendered in blocks of pixels."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nir_render.camera.enlarge import Enlargement, enlargement, without_edges
from nir_render.scene.load import Scene
from nir_render.transport import groups, world
from nir_render.transport.kernel.tables import World
from nir_render.transport.labels import labels_of
from nir_render.transport.light import Edges, Indirect

FLARE_PILOT_SAMPLES = 256


def enlargement_of(built: World, rays: groups.Rays, scale: int) -> Enlargement:
    """Return how light in blocks of scale × scale pixels is enlarged; of scale 1 nothing is."""
    if scale == 1:
        return without_edges(*(count - 1 for count in rays.corners.shape[:2]))
    return enlargement(labels_of(built, rays.origin_m, rays.corners), scale)


def sharpened(
    scene: Scene, built: World, rays: groups.Rays, seed: int, light: Indirect, how: Enlargement
) -> Indirect:
    """Return a light with what its enlargement needs: weights beside edges, and pixels rendered one by one.

    These have as many samples as the block that they lie in. Of scale 1 nothing is enlarged.

    Parameters
    ----------
    built, rays, seed
        Those with which the light was rendered, as for `groups.estimate`.
    """
    if light.scale == 1:
        return light
    blocks = light.radiance_per_w.shape[2:]
    row, column = (at // light.scale for at in np.divmod(how.patch.astype(np.int64), how.columns))
    counts = np.broadcast_to(light.samples if light.counts is None else light.counts, blocks)[row, column]
    radiance, variance = _estimated(
        scene, built, rays, groups.light_seed(seed, "edges"), how.patch.astype(np.int64), counts
    )
    return replace(light, edges=Edges(how, radiance[:, None], variance[:, None]))


def flare_pilot(
    scene: Scene,
    built: World,
    rays: groups.Rays,
    seed: int,
    blocks: NDArray[np.int64],
    how: Enlargement,
) -> Indirect:
    """Return a pilot in chosen blocks, as an image of one row, and in each pixel of the patch.

    Parameters
    ----------
    built, rays, seed
        As for `groups.estimate`.
    blocks
        Numbers of the film's pixels, row by row, shape (n,).
    """
    scale, samples = scene.document.render.indirect.scale, FLARE_PILOT_SAMPLES
    patch = how.patch.astype(np.int64)
    parts = [
        _estimated(scene, built, rays, groups.light_seed(seed, of), some, np.full(some.size, samples), size)
        for of, some, size in (("blocks", blocks, scale), ("edges", patch, 1))
    ]
    (radiance, variance), (alone, variance_alone) = parts
    edges = Edges(how, alone[:, None], variance_alone[:, None])
    return Indirect(radiance[:, None, None], variance[:, None, None], scale, samples, edges=edges)


def rendered_again(
    scene: Scene,
    rays: groups.Rays,
    time_s: float,
    seed: int,
    power: NDArray[np.float64],
    pixels: dict[int, NDArray[np.int64]],
    samples: int,
) -> list[dict[int, NDArray[np.float32]]]:
    """Return the indirect light of some pixels of films, twice, independent of each other and of the light.

    Parameters
    ----------
    rays, time_s, seed, power
        As for `groups.indirect`.
    pixels
        Their numbers, row by row, by the scale of the film.
    samples
        In each pixel, a power of two.

    Returns
    -------
    By scale, radiance per unit of each group, shape (groups, nodes, pixels).
    """
    built = groups.world_on_device(scene, time_s, power)
    renders: list[dict[int, NDArray[np.float32]]] = []
    for number in range(2):
        radiance = {}
        for scale, some in pixels.items():
            key = groups.light_seed(seed, "again", number, scale)
            counts = np.full(some.size, samples)
            radiance[scale] = _estimated(scene, built, rays, key, some, counts, scale)[0][:, None]
        renders.append(radiance)
    return renders


def _estimated(
    scene: Scene,
    built: World,
    rays: groups.Rays,
    seed: int,
    pixels: NDArray[np.int64],
    counts: NDArray[np.int64],
    scale: int = 1,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return radiance per unit of each group in some pixels of a film, and its variance.

    Parameters
    ----------
    pixels
        Numbers of the pixels, row by row, shape (pixels,).
    counts
        Samples in each, powers of two, shape (pixels,).

    Returns
    -------
    Shape (groups, pixels) each.
    """
    number = len(world.groups(scene))
    radiance, variance = (np.zeros((number, pixels.size), dtype=np.float32) for _ in range(2))
    for count in np.unique(counts):
        some = np.flatnonzero(counts == count)
        film = groups.film_on_device(rays, scale, pixels[some])
        radiance[:, some], variance[:, some] = groups.estimate(
            built, film, seed, number, int(count), scene.document.render.indirect.max_depth
        )
    return radiance, variance
