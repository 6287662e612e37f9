"""From a blob to its place, flux and range: the fit, and what to do where it cannot be had."""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import PixelBox, image_radius_px
from perception.model.ranging import angular_radius_rad, range_from_flux
from perception.model.sensor import clip_level_e, gain_dn_per_e, saturation_dn
from perception.robust.blobs import Blob
from perception.robust.fit import aperture_flux, core_goodness
from perception.robust.prepare import PreparedFrame
from perception.robust.source_fit import SourceFit, fit_source

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
    range is known. `expected_e`: electrons in each pixel of the candidate's window by a lone flare's fit.
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
    saturated: bool = False
    misfit: bool = False
    expected_e: NDArray[np.float64] | None = None

    @property
    def stands_out(self) -> bool:
        """Whether its flux exceeds the background right beside it by 4 σ (a clipped one always does).

        What only the coarse background made look bright, such as the border of a shadow, does not. A blob
        that does not look like a source must exceed 10 σ: overlapping flares bright enough to show it do.
        """
        least = 10.0 if self.misfit else 4.0
        return self.saturated or (self.flux_e > 0.0 and not self.flux_e < least * self.flux_sigma_e)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A blob with what must be known of it before it is measured.

    Attributes
    ----------
    blob
        The flare's pixels.
    window
        The blob's box and enough around it to hold the rest of the PSF and a rim of background.
    clipped
        The window's clipped pixels, shape (height, width).
    u_px, v_px
        Centroid of the blob, weighted by what exceeds the background.
    flux_e
        Sum of what exceeds the background in the blob.
    image_radius_px
        Radius that the image of a source of this flux would have; 0 where no range can be had.
    """

    blob: Blob
    window: PixelBox
    clipped: NDArray[np.bool_]
    u_px: float
    v_px: float
    flux_e: float
    image_radius_px: float


def candidate(blob: Blob, prepared: PreparedFrame) -> Candidate:
    """Look at a blob: its window, its centroid and flux, and how large a source of that flux would look."""
    window = _window(blob, prepared)
    clipped_dn = saturation_dn(prepared.calibration, prepared.frame.gain)
    clipped = np.asarray(prepared.frame.data_dn[window.slices] >= clipped_dn)
    u_px, v_px, flux_e = _moments(blob, prepared)
    radius_px = _image_radius_px(u_px, v_px, flux_e, prepared)
    return Candidate(blob, window, clipped, u_px, v_px, flux_e, radius_px)


def is_extended(candidate: Candidate, prepared: PreparedFrame) -> bool:
    """Whether a blob is far larger than a source of its flux: a lit wall's edge, a window, a lamp tube.

    Flux tells the range, range the size. The area above half of the maximum (which the PSF's faint tail does
    not reach) may be four times what a source would cover, so that flares that overlap are kept. Clipped
    blobs are never called extended, for neither their flux nor their half maximum is known.
    """
    if bool(np.any(candidate.clipped)):
        return False
    brightness = prepared.filtered_e[candidate.blob.box.slices][candidate.blob.pixels]
    half_area = int(np.sum(brightness > 0.5 * brightness.max()))
    # Half maximum of a Gaussian filtered with itself lies at √(2 ln 2) · √2 σ = 1.67 σ.
    smooth_px = math.sqrt(prepared.calibration.psf_sigma_px**2 + 1.0 / 12.0)
    return half_area > 4.0 * math.pi * (candidate.image_radius_px + 1.67 * smooth_px) ** 2 + 8.0


def measure(candidate: Candidate, prepared: PreparedFrame) -> Measurement:
    """Measure one blob; the pixels of all others are left out.

    A source of known size and strength is fitted to the window around the blob. Where no fit is to be had
    the flux comes from an aperture; that of a clipped flare is then a lower bound.

    Parameters
    ----------
    candidate
        The flare's pixels, and what is known of them.
    prepared
        The frame.

    Returns
    -------
    Measurement
    """
    window = candidate.window
    blob_mask = mask_in(window, candidate.blob)
    saturated = bool(np.any(candidate.clipped & blob_mask))
    free = ~dilated(np.asarray(prepared.lit[window.slices] & ~blob_mask), 2)
    too_large = candidate.image_radius_px > MAX_IMAGE_RADIUS_PX

    if candidate.flux_e > 0.0 and not too_large:
        fit = _fit(candidate, free, prepared)
        if fit is not None:
            good = core_goodness(
                prepared.image_e[window.slices],
                fit.fit.expected_e,
                fit.fit.background_e,
                fit.fit.used,
                prepared.floor_e2,
                MODEL_ERROR,
            )
            misfit = good.probability < MISFIT_PROBABILITY
            recovered = not misfit and fit.flux_sigma_e < CLIPPED_FLUX_SIGMA * fit.fit.flux_e
            if recovered or not saturated:
                widening = math.sqrt(good.chi2 / good.pixels) if misfit else 1.0
                return replace(
                    _from_fit(fit, widening, prepared),
                    saturated=saturated,
                    misfit=misfit,
                    expected_e=fit.fit.expected_e,
                )

    bound = _from_aperture(candidate, free, prepared)
    if saturated:
        unknown = math.nan
        return replace(bound, u_sigma_px=unknown, v_sigma_px=unknown, range_sigma_m=unknown, saturated=True)
    return replace(bound, misfit=not too_large)


def _fit(candidate: Candidate, free: NDArray[np.bool_], prepared: PreparedFrame) -> SourceFit | None:
    """Fit a source to the free pixels of the window.

    To leave out clipped pixels alone would choose pixels by their own noise and bias what remains. So at
    first their neighbours are left out too, and then, instead, all pixels that the first fit puts within 3 σ
    of the clip level.
    """
    frame, calibration = prepared.frame, prepared.calibration
    clipped = candidate.clipped

    def attempt(
        usable: NDArray[np.bool_], place: tuple[float, float, float], fluxes_e: list[float]
    ) -> SourceFit | None:
        return fit_source(
            prepared.image_e[candidate.window.slices],
            usable,
            candidate.window,
            calibration,
            place=place,
            first_fluxes_e=fluxes_e,
            exposure_s=frame.exposure_s,
            gain=frame.gain,
            max_image_radius_px=1.6 * MAX_IMAGE_RADIUS_PX,
        )

    u_px, v_px = candidate.u_px, candidate.v_px
    place = (u_px, v_px, float(prepared.background_e[round(v_px), round(u_px)]))
    first = attempt(free & ~dilated(clipped, 1), place, _first_fluxes(candidate, prepared))
    if first is None or not clipped.any():
        return first
    fit = first.fit
    noise_e = np.sqrt(np.maximum(fit.expected_e, 0.0) + prepared.floor_e2)
    below_clip = fit.expected_e < clip_level_e(calibration, frame.black_level_dn, frame.gain) - 3.0 * noise_e
    return attempt(free & ~clipped & below_clip, (fit.u_px, fit.v_px, fit.background_e), [fit.flux_e])


def _first_fluxes(candidate: Candidate, prepared: PreparedFrame) -> list[float]:
    """Fluxes to start from: of a flare that the frame's edge cuts, the part seen may be half or less."""
    rows, columns = prepared.image_e.shape
    box, flux_e = candidate.blob.box, candidate.flux_e
    cut = box.top == 0 or box.left == 0 or box.top + box.height == rows or box.left + box.width == columns
    return [flux_e, 2.0 * flux_e, 4.0 * flux_e] if cut else [flux_e]


def _from_fit(source: SourceFit, widening: float, prepared: PreparedFrame) -> Measurement:
    """Turn a fit into a measurement, its sigmas wider by a factor."""
    fit, gain = source.fit, gain_dn_per_e(prepared.frame, prepared.calibration)
    sigmas_px = (source.u_sigma_px * widening, source.v_sigma_px * widening)
    flux = (fit.flux_e, fit.flux_sigma_e * widening, fit.background_e)
    # Of the range, also what the size assumed adds.
    return measurement_of(
        (fit.u_px, fit.v_px), sigmas_px, flux, source.flux_sigma_e * gain * widening, prepared
    )


def _from_aperture(candidate: Candidate, free: NDArray[np.bool_], prepared: PreparedFrame) -> Measurement:
    """Sum what exceeds a ring around the blob, at its centroid."""
    blob, window = candidate.blob, candidate.window
    u_px, v_px = candidate.u_px, candidate.v_px
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
    flux = (aperture.flux, aperture.flux_sigma, aperture.background)
    flux_sigma_dn = aperture.flux_sigma * gain_dn_per_e(prepared.frame, prepared.calibration)
    sigmas_px = _centroid_sigmas(candidate, aperture.flux, prepared)
    return measurement_of((u_px, v_px), sigmas_px, flux, flux_sigma_dn, prepared)


def measurement_of(
    place: tuple[float, float],
    place_sigmas_px: tuple[float, float],
    flux: tuple[float, float, float],
    range_flux_sigma_dn: float,
    prepared: PreparedFrame,
) -> Measurement:
    """Range a flux, given in electrons with its sigma and the background, and put all together."""
    (u_px, v_px), (flux_e, flux_sigma_e, background_e) = place, flux
    frame, calibration = prepared.frame, prepared.calibration
    flux_dn = flux_e * gain_dn_per_e(frame, calibration)
    ranged = range_from_flux(
        flux_dn, range_flux_sigma_dn, u_px, v_px, frame.exposure_s, frame.gain, calibration
    )
    return Measurement(
        u_px=u_px,
        v_px=v_px,
        u_sigma_px=place_sigmas_px[0],
        v_sigma_px=place_sigmas_px[1],
        flux_e=flux_e,
        flux_sigma_e=flux_sigma_e,
        background_e=background_e,
        range_m=ranged.range_m,
        range_sigma_m=ranged.range_sigma_m,
    )


def _window(blob: Blob, prepared: PreparedFrame) -> PixelBox:
    margin = math.ceil(4.0 * prepared.calibration.psf_sigma_px) + 4
    rows, columns = prepared.image_e.shape
    top, left = max(0, blob.box.top - margin), max(0, blob.box.left - margin)
    bottom = min(rows, blob.box.top + blob.box.height + margin)
    right = min(columns, blob.box.left + blob.box.width + margin)
    return PixelBox(top, left, bottom - top, right - left)


def mask_in(window: PixelBox, blob: Blob) -> NDArray[np.bool_]:
    """Mark the blob's pixels in a mask over a window that holds it."""
    mask = np.zeros((window.height, window.width), dtype=bool)
    top, left = blob.box.top - window.top, blob.box.left - window.left
    mask[top : top + blob.box.height, left : left + blob.box.width] = blob.pixels
    return mask


def dilated(mask: NDArray[np.bool_], by_px: int) -> NDArray[np.bool_]:
    """Widen a mask by some pixels in each direction, corners too."""
    import cv2

    if not mask.any():
        return mask
    kernel = np.ones((2 * by_px + 1, 2 * by_px + 1), dtype=np.uint8)
    return np.asarray(cv2.dilate(mask.view(np.uint8), kernel), dtype=bool).reshape(mask.shape)


def _moments(blob: Blob, prepared: PreparedFrame) -> tuple[float, float, float]:
    """Centroid (u, v), weighted by what exceeds the background, and its sum in electrons."""
    box = blob.box.slices
    excess = (prepared.image_e[box] - prepared.background_e[box])[blob.pixels].astype(np.float64)
    weight = np.maximum(excess, 0.0)
    if not weight.sum() > 0.0:
        weight = np.ones_like(excess)
    rows, columns = np.nonzero(blob.pixels)
    u_px = blob.box.left + float(np.average(columns, weights=weight))
    v_px = blob.box.top + float(np.average(rows, weights=weight))
    return u_px, v_px, float(excess.sum())


def _centroid_sigmas(candidate: Candidate, flux_e: float, prepared: PreparedFrame) -> tuple[float, float]:
    """Compute the centroid's standard deviations: √(Σ (x - x̄)² variance) / flux along each axis."""
    if not flux_e > 0.0:
        return math.nan, math.nan
    blob, u_px, v_px = candidate.blob, candidate.u_px, candidate.v_px
    variance = np.maximum(prepared.image_e[blob.box.slices][blob.pixels], 0.0) + prepared.floor_e2
    rows, columns = np.nonzero(blob.pixels)
    return (
        math.sqrt(float(np.sum((blob.box.left + columns - u_px) ** 2 * variance))) / flux_e,
        math.sqrt(float(np.sum((blob.box.top + rows - v_px) ** 2 * variance))) / flux_e,
    )


def _image_radius_px(u_px: float, v_px: float, flux_e: float, prepared: PreparedFrame) -> float:
    frame, calibration = prepared.frame, prepared.calibration
    flux_dn = flux_e * gain_dn_per_e(frame, calibration)
    ranged = range_from_flux(flux_dn, math.nan, u_px, v_px, frame.exposure_s, frame.gain, calibration)
    if not math.isfinite(ranged.range_m):
        return 0.0
    radius_rad = angular_radius_rad(ranged.range_m, calibration.source_radius_m)
    return image_radius_px(u_px, v_px, radius_rad, calibration)
