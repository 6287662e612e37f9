"""The physical limit: how well any unbiased estimator could place and range a flare (Cramér–Rao)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import PixelBox, image_radius_px
from perception.model.layout import Layout, Structure, View, even
from perception.model.likelihood.pixels import expectation
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


@dataclass(frozen=True)
class RangeCauses:
    """What each cause brings to the least σ of a range, in metres: in quadrature they add up to it.

    The noise of pixels: shot noise of the flare's own light (`own_light_m`) and of the rest (`background_m`),
    unequal response (`prnu_m`), read noise, offsets (`dsnu_m`), the ADC's rounding. What the calibration says
    of its own σ: of the range constant, the source's radius, the point spread's width.
    """

    own_light_m: float
    background_m: float
    prnu_m: float
    read_noise_m: float
    dsnu_m: float
    rounding_m: float
    range_constant_m: float
    source_radius_m: float
    point_spread_m: float


@dataclass(frozen=True, eq=False)
class _Known:
    """What the pixels that tell anything, shape (pixels,), tell of flares; `inverse` has the priors in it.

    `used` are these among those of the box, shape (rows, columns).
    """

    camera: Camera
    box: PixelBox
    used: NDArray[np.bool_]
    layout: Layout
    jacobian: NDArray[np.float64]
    expected_e: NDArray[np.float64]
    variance_e2: NDArray[np.float64]
    telling: NDArray[np.float64]
    inverse: NDArray[np.float64]


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
    pixels = _pixels_of_disc(calibration, angular_radius)
    if flux_e / pixels + background_e >= clip_level_e(calibration, calibration.black_level_dn):
        return FlareLimit(math.nan, math.nan, math.inf, math.inf)
    lit_e = np.array(flux_e / pixels + max(background_e, 0.0))
    of_pixel_e2 = pixel_variance_e2(lit_e, noise_floor_e2(calibration), calibration.prnu)
    flux_sigma = math.sqrt(pixels * float(of_pixel_e2))
    relative = math.hypot(flux_sigma / flux_e, Camera(calibration, 1.0, 1.0).flux_spread)
    return FlareLimit(math.nan, math.nan, flux_sigma, 0.5 * range_m * relative)


def _pixels_of_disc(calibration: Calibration, angular_radius: float) -> float:
    return math.pi * (calibration.fx_px * math.tan(min(angular_radius, 1.5))) ** 2


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
    motions_px: Sequence[tuple[float, float]] | None = None,
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
    motions_px
        How far each moves along u and v during the exposure, which is not known beforehand; by default none
        does, and that is known.

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
    known = _known(calibration, place, background_e, clipped_tell_nothing, structure, motions_px)
    if known is None:
        return [FlareLimit(math.inf, math.inf, math.inf, math.inf)] * len(flares)
    return _limits(known.camera, known.layout, place, known.inverse)


def range_causes(
    calibration: Calibration, u_px: float, v_px: float, range_m: float, flux_e: float, background_e: float
) -> RangeCauses | None:
    """Return the causes of one flare's `range_sigma_m` in `flare_limit`; None where that is infinite.

    The bound is the variance of the efficient estimate, in which a pixel's noise n enters by the weight
    b C ∂λ/V, C the inverse information and b how range follows from the unknowns: so variances of several
    causes, V = Σ V_i, enter as Σ (b C ∂λ/V)² V_i. Priors enter as measurements do. A pixel that may be
    clipped tells less, and counts as one of so much more noise. Parameters as `flare_limit`.
    """
    if not (range_m > 0.0 and flux_e > 0.0):
        raise ValueError(f"range_m and flux_e must be positive, not {[range_m, flux_e]}")
    if not calibration.range_constant_dn_m2_per_s > 0.0:
        return None
    rounding_e2 = 1.0 / (12.0 * calibration.system_gain_dn_per_e**2)
    floors_e2 = (calibration.read_noise_e**2, calibration.dsnu_e**2, rounding_e2)
    rest_e = max(background_e, 0.0)
    angular_radius = float(angular_radius_rad(range_m, calibration.source_radius_m))
    if float(image_radius_px(u_px, v_px, angular_radius, calibration)) > WIDE_PX:
        if math.isinf(_wide_limit(calibration, range_m, flux_e, background_e, angular_radius).range_sigma_m):
            return None
        pixels = _pixels_of_disc(calibration, angular_radius)
        lit_e = flux_e / pixels + rest_e
        parts_e2 = (flux_e / pixels, rest_e, (calibration.prnu * lit_e) ** 2, *floors_e2)
        noise_m = [0.5 * range_m / flux_e * math.sqrt(pixels * part_e2) for part_e2 in parts_e2]
        return RangeCauses(*[*noise_m, 0.5 * range_m * Camera(calibration, 1.0, 1.0).flux_spread, 0.0, 0.0])
    place = np.array([[u_px, v_px, range_m, flux_e]], dtype=np.float64)
    known = _known(calibration, place, background_e, True, None)
    if known is None:
        return None
    all_e = np.maximum(known.expected_e, 0.0)
    own_e = np.maximum(all_e - rest_e, 0.0)
    camera, by_flux = known.camera, 0.5 * known.camera.flux_spread
    range_row = np.zeros(known.layout.size)
    range_row[2] = 1.0
    if known.layout.has_slack:
        range_row[3] = -(by_flux**2) / camera.tie_spread
    answer = range_row @ known.inverse
    per_e2 = (answer @ known.jacobian) ** 2 * known.telling / known.variance_e2**2
    parts = (own_e, all_e - own_e, (calibration.prnu * all_e) ** 2, *floors_e2)
    noise = [math.sqrt(float((per_e2 * part_e2).sum())) for part_e2 in parts]
    constant, radius = by_flux, 0.0
    if known.layout.has_slack:
        # Of errors φ in ½ ln K and ρ in ln r the slack is (φ + ρ)/σ_t; (σ_r² φ − σ_φ² ρ)/σ_t² stays open.
        of_slack, tie = float(answer[3]) / camera.tie_spread, camera.tie_spread
        constant = by_flux * abs((camera.radius_spread / tie) ** 2 - of_slack)
        radius = camera.radius_spread * abs((by_flux / tie) ** 2 + of_slack)
    width = abs(float(answer[known.layout.width])) if known.layout.has_width else 0.0
    return RangeCauses(*[range_m * share for share in (*noise, constant, radius, width)])


def fixed_influence(
    calibration: Calibration, u_px: float, v_px: float, range_m: float, flux_e: float, background_e: float
) -> tuple[PixelBox, NDArray[np.float64], NDArray[np.float64]] | None:
    """Return by how much ln F of the efficient estimate changes with what is fixed about pixels.

    Returns
    -------
    The pixels, and for each the change with its relative response and with its offset in electrons, shape
    (rows, columns); None where the flare cannot be ranged, or is too large. Parameters as `flare_limit`.
    """
    radius_rad = float(angular_radius_rad(range_m, calibration.source_radius_m))
    if float(image_radius_px(u_px, v_px, radius_rad, calibration)) > WIDE_PX:
        return None
    place = np.array([[u_px, v_px, range_m, flux_e]], dtype=np.float64)
    known = _known(calibration, place, background_e, True, None)
    if known is None:
        return None
    of_offset, of_response = np.zeros(known.used.shape), np.zeros(known.used.shape)
    weight = (known.inverse[2] @ known.jacobian) * known.telling / known.variance_e2
    of_offset[known.used] = -2.0 * weight  # ln F is −2 ln d
    of_response[known.used] = -2.0 * weight * np.maximum(known.expected_e, 0.0)
    return known.box, of_response, of_offset


def _known(
    calibration: Calibration,
    place: NDArray[np.float64],
    background_e: float,
    clipped_tell_nothing: bool,
    structure: Structure | None,
    motions_px: Sequence[tuple[float, float]] | None = None,
) -> _Known | None:
    """Return what is known of flares, shape (flares, 4) as in `flare_limits`; None if nothing is."""
    box, camera, moved_px = limit_box(calibration, place), Camera(calibration, 1.0, 1.0), None
    if motions_px is not None:
        camera = camera.moving
        moved_px = np.hypot(*np.array(motions_px, dtype=np.float64).T)
        box = box.with_margin(math.ceil(float(moved_px.max()))).inside(
            (calibration.height_px, calibration.width_px)
        )
    log_range, pixels = np.log(place[:, 2]), box.height * box.width
    sources, imaged = lay_out(camera, place[:, 0], place[:, 1], log_range, moved_px=moved_px)
    if not imaged.all() or pixels == 0:
        return None
    clip_e = clip_level_e(calibration, calibration.black_level_dn) if clipped_tell_nothing else math.inf
    known, structure = camera.known(clip_e), structure or even(pixels)
    layout = known.layout(len(place), structure.amplitudes)
    values = np.zeros(layout.size)
    own = layout.of_sources(values)
    own[:, 0], own[:, 1], own[:, 2] = place[:, 0], place[:, 1], log_range
    if motions_px is not None:
        own[:, layout.motion :] = motions_px
    values[layout.background] = background_e
    expected_e, variance_e2 = np.empty(pixels), np.empty(pixels)
    jacobian = np.empty((layout.size - len(structure.order), pixels))
    at_1_m = sources._replace(log_flux_at_1_m=np.log(place[:, 3]) + 2.0 * log_range)
    blank = np.zeros((box.height, box.width))
    view = View(box.top, box.left, blank, blank.astype(np.uint8), noise_floor_e2(calibration), blank)
    expectation(values, view, at_1_m, structure, known, expected_e, jacobian, variance_e2)
    if len(structure.order):
        first = layout.background + 1
        jacobian = np.concatenate([jacobian[:first], structure.waves, jacobian[first:]])
    telling = np.ones(pixels)
    if clipped_tell_nothing:
        telling = censored_weight(expected_e, variance_e2, clip_e)
    used = telling > _LEAST_TELLING
    jacobian, expected_e = jacobian[:, used], expected_e[used]
    variance_e2, telling = variance_e2[used], telling[used]
    prior = layout.prior(structure, known.motion_px)
    inverse = covariance(fisher_information(jacobian, variance_e2 / telling) + prior)
    if inverse is None:
        return None
    used = used.reshape(box.height, box.width)
    return _Known(camera, box, used, layout, jacobian, expected_e, variance_e2, telling, inverse)


def limit_box(
    calibration: Calibration, flares: Sequence[tuple[float, float, float, float]] | NDArray[np.float64]
) -> PixelBox:
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
