"""From photometry to range: the law of the integrated flux."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perception.model.bearing import angle_from_axis_rad, direction_camera, pixel_turn
from perception.types import Calibration

Array = NDArray[np.float64]

LEAST_LEFT = 0.05
"""At least so much of a source's flux is seen, however bright the background that it hides."""


@dataclass(frozen=True)
class Range:
    """A range and its standard deviation; NaN where there is none."""

    range_m: float
    range_sigma_m: float


def effective_exposure_s(
    u_px: ArrayLike, v_px: ArrayLike, exposure_s: float, gain: float, calibration: Calibration
) -> Array:
    """Exposure that would give as much flux at unit gain on the axis: t g cos θ · response(θ).

    The lens's aperture is seen tilted, and the response (filter, vignetting) changes with the field angle θ.
    The response is taken at the centre of the source. NaN beyond the last angle of the response table: it is
    not extrapolated. Places are numbers or arrays of one shape, which the result has.
    """
    places = np.stack(np.broadcast_arrays(u_px, v_px), axis=-1).astype(np.float64)
    direction = direction_camera(places.reshape(-1, 2), calibration).reshape(*places.shape[:-1], 3)
    return exposure_towards(direction, exposure_s, gain, calibration)


def exposure_towards(direction: Array, exposure_s: float, gain: float, calibration: Calibration) -> Array:
    """As `effective_exposure_s`, of unit directions in camera axes, shape (..., 3) → (...)."""
    response = np.interp(
        angle_from_axis_rad(direction),
        calibration.response_angle_rad,
        calibration.response_relative,
        left=math.nan,
        right=math.nan,
    )
    return np.asarray(exposure_s * gain * direction[..., 2] * response)


def flux_at_one_metre_dn(
    u_px: ArrayLike, v_px: ArrayLike, exposure_s: float, gain: float, calibration: Calibration
) -> Array:
    """Integrated flux, in counts, that a source one metre away in the direction of a pixel would give.

    K times `effective_exposure_s`; NaN where that is.
    """
    exposed_s = effective_exposure_s(u_px, v_px, exposure_s, gain, calibration)
    return np.asarray(calibration.range_constant_dn_m2_per_s * exposed_s)


def flux_e_of(exposed_s: Array, gain: float, calibration: Calibration) -> Array:
    """Electrons that a source one metre away gives in an effective exposure (`effective_exposure_s`)."""
    at_one_metre_dn = calibration.range_constant_dn_m2_per_s * exposed_s
    return np.asarray(at_one_metre_dn / (calibration.system_gain_dn_per_e * gain))


def constant_spread(calibration: Calibration) -> float:
    """Return the standard deviation of the range constant, relatively."""
    sigma = calibration.sigma.get("range_constant_dn_m2_per_s", 0.0)
    return sigma / calibration.range_constant_dn_m2_per_s


def range_from_flux(
    flux_dn: float,
    flux_sigma_dn: float,
    u_px: float,
    v_px: float,
    exposure_s: float,
    gain: float,
    calibration: Calibration,
    background_dn: float = 0.0,
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
    background_dn
        Of a pixel beside the flare: the flux lacks what the source hides of it (`covered_px_at_1_m`).

    Returns
    -------
    Range
        NaN for flux that is not positive, or a direction beyond the response table.
    """
    at_one_metre_dn = float(flux_at_one_metre_dn(u_px, v_px, exposure_s, gain, calibration))
    if not (flux_dn > 0.0 and at_one_metre_dn > 0.0):
        return Range(math.nan, math.nan)
    behind = 0.0  # background that the source stands before, over its own flux
    if background_dn > 0.0:
        covered = float(covered_px_at_1_m(np.array([[u_px, v_px]]), calibration)[0])
        behind = covered * background_dn / at_one_metre_dn
    hidden_sigma = behind * calibration.sigma.get("hidden_background", 0.0)
    at_one_metre_dn *= max(1.0 - behind * calibration.hidden_background, LEAST_LEFT)
    relative = flux_sigma_dn / flux_dn
    constant_relative = constant_spread(calibration)
    range_m = math.sqrt(at_one_metre_dn / flux_dn)
    if math.isfinite(relative):
        range_m /= 1.0 + 0.375 * relative**2
    return Range(range_m, 0.5 * range_m * math.hypot(relative, constant_relative, hidden_sigma))


def covered_px_at_1_m(places_px: Array, calibration: Calibration) -> Array:
    """How many pixels a source would cover from one metre: π r² over the solid angle of a pixel there.

    At d it covers 1/d² of that, as its flux is 1/d² of what it has at one metre: of a background it takes
    away the same share of its own flux at any range (`Calibration.hidden_background`). Of places of shape
    (n, 2); 0 where the radius is not known.
    """
    radius_m = calibration.source_radius_m
    if not radius_m > 0.0:
        return np.zeros(len(places_px))
    along_u, along_v = pixel_turn(places_px, calibration).swapaxes(0, 1)
    return np.asarray(math.pi * radius_m**2 / np.linalg.norm(np.cross(along_u, along_v), axis=1))


def brightness_e(places_px: Array, exposure_s: float, gain: float, calibration: Calibration) -> Array:
    """Electrons of a pixel that the image of a source covers: the same at any range.

    Of places of shape (n, 2) → (n,); infinite where sources are points, NaN where no range can be had.
    """
    exposed_s = exposure_towards(direction_camera(places_px, calibration), exposure_s, gain, calibration)
    with np.errstate(divide="ignore"):
        return flux_e_of(exposed_s, gain, calibration) / covered_px_at_1_m(places_px, calibration)


def angular_radius_rad(range_m: ArrayLike, source_radius_m: float) -> Array:
    """Angular radius of a sphere, asin(r / d), d the distance of its centre, a number or an array.

    A distance below 1.05 r counts as 1.05 r: a trial value of a fit may put the camera inside the source.

    Examples
    --------
    >>> round(float(angular_radius_rad(2.0, 0.01)), 6)
    0.005
    """
    distance_m = np.maximum(np.asarray(range_m, dtype=np.float64), 1.05 * source_radius_m)
    if not source_radius_m > 0.0:
        return np.zeros_like(distance_m)
    return np.asarray(np.arcsin(source_radius_m / distance_m))
