"""An estimator of one's own, to copy and change: it measures the brightest spot of each frame.

Run it over the frames of a folder, and score it against truth beside the estimators that are built in:

    nir-render perceive DIR --estimator my_estimator.py:brightest_spot
    nir-render report DIR

An estimator is a function of a frame (raw counts, exposure) and its camera's calibration that returns
detections. A frame holds nothing else: no truth, no other frame. Whatever Python can import may be used here.
"""

import numpy as np

from perception import Calibration, Detection, RawFrame
from perception.model.bearing import bearing_body
from perception.model.ranging import range_from_flux
from perception.model.sensor import electrons, gain_dn_per_e, noise_floor_e2
from perception.robust.large.aperture import aperture_flux

APERTURE_PX = 12.0
RING_PX = (16.0, 24.0)  # the background is measured between these radii


def brightest_spot(frame: RawFrame, calibration: Calibration) -> list[Detection]:
    """Range the brightest spot of a frame by the light within a circle around it."""
    # Counts become electrons above black level: photons arrive as electrons, noise is counted in them.
    image_e = electrons(frame, calibration)

    # Where: from the brightest pixel to the centroid of what stands out of the noise around it. Twice,
    # because the brightest pixel of a wide flare may lie anywhere in it.
    noise_e = noise_floor_e2(calibration, frame.gain) ** 0.5
    row, column = np.unravel_index(np.argmax(image_e), image_e.shape)
    u_px, v_px = float(column), float(row)
    reach = round(APERTURE_PX)
    for _ in range(2):
        top, left = max(0, round(v_px) - reach), max(0, round(u_px) - reach)
        near_e = image_e[top : round(v_px) + reach + 1, left : round(u_px) + reach + 1] - np.median(image_e)
        bright_e = np.where(near_e > 4.0 * noise_e, near_e, 0.0).astype(np.float64)
        rows, columns = np.indices(bright_e.shape)
        total_e = bright_e.sum()
        if total_e == 0.0:
            return []  # noise has a brightest pixel too
        u_px = left + float((columns * bright_e).sum() / total_e)
        v_px = top + float((rows * bright_e).sum() / total_e)

    # How much light: everything within the aperture, above the mean of the ring around it.
    light = aperture_flux(image_e, u_px, v_px, APERTURE_PX, *RING_PX)
    if light.flux < 5.0 * light.flux_sigma:
        return []

    # How far: a source's light falls with the square of its distance; the calibration knows it at one metre.
    gain = gain_dn_per_e(frame, calibration)
    found = range_from_flux(
        light.flux * gain, light.flux_sigma * gain, u_px, v_px, frame.exposure_s, frame.gain, calibration
    )

    # In which direction, seen from the robot: x forward, y left, z up.
    x, y, z = bearing_body([[u_px, v_px]], calibration)[0]

    lit_e = image_e[top : top + len(bright_e), left : left + bright_e.shape[1]][bright_e > 0.0]
    return [
        Detection(
            camera=frame.camera,
            index=frame.index,
            time_s=frame.time_s,
            u_px=u_px,
            v_px=v_px,
            u_sigma_px=np.nan,  # NaN: no claim is made
            v_sigma_px=np.nan,
            flux_dn=light.flux * gain,
            mean_dn=frame.black_level_dn + float(lit_e.mean()) * gain,
            background_dn=frame.black_level_dn + light.background * gain,
            area_px=lit_e.size,
            saturated=bool(frame.data_dn[row, column] >= calibration.saturation_dn),
            merged=False,
            ghost=False,
            range_m=found.range_m,
            range_sigma_m=found.range_sigma_m,
            bearing_body=(x, y, z),
        )
    ]
