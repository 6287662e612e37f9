"""From counts to electrons, and what the sensor adds on the way (EMVA 1288 linear model)."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perception.types import Calibration, RawFrame

_LEAST = {
    "psf_sigma_px": 1e-3, "system_gain_dn_per_e": 1e-12, "read_noise_e": 0.0, "dsnu_e": 0.0, "prnu": 0.0,
    "source_radius_m": 0.0,
}  # fmt: skip


def check_frame(frame: RawFrame, calibration: Calibration) -> None:
    """Refuse a frame that the calibration does not describe.

    Raises
    ------
    ValueError
        If the camera's name, the shape or the type of the counts differ, if exposure or gain are not
        positive, or if the calibration's point spread, gain, read noise or source radius cannot be.
    """
    where = f"frame {frame.index} of camera {frame.camera!r}"
    if frame.camera != calibration.camera:
        raise ValueError(f"{where} came with the calibration of camera {calibration.camera!r}")
    if frame.data_dn.dtype != np.uint16:
        raise ValueError(f"{where} holds {frame.data_dn.dtype} counts; raw counts are uint16")
    expected = (calibration.height_px, calibration.width_px)
    if frame.data_dn.shape != expected:
        raise ValueError(
            f"{where} has shape {frame.data_dn.shape}, its calibration says (rows, columns) = {expected}"
        )
    wrong = [
        f"{name} = {getattr(calibration, name)}"
        for name, least in _LEAST.items()
        if not least <= getattr(calibration, name) < math.inf
    ]
    wrong += [
        f"sigma of {k} = {sigma}" for k, sigma in calibration.sigma.items() if not 0.0 <= sigma < math.inf
    ]
    if wrong:
        raise ValueError(
            f"{where}: its calibration has {', '.join(wrong)}; wanted finite numbers, psf_sigma_px and "
            "system_gain_dn_per_e above 0, all else and every sigma 0 or more"
        )
    if not (0.0 < frame.exposure_s < math.inf and 0.0 < frame.gain < math.inf):
        raise ValueError(
            f"{where} has exposure_s = {frame.exposure_s} and gain = {frame.gain}; both must be positive"
        )
    if not math.isfinite(frame.black_level_dn):
        raise ValueError(f"{where} has black_level_dn = {frame.black_level_dn}; it must be a finite number")


def gain_dn_per_e(frame: RawFrame, calibration: Calibration) -> float:
    """System gain at which the frame was taken, in counts per electron."""
    return calibration.system_gain_dn_per_e * frame.gain


def without_offsets(frame: RawFrame, calibration: Calibration) -> RawFrame:
    """Take the pixels' known offsets off a frame; clipped pixels stay as they are.

    Detection, tracking and photometry take a frame whose offsets are off where its calibration knows them.
    """
    if calibration.offset_dn is None:
        return frame
    offset_dn = calibration.offset_dn
    if frame.gain != 1.0:
        offset_dn = np.rint(offset_dn * np.float32(frame.gain)).astype(np.int16)
    return _with_unclipped(frame, frame.data_dn.astype(np.int32) - offset_dn, calibration)


def without_response(
    frame: RawFrame, calibration: Calibration, pixel_response: NDArray[np.float64]
) -> RawFrame:
    """Divide a frame by its pixels' responses, shape (rows, columns); clipped pixels stay as they are."""
    light_dn = (frame.data_dn - frame.black_level_dn) / pixel_response
    return _with_unclipped(frame, np.rint(light_dn + frame.black_level_dn), calibration)


def _with_unclipped(frame: RawFrame, counts: NDArray[Any], calibration: Calibration) -> RawFrame:
    """Put other counts into pixels that are not clipped: what is must read so, and what is not must not."""
    clipped_dn = saturation_dn(calibration, frame.gain)
    free = np.clip(counts, 0, int(clipped_dn - 1)).astype(np.uint16)
    return replace(frame, data_dn=np.where(frame.data_dn >= clipped_dn, frame.data_dn, free))


def electrons(frame: RawFrame, calibration: Calibration) -> NDArray[np.float32]:
    """Turn counts above black level into electrons; float32, same shape as the frame."""
    scale = 1.0 / gain_dn_per_e(frame, calibration)
    image = frame.data_dn.astype(np.float32)
    image -= np.float32(frame.black_level_dn)
    image *= np.float32(scale)
    return image


def noise_floor_e2(calibration: Calibration, gain: float = 1.0) -> float:
    """Variance of a dark pixel, in electrons squared: read noise, fixed offsets, rounding to whole counts.

    σ_d² + DSNU² + 1 / (12 K²), EMVA 1288 release 4.0 (linear model), K the system gain in DN/e.

    Parameters
    ----------
    calibration
        Read noise, DSNU and system gain.
    gain
        Factor on the calibrated system gain.
    """
    rounding_e2 = 1.0 / (12.0 * (calibration.system_gain_dn_per_e * gain) ** 2)
    return calibration.read_noise_e**2 + calibration.dsnu_e**2 + rounding_e2


def summed_floor_e2(calibration: Calibration, frames: int, gain: float = 1.0) -> float:
    """Variance of a dark pixel of a sum of frames, in electrons squared; parameters as `noise_floor_e2`.

    Read noise and rounding grow with the number of frames, fixed offsets with its square.
    """
    rounding_e2 = 1.0 / (12.0 * (calibration.system_gain_dn_per_e * gain) ** 2)
    return frames * (calibration.read_noise_e**2 + rounding_e2) + (frames * calibration.dsnu_e) ** 2


def pixel_variance_e2(
    expected_e: NDArray[np.float64], floor_e2: float | NDArray[np.float64], prnu: float
) -> NDArray[np.float64]:
    """Variance of pixels that expect some electrons: max(λ, 0) + (PRNU λ)² + that of a dark pixel.

    An expectation below black level (an offset that drifted) has no negative shot noise.
    """
    lit_e = np.maximum(expected_e, 0.0)
    return np.asarray(lit_e + (prnu * lit_e) ** 2 + floor_e2)


def saturation_dn(calibration: Calibration, gain: float) -> int:
    """Count from which on a pixel is clipped, at a gain.

    Below full scale it is the full well that clips: its count rises with the gain, up to full scale.

    Parameters
    ----------
    calibration
        With the count at gain 1.
    gain
        Factor on the calibrated system gain.
    """
    full_scale_dn = max(2**calibration.bit_depth - 1, calibration.saturation_dn)
    above_black_dn = calibration.saturation_dn - calibration.black_level_dn
    return int(min(math.floor(calibration.black_level_dn + gain * above_black_dn), full_scale_dn))


def at_gain(calibration: Calibration, gain: float) -> Calibration:
    """Calibration of a camera that has a gain for good."""
    return replace(
        calibration,
        system_gain_dn_per_e=calibration.system_gain_dn_per_e * gain,
        saturation_dn=saturation_dn(calibration, gain),
    )


def clip_level_e(calibration: Calibration, black_level_dn: float, gain: float = 1.0) -> float:
    """Electrons at which a pixel is clipped, at a gain."""
    above_black_dn = saturation_dn(calibration, gain) - black_level_dn
    return above_black_dn / (calibration.system_gain_dn_per_e * gain)
