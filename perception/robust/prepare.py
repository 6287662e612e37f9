"""From a raw frame to what the robust detector looks at: electrons, background, filtered image, mask.

`prepare` is the conductor; below it stand the background on a coarse mesh, blind to flares, and the matched
filter for a point source with the level that noise alone does not pass.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import PixelBox
from perception.model.sensor import bad_pixels, electrons, gain_dn_per_e, noise_floor_e2, saturation_dn
from perception.robust.structure import LEAST_RATIO, LEAST_RATIO_AROUND, Texture, autocorrelation, scatter
from perception.types import Calibration, RawFrame

CELL_PX = 64

FALSE_ALARMS_PER_PIXEL = 1e-3 / (1280 * 960)
"""Chance that the noise of one pixel passes: by the union bound, one false alarm in a thousand frames."""

_SAMPLES_PER_AXIS = 24
_SCATTER_SAMPLES_PER_AXIS = 16
_CLIP_SIGMA = 3.0
_CLIP_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class PreparedFrame:
    """A frame with all that is computed for whole images; each array has the frame's shape.

    Attributes
    ----------
    frame, calibration
        Where it comes from.
    image_e
        Electrons above black level.
    background_e
        Smooth local background.
    filtered_e
        Matched filter of what exceeds the background.
    filtered_noise
        Noise of `filtered_e` relative to that of a pixel, √Σh².
    lit
        Pixels above the detection limit.
    floor_e2
        Variance of a dark pixel.
    texture
        Structure of the background; None where the frame is even.
    bad
        Pixels that are stuck or hot; `filtered_e` has them as dark as the background.
    """

    frame: RawFrame
    calibration: Calibration
    image_e: NDArray[np.float32]
    background_e: NDArray[np.float32]
    filtered_e: NDArray[np.float32]
    filtered_noise: float
    lit: NDArray[np.bool_]
    floor_e2: float
    texture: Texture | None
    bad: NDArray[np.bool_]

    @property
    def clipped_dn(self) -> int:
        """Count from which on a pixel is clipped."""
        return saturation_dn(self.calibration, self.frame.gain)

    def lit_in(self, box: PixelBox) -> NDArray[np.bool_]:
        """Return `lit` in a box that may reach beyond the frame."""
        rows, columns = self.lit.shape
        inside = np.zeros((box.height, box.width), dtype=bool)
        top, left = max(0, -box.top), max(0, -box.left)
        part = self.lit[
            max(box.top, 0) : min(box.top + box.height, rows),
            max(box.left, 0) : min(box.left + box.width, columns),
        ]
        inside[top : top + part.shape[0], left : left + part.shape[1]] = part
        return inside


def prepare(frame: RawFrame, calibration: Calibration) -> PreparedFrame:
    """Filter a frame and mark what is no noise.

    Parameters
    ----------
    frame
        A raw frame that matches its calibration.
    calibration
        Its camera's calibration.

    Returns
    -------
    PreparedFrame
    """
    floor_e2 = noise_floor_e2(calibration, frame.gain)
    kernel = point_kernel(calibration.psf_sigma_px)
    image_e = electrons(frame, calibration)
    mesh_e = background_mesh_e(frame, calibration)
    background_e = spread_mesh(mesh_e, calibration)
    excess_e = image_e - background_e
    filtered_noise = float(np.sum(kernel**2))
    noise_mesh_e = np.sqrt(np.maximum(mesh_e, 0.0) + floor_e2).astype(np.float32)
    limit_mesh_e = _limit_mesh_e(mesh_e, floor_e2, kernel)
    filtered_e = matched_filter(excess_e, kernel)
    ratio = _scatter_ratio(filtered_e, filtered_noise * noise_mesh_e)
    limit_e = spread_mesh(limit_mesh_e * ratio, calibration)
    lit = _above(filtered_e, limit_e)
    bad = bad_pixels(excess_e, image_e, lit, floor_e2, kernel, along_rows=frame.line_time_s > 0.0)
    if bad.any():
        excess_e[bad] = 0.0
        filtered_e = matched_filter(excess_e, kernel)
        lit = _above(filtered_e, limit_e)
    texture = None
    if (ratio > 1.0).any():
        lit |= _local_contrast(
            filtered_e, limit_mesh_e, filtered_noise * noise_mesh_e, ratio, kernel, calibration
        )
        sigma_e = spread_mesh(filtered_noise * noise_mesh_e * np.sqrt(ratio**2 - 1.0), calibration)
        known = autocorrelation(excess_e, sigma_e, spread_mesh(noise_mesh_e, calibration))
        texture = Texture(sigma_e, known)
    return PreparedFrame(
        frame=frame,
        calibration=calibration,
        image_e=image_e,
        background_e=background_e,
        filtered_e=filtered_e,
        filtered_noise=filtered_noise,
        lit=lit,
        floor_e2=floor_e2,
        texture=texture,
        bad=bad,
    )


def _above(image_e: NDArray[np.float32], limit_e: NDArray[np.float32]) -> NDArray[np.bool_]:
    import cv2

    return np.asarray(cv2.compare(image_e, limit_e, cv2.CMP_GT), dtype=bool).reshape(image_e.shape)


def _scatter_ratio(image_e: NDArray[np.float32], noise_mesh_e: NDArray[np.float32]) -> NDArray[np.float32]:
    """Scatter of a filtered image in each cell relative to that of noise; 1 where it is no larger."""
    import cv2

    ratio = scatter(_cell_samples(image_e, _SCATTER_SAMPLES_PER_AXIS)) / noise_mesh_e
    smooth = np.asarray(cv2.medianBlur(ratio, 3), dtype=np.float32).reshape(ratio.shape)
    # A cell's ratio is known to 6 % only: those around must have some structure too.
    around = np.asarray(cv2.blur(ratio, (5, 5)), dtype=np.float32).reshape(ratio.shape)
    structured = (smooth > LEAST_RATIO) & (around > LEAST_RATIO_AROUND)
    return np.where(structured, smooth, np.float32(1.0))


def _local_contrast(
    filtered_e: NDArray[np.float32],
    limit_mesh_e: NDArray[np.float32],
    noise_mesh_e: NDArray[np.float32],
    ratio: NDArray[np.float32],
    kernel: NDArray[np.float64],
    calibration: Calibration,
) -> NDArray[np.bool_]:
    """Mark what stands out of its close surroundings where the background has structure.

    A point on a hill that is wider than the point spread does so though the hill is as bright as the point.
    """
    import cv2

    side = 2 * len(kernel) - 1
    contrast_e = filtered_e - cv2.blur(filtered_e, (side, side))
    widened = np.zeros(side + len(kernel) - 1)
    middle = (len(widened) - len(kernel)) // 2
    widened[middle : middle + len(kernel)] = kernel
    mean = np.convolve(kernel, np.full(side, 1.0 / side))
    of_noise = math.sqrt(float(np.sum((np.outer(widened, widened) - np.outer(mean, mean)) ** 2)))
    noise_e = noise_mesh_e * (of_noise / float(np.sum(kernel**2)))
    limit_e = limit_mesh_e * (of_noise / float(np.sum(kernel**2))) * _scatter_ratio(contrast_e, noise_e)
    structured = cv2.dilate((ratio > 1.0).astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.float32)
    limit_e = np.where(structured > 0.0, limit_e, np.float32(np.inf)).astype(np.float32)
    # Cells of even ground have no limit here: infinity must not spread into their neighbours.
    finite = np.where(np.isfinite(limit_e), limit_e, np.float32(1e9))
    return _above(contrast_e, spread_mesh(finite, calibration))


# --- background ---


def background_mesh_e(frame: RawFrame, calibration: Calibration) -> NDArray[np.float32]:
    """Background in electrons per pixel on a mesh of cells of about 64 px.

    In each cell the mean of what lies within 3 σ of the median, σ from the noise model at that median; the
    median of what is kept decides the next round. Then a median over 3 × 3 cells removes cells that a large
    flare fills. A cell is sampled at 24 × 24 of its pixels: the error is σ/24, of which a detection notices
    nothing.

    Parameters
    ----------
    frame
        A raw frame that matches its calibration.
    calibration
        Noise model.

    Returns
    -------
    Mesh, float32, shape (cells down, cells across); cells divide the frame evenly.
    """
    import cv2

    gain = gain_dn_per_e(frame, calibration)
    samples = _cell_samples(frame.data_dn, _SAMPLES_PER_AXIS)
    samples.sort(axis=-1)
    count = samples.shape[-1]
    # The lower median is itself a sample, so at least it is always kept.
    median = samples[..., (count - 1) // 2].astype(np.float64)
    kept = np.ones(samples.shape, dtype=bool)
    for _ in range(_CLIP_ROUNDS):
        sigma = gain * np.sqrt(
            np.maximum((median - frame.black_level_dn) / gain, 0.0) + noise_floor_e2(calibration, frame.gain)
        )
        kept = np.abs(samples - median[..., None]) <= _CLIP_SIGMA * sigma[..., None]
        first = kept.argmax(axis=-1)
        middle = first + (kept.sum(axis=-1) - 1) // 2
        median = np.take_along_axis(samples, middle[..., None], axis=-1)[..., 0].astype(np.float64)
    mean = np.sum(samples, axis=-1, where=kept, dtype=np.float64) / kept.sum(axis=-1)
    mesh = ((mean - frame.black_level_dn) / gain).astype(np.float32)
    return np.asarray(cv2.medianBlur(mesh, 3), dtype=np.float32).reshape(mesh.shape)


def spread_mesh(mesh: NDArray[np.float32], calibration: Calibration) -> NDArray[np.float32]:
    """Interpolate a mesh to every pixel of the frame, bilinearly between the cells' middles."""
    import cv2

    size = (calibration.width_px, calibration.height_px)
    full = cv2.resize(mesh, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(full, dtype=np.float32).reshape(calibration.height_px, calibration.width_px)


def _cell_samples(image: NDArray[Any], per_axis: int) -> NDArray[Any]:
    """Pixels of each cell, shape (cells down, cells across, samples)."""
    down, rows = _sample_places(image.shape[0], per_axis)
    across, columns = _sample_places(image.shape[1], per_axis)
    taken = image[np.ix_(rows, columns)]
    blocks = taken.reshape(down, rows.size // down, across, columns.size // across)
    return blocks.transpose(0, 2, 1, 3).reshape(down, across, -1)


def _sample_places(length: int, per_axis: int) -> tuple[int, NDArray[np.intp]]:
    """Divide an axis: the number of cells, and the pixels sampled, evenly in each."""
    cells = max(1, round(length / CELL_PX))
    per_cell = min(per_axis, math.floor(length / cells))
    place = (np.arange(cells * per_cell) + 0.5) * (length / (cells * per_cell))
    return cells, place.astype(np.intp)


# --- matched filter and detection limit ---


def point_kernel(psf_sigma_px: float) -> NDArray[np.float64]:
    """Image of a point on a pixel's centre along one axis, sum 1: the PSF with the pixel's own aperture."""
    from scipy.special import erf

    half = math.ceil(3.0 * psf_sigma_px + 0.5)
    edges = np.arange(-half, half + 2) - 0.5
    share = 0.5 * np.diff(erf(edges / (math.sqrt(2.0) * psf_sigma_px)))
    return np.asarray(share / share.sum())


def matched_filter(image_e: NDArray[np.float32], kernel: NDArray[np.float64]) -> NDArray[np.float32]:
    """Correlate an image with the outer product of a kernel with itself, zero beyond the border.

    Zero is the expected value there (the background is subtracted), so the border is less noisy than the
    rest, never more.
    """
    import cv2

    filtered = cv2.sepFilter2D(image_e, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(filtered, dtype=np.float32).reshape(image_e.shape)


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
    from scipy.special import ndtr

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
        tail = ndtr(-w) + density * (1.0 / (s * np.sqrt(curvature)) - 1.0 / w)
        low, high = (
            np.where(tail > false_alarms_per_pixel, s, low),
            np.where(tail > false_alarms_per_pixel, high, s),
        )
    return np.asarray(slope.reshape(level.shape))


def _limit_mesh_e(
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
