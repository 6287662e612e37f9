"""From a blob to its place, flux and range: the fit, and what to do where it cannot be had."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from perception.blobs import Blob
from perception.flare_model import Window, image_radius_px
from perception.photometry import aperture_flux, core_goodness
from perception.preparation import PreparedFrame
from perception.ranging import angular_radius_rad, range_from_flux
from perception.sensor import clip_level_e, gain_dn_per_e, saturation_dn
from perception.source_fit import SourceFit, fit_source

MODEL_ERROR = 0.05
"""How far, relative to the flare's own light, a good PSF and source may be off before a fit counts as bad."""

MISFIT_PROBABILITY = 1e-6
MAX_IMAGE_RADIUS_PX = 20.0
"""Sources that look larger are measured by aperture: as good for them, and far cheaper than the fit."""

CLIPPED_FLUX_SIGMA = 0.25
"""A clipped flare counts as recovered if the fit claims its flux to better than this, relatively."""


@dataclass(frozen=True)
class Measurement:
    """Place, flux and range of a flare; NaN where no claim is made. `background_e` is per pixel.

    `flux_sigma_e` holds for a source of the size found: it says whether there is a flare, not how well its
    range is known.
    """

    u_px: float
    v_px: float
    u_sigma_px: float
    v_sigma_px: float
    flux_e: float
    flux_sigma_e: float
    background_e: float
    range_m: float
    range_sigma_m: float
    saturated: bool
    misfit: bool

    @property
    def stands_out(self) -> bool:
        """Whether its flux exceeds the background right beside it by 4 σ (a clipped one always does).

        What only the coarse background made look bright, such as the border of a shadow, does not. A blob
        that does not look like a source must exceed 10 σ: overlapping flares bright enough to show it do.
        """
        least = 10.0 if self.misfit else 4.0
        return self.saturated or (self.flux_e > 0.0 and not self.flux_e < least * self.flux_sigma_e)


def is_extended(blob: Blob, prepared: PreparedFrame) -> bool:
    """Whether a blob is far larger than a source of its flux: a lit wall's edge, a window, a lamp tube.

    Flux tells the range, range the size. The area above half of the maximum (which the PSF's faint tail does
    not reach) may be four times what a source would cover, so that flares that overlap are kept. Clipped
    blobs are never called extended, for neither their flux nor their half maximum is known.
    """
    window = _window(blob, prepared)
    if bool(np.any(_clipped(prepared, window))):
        return False
    u_px, v_px, flux_e = _moments(blob, prepared)
    brightness = prepared.filtered_e[blob.box.slices][blob.pixels]
    half_area = int(np.sum(brightness > 0.5 * brightness.max()))
    radius_px = _image_radius_px(u_px, v_px, flux_e, prepared)
    # Half maximum of a Gaussian filtered with itself lies at √(2 ln 2) · √2 σ = 1.67 σ.
    smooth_px = math.sqrt(prepared.calibration.psf_sigma_px**2 + 1.0 / 12.0)
    return half_area > 4.0 * math.pi * (radius_px + 1.67 * smooth_px) ** 2 + 8.0


def measure(blob: Blob, prepared: PreparedFrame) -> Measurement:
    """Measure one blob; the pixels of all others are left out.

    A source of known size and strength is fitted to the window around the blob. Where no fit is to be had
    the flux comes from an aperture; that of a clipped flare is then a lower bound.

    Parameters
    ----------
    blob
        The flare's pixels.
    prepared
        The frame.

    Returns
    -------
    Measurement
    """
    window = _window(blob, prepared)
    clipped = _clipped(prepared, window)
    saturated = bool(np.any(clipped & _placed(blob, window)))
    free = ~_grown(_others(blob, prepared, window), 2)
    u_px, v_px, flux_e = _moments(blob, prepared)
    too_large = _image_radius_px(u_px, v_px, flux_e, prepared) > MAX_IMAGE_RADIUS_PX

    if flux_e > 0.0 and not too_large:
        place = (u_px, v_px, _background_at(u_px, v_px, prepared))
        fit = _fit(free, clipped, window, prepared, place, _first_fluxes(blob, flux_e, prepared))
        if fit is not None:
            good = core_goodness(prepared.image_e[window.slices], fit.fit, prepared.floor_e2, MODEL_ERROR)
            misfit = good.probability < MISFIT_PROBABILITY
            recovered = not misfit and fit.flux_sigma_e < CLIPPED_FLUX_SIGMA * fit.fit.flux_e
            if recovered or not saturated:
                stretch = math.sqrt(good.chi2 / good.pixels) if misfit else 1.0
                return _from_fit(fit, prepared, stretch, saturated=saturated, misfit=misfit)

    bound = _from_aperture(blob, free, window, prepared)
    if saturated:
        unknown = math.nan
        return replace(bound, u_sigma_px=unknown, v_sigma_px=unknown, range_sigma_m=unknown, saturated=True)
    return replace(bound, misfit=not too_large)


def _first_fluxes(blob: Blob, flux_e: float, prepared: PreparedFrame) -> list[float]:
    """Fluxes to start from: of a flare that the frame's edge cuts, the part seen may be half or less."""
    rows, columns = prepared.image_e.shape
    box = blob.box
    cut = box.top == 0 or box.left == 0 or box.top + box.height == rows or box.left + box.width == columns
    return [flux_e, 2.0 * flux_e, 4.0 * flux_e] if cut else [flux_e]


def _fit(
    free: NDArray[np.bool_],
    clipped: NDArray[np.bool_],
    window: Window,
    prepared: PreparedFrame,
    place: tuple[float, float, float],
    first_fluxes_e: list[float],
) -> SourceFit | None:
    """Fit from (u, v, background) and first guesses of the flux.

    To leave out clipped pixels alone would choose pixels by their own noise and bias what remains. So at
    first their neighbours are left out too, and then, instead, all pixels that the first fit puts within 3 σ
    of the clip level.
    """
    frame, calibration = prepared.frame, prepared.calibration

    def attempt(
        usable: NDArray[np.bool_], place: tuple[float, float, float], fluxes_e: list[float]
    ) -> SourceFit | None:
        return fit_source(
            prepared.image_e[window.slices],
            usable,
            window,
            calibration,
            place=place,
            first_fluxes_e=fluxes_e,
            exposure_s=frame.exposure_s,
            gain=frame.gain,
            max_image_radius_px=1.6 * MAX_IMAGE_RADIUS_PX,
        )

    first = attempt(free & ~_grown(clipped, 1), place, first_fluxes_e)
    if first is None or not clipped.any():
        return first
    fit = first.fit
    noise_e = np.sqrt(np.maximum(fit.expected_e, 0.0) + prepared.floor_e2)
    below_clip = fit.expected_e < clip_level_e(calibration, frame.black_level_dn, frame.gain) - 3.0 * noise_e
    return attempt(free & ~clipped & below_clip, (fit.u_px, fit.v_px, fit.background_e), [fit.flux_e])


def _from_fit(
    source: SourceFit, prepared: PreparedFrame, stretch: float, *, saturated: bool, misfit: bool
) -> Measurement:
    fit, frame = source.fit, prepared.frame
    gain = gain_dn_per_e(frame, prepared.calibration)
    ranged = range_from_flux(
        fit.flux_e * gain,
        source.flux_sigma_e * gain * stretch,
        fit.u_px,
        fit.v_px,
        frame.exposure_s,
        frame.gain,
        prepared.calibration,
    )
    return Measurement(
        u_px=fit.u_px,
        v_px=fit.v_px,
        u_sigma_px=source.u_sigma_px * stretch,
        v_sigma_px=source.v_sigma_px * stretch,
        flux_e=fit.flux_e,
        flux_sigma_e=fit.flux_sigma_e * stretch,
        background_e=fit.background_e,
        range_m=ranged.range_m,
        range_sigma_m=ranged.range_sigma_m,
        saturated=saturated,
        misfit=misfit,
    )


def _from_aperture(
    blob: Blob, free: NDArray[np.bool_], window: Window, prepared: PreparedFrame
) -> Measurement:
    frame, calibration = prepared.frame, prepared.calibration
    u_px, v_px, _ = _moments(blob, prepared)
    reach_px = 0.5 * math.hypot(blob.box.height, blob.box.width) + 2.0
    aperture = aperture_flux(
        prepared.image_e[window.slices],
        u_px - window.left,
        v_px - window.top,
        reach_px,
        reach_px,
        reach_px + 4.0,
        free,
    )
    gain = gain_dn_per_e(frame, calibration)
    ranged = range_from_flux(
        aperture.flux * gain,
        aperture.flux_sigma * gain,
        u_px,
        v_px,
        frame.exposure_s,
        frame.gain,
        calibration,
    )
    u_sigma_px, v_sigma_px = _centroid_sigmas(blob, aperture.flux, prepared)
    return Measurement(
        u_px=u_px,
        v_px=v_px,
        u_sigma_px=u_sigma_px,
        v_sigma_px=v_sigma_px,
        flux_e=aperture.flux,
        flux_sigma_e=aperture.flux_sigma,
        background_e=aperture.background,
        range_m=ranged.range_m,
        range_sigma_m=ranged.range_sigma_m,
        saturated=False,
        misfit=False,
    )


def _window(blob: Blob, prepared: PreparedFrame) -> Window:
    """Take the blob's box and enough around it to hold the rest of the PSF and a rim of background."""
    margin = math.ceil(4.0 * prepared.calibration.psf_sigma_px) + 4
    rows, columns = prepared.image_e.shape
    top, left = max(0, blob.box.top - margin), max(0, blob.box.left - margin)
    bottom = min(rows, blob.box.top + blob.box.height + margin)
    right = min(columns, blob.box.left + blob.box.width + margin)
    return Window(top, left, bottom - top, right - left)


def _placed(blob: Blob, window: Window) -> NDArray[np.bool_]:
    """Mark the blob's pixels in a mask over a window that holds it."""
    mask = np.zeros((window.height, window.width), dtype=bool)
    top, left = blob.box.top - window.top, blob.box.left - window.left
    mask[top : top + blob.box.height, left : left + blob.box.width] = blob.pixels
    return mask


def _others(blob: Blob, prepared: PreparedFrame, window: Window) -> NDArray[np.bool_]:
    """Pixels of the window that belong to other flares."""
    return np.asarray(prepared.lit[window.slices] & ~_placed(blob, window))


def _clipped(prepared: PreparedFrame, window: Window) -> NDArray[np.bool_]:
    clipped_dn = saturation_dn(prepared.calibration, prepared.frame.gain)
    return np.asarray(prepared.frame.data_dn[window.slices] >= clipped_dn)


def _grown(mask: NDArray[np.bool_], by_px: int) -> NDArray[np.bool_]:
    if not mask.any():
        return mask
    kernel = np.ones((2 * by_px + 1, 2 * by_px + 1), dtype=np.uint8)
    return np.asarray(cv2.dilate(mask.view(np.uint8), kernel), dtype=bool).reshape(mask.shape)


def _excess(blob: Blob, prepared: PreparedFrame) -> NDArray[np.float64]:
    """Electrons above the background in the blob's pixels, shape (area,)."""
    box = blob.box.slices
    return (prepared.image_e[box] - prepared.background_e[box])[blob.pixels].astype(np.float64)


def _moments(blob: Blob, prepared: PreparedFrame) -> tuple[float, float, float]:
    """Centroid (u, v), weighted by what exceeds the background, and its sum in electrons."""
    excess = _excess(blob, prepared)
    weight = np.maximum(excess, 0.0)
    if not weight.sum() > 0.0:
        weight = np.ones_like(excess)
    rows, columns = np.nonzero(blob.pixels)
    u_px = blob.box.left + float(np.average(columns, weights=weight))
    v_px = blob.box.top + float(np.average(rows, weights=weight))
    return u_px, v_px, float(excess.sum())


def _centroid_sigmas(blob: Blob, flux_e: float, prepared: PreparedFrame) -> tuple[float, float]:
    """Compute the centroid's standard deviations: √(Σ (x - x̄)² variance) / flux along each axis."""
    if not flux_e > 0.0:
        return math.nan, math.nan
    u_px, v_px, _ = _moments(blob, prepared)
    variance = np.maximum(prepared.image_e[blob.box.slices][blob.pixels], 0.0) + prepared.floor_e2
    rows, columns = np.nonzero(blob.pixels)
    return (
        math.sqrt(float(np.sum((blob.box.left + columns - u_px) ** 2 * variance))) / flux_e,
        math.sqrt(float(np.sum((blob.box.top + rows - v_px) ** 2 * variance))) / flux_e,
    )


def _background_at(u_px: float, v_px: float, prepared: PreparedFrame) -> float:
    return float(prepared.background_e[round(v_px), round(u_px)])


def _image_radius_px(u_px: float, v_px: float, flux_e: float, prepared: PreparedFrame) -> float:
    """Radius that the image of a source of this flux would have; 0 where no range can be had."""
    frame, calibration = prepared.frame, prepared.calibration
    flux_dn = flux_e * gain_dn_per_e(frame, calibration)
    ranged = range_from_flux(flux_dn, math.nan, u_px, v_px, frame.exposure_s, frame.gain, calibration)
    if not math.isfinite(ranged.range_m):
        return 0.0
    radius_rad = angular_radius_rad(ranged.range_m, calibration.source_radius_m)
    return image_radius_px(u_px, v_px, radius_rad, calibration)
