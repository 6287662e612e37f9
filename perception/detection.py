"""Flares in one raw frame, found and measured in two ways: as the paper does, and soundly."""

import math

import numpy as np
from numpy.typing import NDArray

from perception.bearing import bearing_body, bearing_body_paper
from perception.blobs import Blob, components, split_at_peaks
from perception.contrast import stands_above_surroundings
from perception.measurement import Measurement, is_extended, measure
from perception.photometry import grey_levels_paper
from perception.preparation import PreparedFrame, prepare
from perception.ranging import range_paper_m
from perception.sensor import check_frame, gain_dn_per_e, saturation_dn
from perception.types import Calibration, Detection, RawFrame

PAPER_MIN_AREA_PX = 5
"""The paper keeps A_k > 4."""

PAPER_ASPECT = (0.8, 1.2)

MAX_FLARES = 100
"""The robust detector measures no more blobs of a frame than this, the brightest: it bounds the time."""


def detect_paper(frame: RawFrame, calibration: Calibration) -> list[Detection]:
    """Flares as the paper finds and ranges them (its section "Grayscale-based Ranging"), to the letter.

    Pixels above twice the frame's mean grey value (raw: black level included), connected components of
    area > 4 px whose bounding box has an aspect within [0.8, 1.2]; range from the mean grey (eq. 1), bearing
    from the centroid (eq. cam_to_car).

    What the paper leaves open, and what is done here: components have 8 neighbours; the aspect is width /
    height, both ends included; the centroid is that of the blob's pixels, unweighted; N̄ comes from a ring
    (`photometry.grey_levels_paper`); the range constant is used as it is, whatever the frame's gain.

    Parameters
    ----------
    frame
        A raw frame.
    calibration
        Its camera's calibration.

    Returns
    -------
    Detections
        From top to bottom. The paper claims no uncertainty: all sigmas are NaN. `flux_dn` is
        (N_d - N̄) · area. `saturated` is set where a pixel of the blob is clipped; `merged` and `ghost`
        never.

    Raises
    ------
    ValueError
        If frame and calibration do not belong together (`sensor.check_frame`).
    """
    check_frame(frame, calibration)
    data = frame.data_dn
    lit = data > 2.0 * float(data.mean(dtype=np.float64))
    clipped_dn = saturation_dn(calibration, frame.gain)
    found = []
    for blob in components(lit, PAPER_MIN_AREA_PX):
        aspect = blob.box.width / blob.box.height
        if not PAPER_ASPECT[0] <= aspect <= PAPER_ASPECT[1]:
            continue
        grey = grey_levels_paper(data, blob.pixels, lit, blob.box)
        rows, columns = np.nonzero(blob.pixels)
        u_px, v_px = blob.box.left + float(columns.mean()), blob.box.top + float(rows.mean())
        found.append(
            Detection(
                camera=frame.camera,
                index=frame.index,
                time_s=frame.time_s,
                u_px=u_px,
                v_px=v_px,
                u_sigma_px=math.nan,
                v_sigma_px=math.nan,
                flux_dn=(grey.mean_dn - grey.background_dn) * blob.area_px,
                mean_dn=grey.mean_dn,
                background_dn=grey.background_dn,
                area_px=blob.area_px,
                saturated=bool(np.any(data[blob.box.slices][blob.pixels] >= clipped_dn)),
                merged=False,
                ghost=False,
                range_m=range_paper_m(grey.mean_dn, grey.background_dn, frame.exposure_s, calibration),
                range_sigma_m=math.nan,
                bearing_body=_vector(bearing_body_paper([[u_px, v_px]], calibration)),
            )
        )
    return found


def detect_robust(frame: RawFrame, calibration: Calibration) -> list[Detection]:
    """Flares found against the local background and measured by maximum likelihood.

    Counts become electrons; a background on a coarse mesh is subtracted; the rest is matched to the image of
    a point and compared with the level that noise alone passes once in a thousand frames. Each component
    (divided where it has several maxima) is fitted with the image of a source of known size and strength.

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
        `saturated`: a pixel is clipped; the rest is fitted, and where that does not determine the flux, the
        clipped flux is given as its lower bound, the range that follows is an upper bound, and
        `range_sigma_m` is NaN. `merged`: the flare shares its component with another, or does not look like
        one source; its sigmas are then widened by √χ². `ghost` is never set: one frame cannot tell a mirror
        image from a source. Blobs much larger than a source of their flux would be are left out,
        and so are those that do not stand out from what lies right beside them, and all but the brightest
        100.

    Raises
    ------
    ValueError
        If frame and calibration do not belong together (`sensor.check_frame`).
    """
    check_frame(frame, calibration)
    prepared = prepare(frame, calibration)
    blobs = [
        blob
        for component in components(prepared.lit)
        for blob in _parted(component, prepared)
        if stands_above_surroundings(blob, prepared) and not is_extended(blob, prepared)
    ]
    measured = [(blob, measure(blob, prepared)) for blob in _brightest(blobs, prepared.filtered_e)]
    return [_detection(blob, found, frame, calibration) for blob, found in measured if found.stands_out]


def _parted(component: Blob, prepared: PreparedFrame) -> list[Blob]:
    """Divide a component at maxima that differ by more than their noise."""
    box = component.box.slices
    brightness_e = prepared.filtered_e[box]
    expected_e = np.maximum(brightness_e + prepared.background_e[box], 0.0)
    noise_e = prepared.filtered_noise * np.sqrt(expected_e + prepared.floor_e2)
    return split_at_peaks(component, brightness_e, noise_e)


def _detection(blob: Blob, measured: Measurement, frame: RawFrame, calibration: Calibration) -> Detection:
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
        merged=blob.touching or measured.misfit,
        ghost=False,
        range_m=measured.range_m,
        range_sigma_m=measured.range_sigma_m,
        bearing_body=_vector(bearing_body([[measured.u_px, measured.v_px]], calibration)),
    )


def _brightest(blobs: list[Blob], brightness: NDArray[np.float32]) -> list[Blob]:
    """Keep the brightest blobs, in the order in which they are."""
    if len(blobs) <= MAX_FLARES:
        return blobs
    peaks = [float(brightness[blob.box.slices][blob.pixels].max()) for blob in blobs]
    kept = np.sort(np.argsort(peaks)[-MAX_FLARES:])
    return [blobs[index] for index in kept]


def _vector(rows: NDArray[np.float64]) -> tuple[float, float, float]:
    x, y, z = rows[0].tolist()
    return x, y, z
