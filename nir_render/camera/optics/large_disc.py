"""The image of a disc that is large against the finest waves that the core passes: its inside and its edge.

Nodes as dense as the core asks for all over the disc would be millions. So the disc is split by a smooth
weight: 1 over the inside, falling to 0 over some pixels before the rim. The inside varies so slowly that its
samples at the middles of pixels tell all about it; they are spread by FFT. Only the edge gets dense nodes,
Gauss–Legendre across it and even along it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve
from scipy.special import betainc

from nir_render.camera.optics.gaussian import pixel_shares
from nir_render.camera.optics.lens import Intrinsics
from nir_render.camera.optics.otf import Core
from nir_render.camera.optics.waves import image_of_points, smooth_kernel
from nir_render.geometry import cone_directions, cone_versine

Array = NDArray[np.float64]

_EDGE_PX = 16.0  # at its thinnest
_SMOOTHNESS = 5  # derivatives of the weight that are continuous, and one
_OUTLINE = 720
_SMALL_PART = 0.01
# As dense as the rings and spokes of a small disc.
_NODES_PER_SIGMA_ACROSS, _NODES_PER_SIGMA_ALONG = 2.1, 1.0
_LEAST_ACROSS, _LEAST_ALONG = 16, 256
_TAIL_SIGMAS = 8.0
_LEAST_REACH_PX = 40  # of the kernel that spreads the inside, where the core reaches less far
_TILE_PX = 96
_CHUNK = 1 << 22
_BAND_ROWS = 64


@dataclass(frozen=True, eq=False)
class Disc:
    """A cone of directions that is evenly bright, and what it gives: see `psf.source_window`.

    `total` is the sum over the whole cone, `finest_px` the σ of the Gaussian that passes as fine waves as
    the core.
    """

    direction: Array
    angular_radius_rad: float
    power_at: Callable[[Array], Array]
    total: float
    finest_px: float


@dataclass(frozen=True)
class _Split:
    """How a disc is split.

    `part` of the radius is edge, with so many nodes across and along; the whole disc is imaged within rows
    and columns from the first to before the last. `cut` tells whether some of it lies beyond them.
    """

    part: float
    across: int
    along: int
    rows: tuple[int, int]
    columns: tuple[int, int]
    cut: bool


def image_of_large_disc(lens: Intrinsics, core: Core, disc: Disc) -> tuple[Array, int, int]:
    """Return a disc's image, as far as it falls on the sensor, and its first row and column.

    Errors are below 1e-3 of the disc's brightness, and next to none of the light.
    """
    reach_px = max(math.ceil(core.reach_px), _LEAST_REACH_PX)
    split = _split(lens, disc, reach_px)
    # Tiles under a wide core reach farther.
    margin_px = reach_px if core.gaussian_px is not None else 2 * (reach_px + _TILE_PX)
    top, bottom = max(split.rows[0] - margin_px, 0), min(split.rows[1] + margin_px, lens.height_px)
    left, right = max(split.columns[0] - margin_px, 0), min(split.columns[1] + margin_px, lens.width_px)
    if top >= bottom or left >= right:
        return np.empty((0, 0)), 0, 0
    places_px, power = _edge(lens, disc, split)
    inside = _inside(lens, disc, split)
    if not split.cut:
        inside *= (disc.total - power.sum()) / inside.sum()
    seen = np.all((places_px > -0.5 - reach_px) & (places_px < _size(lens) - 0.5 + reach_px), axis=1)
    if not (seen.any() or inside.any()):  # of what shines in nearly from the side
        return np.empty((0, 0)), 0, 0
    image = np.zeros((lens.height_px, lens.width_px))
    if core.gaussian_px is None:
        _add_waves(image, core, places_px[seen], power[seen])
    else:
        _add_gaussians(image, core.gaussian_px, places_px[seen], power[seen])
    _add_inside(image, core, inside, split)
    # Around the rim the inside's waves dip below 0, by some 1e-6 of its brightness.
    return np.maximum(image[top:bottom, left:right], 0.0), top, left


def _size(lens: Intrinsics) -> Array:
    return np.array([lens.width_px, lens.height_px], dtype=np.float64)


def _split(lens: Intrinsics, disc: Disc, reach_px: int) -> _Split:
    turn = 2.0 * np.pi * np.arange(_OUTLINE) / _OUTLINE
    rim, within = (
        lens.project(cone_directions(disc.direction, np.array(cone_versine(radius_rad)), turn))
        for radius_rad in (disc.angular_radius_rad, (1.0 - _SMALL_PART) * disc.angular_radius_rad)
    )
    thickness_px = np.linalg.norm(rim - within, axis=1) / _SMALL_PART
    step_px = np.linalg.norm(rim - np.roll(rim, 1, axis=0), axis=1)
    margin_px = reach_px + _EDGE_PX
    near = np.all((rim > -margin_px) & (rim < _size(lens) + margin_px), axis=1)
    near &= np.isfinite(thickness_px) & np.isfinite(step_px)
    # A rim that lies beyond the frame all around, or far from it, leaves no edge to see.
    part, across, along = _SMALL_PART, _LEAST_ACROSS, _LEAST_ALONG
    if near.any():
        part = min(_EDGE_PX / float(thickness_px[near].min()), 1.0)
        thickest_px = part * float(thickness_px[near].max())
        across += math.ceil(_NODES_PER_SIGMA_ACROSS * thickest_px / disc.finest_px)
        along_px = _OUTLINE * float(step_px[near].max())
        along = max(along, math.ceil(_NODES_PER_SIGMA_ALONG * along_px / disc.finest_px))
    lowest, highest = np.full(2, -float(reach_px)), _size(lens) + reach_px
    cut = bool(np.isnan(rim).any())
    if not cut:
        first, last = np.floor(rim.min(axis=0)) - 1.0, np.ceil(rim.max(axis=0)) + 2.0
        cut = bool((first < lowest).any() or (last > highest).any())
        lowest, highest = np.clip([first, last], lowest, highest)
    columns, rows = ((int(low), int(high)) for low, high in zip(lowest, highest, strict=True))
    return _Split(part, across, along, rows, columns, cut)


def _inner_weight(disc: Disc, split: _Split, angle_rad: Array) -> Array:
    """Return the share of the light at an angle from the disc's centre that counts as its inside."""
    depth = (disc.angular_radius_rad - angle_rad) / (disc.angular_radius_rad * split.part)
    return np.asarray(betainc(_SMOOTHNESS, _SMOOTHNESS, np.clip(depth, 0.0, 1.0)))


def _edge(lens: Intrinsics, disc: Disc, split: _Split) -> tuple[Array, Array]:
    """Return pixels (u, v) of nodes over the edge, shape (n, 2), and what each gives, (n,)."""
    whole = cone_versine(disc.angular_radius_rad)
    first = cone_versine((1.0 - split.part) * disc.angular_radius_rad)
    nodes, weights = np.polynomial.legendre.leggauss(split.across)
    versine = first + 0.5 * (nodes + 1.0) * (whole - first)
    outer = 1.0 - _inner_weight(disc, split, 2.0 * np.arcsin(np.sqrt(0.5 * versine)))
    shares = 0.5 * weights * outer * (whole - first) / (whole * split.along)
    turn = 2.0 * np.pi * (np.arange(split.along) + 0.5) / split.along
    directions = cone_directions(disc.direction, *np.meshgrid(versine, turn, indexing="ij")).reshape(-1, 3)
    in_front = directions[:, 2] > 1e-6
    directions = directions[in_front]
    power = np.repeat(shares, split.along)[in_front] * disc.power_at(directions[:, 2])
    return lens.project(directions), power


def _inside(lens: Intrinsics, disc: Disc, split: _Split) -> Array:
    """Return what the inside gives per pixel, at the middles of the split's rows and columns."""
    tops = range(*split.rows, _BAND_ROWS)
    bands = [(top, min(top + _BAND_ROWS, split.rows[1])) for top in tops]
    return np.concatenate([_band(lens, disc, split, rows) for rows in bands])


def _band(lens: Intrinsics, disc: Disc, split: _Split, rows: tuple[int, int]) -> Array:
    """Return `_inside` of the rows from the first to before the last: all at once take 100 MiB."""
    u_px, v_px = (np.arange(float(first), float(last)) for first, last in (split.columns, rows))
    direction = lens.unproject(np.stack(np.meshgrid(u_px, v_px), axis=-1))
    chord = np.linalg.norm(direction - disc.direction, axis=-1)
    angle_rad = 2.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
    lit = (angle_rad < disc.angular_radius_rad) & (direction[..., 2] > 1e-6)
    lit_direction = direction[lit]
    pixel_sr = lens.distortion.solid_angle_sr(lit_direction) / (lens.fx_px * lens.fy_px)
    share = pixel_sr / (2.0 * np.pi * cone_versine(disc.angular_radius_rad))
    image = np.zeros(lit.shape)
    image[lit] = share * disc.power_at(lit_direction[:, 2]) * _inner_weight(disc, split, angle_rad[lit])
    return image


def _add_inside(image: Array, core: Core, inside: Array, split: _Split) -> None:
    """Add the light of the inside, spread by the core and the pixel's aperture."""
    kernel = smooth_kernel(core)
    half = kernel.shape[0] // 2
    spread = fftconvolve(inside, kernel)
    height, width = (ours + its - 1 for ours, its in zip(inside.shape, kernel.shape, strict=True))
    top, left = split.rows[0] - half, split.columns[0] - half
    first_row, first_column = max(top, 0), max(left, 0)
    last_row = min(top + height, image.shape[0])
    last_column = min(left + width, image.shape[1])
    image[first_row:last_row, first_column:last_column] += spread[
        first_row - top : last_row - top, first_column - left : last_column - left
    ]


def _add_waves(image: Array, core: Core, places_px: Array, power: Array) -> None:
    """Add points under a core, tile by tile: the work grows with the third power of the side."""
    tile = np.floor(places_px / _TILE_PX).astype(np.int64)
    for one in np.unique(tile, axis=0):
        here = np.all(tile == one, axis=1)
        values, row, column = image_of_points(core, places_px[here], power[here], *image.shape)
        image[row : row + values.shape[0], column : column + values.shape[1]] += values


def _add_gaussians(image: Array, sigma_px: float, places_px: Array, power: Array) -> None:
    """Add points under a Gaussian, each integrated over the pixels within its reach."""
    half = math.ceil(_TAIL_SIGMAS * sigma_px + 1.0)
    width = 2 * half + 1
    rows, columns = image.shape[0] + 4 * half, image.shape[1] + 4 * half
    padded = np.zeros(rows * columns)
    count = max(_CHUNK // width**2, 1)
    for start in range(0, len(power), count):
        place, light = places_px[start : start + count], power[start : start + count]
        first = np.rint(place).astype(np.int64) - half
        edges = first[..., None] + np.arange(width + 1) - 0.5 - place[..., None]
        shares = pixel_shares(edges, sigma_px)
        u_shares, v_shares = shares[:, 0], shares[:, 1]
        weight = (light[:, None] * v_shares)[:, :, None] * u_shares[:, None, :]
        index = first[..., None] + 2 * half + np.arange(width)
        # Points beyond the sensor's edge by more than their reach bring it nothing.
        on = np.all((first > -2 * half) & (first + width < np.array(image.shape[::-1]) + 2 * half), axis=1)
        flat = index[on, 1, :, None] * columns + index[on, 0, None, :]
        padded += np.bincount(flat.ravel(), weight[on].ravel(), minlength=padded.size)
    image += padded.reshape(rows, columns)[2 * half : -2 * half, 2 * half : -2 * half]
