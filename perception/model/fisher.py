"""The physical limit: how well any unbiased estimator could place and range a flare (Cramér–Rao)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import FlareImage, PixelBox, flare_image, has_image, image_radius_px
from perception.model.ranging import angular_radius_rad
from perception.model.sensor import clip_level_e, noise_floor_e2, pixel_variance_e2
from perception.types import Calibration

WIDE_PX = 64.0
"""Images larger than this, sources within arm's length, have their limit in closed form."""


@dataclass(frozen=True)
class FlareLimit:
    """Least standard deviations of one flare; infinite where the pixels cannot tell.

    `range_sigma_m` is d/2 · σ_F/F: of the photometry alone, the range constant taken as exact.
    """

    u_sigma_px: float
    v_sigma_px: float
    flux_sigma_e: float
    range_sigma_m: float


def flare_jacobian(image: FlareImage, flux_e: float) -> NDArray[np.float64]:
    """Differentiate λ = F·S + B by (u, v, F, B); shape (4, height, width)."""
    return np.stack([flux_e * image.d_du, flux_e * image.d_dv, image.fraction, np.ones_like(image.fraction)])


def fisher_information(
    jacobian: NDArray[np.float64], variance_e2: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Fisher information I_ij = Σ_px ∂_iλ ∂_jλ / variance.

    With variance λ + σ² this is exact for the shifted Poisson likelihood, x + σ² ~ Poisson(λ + σ²) (Snyder,
    Helstrom, Lanterman, Faisal, White, J. Opt. Soc. Am. A 12, 272, 1995), and for a Gaussian of that
    variance it leaves out only what the variance itself tells, of order 1/λ.

    Parameters
    ----------
    jacobian
        Derivatives, shape (parameters, pixels).
    variance_e2
        Variance, shape (pixels,).

    Returns
    -------
    Information matrix, shape (parameters, parameters).
    """
    weighted = jacobian / variance_e2
    return np.asarray(weighted @ jacobian.T)


def covariance(information: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Inverse of an information matrix, or None where it is singular.

    It is scaled to a unit diagonal first: flux and position differ by many powers of ten.
    """
    diagonal = np.diagonal(information)
    if not (np.all(np.isfinite(information)) and np.all(diagonal > 0.0)):
        return None
    scale = 1.0 / np.sqrt(diagonal)
    scaled = information * np.outer(scale, scale)
    if np.linalg.cond(scaled) > 1e10:
        return None
    return np.asarray(np.linalg.inv(scaled) * np.outer(scale, scale))


def _wide_limit(
    calibration: Calibration, range_m: float, flux_e: float, background_e: float, angular_radius: float
) -> FlareLimit:
    """Bound of a disc so wide that its rim tells nothing more: σ_F² = F + n (B + σ²) over its n pixels.

    Its place is not asked for (NaN). A disc that is clipped all over tells nothing.
    """
    pixels = math.pi * (calibration.fx_px * math.tan(min(angular_radius, 1.5))) ** 2
    if flux_e / pixels + background_e >= clip_level_e(calibration, calibration.black_level_dn):
        return FlareLimit(math.nan, math.nan, math.inf, math.inf)
    lit_e = np.array(flux_e / pixels + max(background_e, 0.0))
    of_pixel_e2 = pixel_variance_e2(lit_e, noise_floor_e2(calibration), calibration.prnu)
    flux_sigma = math.sqrt(pixels * float(of_pixel_e2))
    return FlareLimit(math.nan, math.nan, flux_sigma, 0.5 * range_m * flux_sigma / flux_e)


def flare_limit(
    calibration: Calibration,
    u_px: float,
    v_px: float,
    range_m: float,
    flux_e: float,
    background_e: float,
    *,
    clipped_tell_nothing: bool = True,
) -> FlareLimit:
    """Cramér–Rao bound of (u, v, flux, background), all four unknown, for one flare.

    λ = F·S(u, v) + B electrons in a pixel, with variance λ + σ_read² + 1/(12 K²) (shot noise, read noise,
    rounding). The size of the image is taken as known.

    Parameters
    ----------
    calibration
        Camera and source.
    u_px, v_px
        Projection of the source's centre; it may lie outside the frame.
    range_m
        Distance of the centre; gives the angular radius asin(r / d).
    flux_e
        F, electrons in the whole image of the source.
    background_e
        B, electrons per pixel.
    clipped_tell_nothing
        Leave out pixels whose expected value is clipped.

    Returns
    -------
    FlareLimit

    Raises
    ------
    ValueError
        If range or flux is not positive.
    """
    if not (range_m > 0.0 and flux_e > 0.0):
        raise ValueError(f"range_m and flux_e must be positive, not {range_m} and {flux_e}")
    angular_radius = angular_radius_rad(range_m, calibration.source_radius_m)
    if image_radius_px(u_px, v_px, angular_radius, calibration) > WIDE_PX:
        return _wide_limit(calibration, range_m, flux_e, background_e, angular_radius)
    if not has_image(u_px, v_px, angular_radius, calibration):
        return FlareLimit(math.inf, math.inf, math.inf, math.inf)
    # Beyond 8 σ the pixels tell about the background only, and a ring that wide tells it well enough.
    half_px = image_radius_px(u_px, v_px, angular_radius, calibration) + 8.0 * calibration.psf_sigma_px + 8.0
    window = PixelBox.around(u_px, v_px, half_px, calibration)
    image = flare_image(u_px, v_px, angular_radius, window, calibration)
    expected_e = flux_e * image.fraction + background_e
    used = np.ones(expected_e.shape, dtype=bool)
    if clipped_tell_nothing:
        used = expected_e < clip_level_e(calibration, calibration.black_level_dn)
    variance_e2 = pixel_variance_e2(expected_e, noise_floor_e2(calibration), calibration.prnu)
    information = fisher_information(flare_jacobian(image, flux_e)[:, used], variance_e2[used])
    inverse = covariance(information)
    if inverse is None:
        return FlareLimit(math.inf, math.inf, math.inf, math.inf)
    u_sigma, v_sigma, flux_sigma, _ = np.sqrt(np.diagonal(inverse)).tolist()
    return FlareLimit(u_sigma, v_sigma, flux_sigma, 0.5 * range_m * flux_sigma / flux_e)
