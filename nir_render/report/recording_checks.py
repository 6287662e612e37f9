"""Where a recording contradicts its calibration: flares of another width, dark pixels of another level."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nir_render.report.wording import counted
from perception.calibration.dark import Darkness, darkness
from perception.model.flare import image_radius_px
from perception.model.ranging import angular_radius_rad, flux_at_one_metre_dn
from perception.types import Calibration, Detection, RawFrame

_SPOTS = 3  # the brightest of a frame that are measured
_LEAST_SPOTS = 5  # for a median that holds
_BRIGHT = 20.0  # flux over its noise: then one width is known to a few per cent
_APART_PX = 12
_HALF_PX = 8
_PASSES = 12
_MOST_DISC_PX = 1.2  # of a disc whose share of the width is its variance
_HOT = 0.9  # of its light in one pixel: no lens makes that
_PIXEL_PX2 = 1.0 / 12.0
_LEAST_FLARES = 5
_MANY_MERGED = 0.3
_NARROW, _WIDE = 0.75, 1.33
_QUIET, _NOISY = 0.5, 2.5  # of the variance that is due
_OFF_SIGMAS = 3.0


@dataclass(frozen=True)
class ShapesSeen:
    """The shapes in some frames of a camera, and what an estimator made of them.

    `flares` that it found there, `merged` ones among them; `psf_sigma_px` is the σ of the point spread that
    the brightest spots have, in the median; NaN where too few are bright.
    """

    flares: int
    merged: int
    psf_sigma_px: float


def shapes_seen(
    frames: Sequence[RawFrame], found: Sequence[Sequence[Detection]], calibration: Calibration
) -> ShapesSeen:
    """Look at the shapes in some frames of one camera, whether they were found or not."""
    widths_px = [width_px for frame in frames for width_px in _spot_sigmas_px(frame, calibration)]
    flares = [detection for detections in found for detection in detections if not detection.saturated]
    width_px = float(np.median(widths_px)) if len(widths_px) >= _LEAST_SPOTS else math.nan
    return ShapesSeen(len(flares), sum(flare.merged for flare in flares), width_px)


def _spot_sigmas_px(frame: RawFrame, calibration: Calibration) -> Iterator[float]:
    """Yield the σ of the point spread that the brightest spots of a frame have.

    Pixel aperture (variance 1/12) and the source's disc (radius²/4) are taken off; near sources, whose discs
    are wide, are passed over.
    """
    light = frame.data_dn.astype(np.float64)
    light -= np.median(light)
    noise_dn = max(1.4826 * float(np.median(np.abs(light))), 0.3)
    left = light.copy()
    for _ in range(_SPOTS):
        row, column = (int(at) for at in np.unravel_index(int(np.argmax(left)), left.shape))
        if left[row, column] < 3.0 * noise_dn:
            return
        left[
            max(row - _APART_PX, 0) : row + _APART_PX + 1, max(column - _APART_PX, 0) : column + _APART_PX + 1
        ] = 0.0
        rows, columns = light.shape
        if not (_HALF_PX <= row < rows - _HALF_PX and _HALF_PX <= column < columns - _HALF_PX):
            continue
        around = (slice(row - _HALF_PX, row + _HALF_PX + 1), slice(column - _HALF_PX, column + _HALF_PX + 1))
        if int(frame.data_dn[around].max()) >= calibration.saturation_dn:
            continue
        variance_px2 = spot_variance_px2(light[around], noise_dn)
        radius_px = _disc_radius_px(column, row, float(light[around].sum()), frame, calibration)
        if radius_px > _MOST_DISC_PX:
            continue
        if not math.isnan(variance_px2):
            yield math.sqrt(max(variance_px2 - 0.25 * radius_px**2 - _PIXEL_PX2, 0.0))


def _disc_radius_px(
    column: int, row: int, flux_dn: float, frame: RawFrame, calibration: Calibration
) -> float:
    """Return the radius of a source's disc at the range that its flux tells; infinite where it tells none."""
    at_one_metre_dn = float(flux_at_one_metre_dn(column, row, frame.exposure_s, frame.gain, calibration))
    if not (flux_dn > 0.0 and at_one_metre_dn > 0.0):
        return math.inf
    angle_rad = angular_radius_rad(math.sqrt(at_one_metre_dn / flux_dn), calibration.source_radius_m)
    return float(image_radius_px(column, row, angle_rad, calibration))


def spot_variance_px2(light: NDArray[np.float64], noise_dn: float) -> float:
    """Return the variance of a spot along an axis, by moments under a Gaussian weight of its own width.

    Under a weight of its own variance t a Gaussian spot has the variance t/2 (Bernstein & Jarvis 2002, AJ
    123, 583); far pixels, which hold noise alone, so count little.

    Parameters
    ----------
    light
        Counts above the background, shape (n, n), the spot about in the middle.
    noise_dn
        σ of a pixel.

    Returns
    -------
    float
        NaN of a spot that is faint, is one hot pixel, or is no spot.
    """
    half = light.shape[0] // 2
    rows, columns = np.mgrid[-half : half + 1, -half : half + 1].astype(np.float64)
    u = v = 0.0
    variance = 1.0
    for _ in range(_PASSES):
        square = (columns - u) ** 2 + (rows - v) ** 2
        weight = np.exp(-0.5 * square / variance)
        weighted = weight * light
        total = float(weighted.sum())
        if not total > _BRIGHT * noise_dn * math.sqrt(float((weight**2).sum())):
            return math.nan
        if float(light.max()) > _HOT * float(light[weight > 0.01].sum()):
            return math.nan
        u, v = (
            min(max(at + float((weighted * (axis - at)).sum()) / total, -3.0), 3.0)
            for axis, at in ((columns, u), (rows, v))
        )
        seen = float((weighted * square).sum()) / (2.0 * total)
        if not 0.0 < seen < 0.95 * variance:
            variance *= 2.0
        else:
            variance = 1.0 / (1.0 / seen - 1.0 / variance)
        if not 0.02 < variance < half**2:
            return math.nan
    return variance


def shape_warnings(camera: str, estimator: str, seen: ShapesSeen, calibration: Calibration) -> Iterator[str]:
    """Yield where the shapes in the frames contradict the calibrated point spread."""
    said_px = calibration.psf_sigma_px
    ratio = seen.psf_sigma_px / said_px
    off = abs(seen.psf_sigma_px - said_px) > _OFF_SIGMAS * calibration.sigma.get("psf_sigma_px", 0.0)
    found = f"{estimator} found {counted(seen.flares, 'flare')} there, {seen.merged} merged"
    if math.isfinite(ratio) and not _NARROW < ratio < _WIDE and off:
        yield (
            f"{camera}: the brightest spots look like a point spread of {seen.psf_sigma_px:.2f} px, the "
            f"calibration says psf_sigma_px = {said_px:.2f}; {found}. What is sharper than the calibration "
            "is passed over, what is wider is taken for several: check focus and psf_sigma_px"
        )
    elif seen.flares >= _LEAST_FLARES and seen.merged > _MANY_MERGED * seen.flares:
        yield (
            f"{camera}: {found}: they do not look like one source through the calibrated point spread, "
            f"psf_sigma_px = {said_px:.2f}: check focus, psf_sigma_px, focal length and source_radius_m, "
            "or sources overlap"
        )


def darkness_warnings(frames: Sequence[RawFrame], calibration: Calibration) -> Iterator[str]:
    """Yield where the dark pixels of a camera's frames contradict its black level, gain or read noise."""
    dark = darkness([frame.data_dn for frame in frames])
    black_dn = float(np.mean([frame.black_level_dn for frame in frames]))
    gain_dn_per_e = calibration.system_gain_dn_per_e * float(np.mean([frame.gain for frame in frames]))
    off_dn = dark.level_dn - black_dn
    slack_dn = max(
        _OFF_SIGMAS * math.hypot(calibration.sigma.get("black_level_dn", 0.0), dark.level_sigma_dn),
        0.1 * dark.noise_dn,
    )
    seen, said = f"dark pixels count {dark.level_dn:.1f} DN", f"the black level of {black_dn:.1f} DN"
    again = "measure black_level_dn again with the lens covered"
    if off_dn < -slack_dn:
        yield f"{calibration.camera}: {seen}, below {said}: no light makes that; {again}"
    elif off_dn > slack_dn and dark.noise_dn**2 + _PIXEL_PX2 < _QUIET * off_dn * gain_dn_per_e:
        yield (
            f"{calibration.camera}: {seen}, above {said}, and are too quiet for so much light: "
            f"black_level_dn or system_gain_dn_per_e is wrong; {again}"
        )
    else:
        yield from _noise_warnings(dark, max(off_dn, 0.0), gain_dn_per_e, calibration)


def _noise_warnings(
    dark: Darkness, light_dn: float, gain_dn_per_e: float, calibration: Calibration
) -> Iterator[str]:
    due_dn2 = (calibration.read_noise_e * gain_dn_per_e) ** 2 + light_dn * gain_dn_per_e + _PIXEL_PX2
    if dark.noise_dn**2 > _NOISY * due_dn2:
        yield (
            f"{calibration.camera}: dark pixels scatter by {dark.noise_dn:.2g} DN from frame to frame, the "
            f"calibration says {math.sqrt(due_dn2):.2g} DN: every σ is too small; check read_noise_e and "
            "system_gain_dn_per_e"
        )
