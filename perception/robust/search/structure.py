"""What a background holds beside noise: how strong its structure is, and how it is correlated.

Structure is told from noise by its scatter: where the filtered image scatters by more than the noise model
says, the rest is structure. Its autocorrelation, measured in the frame, makes of it a Gaussian process; in a
window that is a handful of cosines whose amplitudes have a prior (`model.layout.Structure`), so that a fit
knows which backgrounds are likely under a flare, and its sigmas know that it does not see them.
"""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import PixelBox
from perception.model.layout import Structure

Array = NDArray[np.float64]

_HALO_WIDTHS = (1.0, 2.0, 4.0, 8.0, 16.0)
_LEAST_HALO_PX, _LEAST_HALO_RADII = 1.5, 1.2
_MOST_HALO_SIDES = 0.6
_HALO_SHARE, _SHAPE_SHARE = 1.0, 0.1
"""What a wall throws back of the light of a source before it, and how far that differs in shape, a priori."""

EDGES = tuple(np.exp(-np.arange(16) / 4.0).round(3).tolist())
"""Autocorrelation of what has edges, as shadows and panels do: it falls at once, and its spectrum slowly."""

_LAGS = 48
_LINES = 96
_CLIP_SIGMAS = 4.0
_MOST_WAVES = 6
_LEAST_EIGENVALUE = 1e-6


def structure_of(correlation: tuple[float, ...], side_px: int, sigma_e: float) -> Structure:
    """Return the structure of one square window, of an autocorrelation and a standard deviation."""
    columns, precision = _cosines(correlation, side_px)
    return Structure(columns, precision / sigma_e**2)


def autocorrelation(
    excess_e: NDArray[np.float32], sigma_e: NDArray[np.float32], noise_e: NDArray[np.float32]
) -> tuple[float, ...]:
    """Measure how the structure of a frame is correlated, along some of its rows and columns.

    Parameters
    ----------
    excess_e
        Electrons above the smooth background.
    sigma_e
        Standard deviation of the structure, 0 where there is none.
    noise_e
        Standard deviation of a pixel's noise. All three of the frame's shape.

    Returns
    -------
    At distances of 0, 1, 2, ... px up to where it has fallen to nothing.
    """
    products, pairs = np.zeros(_LAGS), np.zeros(_LAGS)
    for turned in (False, True):
        step = max(1, excess_e.shape[1 if turned else 0] // _LINES)
        excess, sigma, noise = (
            np.asarray((a.T if turned else a)[step // 2 :: step], dtype=np.float64)
            for a in (excess_e, sigma_e, noise_e)
        )
        total = np.hypot(sigma, noise)
        # Flares, and whatever else stands far out, are no part of it.
        counted = (sigma > 0.0) & (np.abs(excess) < _CLIP_SIGMAS * total)
        value = np.where(counted, excess / np.where(sigma > 0.0, sigma, 1.0), 0.0)
        padded, lags = 2 * value.shape[1], min(_LAGS, value.shape[1])
        for line, into in ((value, products), (counted.astype(np.float64), pairs)):
            power = np.abs(np.fft.rfft(line, padded, axis=1)) ** 2
            into[:lags] += np.fft.irfft(power.sum(axis=0), padded)[:lags]
    measured = products / np.maximum(pairs, 1.0)
    # Noise adds to distance 0 alone: what structure has there follows from its neighbours, by a parabola.
    top = max((4.0 * measured[1] - measured[2]) / 3.0, measured[1], 1e-6)
    measured = np.concatenate([[1.0], measured[1:] / top])
    gone = np.flatnonzero(measured < 0.02)
    last = int(gone[0]) if len(gone) else _LAGS
    return tuple(np.clip(measured[:last], 0.0, 1.0).round(3).tolist())


@lru_cache(maxsize=128)
def _cosines(correlation: tuple[float, ...], side_px: int) -> tuple[Array, Array]:
    """Return cosines over a square window, and the precision of their amplitudes at variance 1.

    As many as structure of this correlation needs; the constant is left out, as the background has it.
    """
    at = np.arange(side_px)
    distance = np.hypot(at[:, None], at[None, :])  # by how many rows and columns two pixels differ
    known = np.interp(distance, np.arange(len(correlation) + 1), [*correlation, 0.0])
    waves = np.cos(np.pi * np.arange(_MOST_WAVES)[:, None] * (at + 0.5) / side_px)
    waves /= np.linalg.norm(waves, axis=1, keepdims=True)
    # Cov(nm, n'm') = Σ waves_n(r) waves_m(c) ρ(r - r', c - c') waves_n'(r') waves_m'(c').
    lag = np.abs(at[:, None] - at[None, :])
    by_rows = np.einsum("nr,rsd,ps->npd", waves, known[lag], waves, optimize=True)  # d: columns apart
    full = np.einsum("mc,npce,qe->nmpq", waves, by_rows[:, :, lag], waves, optimize=True)
    number = _MOST_WAVES**2
    covariance = full.reshape(number, number)
    order = [k for k in range(1, number) if sum(divmod(k, _MOST_WAVES)) < _MOST_WAVES + 1]
    covariance = covariance[np.ix_(order, order)]
    values, vectors = np.linalg.eigh(covariance)
    values = np.maximum(values, _LEAST_EIGENVALUE * values[-1])
    basis = np.einsum("nr,mc->nmrc", waves, waves).reshape(number, side_px**2)[order]
    return basis, np.asarray((vectors / values) @ vectors.T)


def halo_widths_px(image_radius_px: float, side_px: int) -> tuple[float, ...]:
    """Return how wide the light may be that a wall close behind a source throws back around its flare.

    A ball is before its wall: h > r. Wider ones than a window of that side are even ground in it.
    """
    narrowest_px = max(_LEAST_HALO_PX, _LEAST_HALO_RADII * image_radius_px)
    widths_px = (narrowest_px * factor for factor in _HALO_WIDTHS)
    return tuple(width_px for width_px in widths_px if width_px < _MOST_HALO_SIDES * side_px)


def halo_of(
    box: PixelBox,
    flare: tuple[float, float, float, float],
    image: Array,
    width_px: float,
    psf_sigma_px: float,
) -> Structure:
    """Return the light that a wall close behind a source throws back around its flare.

    A wall at a distance h behind an isotropic source is lit as (1 + ρ²/h²)^(-3/2), ρ from the foot of the
    source: seen from the front that is a halo of width f h / d, wider than the source's image by h / r. What
    the source hides of it, 1 - (1 + r²/h²)^(-1/2), is missing where its image is. A white wall throws back as
    much as twice the flare's own light, over a hemisphere. The second part is what another width changes.

    Parameters
    ----------
    box
        The window.
    flare
        Its place u and v and the radius of its image, in pixels, and its flux.
    image
        The share of its flux in each pixel of the window, shape (rows, columns).
    width_px, psf_sigma_px
        Of the halo, and of the point spread.
    """
    from scipy.ndimage import gaussian_filter

    u_px, v_px, radius_px, flux_e = flare
    smooth_px = math.hypot(psf_sigma_px, 12**-0.5)
    rows, columns = np.ogrid[box.top : box.top + box.height, box.left : box.left + box.width]
    distance2 = (columns - u_px) ** 2 + (rows - v_px) ** 2

    def profile(w_px: float) -> Array:
        hidden = 1.0 - (1.0 + (radius_px / w_px) ** 2) ** -0.5
        sharp = (1.0 + distance2 / w_px**2) ** -1.5 / (2.0 * np.pi * w_px**2)
        return np.asarray(gaussian_filter(sharp, smooth_px, mode="nearest") - hidden * image)

    wider, narrower = profile(width_px * math.exp(0.1)), profile(width_px * math.exp(-0.1))
    return Structure(
        np.stack([profile(width_px).ravel(), ((wider - narrower) / 0.2).ravel()]),
        np.diag([_HALO_SHARE**-2, _SHAPE_SHARE**-2]) / flux_e**2,
    )


def joined(one: Structure | None, other: Structure) -> Structure:
    """Return two structures on top of each other."""
    if one is None:
        return other
    count, more = len(one.columns), len(other.columns)
    precision = np.zeros((count + more, count + more))
    precision[:count, :count], precision[count:, count:] = one.precision, other.precision
    return Structure(np.concatenate([one.columns, other.columns]), precision)
