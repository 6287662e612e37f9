"""How bright a tracked source is in a frame, dark or lit: measured where it is predicted.

A source that was found is as bright as its detection says. One that was not may be dark, and how dark is a
measurement too: the flux of an image of known place and shape, by weighted least squares, beside a level
background and the images of all flares found near it, at their places, with fluxes fitted anew.
Where a neighbour's image cannot be told from its own the standard deviation says so by itself.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.compiled import compiled
from perception.model.bearing import pixel_turn
from perception.model.flare import PixelBox, flare_image, has_image, image_radius_px
from perception.model.lens import project, stretch
from perception.model.ranging import angular_radius_rad, exposure_towards
from perception.model.sensor import gain_dn_per_e, noise_floor_e2, saturation_dn
from perception.types import Calibration, Detection, RawFrame, Signal

Array = NDArray[np.float64]

OWN_ERROR = 0.02
"""A lit level is never known better than this: pixels differ, patterns are uneven, ranges are predicted."""

BLURRED_MOST = 3.0
"""At a place less certain than this many times the image's own width it counts whether a flare was found."""

SURE_SNR = 12.0
"""A lit source whose flux is this many times its noise is found."""

_MISSED, _MOST_MISSED, _MERGE = 3e-4, 0.2, 3.0

_REACH = 4.0
"""Half a window, in standard deviations of the image, and what counts as a neighbour beyond its edge."""

_LARGEST_PX, _RESOLVED_PX, _MOST_STRETCH = 40.0, 0.5, 8.0
_LEAST_PIXELS = 9


@dataclass(frozen=True)
class Sample:
    """Brightness of one source in one frame, as in `Signal`."""

    time_s: float
    exposure_s: float
    level: float
    sigma_dark: float
    sigma_lit: float


@dataclass(frozen=True, eq=False)
class Expected:
    """Where a source must be in a frame, and how bright if it is lit.

    Attributes
    ----------
    u_px, v_px
        Its place.
    sigma_px
        Standard deviation of the place, the larger half axis.
    range_m
        From the lens.
    flux_dn
        Background-subtracted integral if it is lit throughout.
    width_px
        Standard deviation of its image, the pixel's own aperture left out.
    """

    u_px: float
    v_px: float
    sigma_px: float
    range_m: float
    flux_dn: float
    width_px: float


def expected_images(
    position_body_m: Array,
    covariance_m2: Array,
    frame: RawFrame,
    calibration: Calibration,
    extinction_per_m: float | None = None,
) -> list[Expected | None]:
    """Return where sources must be in a frame, by their predicted places; None for each out of view.

    Parameters
    ----------
    position_body_m, covariance_m2
        Where they are predicted at the frame's time, in body axes, shape (sources, 3), and how well, shape
        (sources, 3, 3).
    extinction_per_m
        Of the fog, as a set told it; without it what the calibration says.
    """
    found: list[Expected | None] = [None] * len(position_body_m)
    towards_m = (position_body_m - calibration.position_body_m) @ calibration.rotation_body_camera
    place_px = project(towards_m, calibration)  # NaN behind the lens
    size_px = (calibration.width_px, calibration.height_px)
    seen = np.flatnonzero(((place_px >= -0.5) & (place_px < np.subtract(size_px, 0.5))).all(axis=1))
    if not len(seen):
        return found
    place_px, range_m = place_px[seen], np.linalg.norm(towards_m[seen], axis=1)
    direction = towards_m[seen] / range_m[:, None]
    exposed_s = exposure_towards(direction, frame.exposure_s, frame.gain, calibration)
    fog_per_m = calibration.extinction_per_m if extinction_per_m is None else extinction_per_m
    flux_dn = calibration.range_constant_dn_m2_per_s * exposed_s / range_m**2 * np.exp(-fog_per_m * range_m)
    turn = pixel_turn(place_px, calibration)
    axes = turn / (turn**2).sum(axis=2, keepdims=True) / range_m[:, None, None]
    axes = axes @ calibration.rotation_body_camera.T
    place_px2 = axes @ covariance_m2[seen] @ axes.swapaxes(1, 2)
    across2, down2 = place_px2[:, 0, 0], place_px2[:, 1, 1]
    longest2 = 0.5 * (across2 + down2) + np.hypot(0.5 * (across2 - down2), place_px2[:, 0, 1])
    sigma_px = np.sqrt(np.maximum(longest2, 0.0))
    disc_rad = angular_radius_rad(range_m, calibration.source_radius_m)
    width_px = _width_px(stretch(direction, calibration) * np.tan(disc_rad), disc_rad, calibration)
    columns = np.column_stack([place_px, sigma_px, range_m, flux_dn, width_px])
    for index, row, flux in zip(seen.tolist(), columns.tolist(), flux_dn.tolist(), strict=True):
        if flux > 0.0:
            found[index] = Expected(*row)
    return found


def sample_of_detection(
    hit: Detection, expected: Expected, frame: RawFrame, calibration: Calibration
) -> Sample:
    """Return the brightness of a source that was found."""
    level = hit.flux_dn / expected.flux_dn
    sigma = hit.flux_sigma_dn / expected.flux_dn
    if not (math.isfinite(sigma) and math.isfinite(level)):
        # Lit it is, for it was found; how brightly is not said.
        level, sigma = (max(level, 1.0) if math.isfinite(level) else 1.0), 0.3
    shot = math.sqrt(gain_dn_per_e(frame, calibration) * max(hit.flux_dn, 0.0)) / expected.flux_dn
    dark = math.sqrt(max(sigma**2 - shot**2, 0.04 * sigma**2))
    return _sample(level, dark, expected, frame, calibration)


def sample_at(
    expected: Expected,
    found: Sequence[Detection],
    frame: RawFrame,
    calibration: Calibration,
    claimed: Sequence[bool] | None = None,
) -> Sample | None:
    """Return the brightness at the place where a source is expected but was not found.

    Parameters
    ----------
    found
        All detections in the frame: none of them is taken for the source.
    claimed
        Which of them are known to be others'; by default none is.

    Returns
    -------
    None where nothing can be said: a flare lies upon the place, or may be the source after all; pixels are
    clipped; the place is too uncertain and the source too faint for its absence to say that it is dark.
    """
    width_px = expected.width_px
    if width_px > _LARGEST_PX:
        return None
    gain = gain_dn_per_e(frame, calibration)
    floor_e2 = noise_floor_e2(calibration, frame.gain)
    lit_e = expected.flux_dn / gain
    if expected.sigma_px > BLURRED_MOST * width_px:
        snr = lit_e / math.sqrt(lit_e + 4.0 * math.pi * width_px**2 * floor_e2)
        missed = _chance_missed(expected, width_px, found, claimed or [False] * len(found))
        if snr < SURE_SNR or missed > _MOST_MISSED:
            return None
        return _sample(0.0, 1.0 / math.sqrt(-2.0 * math.log(missed)), expected, frame, calibration)
    blurred_px = math.hypot(width_px, expected.sigma_px)
    # Images so close differ by their shapes alone, and places are not known as well as that.
    if any(
        math.hypot(hit.u_px - expected.u_px, hit.v_px - expected.v_px) < 1.5 * blurred_px for hit in found
    ):
        return None
    half_px = _REACH * blurred_px + 1.0
    window = PixelBox.around(expected.u_px, expected.v_px, half_px, calibration)
    counts = frame.data_dn[window.slices]
    if counts.size < _LEAST_PIXELS or counts.max() >= saturation_dn(calibration, frame.gain):
        return None
    # The image of a source whose place is not known well is its mean over where it may be.
    box = window.left, window.top, window.width, window.height
    shapes = [_gaussian(expected.u_px, expected.v_px, blurred_px, *box)]
    near = [hit for hit in found if _may_reach(hit, expected, half_px, calibration)]
    for hit, hit_rad, hit_px in _sizes(near, calibration):
        if max(abs(hit.u_px - expected.u_px), abs(hit.v_px - expected.v_px)) < half_px + _REACH * hit_px:
            resolved = hit_rad * calibration.fx_px > _RESOLVED_PX
            if resolved and has_image(hit.u_px, hit.v_px, hit_rad, calibration):
                shapes.append(flare_image(hit.u_px, hit.v_px, hit_rad, window, calibration).fraction)
            else:
                shapes.append(_gaussian(hit.u_px, hit.v_px, hit_px, *box))
    image_e = np.asarray((counts.ravel() - frame.black_level_dn) / gain, dtype=np.float64)
    columns = np.array(shapes).reshape(len(shapes), -1)
    flux_e, sigma_e = _fitted_flux(columns, image_e, floor_e2)
    if not 0.0 < sigma_e < lit_e:
        return None
    return _sample(flux_e / lit_e, sigma_e / lit_e, expected, frame, calibration)


def _may_reach(hit: Detection, expected: Expected, half_px: float, calibration: Calibration) -> bool:
    """Tell cheaply whether a detection's image may reach into a window: with room for any lens's stretch."""
    off_px = max(abs(hit.u_px - expected.u_px), abs(hit.v_px - expected.v_px))
    if math.isnan(hit.range_m):
        return off_px < half_px + _REACH * calibration.psf_sigma_px
    radius_px = _MOST_STRETCH * calibration.fx_px * calibration.source_radius_m / max(hit.range_m, 0.01)
    return off_px < half_px + _REACH * (calibration.psf_sigma_px + radius_px)


def _sizes(found: Sequence[Detection], calibration: Calibration) -> list[tuple[Detection, float, float]]:
    """Return detections, each with its angular radius and the standard deviation of its image."""
    if not found:
        return []
    u_px, v_px, range_m = np.array([(hit.u_px, hit.v_px, hit.range_m) for hit in found]).T
    radius_rad = angular_radius_rad(np.maximum(range_m, 0.01), calibration.source_radius_m)
    radius_rad = np.where(np.isfinite(radius_rad), radius_rad, 0.0)
    width_px = _width_px(image_radius_px(u_px, v_px, radius_rad, calibration), radius_rad, calibration)
    return list(zip(found, radius_rad.tolist(), width_px.tolist(), strict=True))


def signal_of(robot: str, track: int, samples: Sequence[Sample]) -> Signal:
    """Return the samples of one track, by time, as a signal."""
    columns = np.array(
        [[one.time_s, one.exposure_s, one.level, one.sigma_dark, one.sigma_lit] for one in samples]
    ).reshape(-1, 5)
    return Signal(robot, track, *columns.T)


def _chance_missed(
    expected: Expected, width_px: float, found: Sequence[Detection], claimed: Sequence[bool]
) -> float:
    """Return how probable it is that a lit source goes unseen: it may stand upon another, or be the other."""
    missed = _MISSED
    for hit, others in zip(found, claimed, strict=True):
        off_px = math.hypot(hit.u_px - expected.u_px, hit.v_px - expected.v_px)
        if not others and off_px < _REACH * (expected.sigma_px + width_px):
            return 1.0
        upon = (_MERGE * width_px / expected.sigma_px) ** 2
        missed += (
            0.5 * upon * math.exp(-0.5 * (max(off_px - _MERGE * width_px, 0.0) / expected.sigma_px) ** 2)
        )
    return missed


def _sample(
    level: float, sigma_dark: float, expected: Expected, frame: RawFrame, calibration: Calibration
) -> Sample:
    shot2 = gain_dn_per_e(frame, calibration) / expected.flux_dn
    lit = math.sqrt(sigma_dark**2 + shot2 + OWN_ERROR**2)
    middle_s = frame.time_s + 0.5 * frame.exposure_s + frame.line_time_s * expected.v_px
    return Sample(middle_s, frame.exposure_s, level, sigma_dark, lit)


def _width_px(radius_px: Array, disc_rad: Array, calibration: Calibration) -> Array:
    """Return the standard deviations of images, the pixel's own aperture left out, shape (sources,)."""
    return np.asarray(np.hypot(calibration.psf_sigma_px, 0.5 * np.where(disc_rad > 0.0, radius_px, 0.0)))


@compiled
def _gaussian(
    u_px: float, v_px: float, sigma_px: float, left: int, top: int, width: int, height: int
) -> Array:
    """Return the share of a Gaussian in each pixel of a window."""
    across, down, shares = np.empty(width), np.empty(height), np.empty((height, width))
    for share, first, middle_px in ((across, left, u_px), (down, top, v_px)):
        before = _below((first - 0.5 - middle_px) / sigma_px)
        for k in range(len(share)):
            after = _below((k + 0.5 + first - middle_px) / sigma_px)
            share[k], before = after - before, after
    for row in range(height):
        for column in range(width):
            shares[row, column] = down[row] * across[column]
    return shares


@compiled
def _below(sigmas: float) -> float:
    """Return the share of a Gaussian below so many standard deviations."""
    return 0.5 * math.erfc(-sigmas / math.sqrt(2.0))


@compiled
def _fitted_flux(shapes: Array, image_e: Array, floor_e2: float) -> tuple[float, float]:
    """Fit images to pixels beside a level background: flux of the first and its σ; 0 where these are alike.

    Parameters
    ----------
    shapes
        Share of each image in each pixel, shape (images, pixels).
    image_e
        Electrons, shape (pixels,).
    floor_e2
        Variance of a dark pixel.
    """
    images = len(shapes)
    # Weights by single pixels would favour those that are low by chance: an even ground has its mean's.
    level_e2 = max(np.median(image_e), 0.0) + floor_e2
    normal, seen = np.zeros((images + 1, images + 1)), np.zeros(images + 1)
    column = np.ones(images + 1)
    for pixel in range(len(image_e)):
        variance_e2 = max(image_e[pixel] + floor_e2, level_e2) if images > 1 else level_e2
        column[:images] = shapes[:, pixel]
        for a in range(images + 1):
            weighed = column[a] / variance_e2
            seen[a] += weighed * image_e[pixel]
            for b in range(images + 1):
                normal[a, b] += weighed * column[b]
    # The others are eliminated, the last first; what is left is of the first alone.
    for pivot in range(images, 0, -1):
        if not normal[pivot, pivot] > 0.0:
            return 0.0, 0.0
        for a in range(pivot):
            factor = normal[a, pivot] / normal[pivot, pivot]
            seen[a] -= factor * seen[pivot]
            for b in range(pivot):
                normal[a, b] -= factor * normal[pivot, b]
    if not normal[0, 0] > 0.0:
        return 0.0, 0.0
    return seen[0] / normal[0, 0], 1.0 / math.sqrt(normal[0, 0])
