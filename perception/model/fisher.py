"""The physical limit: how well any unbiased estimator could place and range a flare (Cramér–Rao)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import PixelBox, image_radius_px
from perception.model.layout import Layout, Structure, View, even
from perception.model.pixels import expectation
from perception.model.ranging import angular_radius_rad
from perception.model.sensor import clip_level_e, noise_floor_e2, pixel_variance_e2
from perception.model.window import Camera, lay_out
from perception.types import Calibration

WIDE_PX = 64.0
"""Images larger than this, sources within arm's length, have their limit in closed form."""

_RIM_PX = 8.0
_LEAST_TELLING = 1e-9


@dataclass(frozen=True)
class FlareLimit:
    """Least standard deviations of one flare; infinite where the pixels cannot tell.

    `range_sigma_m` knows that the range sets flux and size, and of the σ that the calibration states of its
    range constant, its sources' radius and its point spread.
    """

    u_sigma_px: float
    v_sigma_px: float
    flux_sigma_e: float
    range_sigma_m: float


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


def censored_weight(
    expected_e: NDArray[np.float64], variance_e2: NDArray[np.float64], clip_e: float
) -> NDArray[np.float64]:
    """Share of its information that a pixel keeps which is clipped at a level: 1 far below, 0 far above.

    Of x ~ Normal(λ, σ²) told as min(x, c): Φ(z) - z φ(z) + φ(z)² / Q(z), z = (c - λ) / σ (the variance of the
    score of a censored normal variable; Cohen, Ann. Math. Stat. 21, 557, 1950).
    """
    from scipy.special import log_ndtr, ndtr

    z = np.clip((clip_e - expected_e) / np.sqrt(variance_e2), -38.0, 38.0)
    log_density = -0.5 * z**2 - 0.5 * math.log(2.0 * math.pi)
    kept = ndtr(z) - z * np.exp(log_density) + np.exp(2.0 * log_density - log_ndtr(-z))
    return np.asarray(np.clip(kept, 0.0, 1.0))


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
    relative = math.hypot(flux_sigma / flux_e, Camera(calibration, 1.0, 1.0).flux_spread)
    return FlareLimit(math.nan, math.nan, flux_sigma, 0.5 * range_m * relative)


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
    """Cramér–Rao bound of one flare; see `flare_limits`."""
    (limit,) = flare_limits(
        calibration, [(u_px, v_px, range_m, flux_e)], background_e, clipped_tell_nothing=clipped_tell_nothing
    )
    return limit


def flare_limits(
    calibration: Calibration,
    flares: Sequence[tuple[float, float, float, float]],
    background_e: float,
    *,
    clipped_tell_nothing: bool = True,
    structure: Structure | None = None,
) -> list[FlareLimit]:
    """Cramér–Rao bounds of flares in one another's light: places, ranges and the background are all unknown.

    λ = Σ F·S(u, v, ρ) + B electrons in a pixel (`model.window`), with variance λ + σ_read² + 1/(12 K²) (shot
    noise, read noise, rounding). Range sets flux and size together; priors are those of the calibration.

    Parameters
    ----------
    calibration
        Camera and sources.
    flares
        u_px, v_px, range_m and flux_e of each: the projection of its centre, which may lie outside the frame,
        its distance, and the electrons in the whole image of it.
    background_e
        B, electrons per pixel.
    clipped_tell_nothing
        Count pixels as clipped where the camera would clip them: they tell no more than that they are.
    structure
        What else may lie on the background, for a window of `limit_box`.

    Returns
    -------
    The bound of each.

    Raises
    ------
    ValueError
        If a range or flux is not positive.
    """
    place = np.array(flares, dtype=np.float64).reshape(-1, 4)
    if not (place[:, 2:] > 0.0).all():
        raise ValueError(f"range_m and flux_e must be positive, not {place[:, 2:].tolist()}")
    radius_rad = angular_radius_rad(place[:, 2], calibration.source_radius_m)
    radius_px = image_radius_px(place[:, 0], place[:, 1], radius_rad, calibration)
    if (radius_px > WIDE_PX).any():
        return [
            _wide_limit(calibration, *flare[2:], background_e, float(angle))
            if radius > WIDE_PX
            else flare_limit(calibration, *flare, background_e, clipped_tell_nothing=clipped_tell_nothing)
            for flare, angle, radius in zip(flares, radius_rad, radius_px, strict=True)
        ]
    box = limit_box(calibration, flares)
    nothing = [FlareLimit(math.inf, math.inf, math.inf, math.inf)] * len(flares)
    camera = Camera(calibration, 1.0, 1.0)
    log_range, pixels = np.log(place[:, 2]), box.height * box.width
    sources, imaged = lay_out(camera, place[:, 0], place[:, 1], log_range)
    if not imaged.all() or pixels == 0:
        return nothing
    clip_e = clip_level_e(calibration, calibration.black_level_dn) if clipped_tell_nothing else math.inf
    known, structure = camera.known(clip_e), structure or even(pixels)
    layout = known.layout(len(flares), len(structure.columns))
    values = np.zeros(layout.size)
    own = layout.of_sources(values)
    own[:, 0], own[:, 1], own[:, 2] = place[:, 0], place[:, 1], log_range
    values[layout.background] = background_e
    expected_e, variance_e2, jacobian = np.empty(pixels), np.empty(pixels), np.empty((layout.size, pixels))
    at_1_m = sources._replace(log_flux_at_1_m=np.log(place[:, 3]) + 2.0 * log_range)
    blank = np.zeros((box.height, box.width))
    view = View(box.top, box.left, blank, blank.astype(np.uint8), noise_floor_e2(calibration))
    expectation(values, view, at_1_m, structure, known, expected_e, jacobian, variance_e2)
    telling = np.ones(pixels)
    if clipped_tell_nothing:
        telling = censored_weight(expected_e, variance_e2, clip_e)
    used = telling > _LEAST_TELLING
    information = fisher_information(jacobian[:, used], variance_e2[used] / telling[used])
    inverse = covariance(information + layout.prior(structure))
    return nothing if inverse is None else _limits(camera, layout, place, inverse)


def limit_box(calibration: Calibration, flares: Sequence[tuple[float, float, float, float]]) -> PixelBox:
    """Return the pixels whose light a bound counts: up to 8 σ from the flares, and a rim.

    Beyond they tell of the background only, and a rim that wide tells that well enough.
    """
    place = np.array(flares, dtype=np.float64).reshape(-1, 4)
    radius_rad = angular_radius_rad(place[:, 2], calibration.source_radius_m)
    radius_px = np.nan_to_num(image_radius_px(place[:, 0], place[:, 1], radius_rad, calibration))
    reach_px = radius_px + 8.0 * calibration.psf_sigma_px + _RIM_PX
    size = (calibration.height_px, calibration.width_px)
    edges = []
    for at, length in ((place[:, 1], size[0]), (place[:, 0], size[1])):
        first = max(0, math.floor(float((at - reach_px).min()) + 0.5))
        last = min(length, math.floor(float((at + reach_px).max()) + 0.5) + 1)
        edges.append((first, max(0, last - first)))
    (top, height), (left, width) = edges
    return PixelBox(top, left, height, width)


def _limits(
    camera: Camera, layout: Layout, place: NDArray[np.float64], inverse: NDArray[np.float64]
) -> list[FlareLimit]:
    """Return the bounds that a covariance of all unknowns holds."""
    limits, step = [], layout.per_source
    ranged = camera.calibration.range_constant_dn_m2_per_s > 0.0
    for index, (_, _, range_m, flux_e) in enumerate(place.tolist()):
        own = inverse[index * step : (index + 1) * step, index * step : (index + 1) * step]
        slack = np.zeros(()) if layout.has_slack else None
        _, log_sigma, _ = camera.log_range(np.zeros(()), slack, own[2:, 2:])
        u_sigma, v_sigma, l_sigma = np.sqrt(np.diagonal(own)[:3]).tolist()
        # Without a range constant there is no range to be had from whatever is seen.
        range_sigma_m = range_m * float(log_sigma) if ranged else math.inf
        limits.append(FlareLimit(u_sigma, v_sigma, 2.0 * l_sigma * flux_e, range_sigma_m))
    return limits
