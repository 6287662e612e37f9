"""From photometry to range: the law of the integrated flux."""

import math
from dataclasses import dataclass

import numpy as np

from perception.model.bearing import field_angle_rad
from perception.types import Calibration


@dataclass(frozen=True)
class Range:
    """A range and its standard deviation; NaN where there is none."""

    range_m: float
    range_sigma_m: float


def effective_exposure_s(
    u_px: float, v_px: float, exposure_s: float, gain: float, calibration: Calibration
) -> float:
    """Exposure that would give as much flux at unit gain on the axis: t g cos θ · response(θ).

    The lens's aperture is seen tilted, and the response (filter, vignetting) changes with the field angle θ.
    The response is taken at the centre of the source. NaN beyond the last angle of the response table: it is
    not extrapolated.
    """
    theta = float(field_angle_rad([[u_px, v_px]], calibration)[0])
    response = float(
        np.interp(
            theta,
            calibration.response_angle_rad,
            calibration.response_relative,
            left=math.nan,
            right=math.nan,
        )
    )
    return exposure_s * gain * math.cos(theta) * response


def flux_at_one_metre_dn(
    u_px: float, v_px: float, exposure_s: float, gain: float, calibration: Calibration
) -> float:
    """Integrated flux, in counts, that a source one metre away in the direction of a pixel would give.

    K times `effective_exposure_s`; NaN where that is.
    """
    return calibration.range_constant_dn_m2_per_s * effective_exposure_s(
        u_px, v_px, exposure_s, gain, calibration
    )


def range_from_flux(
    flux_dn: float,
    flux_sigma_dn: float,
    u_px: float,
    v_px: float,
    exposure_s: float,
    gain: float,
    calibration: Calibration,
) -> Range:
    """Range from the background-subtracted integrated flux F.

    d = √(K t g cos θ · response(θ) / F), σ_d = d/2 · √((σ_F/F)² + (σ_K/K)²).

    The square root bends, so noise in F alone makes d too large on average, by the factor 1 + ⅜ (σ_F/F)²
    (second order of F^(-1/2)); it is divided out. An error in K is the same in every frame, so it widens
    the sigma but has no mean to correct.

    Parameters
    ----------
    flux_dn, flux_sigma_dn
        Flux and its standard deviation in counts. An unknown sigma (NaN) leaves the range uncorrected.
    u_px, v_px
        Where the flare is.
    exposure_s, gain
        Exposure time, and gain of the frame relative to the calibrated one.
    calibration
        K is `range_constant_dn_m2_per_s`, σ_K its entry in `sigma`.

    Returns
    -------
    Range
        NaN for flux that is not positive, or a direction beyond the response table.
    """
    at_one_metre_dn = flux_at_one_metre_dn(u_px, v_px, exposure_s, gain, calibration)
    if not (flux_dn > 0.0 and at_one_metre_dn > 0.0):
        return Range(math.nan, math.nan)
    relative = flux_sigma_dn / flux_dn
    constant_relative = (
        calibration.sigma.get("range_constant_dn_m2_per_s", 0.0) / calibration.range_constant_dn_m2_per_s
    )
    range_m = math.sqrt(at_one_metre_dn / flux_dn)
    if math.isfinite(relative):
        range_m /= 1.0 + 0.375 * relative**2
    return Range(range_m, 0.5 * range_m * math.hypot(relative, constant_relative))


def angular_radius_rad(range_m: float, source_radius_m: float) -> float:
    """Angular radius of a sphere, asin(r / d), d the distance of its centre.

    A distance below 1.05 r counts as 1.05 r: a trial value of a fit may put the camera inside the source.

    Examples
    --------
    >>> round(angular_radius_rad(2.0, 0.01), 6)
    0.005
    """
    return math.asin(source_radius_m / max(range_m, 1.05 * source_radius_m)) if source_radius_m > 0.0 else 0.0
