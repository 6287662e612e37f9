"""What veils the whole frame: glare with its wide tail, and ghosts between sensor and lens.

Both take their shares of the light and spread them over kernels that may be larger than the frame. As these
are smooth over several pixels, the convolution is done on a coarser grid, by FFT, with as much darkness
around the frame as the kernels reach. What falls outside the frame is lost; of the light from outside it only
what the core spreads into it is known here.

Glare: w(r) = (γ − 1) / (π r₀²) · (1 + (r/r₀)²)^(−γ), of which 1 − (1 + (r/r₀)²)^(1−γ) lies within r. It is
interpolated by cubic splines from the grid and back, right to 3e-3 of itself. A ghost is the image magnified
about the principal point, under a disc whose rim the grid softens; light, place and second moment are kept.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from nir_render.camera.optics.lens import Intrinsics, intrinsics_of
from nir_render.scene.documents.camera import Camera
from nir_render.scene.documents.point_spread import Glare, LensGhost

_STEPS_PER_GLARE_RADIUS = 3.1  # times √γ, for w falls off the faster
_STEPS_PER_GHOST_RADIUS = 8.0
_SPARE_NODES = 4  # what cubic splines touch beyond the ends of an axis
_PARTS = 8


@dataclass(frozen=True, eq=False)
class _Layer:
    """How pixels come to the grid, (nodes, pixels) along v and u, and what a kernel passes of it there."""

    v_nodes: csr_array
    u_nodes: csr_array
    passed: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class _Veil:
    """All layers; the grid's shape with darkness around; how it comes back to pixels, (pixels, nodes)."""

    layers: tuple[_Layer, ...]
    shape: tuple[int, int]
    v_pixels: csr_array
    u_pixels: csr_array


def veil(camera: Camera, core_e: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what glare and ghosts bring to a frame, shape (rows, columns).

    Parameters
    ----------
    core_e
        What the cores of all light bring, the share of it that glare and ghosts take left out: the sum of
        `beam_window` and `blur`, shape (rows, columns).
    """
    spread = camera.point_spread
    how = _veil(spread.glare, spread.ghosts, intrinsics_of(camera))
    spectrum = np.zeros((how.shape[0], how.shape[1] // 2 + 1), dtype=complex)
    for layer in how.layers:
        on_grid = _along_both(layer.v_nodes, layer.u_nodes, core_e)
        waves = scipy.fft.fft(scipy.fft.rfft(on_grid, how.shape[1], axis=1), how.shape[0], axis=0)
        waves *= layer.passed
        spectrum += waves
    used = scipy.fft.ifft(spectrum, axis=0, overwrite_x=True)[: how.v_pixels.shape[1]]
    spread_e = scipy.fft.irfft(used, how.shape[1], axis=1)[:, : how.u_pixels.shape[1]]
    wide_e = _along_both(how.v_pixels, how.u_pixels, spread_e)
    return np.maximum(wide_e, 0.0) / spread.core_share  # far from all light, rounding may go below 0


def _along_both(v: csr_array, u: csr_array, image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return v · image · uᵀ."""
    return np.asarray((u @ np.ascontiguousarray((v @ image).T)).T)


@lru_cache(maxsize=8)
def _veil(glare: Glare | None, ghosts: tuple[LensGhost, ...], lens: Intrinsics) -> _Veil:
    radii = [ghost.radius_px / _STEPS_PER_GHOST_RADIUS for ghost in ghosts]
    radii += [glare.core_radius_px / (_STEPS_PER_GLARE_RADIUS * math.sqrt(glare.exponent))] if glare else []
    step_px = max(int(min(radii)), 1)
    reach = max((math.ceil(ghost.radius_px / step_px) + _SPARE_NODES for ghost in ghosts), default=0)
    axes = [(lens.height_px, lens.cy_px), (lens.width_px, lens.cx_px)]
    nodes = [math.ceil(pixels / step_px) + _SPARE_NODES + 2 * reach for pixels, _ in axes]
    # Darkness for the longest way on the grid: over the frame for glare, over a ghost's margin for its disc.
    v_size, u_size = (
        scipy.fft.next_fast_len(max(count + reach, 2 * (count - 2 * reach) if glare else 0), real=True)
        for count in nodes
    )

    def to_grid(places_px: NDArray[np.float64], count: int) -> csr_array:
        return _splines(places_px / step_px + reach + 1.0, count)

    v_home, u_home = (
        to_grid(np.arange(float(pixels)), count) for (pixels, _), count in zip(axes, nodes, strict=True)
    )
    layers = []
    if glare is not None:
        layers.append(_Layer(v_home, u_home, _glare(glare, (v_size, u_size), step_px)))
    for ghost in ghosts:
        v_there, u_there = (
            to_grid(_ghost_places_px(ghost, *axis, step_px), count)
            for axis, count in zip(axes, nodes, strict=True)
        )
        layers.append(_Layer(v_there, u_there, _disc(ghost, (v_size, u_size), step_px)))
    return _Veil(tuple(layers), (v_size, u_size), v_home.T.tocsr(), u_home.T.tocsr())


def _ghost_places_px(ghost: LensGhost, pixels: int, centre_px: float, step_px: int) -> NDArray[np.float64]:
    """Return where the pixels of an axis go; NaN where their ghosts stay outside the frame."""
    place_px = centre_px + ghost.magnification * (np.arange(pixels) - centre_px)
    near = (place_px > -ghost.radius_px - step_px) & (place_px < pixels + ghost.radius_px + step_px)
    return np.where(near, place_px, np.nan)


def _splines(places: NDArray[np.float64], nodes: int) -> csr_array:
    """Return the cubic B-splines about nodes at places, in steps, shape (nodes, places); none at NaN."""
    column = np.flatnonzero(np.isfinite(places))
    first = np.floor(places[column]).astype(np.int64) - 1
    t = places[column] - first - 1.0
    weights = np.stack(
        [(1.0 - t) ** 3, 3.0 * t**3 - 6.0 * t**2 + 4.0, -3.0 * t**3 + 3.0 * t**2 + 3.0 * t + 1.0, t**3]
    )
    rows = first + np.arange(4)[:, None]
    entries = (weights.ravel() / 6.0, (rows.ravel(), np.tile(column, 4)))
    return coo_array(entries, shape=(nodes, len(places))).tocsr()


def _apart(nodes: int) -> NDArray[np.float64]:
    """Return how far periodic nodes are from the first, in steps."""
    return np.asarray(np.fft.fftfreq(nodes, 1.0 / nodes))


def _glare(glare: Glare, shape: tuple[int, int], step_px: int) -> NDArray[np.float64]:
    """Return what glare passes, its share included: its samples, made splines in both places.

    A cubic B-spline on its nodes is 1/6, 4/6, 1/6, which passes (2 + cos 2πf) / 3.
    """
    r0_px, gamma = glare.core_radius_px, glare.exponent
    v, u = (step_px * _apart(nodes) / r0_px for nodes in shape)
    density = (gamma - 1.0) / (math.pi * r0_px**2) * (1.0 + v[:, None] ** 2 + u**2) ** -gamma
    v_spline, u_spline = ((2.0 + np.cos(2.0 * np.pi * np.fft.fftfreq(nodes))) / 3.0 for nodes in shape)
    spline = v_spline[:, None] * u_spline[: shape[1] // 2 + 1]
    return np.asarray(glare.share * scipy.fft.rfft2(density).real / spline**2)


def _disc(ghost: LensGhost, shape: tuple[int, int], step_px: int) -> NDArray[np.float64]:
    """Return what the disc of a ghost passes, its share included.

    Splines to the grid and back and the grid's cells, of variance 1/3, 1/3 and 1/12 steps² along an axis,
    widen the disc, of variance r²/4; it is made smaller by as much.
    """
    radius = math.sqrt((ghost.radius_px / step_px) ** 2 - 3.0)
    part = (np.arange(_PARTS) + 0.5) / _PARTS - 0.5
    covered = np.zeros(shape)
    for down in part:
        for right in part:
            v, u = _apart(shape[0]) + down, _apart(shape[1]) + right
            covered += v[:, None] ** 2 + u**2 < radius**2
    return np.asarray(ghost.share * scipy.fft.rfft2(covered / (covered.sum() * step_px**2)).real)
