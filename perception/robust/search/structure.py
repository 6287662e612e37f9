"""What a background holds beside noise: how strong its structure is, and how it is correlated.

Structure is told from noise by its scatter: where the filtered image scatters by more than the noise model
says, the rest is structure. Its autocorrelation, measured in the frame, makes of it a Gaussian process; in a
window that is a handful of cosines whose amplitudes have a prior (`model.layout.Structure`), so that a fit
knows which backgrounds are likely under a flare, and its sigmas know that it does not see them.
"""

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from perception.model.layout import Structure

Array = NDArray[np.float64]

EDGES = tuple(np.exp(-np.arange(16) / 4.0).round(3).tolist())
"""Autocorrelation of what has edges, as shadows and panels do: it falls at once, and its spectrum slowly."""

_LAGS = 48
_LINES = 96
_CLIP_SIGMAS = 4.0
_MOST_WAVES = 6
_LEAST_EIGENVALUE = 1e-6


def structure_of(correlation: tuple[float, ...], side_px: int, sigma_e: float) -> Structure:
    """Return the structure of one square window, of an autocorrelation and a standard deviation."""
    structure = _structure(correlation, side_px)
    return structure._replace(precision=structure.precision / sigma_e**2)


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
        told = (sigma > 0.0).any(axis=1)  # the other lines tell nothing
        excess, sigma, noise = excess[told], sigma[told], noise[told]
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
def _structure(correlation: tuple[float, ...], side_px: int) -> Structure:
    """Return the structure of a square window at variance 1: cosines, and their amplitudes' precision.

    As many as structure of this correlation needs; the constant is left out, as the background has it.
    """
    at = np.arange(side_px)
    distance = np.hypot(at[:, None], at[None, :])  # by how many rows and columns two pixels differ
    known = np.interp(distance, np.arange(len(correlation) + 1), [*correlation, 0.0])
    cosines = np.cos(np.pi * np.arange(2 * _MOST_WAVES)[:, None] * (at + 0.5) / side_px)
    lengths = np.linalg.norm(cosines[:_MOST_WAVES], axis=1)
    waves = cosines[:_MOST_WAVES] / lengths[:, None]
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
    pairs = np.array([divmod(k, _MOST_WAVES) for k in order])
    scale = lengths[pairs].prod(axis=1)  # the cosines are not of length 1
    precision = scale[:, None] * ((vectors / values) @ vectors.T) * scale
    nothing = np.empty((0, side_px**2))
    return Structure(cosines, pairs, nothing, precision)


def joined(one: Structure | None, other: Structure) -> Structure:
    """Return two structures on top of each other, the second without waves."""
    if one is None:
        return other
    count, more = one.amplitudes, other.amplitudes
    precision = np.zeros((count + more, count + more))
    precision[:count, :count], precision[count:, count:] = one.precision, other.precision
    return one._replace(columns=np.concatenate([one.columns, other.columns]), precision=precision)
