"""Width of the point spread and share of the glare, from one source at known ranges.

What is fitted, all places of the rail at once, is λ = F ((1 − g) S(σ) + g w ⊗ S) + B: S the image of a sphere
of known size under a Gaussian, w(r) = (γ − 1) / (π r₀²) (1 + (r / r₀)²)^−γ the glare. Place, flux F and
background B are free at each place, the rest is the camera's.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.calibration.rail_equations import RailEquations, RailNoise, rail_equations
from perception.model.flare import PixelBox, flare_image
from perception.model.ranging import angular_radius_rad
from perception.types import Calibration

Array = NDArray[np.float64]

HALF_WINDOW_PX = 48.0
"""How far from a flare its glare is looked at."""

_CORE_SIGMAS = 8.0
_MOST_STEPS, _FEW_STEPS = 60, 2
_SETTLED = 1e-3  # of a σ
_FIRST_DAMPING, _LEAST_DAMPING, _MOST_DAMPING = 1e-3, 1e-9, 1e6
_SHAPE_PRIOR = ((math.log(10.0), 1.0), (math.log(1.5), 0.7))
"""What is taken of a lens's glare before it is seen, ln r₀ and ln (γ − 1) and their σ.

Far wings look like background: without it a share of 2 % may be one of 20 % that lies beyond the window.
"""

_SHAPE_BOUNDS = ((math.log(3.0), math.log(300.0)), (math.log(0.05), math.log(9.0)))
# A disc's middle and a hexagon within it: right for polynomials of degree 5.
_DISC = np.array(
    [(0.0, 0.0), *((math.cos(k * math.pi / 3.0), math.sin(k * math.pi / 3.0)) for k in range(6))]
)
_DISC_RADIUS, _DISC_WEIGHT = math.sqrt(2.0 / 3.0), np.array([0.25, *[0.125] * 6])


@dataclass(frozen=True, eq=False)
class StackedFlare:
    """The sum of frames of one source at one place.

    Attributes
    ----------
    range_m, frames
        How far it is, and how many frames are added up.
    u_px, v_px
        About where it is.
    box
        Which pixels are cut out.
    sum_e
        Electrons above black level, shape of the box.
    floor_e2
        Variance of a dark pixel of the sum from frame to frame: read noise and rounding.
    """

    range_m: float
    frames: int
    u_px: float
    v_px: float
    box: PixelBox
    sum_e: Array
    floor_e2: float


@dataclass(frozen=True)
class PointSpreadShape:
    """What all places share: the Gaussian's σ, glare's share, r₀ and γ; the true over the assumed radius."""

    sigma_px: float
    glare_share: float
    glare_radius_px: float
    glare_exponent: float
    growth: float = 1.0


@dataclass(frozen=True, eq=False)
class PointSpreadFit:
    """A fit: the shape, its covariance in ln σ, g, ln r₀, ln (γ − 1), ln growth, and how well it fits.

    `own` is what each place has for itself: u, v, flux and background; `noise`, that of the pixels.
    """

    shape: PointSpreadShape
    covariance: Array
    chi2: float
    freedom: int
    own: Sequence[Array]
    noise: RailNoise


def fit_point_spread(
    flares: Sequence[StackedFlare],
    calibration: Calibration,
    start: PointSpreadShape,
    free: Sequence[bool],
    like: PointSpreadFit | None = None,
) -> PointSpreadFit:
    """Fit the shape to all flares by Gauss–Newton with damping (Levenberg, Marquardt).

    A pixel's noise is that of the model; what is fixed about a pixel errs alike at all places
    (`rail_equations`). Radii of sources have the σ that the
    calibration states; without one they are exact. The shape of glare has a wide prior.

    Parameters
    ----------
    flares
        Sums at the places.
    calibration
        Of the camera.
    start
        Where the fit begins; what is not free stays there.
    free
        Which of ln σ, g, ln r₀, ln (γ − 1), ln growth are to be found.
    like
        A fit nearby, whose places and fluxes are begun with: two steps from there are enough. The noise is
        then its noise, so that both χ² can be compared.
    """
    shared = to_vector(start)
    free_at = np.flatnonzero(free)
    prior = _prior_of(calibration)
    if like is None:
        own = [np.array([one.u_px, one.v_px, *_flux_and_background(one)]) for one in flares]
    else:
        own = list(like.own)
    damping = _FIRST_DAMPING if like is None else 0.0

    def equations(expected: Sequence[tuple[Array, Array]]) -> RailEquations:
        noise = _noise(flares, expected, calibration) if like is None else like.noise
        jacobians = [jacobian for _, jacobian in expected]
        below = (prior[0] - shared, prior[1])
        return rail_equations(_left_e(flares, expected), jacobians, noise, below)

    held = equations(_expected_of(flares, own, shared, calibration))
    for _ in range(_MOST_STEPS if like is None else _FEW_STEPS):
        change, own_changes, covariance = held.step(free_at, damping)
        trial = shared.copy()
        trial[free_at] += change
        for at, (low, high) in enumerate(_SHAPE_BOUNDS, start=2):
            if free[at]:
                trial[at] = min(max(trial[at], low), high)
        own_trial = [one + by for one, by in zip(own, own_changes, strict=True)]
        expected = _expected_of(flares, own_trial, trial, calibration)
        off = trial - prior[0]
        cost = held.noise.chi2(_left_e(flares, expected)) + float(off @ (prior[1] * off))
        if cost <= held.chi2 * (1.0 + 1e-12):
            shared, own = trial, own_trial
            held = equations(expected)
            sigma = np.sqrt(np.diagonal(covariance))
            settled = bool((np.abs(change) < _SETTLED * sigma).all())
            damping = max(0.1 * damping, _LEAST_DAMPING)
            if settled and damping < 1e-4:
                break
        else:
            damping = max(10.0 * damping, _FIRST_DAMPING)
            if damping > _MOST_DAMPING:
                break
    _, _, found = held.step(free_at, 0.0)
    covariance = np.zeros((5, 5))
    covariance[np.ix_(free_at, free_at)] = found
    pixels = sum(one.sum_e.size for one in flares)
    freedom = pixels - 4 * len(flares) - len(free_at)
    return PointSpreadFit(to_shape(shared), covariance, held.chi2, freedom, own, held.noise)


def _prior_of(calibration: Calibration) -> tuple[Array, Array]:
    """Return the middle and the precision of what is known beforehand, shape (5,) each."""
    middle, precision = np.zeros(5), np.zeros(5)
    for at, (mean, sigma) in enumerate(_SHAPE_PRIOR, start=2):
        middle[at], precision[at] = mean, 1.0 / sigma**2
    radius_sigma_m = calibration.sigma.get("source_radius_m", 0.0)
    if radius_sigma_m > 0.0:
        precision[4] = (calibration.source_radius_m / radius_sigma_m) ** 2
    return middle, precision


def to_vector(shape: PointSpreadShape) -> Array:
    """Return what a fit moves: ln σ, g, ln r₀, ln (γ − 1), ln growth."""
    return np.array([
        math.log(shape.sigma_px), shape.glare_share, math.log(shape.glare_radius_px),
        math.log(shape.glare_exponent - 1.0), math.log(shape.growth),
    ])  # fmt: skip


def to_shape(shared: Array) -> PointSpreadShape:
    """Return the shape of what a fit moves."""
    width, share, radius, exponent, growth = shared.tolist()
    return PointSpreadShape(
        math.exp(width), share, math.exp(radius), 1.0 + math.exp(exponent), math.exp(growth)
    )


def _flux_and_background(flare: StackedFlare) -> tuple[float, float]:
    edge = np.concatenate([flare.sum_e[0], flare.sum_e[-1], flare.sum_e[:, 0], flare.sum_e[:, -1]])
    background_e = float(np.median(edge))
    return float((flare.sum_e - background_e).sum()), background_e


def _expected_of(
    flares: Sequence[StackedFlare], own: Sequence[Array], shared: Array, calibration: Calibration
) -> list[tuple[Array, Array]]:
    return [_expected(flare, one, shared, calibration) for flare, one in zip(flares, own, strict=True)]


def _left_e(flares: Sequence[StackedFlare], expected: Sequence[tuple[Array, Array]]) -> list[Array]:
    return [flare.sum_e - expected_e for flare, (expected_e, _) in zip(flares, expected, strict=True)]


def _noise(
    flares: Sequence[StackedFlare], expected: Sequence[tuple[Array, Array]], calibration: Calibration
) -> RailNoise:
    lit_e = [np.maximum(expected_e, 0.0) for expected_e, _ in expected]
    return RailNoise(
        tuple(flare.box for flare in flares),
        tuple(lit + flare.floor_e2 for flare, lit in zip(flares, lit_e, strict=True)),
        tuple(
            np.stack([np.full_like(lit, flare.frames * calibration.dsnu_e), calibration.prnu * lit])
            for flare, lit in zip(flares, lit_e, strict=True)
        ),
    )


def _expected(
    flare: StackedFlare, own: Array, shared: Array, calibration: Calibration
) -> tuple[Array, Array]:
    """Return the expected electrons, and their derivatives by shared and own unknowns, (9, height, width)."""
    u_px, v_px, flux_e, background_e = own.tolist()
    shape, box = to_shape(shared), flare.box
    width_px = shape.sigma_px
    radius_rad = float(angular_radius_rad(flare.range_m, calibration.source_radius_m * shape.growth))
    reach_px = 1.5 * calibration.fx_px * math.tan(radius_rad) + _CORE_SIGMAS * width_px + 2.0
    near = PixelBox.around(u_px, v_px, reach_px, calibration)
    core_box = near.overlap(box)
    known = replace(calibration, psf_sigma_px=width_px)
    image = flare_image(u_px, v_px, radius_rad, core_box, known)
    inside = core_box.seen_from(box).slices
    core = np.zeros((5, box.height, box.width))
    core[(slice(None), *inside)] = (
        image.fraction, image.d_du, image.d_dv, image.d_dspread, image.d_dgrowth,
    )  # fmt: skip
    spread = _spread_of(core[0], box, (u_px, v_px), width_px)
    glare = glare_image(u_px, v_px, spread, shape, box)
    share = shape.glare_share
    fraction = (1.0 - share) * core[0] + share * glare[0]
    jacobian = np.stack([
        flux_e * (1.0 - share) * core[3],
        flux_e * (glare[0] - core[0]),
        flux_e * share * glare[3],
        flux_e * share * glare[4],
        flux_e * (1.0 - share) * core[4],
        flux_e * ((1.0 - share) * core[1] + share * glare[1]),
        flux_e * ((1.0 - share) * core[2] + share * glare[2]),
        fraction,
        np.ones_like(fraction),
    ])  # fmt: skip
    return flux_e * fraction + background_e, jacobian


def _spread_of(fraction: Array, box: PixelBox, place: tuple[float, float], width_px: float) -> float:
    """Return the standard deviation of an image along an axis, the mean of both; the width at least."""
    rows, columns = np.arange(box.height) + box.top, np.arange(box.width) + box.left
    total = float(fraction.sum())
    if not total > 0.0:
        return width_px
    across = fraction.sum(axis=0) @ (columns - place[0]) ** 2
    down = fraction.sum(axis=1) @ (rows - place[1]) ** 2
    return max(math.sqrt(0.5 * float(across + down) / total), width_px)


def glare_image(u_px: float, v_px: float, spread_px: float, shape: PointSpreadShape, box: PixelBox) -> Array:
    """Return the share of the glare of an image in each pixel of a box, and how it changes.

    The image, so many pixels wide (σ along an axis), stands for a disc of that width: glare is smooth.

    Returns
    -------
    Shares and derivatives by u, v, ln r₀, ln (γ − 1), shape (5, height, width).
    """
    exponent, radius2_px2 = shape.glare_exponent, shape.glare_radius_px**2
    points = 2.0 * spread_px * _DISC_RADIUS * _DISC
    found = np.zeros((5, box.height, box.width))
    for (du, dv), weight in zip(points, _DISC_WEIGHT, strict=True):
        x = np.arange(box.width) + (box.left - u_px - du)
        y = (np.arange(box.height) + (box.top - v_px - dv))[:, None]
        away = (x**2 + y**2) / radius2_px2
        log_rise = np.log1p(away)
        density = weight * (exponent - 1.0) / (math.pi * radius2_px2) * np.exp(-exponent * log_rise)
        slope = 2.0 * exponent * density / (1.0 + away)
        found[0] += density
        found[1] += slope * (x / radius2_px2)
        found[2] += slope * (y / radius2_px2)
        found[3] += slope * away - 2.0 * density
        found[4] += density * (1.0 - (exponent - 1.0) * log_rise)
    return found
