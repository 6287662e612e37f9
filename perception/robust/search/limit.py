"""The level that noise alone does not pass: the matched filter of a point, and the tail of its noise."""

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

FALSE_ALARMS_PER_PIXEL = 1e-3 / (1280 * 960)
"""Chance that the noise of one pixel passes: by the union bound, one false alarm in a thousand frames."""


def point_kernel(psf_sigma_px: float) -> NDArray[np.float64]:
    """Image of a point on a pixel's centre along one axis, sum 1: the PSF with the pixel's own aperture."""
    half = math.ceil(3.0 * psf_sigma_px + 0.5)
    edges = [(edge - 0.5) / (math.sqrt(2.0) * psf_sigma_px) for edge in range(-half, half + 2)]
    share = 0.5 * np.diff([math.erf(edge) for edge in edges])
    return np.asarray(share / share.sum())


@lru_cache(maxsize=64)
def point_filter(psf_sigma_px: float) -> tuple[NDArray[np.float64], NDArray[np.float32], float]:
    """Return a point's image, the same as `frame` wants it, and its noise over that of a pixel, Σh²."""
    kernel = point_kernel(psf_sigma_px)
    return kernel, in_threes(kernel), float(np.sum(kernel**2))


def in_threes(kernel: NDArray[np.float64]) -> NDArray[np.float32]:
    """Lengthen a kernel by zeros to a multiple of three weights on either side, as `frame` wants it."""
    return np.pad(kernel, -(len(kernel) // 2) % 3).astype(np.float32)


def detection_limit_e(
    background_e: NDArray[np.floating],
    floor_e2: float,
    kernel: NDArray[np.float64],
    false_alarms_per_pixel: float = FALSE_ALARMS_PER_PIXEL,
) -> NDArray[np.float64]:
    """Level of the filtered noise that a pixel exceeds with a given probability.

    The filtered noise is T = Σ h_i n_i with n_i = Poisson(B) - B + Normal(0, σ²). Its cumulant generating
    function is K(s) = Σ B (e^{s h_i} - 1 - s h_i) + ½ s² σ² Σ h_i², and its tail by Lugannani and Rice (Adv.
    Appl. Probab. 12, 475, 1980): P(T > K'(s)) = Q(w) + φ(w)(1/v - 1/w), w = √(2 (s K' - K)),
    v = s √K''. For B = 0 that is the Gaussian tail exactly; at a low background it allows for the longer tail
    of the Poisson distribution. s is found by bisection.

    The chance that any of n pixels passes is at most n times that of one, however their noise is correlated
    (union bound): 8.1e-10 per pixel keeps a frame of 1280 × 960 below 1e-3, and is 6.03 σ for Gaussian noise.

    Parameters
    ----------
    background_e
        B, any shape; negative values count as zero.
    floor_e2
        σ², variance of a dark pixel.
    kernel
        One axis of the separable filter.
    false_alarms_per_pixel
        Probability of T > limit.

    Returns
    -------
    The level in electrons, same shape.
    """
    h = np.outer(kernel, kernel).ravel()
    level = np.maximum(np.asarray(background_e, dtype=np.float64), 0.0)
    b = level.reshape(-1, 1)
    variance = np.sum(h**2) * (b[:, 0] + floor_e2)
    low = np.zeros(b.shape[0])
    high = 8.0 / np.sqrt(variance)  # w ≥ s √variance, so the wanted s lies below
    slope = np.zeros(b.shape[0])
    for _ in range(40):
        s = 0.5 * (low + high)
        lift = np.expm1(s[:, None] * h)
        gaussian = floor_e2 * np.sum(h**2)
        cumulant = np.sum(b * (lift - s[:, None] * h), axis=1) + 0.5 * s**2 * gaussian
        slope = np.sum(b * h * lift, axis=1) + s * gaussian
        curvature = np.sum(b * h**2 * (lift + 1.0), axis=1) + gaussian
        w = np.sqrt(2.0 * np.maximum(s * slope - cumulant, 1e-300))
        density = np.exp(-0.5 * w**2) / math.sqrt(2.0 * math.pi)
        beyond = np.array([0.5 * math.erfc(at) for at in (w * math.sqrt(0.5)).tolist()])
        tail = beyond + density * (1.0 / (s * np.sqrt(curvature)) - 1.0 / w)
        low, high = (
            np.where(tail > false_alarms_per_pixel, s, low),
            np.where(tail > false_alarms_per_pixel, high, s),
        )
    return np.asarray(slope.reshape(level.shape))


def limit_mesh_of(
    mesh_e: NDArray[np.float32], floor_e2: float, kernel: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Compute the detection limit of each cell, by straight lines in √B between the levels of a table."""
    root = np.sqrt(np.maximum(mesh_e, 0.0, dtype=np.float64))
    roots, limits = _limit_table(math.ceil(math.log2(max(float(root.max()), 1.0))), floor_e2, tuple(kernel))
    return np.interp(root, roots, limits).astype(np.float32)


@lru_cache(maxsize=32)
def _limit_table(
    octaves: int, floor_e2: float, kernel: tuple[float, ...]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return levels of √B up to 2^octaves, dense where the limit bends, and the limits there."""
    roots = np.concatenate([[0.0], 2.0 ** np.arange(-3.0, octaves + 0.01, 0.25)])
    return roots, detection_limit_e(roots**2, floor_e2, np.array(kernel))
