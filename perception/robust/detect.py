"""The robust detector: flares found against the noise of one frame, and measured by maximum likelihood."""

import math

import numpy as np

from perception.model.bearing import bearing_body
from perception.model.sensor import check_frame, gain_dn_per_e
from perception.robust.clusters import brightest, candidates, clusters, is_extended
from perception.robust.measure import MeasuredFlare, measure
from perception.robust.search.blobs import Blob, blobs_at, split_at_peaks
from perception.robust.search.cutout import ring_median
from perception.robust.search.frame import filtered
from perception.robust.search.prepare import PreparedFrame, prepare
from perception.types import Calibration, Detection, RawFrame

CONTRAST_SIGMAS = 6.03
"""As for detection against the coarse background: Gaussian noise passes 8e-10 of the time."""

MOST_FLARES = 1000
"""The robust detector measures no more blobs of a frame than this, the brightest: it bounds the time."""

_RING_PX = 4
_FEWEST_RING_PIXELS = 8


def detect_robust(frame: RawFrame, calibration: Calibration) -> list[Detection]:
    """Flares found against the local background and measured by maximum likelihood.

    Counts become electrons; a background on a coarse mesh is subtracted; the rest is matched to the image of
    a point and compared with the level that noise alone passes once in a thousand frames. Each component
    is fitted with the image of a source of known size and strength, or with those of several.

    Parameters
    ----------
    frame
        A raw frame.
    calibration
        Its camera's calibration.

    Returns
    -------
    Detections
        From top to bottom. `area_px` and `mean_dn` are those of the pixels above the detection limit.
        `saturated`: a pixel is clipped, which counts as censored. Where that does not determine the range
        `range_sigma_m` is NaN; of a disc too large to be fitted the flux is a lower bound, too, and the range
        an upper one. Flares that overlap are fitted together (`deblend`), and their sigmas know of it; behind
        a rolling shutter a blob stays one. `merged`: what is seen does not look like one source, nor like
        several that can be told apart; its sigmas are then widened by √χ². `ghost` is never set: one frame
        cannot tell a mirror image from a source. What is no source by its shape, size or brightness is left
        out, and so is what does not stand out from what lies right beside it, and all but the brightest
        thousand.

    Raises
    ------
    ValueError
        If frame and calibration do not belong together (`sensor.check_frame`).
    """
    check_frame(frame, calibration)
    prepared = prepare(frame, calibration)
    blobs = [
        blob
        for component in blobs_at(prepared.lit_at, prepared.lit_e, calibration.width_px)
        for blob in _split(component, prepared)
        if _stands_above_surroundings(blob, prepared)
    ]
    flares = [each for each in candidates(blobs, prepared) if not is_extended(each, prepared)]
    measured = measure(clusters(brightest(flares, MOST_FLARES), prepared), prepared)
    measured.sort(key=lambda each: (each[0].box.top, each[0].box.left))
    reported = [(blob, found) for blob, found in measured if found.stands_out]
    if not reported:
        return []
    bearings = bearing_body([[found.u_px, found.v_px] for _, found in reported], calibration).tolist()
    return [
        _detection(blob, found, (x, y, z), frame, calibration)
        for (blob, found), (x, y, z) in zip(reported, bearings, strict=True)
    ]


def _stands_above_surroundings(blob: Blob, prepared: PreparedFrame) -> bool:
    """Tell whether a blob's peak exceeds the level of a ring around it by more than noise does.

    The sheen of a lamp on metal, or a wall's lit corner, bends within a cell of the background mesh; on the
    slope that is left, noise alone passes the detection limit. The ring lies just outside the PSF's reach and
    takes that slope with it. Its median is blind to other flares in less than half of it.

    Parameters
    ----------
    blob
        The blob.
    prepared
        The frame it was found in.

    Returns
    -------
    True also where the frame's edges leave too little of the ring.
    """
    box = blob.box
    inner = box.with_margin(math.ceil(3.0 * prepared.calibration.psf_sigma_px) + 1)
    outer = inner.with_margin(_RING_PX).inside(prepared.shape)
    around_e = filtered(prepared.pixels, prepared.kernel, prepared.bad_at, outer.corner_and_size)
    level_e, count = ring_median(around_e, inner.seen_from(outer).corner_and_size)
    if count < _FEWEST_RING_PIXELS:
        return True
    middle_e = prepared.background_e(box.left + 0.5 * box.width, box.top + 0.5 * box.height)
    noise_e = prepared.filtered_noise * math.sqrt(max(level_e + middle_e, 0.0) + prepared.floor_e2)
    return blob.peak_e - level_e > CONTRAST_SIGMAS * noise_e


def _split(component: Blob, prepared: PreparedFrame) -> list[Blob]:
    """Divide a component at maxima that differ by more than their noise."""
    box = component.box
    middle_e = prepared.background_e(box.left + 0.5 * box.width, box.top + 0.5 * box.height)
    expected_e = np.maximum(component.filtered_e + np.float32(middle_e), np.float32(0.0))
    noise_e = np.sqrt(expected_e + np.float32(prepared.floor_e2)) * np.float32(prepared.filtered_noise)
    return split_at_peaks(component, noise_e)


def _detection(
    blob: Blob,
    measured: MeasuredFlare,
    bearing: tuple[float, float, float],
    frame: RawFrame,
    calibration: Calibration,
) -> Detection:
    gain = gain_dn_per_e(frame, calibration)
    return Detection(
        camera=frame.camera,
        index=frame.index,
        time_s=frame.time_s,
        u_px=measured.u_px,
        v_px=measured.v_px,
        u_sigma_px=measured.u_sigma_px,
        v_sigma_px=measured.v_sigma_px,
        flux_dn=measured.flux_e * gain,
        mean_dn=float(frame.data_dn[blob.box.slices][blob.pixels].mean()),
        background_dn=frame.black_level_dn + measured.background_e * gain,
        area_px=blob.area_px,
        saturated=measured.saturated,
        merged=measured.misfit,
        ghost=False,
        range_m=measured.range_m,
        range_sigma_m=measured.range_sigma_m,
        bearing_body=bearing,
        flux_sigma_dn=measured.flux_sigma_e * gain,
        range_sigma_common_m=measured.range_sigma_common_m,
    )
