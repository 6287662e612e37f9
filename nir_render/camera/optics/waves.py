"""Points to a blurred image by Fourier transform: that of the points times what the core passes.

A point at x has the transform exp(−2πi f x), whatever its place within a pixel; so places are exact, and as
the transfer function is 1 at rest, no light is lost. The image is made periodic over a square so large that
less than 1e-3 of the light comes round its edges.
"""

import math
from dataclasses import replace

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.special import betainc, i0e

from nir_render.camera.optics.otf import Core, transfer

# Points are put on a grid by a Kaiser–Bessel window of so many steps, four to the finest wave (Jackson et al.
# 1991, "Selection of a convolution function for Fourier inversion using gridding"): right to 1e-7.
_TAPS = 8
_STEPS_PER_WAVE = 4.0
_BETA = math.pi * math.sqrt((_TAPS * 0.75) ** 2 - 0.8)
_PERIOD_STEP_PX = 8
_LEAST_KERNEL_PX = 64.0
_SLOW = 0.33  # cycles per pixel
_CHUNK = 1 << 17  # points at a time, to bound the memory


def image_of_points(
    core: Core, places_px: NDArray[np.float64], power: NDArray[np.float64], rows: int, columns: int
) -> tuple[NDArray[np.float64], int, int]:
    """Return the image of points, as far as it falls on the sensor, and its first row and column.

    Parameters
    ----------
    places_px
        Pixels (u, v), shape (n, 2).
    power
        Of each point, shape (n,).
    rows, columns
        Of the sensor.
    """
    # About the light's centroid, so that what is cut off of a wide tail does not move it.
    light = float(power.sum())
    middle_px = (power[:, None] * places_px).sum(axis=0) / light if light > 0.0 else places_px.mean(axis=0)
    period = _period_px(2.0 * (float(np.abs(places_px - middle_px).max()) + core.reach_px))
    column, row = (round(float(middle) - 0.5 * (period - 1)) for middle in middle_px)
    left, right = max(column, 0), min(column + period, columns)
    top, bottom = max(row, 0), min(row + period, rows)
    if left >= right or top >= bottom:
        return np.empty((0, 0)), 0, 0
    image = _periodic_image(core, places_px - [column, row], power, period)
    return image[top - row : bottom - row, left - column : right - column], top, left


def convolve(core: Core, image: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return an image of pixel means spread by a core, the edge pixels continued outside.

    The kernel is the image of a point on a pixel's centre, so that it is nowhere negative and loses nothing.
    The pixel's aperture, which the means hold already, widens it by 1/12 px²; the Gaussian part is made
    narrower by as much. Without one, edges of extended light come out that much softer.
    """
    optics = replace(core, sigma_px=math.sqrt(max(core.sigma_px**2 - 1.0 / 12.0, 0.0)))
    half = _period_px(2.0 * optics.reach_px) // 2
    kernel = _periodic_image(optics, np.full((1, 2), float(half)), np.ones(1), 2 * half)
    shape = [scipy.fft.next_fast_len(size + 2 * half, real=True) for size in image.shape]
    padded = np.pad(
        image, [(half, size - count - half) for size, count in zip(shape, image.shape, strict=True)], "edge"
    )
    spectrum = scipy.fft.rfft2(padded) * scipy.fft.rfft2(kernel, shape)
    spread = scipy.fft.irfft2(spectrum, shape, overwrite_x=True)
    return np.asarray(spread[2 * half : 2 * half + image.shape[0], 2 * half : 2 * half + image.shape[1]])


def smooth_kernel(core: Core) -> NDArray[np.float64]:
    """Return what turns samples, at pixels' middles, of light that varies slowly into its image.

    It passes what core and pixel pass of waves longer than three pixels, and nothing of those shorter than
    two, of which slow light has none, but its samples do; less and less between, so that it ends soon. Its
    middle has the index size // 2 on both axes.
    """
    period = _period_px(max(2.0 * core.reach_px, _LEAST_KERNEL_PX))
    passed = transfer(core, period)
    given = passed.shape[1] - 1
    count = min(given, period // 2 - 1)
    spectrum = np.zeros((period, period // 2 + 1), dtype=complex)
    spectrum[np.arange(-count, count + 1), : count + 1] = passed[
        given - count : given + count + 1, : count + 1
    ]
    v, u = np.abs(np.fft.fftfreq(period)), np.fft.rfftfreq(period)
    faded = (betainc(4, 4, np.clip((0.5 - f) / (0.5 - _SLOW), 0.0, 1.0)) for f in (v[:, None], u))
    for factor in faded:
        spectrum *= factor
    return np.asarray(scipy.fft.fftshift(scipy.fft.irfft2(spectrum, (period, period))))


def _period_px(least_px: float) -> int:
    """Return a period of which few exist, so that transfer functions are met again; quick to transform."""
    steps = math.ceil(least_px / _PERIOD_STEP_PX)
    return _PERIOD_STEP_PX * scipy.fft.next_fast_len(steps)


def _periodic_image(
    core: Core, places_px: NDArray[np.float64], power: NDArray[np.float64], period: int
) -> NDArray[np.float64]:
    """Return the image of points over one period, shape (period, period)."""
    passed = transfer(core, period)
    count = passed.shape[1] - 1
    step_px = 1.0 / (_STEPS_PER_WAVE * core.highest_frequency)
    start_px = places_px.min(axis=0) - 0.5 * _TAPS * step_px
    grid = _on_grid((places_px - start_px) / step_px, power)
    u_waves = _waves(np.arange(count + 1) / period, start_px[0], step_px, grid.shape[1])
    v_waves = _waves(np.arange(-count, count + 1) / period, start_px[1], step_px, grid.shape[0])
    spectrum = (v_waves @ grid) @ u_waves.T
    spectrum *= passed
    # Waves that differ by one per pixel look alike on pixels. Those of negative u frequency are the
    # conjugates of the others.
    spectrum[:, 1:] *= 2.0
    seen = _folded(_folded(spectrum, -count, period).T, 0, period).T
    return np.ascontiguousarray(scipy.fft.ifft2(seen, overwrite_x=True).real)


def _on_grid(places: NDArray[np.float64], power: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points, (u, v) in steps, spread over a grid, shape (v steps, u steps)."""
    first = np.ceil(places - 0.5 * _TAPS).astype(np.int64)
    columns, rows = (int(size) for size in first.max(axis=0) + _TAPS)
    spread = np.zeros(rows * columns)
    for start in range(0, len(power), _CHUNK):
        here = slice(start, start + _CHUNK)
        index = first[here, :, None] + np.arange(_TAPS)
        window = _kaiser_bessel(index - places[here, :, None])
        flat = index[:, 1, :, None] * columns + index[:, 0, None, :]
        weight = (power[here, None] * window[:, 1])[:, :, None] * window[:, 0, None, :]
        spread += np.bincount(flat.ravel(), weight.ravel(), minlength=rows * columns)
    return spread.reshape(rows, columns)


def _kaiser_bessel(steps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the window at distances in steps: I₀(β √(1 − (2x/w)²)), over its peak."""
    root = _BETA * np.sqrt(np.maximum(1.0 - (2.0 * steps / _TAPS) ** 2, 0.0))
    return np.asarray(i0e(root) * np.exp(root - _BETA) / i0e(_BETA))


def _kaiser_bessel_transform(frequency: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return its Fourier transform at frequencies in cycles per step.

    It is w sinh z / (I₀(β) z) with z² = β² − (π w f)².
    """
    z = np.sqrt(_BETA**2 - (np.pi * _TAPS * frequency) ** 2)
    return np.asarray(_TAPS * (np.exp(z - _BETA) - np.exp(-z - _BETA)) / (2.0 * z * i0e(_BETA)))


def _waves(
    frequency: NDArray[np.float64], start_px: float, step_px: float, steps: int
) -> NDArray[np.complex128]:
    """Return exp(−2πi f x) at the steps of a grid over the window's own transform, (frequencies, steps)."""
    turns = frequency[:, None] * (start_px + step_px * np.arange(steps))
    return np.asarray(np.exp(-2.0j * np.pi * turns) / _kaiser_bessel_transform(frequency * step_px)[:, None])


def _folded(spectrum: NDArray[np.complex128], first: int, period: int) -> NDArray[np.complex128]:
    """Return sums of rows whose numbers, counted from `first`, differ by the period: (period, columns)."""
    lead = first % period
    folds = -(-(lead + len(spectrum)) // period)
    padded = np.zeros((folds * period, spectrum.shape[1]), dtype=complex)
    padded[lead : lead + len(spectrum)] = spectrum
    return np.asarray(padded.reshape(folds, period, -1).sum(axis=0))
