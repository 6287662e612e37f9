"""Sharp edges for indirect light that was rendered in blocks of pixels."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from nir_render.light.enlarge import Enlargement, with_patch
from nir_render.light.light import Edges, Indirect
from nir_render.scene.snapshot import Snapshot
from nir_render.transport.indirect import groups
from nir_render.transport.indirect.averaging import (
    Averaging,
    middle_directions,
    narrow_versine,
    pixel_angle_rad,
    unit,
)
from nir_render.transport.indirect.enlargement import Labels, fit_enlargement
from nir_render.transport.indirect.kernel.tables import DeviceScene
from nir_render.transport.world.medium import medium

FLARE_PILOT_SAMPLES = 256
MULTIPLE = 0
"""In place of a scale: light of many turns."""
_FEWER_SAMPLES = 16  # as an average over 5 × 5 blocks has a nineteenth of a block's variance
# Fog that throws more than this of the light scattered once, over straight light and optical depth, within
# half a block of a source has halos that blocks smear: so many blocks about each are rendered by the pixel.
_SHARP_SHARE, _HALO_BLOCKS = 0.04, 3.0
# A source lights what is near it as 1/r²: where a surface is nearer than so many blocks are wide there, light
# changes within a block. In the blocks beside the source, some of which it cuts, that shows where the surface
# is farther, too. As many pixels as there are blocks are rendered one by one for it at most, the nearest; in
# small images so many.
_GLOW_BLOCKS, _GLOW_BESIDE_BLOCKS, _BESIDE_BLOCKS = 6.0, 24.0, 2.0
_GLOW_PIXELS = 10_000


def enlargement_of(snapshot: Snapshot, labels: Labels, rays: groups.Rays, scale: int) -> Enlargement:
    """Return how light in blocks of scale × scale pixels, which have labels, is enlarged.

    Where sources shine on surfaces close by pixels are rendered one by one.
    """
    enlargement = fit_enlargement(labels, scale)
    glowing, left_out = pixels_in_glow(snapshot, labels, rays, scale)
    if not len(glowing):
        return enlargement
    return replace(with_patch(enlargement, glowing), left_out=enlargement.left_out + left_out)


def pixels_in_glow(
    snapshot: Snapshot, labels: Labels, rays: groups.Rays, scale: int
) -> tuple[NDArray[np.int64], int]:
    """Return the numbers, row by row, of pixels that show surfaces close to a source: blocks smear its light.

    A wall at the distance h behind a source shines as (1 + ρ²/h²)^(-3/2) about its foot. What a mirror shows
    of such surfaces, and what is behind a pane, is not looked for. Beside them, how many more there are.
    """
    rows, columns = labels.middle.shape
    grid = rays.corners[::scale, ::scale]
    blocks = middle_directions(grid)
    # How near each block's nearest surface is to a source, over what counts as near there.
    nearest = np.full((rows // scale, columns // scale), np.inf)
    for source in snapshot.sources.values():
        offset_m = source.pose.position_m - rays.origin_m
        distance_m = max(float(np.linalg.norm(offset_m)), 1e-12)
        towards, radius_m = offset_m / distance_m, source.source.radius_m
        radius_rad = float(np.arcsin(min(radius_m / distance_m, 1.0)))
        cosine = blocks @ towards
        row, column = np.unravel_index(np.argmax(cosine), cosine.shape)
        corner, right, below = unit(grid[[row, row, row + 1], [column, column + 1, column]])
        chord = max(float(np.linalg.norm(right - corner)), float(np.linalg.norm(below - corner)))
        block_rad = 2.0 * float(np.arcsin(min(0.5 * chord, 1.0)))
        reach_rad = radius_rad + (_GLOW_BLOCKS + 1.0) * block_rad
        near_row, near_column = np.nonzero(cosine > np.cos(min(reach_rad, np.pi)))
        if not len(near_row):
            continue
        block = np.s_[near_row.min() : near_row.max() + 1, near_column.min() : near_column.max() + 1]
        at = tuple(slice(one.start * scale, one.stop * scale) for one in block)
        corners = rays.corners[at[0].start : at[0].stop + 1, at[1].start : at[1].stop + 1]
        direction = middle_directions(corners)
        nearness_per_m = labels.nearness_per_m[at]
        along_m = 1.0 / np.maximum(nearness_per_m, 1e-12)
        apart_m = np.linalg.norm(direction * along_m[..., None] - offset_m, axis=-1) - radius_m
        beside = direction @ towards > np.cos(min(radius_rad + _BESIDE_BLOCKS * block_rad, np.pi))
        near_blocks = np.where(beside, _GLOW_BESIDE_BLOCKS, _GLOW_BLOCKS)
        off = apart_m / (near_blocks * block_rad * along_m)
        # What shows the source itself is none of its surroundings.
        off[(nearness_per_m == 0.0) | (apart_m < 0.01 * radius_m)] = np.inf
        of_blocks = off.reshape(-1, scale, off.shape[1] // scale, scale).min(axis=(1, 3))
        nearest[block] = np.minimum(nearest[block], of_blocks)
    glowing = np.flatnonzero(nearest < 1.0)
    most = max(nearest.size, _GLOW_PIXELS) // scale**2
    kept = glowing[np.argsort(nearest.ravel()[glowing], kind="stable")[:most]]
    is_kept = np.zeros(nearest.shape, dtype=np.bool_)
    is_kept.ravel()[kept] = True
    pixels = np.flatnonzero(np.kron(is_kept, np.ones((scale, scale), dtype=np.bool_)))
    return pixels, (len(glowing) - len(kept)) * scale**2


def halo_reach_px(snapshot: Snapshot, rays: groups.Rays, scale: int) -> float:
    """Return how far about flares pixels are rendered one by one, as fog's halos are sharper than blocks.

    A halo of light scattered once goes as ∫ p dβ / α, α the angle off the source (`scattering.forward`).
    """
    fog = medium(snapshot)
    if fog is None or scale == 1:
        return 0.0
    half_block_rad = 0.5 * scale * pixel_angle_rad(rays.corners)
    within = 2.0 * np.pi * half_block_rad * fog.albedo * float(fog.phase.arc[-1])
    return _HALO_BLOCKS * scale if within > _SHARP_SHARE else 0.0


def sharpened(
    snapshot: Snapshot,
    built: DeviceScene,
    rays: groups.Rays,
    seed: int,
    light: Indirect,
    enlargement: Enlargement,
) -> Indirect:
    """Return a light with what its enlargement needs: weights beside edges, and pixels rendered one by one.

    These have as many samples as the block that they lie in. Of scale 1 nothing is enlarged.

    Parameters
    ----------
    built, rays, seed
        Those with which the light was rendered, as for `groups.render_pixels`.
    """
    if light.scale == 1:
        return light
    blocks = light.radiance_per_w.shape[2:]
    pixels = enlargement.patch.astype(np.int64)
    row, column = (at // light.scale for at in np.divmod(pixels, enlargement.columns))
    counts = np.broadcast_to(light.samples if light.counts is None else light.counts, blocks)[row, column]
    key = groups.light_seed(seed, "edges")
    radiance, variance = groups.render_pixels(snapshot, built, rays, key, pixels, counts, 1)
    return replace(light, edges=Edges(enlargement, radiance, variance))


def flare_pilot(
    snapshot: Snapshot,
    built: DeviceScene,
    rays: groups.Rays,
    seed: int,
    blocks: NDArray[np.int64],
    enlargement: Enlargement,
    averaging: Averaging | None = None,
) -> Indirect:
    """Return a pilot in chosen blocks, as an image of one row, and in each pixel of the patch.

    Parameters
    ----------
    built, rays, seed
        As for `groups.render_pixels`.
    blocks
        Numbers of the film's pixels, row by row, shape (n,).
    averaging
        What is averaged, None for nothing.
    """
    scale, samples = snapshot.render.indirect.scale, FLARE_PILOT_SAMPLES

    def rendered(
        name: str, pixels: NDArray[np.int64], size: int, narrow: float | None
    ) -> list[NDArray[np.float32]]:
        key, counts = groups.light_seed(seed, name), np.full(pixels.size, samples)
        return groups.render_pixels(snapshot, built, rays, key, pixels, counts, size, narrow=narrow)

    narrow = None if averaging is None else averaging.narrow
    radiance, variance, *apart = (array[:, :, None] for array in rendered("blocks", blocks, scale, narrow))
    edges = Edges(enlargement, *rendered("edges", enlargement.patch.astype(np.int64), 1, None))
    multiple = None if averaging is None else averaging.multiple(apart)
    return Indirect(radiance, variance, scale, samples, edges=edges, multiple=multiple)


def rendered_again(
    snapshot: Snapshot,
    rays: groups.Rays,
    seed: int,
    power: NDArray[np.float64],
    pixels: dict[int, NDArray[np.int64]],
    samples: int,
    wavelengths_m: tuple[float, ...],
    averaged: NDArray[np.int64] | None = None,
) -> list[dict[int, NDArray[np.float32]]]:
    """Return the indirect light of some pixels of films, twice, independent of each other and of the light.

    Parameters
    ----------
    rays, seed, power
        As for `groups.indirect`.
    pixels
        Their numbers, row by row, by the scale of the film.
    samples
        In each pixel, a power of two.
    wavelengths_m
        The nodes.
    averaged
        Where light of many turns is averaged, the numbers of the blocks whose average it is: films of blocks
        are without that light then, and it comes apart, of few samples as it is the mean of many blocks.

    Returns
    -------
    By scale, radiance per unit of each group, shape (groups, nodes, pixels); at `MULTIPLE` that of many turns
    in the blocks `averaged`.
    """
    built = groups.world_on_device(snapshot, power, wavelengths_m)
    own_scale = snapshot.render.indirect.scale
    narrow = None if averaged is None else narrow_versine(rays.corners, own_scale)

    def rendered(
        name: tuple[object, ...], some: NDArray[np.int64], samples: int, scale: int, narrow: float | None
    ) -> list[NDArray[np.float32]]:
        key, counts = groups.light_seed(seed, "again", *name), np.full(some.size, samples)
        return groups.render_pixels(snapshot, built, rays, key, some, counts, scale, narrow=narrow)

    renders: list[dict[int, NDArray[np.float32]]] = []
    for number in range(2):
        radiance = {}
        for scale, some in pixels.items():
            whole, _, *apart = rendered((number, scale), some, samples, scale, narrow if scale > 1 else None)
            radiance[scale] = whole - apart[0] if apart else whole
        if averaged is not None:
            few = max(samples // _FEWER_SAMPLES, groups.PILOT_SAMPLES)
            radiance[MULTIPLE] = rendered((number, "multiple"), averaged, few, own_scale, narrow)[2]
        renders.append(radiance)
    return renders
