"""Flares that overlap: fitted together, their number decided by likelihood.

The model of a window is λ = Σ_k F_k S(u_k, v_k, ρ_k) + B, the size ρ_k of each image tied to its flux by the
range that both stand for. `fit_together` maximises the shifted Poisson likelihood over all of them at once,
so that each one's covariance knows of the others; `deblend` adds flares where the residual asks for one, as
long as the likelihood gains more than noise or a wrong point spread could give it. (Joint fits of point
spreads in crowded fields: Stetson, Publ. Astron. Soc. Pac. 99, 191, 1987.)
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from perception.model.fisher import covariance, fisher_information
from perception.model.flare import FlareImage, PixelBox, flare_image, has_image, image_radius_px
from perception.model.ranging import angular_radius_rad, flux_at_one_metre_dn
from perception.model.sensor import noise_floor_e2, pixel_variance_e2
from perception.robust.measure import MODEL_ERROR
from perception.types import Calibration, RawFrame

Array = NDArray[np.float64]

MOST_FLARES = 8
"""So many flares one window is divided into at most."""

LEAST_GAIN = 40.0
"""2 Δ ln L that one more flare must bring: noise gives χ² of three degrees of freedom, 40 once in 10⁸."""

RESIDUAL_SIGMAS = 5.5
"""Where the residual, matched to a point's image, exceeds this, another flare is tried."""

_MOST_STEPS = 25
_MOST_PX_A_STEP = 1.0
_MOST_LOG_A_STEP = 1.0
_WIDTH_STEP = 0.02


@dataclass(frozen=True, eq=False)
class Window:
    """A part of a frame to be explained by flares, in electrons.

    `image_e` and `usable` have shape (height, width); `usable` says which pixels count.
    """

    box: PixelBox
    image_e: Array
    usable: NDArray[np.bool_]
    frame: RawFrame
    calibration: Calibration
    max_image_radius_px: float

    @property
    def floor_e2(self) -> float:
        """Variance of a dark pixel."""
        return noise_floor_e2(self.calibration, self.frame.gain)

    def angular_radius_rad(self, u_px: float, v_px: float, flux_e: float) -> float:
        """Return how large a source of this flux looks, NaN where no range can be had."""
        frame, calibration = self.frame, self.calibration
        one_metre_dn = flux_at_one_metre_dn(u_px, v_px, frame.exposure_s, frame.gain, calibration)
        one_metre_e = one_metre_dn / (calibration.system_gain_dn_per_e * frame.gain)
        if not one_metre_e > 0.0:
            return math.nan
        return angular_radius_rad(math.sqrt(one_metre_e / flux_e), calibration.source_radius_m)


@dataclass(frozen=True, eq=False)
class Flares:
    """Flares of one window, fitted together.

    Attributes
    ----------
    u_px, v_px, flux_e
        Shape (flares,) each.
    background_e
        Of a pixel, beneath all of them.
    covariance
        Of (u, v, ln flux) of each flare in turn and of the background, shape (3 flares + 1,) twice.
    expected_e
        λ in each pixel of the window, shape (height, width).
    deviance
        −2 ln L but for a constant.
    """

    u_px: Array
    v_px: Array
    flux_e: Array
    background_e: float
    covariance: Array
    expected_e: Array
    deviance: float

    @property
    def count(self) -> int:
        """Number of flares."""
        return len(self.flux_e)

    def sigmas(self, index: int) -> tuple[float, float, float]:
        """Return the standard deviations of u and v, in px, and of ln flux, of one flare."""
        u, v, log_flux = np.sqrt(np.diagonal(self.covariance)[3 * index : 3 * index + 3]).tolist()
        return u, v, log_flux


Start = tuple[float, float, float]
"""First guess of (u_px, v_px, flux_e) of a flare."""


def deblend(window: Window, starts: Sequence[Start], background_e: float) -> Flares | None:
    """Explain a window by as many flares as its likelihood asks for.

    Begins with the flares of `starts` and adds one at a time where the residual is brightest (or, close to a
    single flare, along the axis in which it is too long), until a further one would bring less than
    `LEAST_GAIN`. A lone flare must first fail to be one whose image is wider or narrower than the point
    spread says, so that a calibration that is wrong by some per cent splits nothing.

    Returns
    -------
    The flares, or None where no fit succeeds.
    """
    current = fit_together(window, starts, background_e)
    while (
        current is not None
        and current.count < MOST_FLARES
        and asks_for_more(window, current.expected_e, current.background_e)
    ):
        trials = [fit_together(window, trial, current.background_e) for trial in _more(window, current)]
        fits = [fit for fit in trials if fit is not None]
        if not fits:
            break
        best = min(fits, key=lambda fit: fit.deviance)
        if _gain(window, current, best) < LEAST_GAIN:
            break
        current = best
    return current


def asks_for_more(window: Window, expected_e: Array, background_e: float) -> bool:
    """Tell whether a fit leaves over so much that another flare could bring `LEAST_GAIN`.

    Where it lies beside the flares the residual shows it; within them, χ² over the pixels in which they stand
    out exceeds what a good fit leaves, n ± √(2n), by nearly that gain.
    """
    variance = _variance(window, expected_e, background_e)
    core = window.usable & (expected_e - background_e > np.sqrt(variance))
    pixels = int(core.sum())
    chi2 = float(np.sum((window.image_e - expected_e)[core] ** 2 / variance[core]))
    if chi2 > pixels + LEAST_GAIN - 4.0 * math.sqrt(2.0 * pixels):
        return True
    return bool(residual_sigmas(window, expected_e, background_e).max() > RESIDUAL_SIGMAS)


def residual_sigmas(window: Window, expected_e: Array, background_e: float) -> Array:
    """Return what a fit leaves over, matched to the image of a point, in units of its noise, for each pixel.

    An error of the model of 5 % of the flares' own light counts as noise.
    """
    from scipy.ndimage import gaussian_filter

    variance = _variance(window, expected_e, background_e)
    weight = np.where(window.usable, 1.0 / variance, 0.0)
    residual = np.where(window.usable, window.image_e - expected_e, 0.0)
    sigma_px = math.hypot(window.calibration.psf_sigma_px, math.sqrt(1.0 / 12.0))
    matched = gaussian_filter(residual * weight, sigma_px, mode="constant")
    # Filtered twice a Gaussian of σ is one of σ/√2 and of peak 1/(4 π σ²): Σ h² w of a kernel h.
    power = gaussian_filter(weight, sigma_px / math.sqrt(2.0), mode="constant") / (
        4.0 * math.pi * sigma_px**2
    )
    return np.asarray(matched / np.sqrt(np.maximum(power, 1e-300)))


def fit_together(window: Window, starts: Sequence[Start], background_e: float) -> Flares | None:
    """Fit places and fluxes of some flares, and the background beneath them, by damped Fisher scoring.

    Maximises the likelihood of x + σ² ~ Poisson(λ + σ²) (see `fit.fit_flare`) with each image's size
    following from its flux: ∂λ/∂ln F = F S + ½ F ∂S/∂ln ρ, for ρ ~ 1/d and F ~ 1/d².

    Returns
    -------
    The flares, or None if a flare leaves the window or fades, or the steps do not settle.
    """
    values = np.array([(u, v, math.log(flux)) for u, v, flux in starts], dtype=np.float64)
    level_e, damping = background_e, 1e-3
    state = _model(window, values, level_e)
    if state is None:
        return None
    for _ in range(_MOST_STEPS):
        expected, jacobian = state
        variance = pixel_variance_e2(expected, window.floor_e2, window.calibration.prnu)[window.usable]
        slopes = jacobian[:, window.usable]
        information = fisher_information(slopes, variance)
        inverse = covariance(information)
        if inverse is None:
            return None
        score = slopes @ ((window.image_e - expected)[window.usable] / variance)
        if np.all(np.abs(inverse @ score) < 0.01 * np.sqrt(np.diagonal(inverse))):
            return Flares(
                u_px=values[:, 0],
                v_px=values[:, 1],
                flux_e=np.exp(values[:, 2]),
                background_e=level_e,
                covariance=inverse,
                expected_e=expected,
                deviance=_deviance(window, expected),
            )
        before = _deviance(window, expected)
        while True:
            step = np.linalg.solve(information + damping * np.diag(np.diagonal(information)), score)
            moved = values + np.clip(
                step[:-1].reshape(-1, 3),
                *(
                    sign * np.array([_MOST_PX_A_STEP, _MOST_PX_A_STEP, _MOST_LOG_A_STEP])
                    for sign in (-1.0, 1.0)
                ),
            )
            tried = _model(window, moved, level_e + float(step[-1]))
            if tried is not None and _deviance(window, tried[0]) <= before + 1e-9 * abs(before):
                break
            damping *= 10.0
            if damping > 1e6:
                return None
        values, level_e, state, damping = moved, level_e + float(step[-1]), tried, max(0.1 * damping, 1e-6)
    return None


def _model(window: Window, values: Array, background_e: float) -> tuple[Array, Array] | None:
    """Return λ and its derivatives by (u, v, ln F) of each flare and by the background, if it has them."""
    box = window.box
    expected = np.full((box.height, box.width), background_e)
    rows = []
    for u, v, log_flux in values.tolist():
        inside = -0.5 < u - box.left < box.width - 0.5 and -0.5 < v - box.top < box.height - 0.5
        if not inside or not -5.0 < log_flux < 40.0:
            return None
        flux = math.exp(log_flux)
        image = _image(window, u, v, flux)
        if image is None:
            return None
        assert image.d_dgrowth is not None
        expected += flux * image.fraction
        rows += [flux * image.d_du, flux * image.d_dv, flux * (image.fraction + 0.5 * image.d_dgrowth)]
    return expected, np.stack([*rows, np.ones_like(expected)])


def _image(window: Window, u_px: float, v_px: float, flux_e: float) -> FlareImage | None:
    radius_rad = window.angular_radius_rad(u_px, v_px, flux_e)
    calibration = window.calibration
    if not has_image(u_px, v_px, radius_rad, calibration):  # also without a range: NaN
        return None
    if image_radius_px(u_px, v_px, radius_rad, calibration) > window.max_image_radius_px:
        return None
    return flare_image(u_px, v_px, radius_rad, window.box, calibration, growth=True)


def _deviance(window: Window, expected_e: Array) -> float:
    """−2 ln L of the shifted Poisson distribution, over that of the data themselves."""
    seen = np.maximum(window.image_e[window.usable] + window.floor_e2, 1e-3)
    wanted = np.maximum(expected_e[window.usable] + window.floor_e2, 1e-3)
    return float(2.0 * np.sum(wanted - seen + seen * np.log(seen / wanted)))


def _variance(window: Window, expected_e: Array, background_e: float) -> Array:
    """Return the variance of pixels, an error of the model of 5 % of the flares' light counted in."""
    variance = pixel_variance_e2(expected_e, window.floor_e2, window.calibration.prnu)
    return variance + (MODEL_ERROR * (expected_e - background_e)) ** 2


def _gain(window: Window, fewer: Flares, more: Flares) -> float:
    """Return by how much more flares explain a window better, as 2 Δ ln L with an imperfect model."""
    variance = _variance(window, more.expected_e, more.background_e)[window.usable]
    data = window.image_e[window.usable]
    before = fewer.expected_e if fewer.count > 1 else _of_free_width(window, fewer)
    of_fewer, of_more = (data - expected[window.usable] for expected in (before, more.expected_e))
    return float(np.sum((of_fewer**2 - of_more**2) / variance))


def _of_free_width(window: Window, lone: Flares) -> Array:
    """Return λ of a lone flare whose point spread may be wider or narrower, by one linear step."""
    wider = replace(window.calibration, psf_sigma_px=window.calibration.psf_sigma_px * (1.0 + _WIDTH_STEP))
    at = np.array([[lone.u_px[0], lone.v_px[0], math.log(lone.flux_e[0])]])
    state, other = (
        _model(window, at, lone.background_e),
        _model(replace(window, calibration=wider), at, lone.background_e),
    )
    if state is None or other is None:
        return lone.expected_e
    slopes = np.concatenate([state[1], ((other[0] - state[0]) / _WIDTH_STEP)[None]])[:, window.usable]
    variance = _variance(window, lone.expected_e, lone.background_e)[window.usable]
    inverse = covariance(fisher_information(slopes, variance))
    if inverse is None:
        return lone.expected_e
    step = inverse @ (slopes @ ((window.image_e - lone.expected_e)[window.usable] / variance))
    moved = _model(
        replace(
            window,
            calibration=replace(
                window.calibration,
                psf_sigma_px=window.calibration.psf_sigma_px * float(np.clip(1.0 + step[-1], 0.7, 1.5)),
            ),
        ),
        at + np.clip(step[:3], -0.5, 0.5),
        lone.background_e + float(step[3]),
    )
    return lone.expected_e if moved is None else moved[0]


def _more(window: Window, current: Flares) -> list[list[Start]]:
    """Return first guesses with one flare more."""
    flares = list(zip(current.u_px.tolist(), current.v_px.tolist(), current.flux_e.tolist(), strict=True))
    sigmas = residual_sigmas(window, current.expected_e, current.background_e)
    row, column = np.unravel_index(int(np.argmax(sigmas)), sigmas.shape)
    guesses = []
    if sigmas[row, column] > RESIDUAL_SIGMAS:
        residual = np.where(window.usable, window.image_e - current.expected_e, 0.0)
        near = residual[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
        brought = max(float(near.sum()), 3.0 * math.sqrt(window.floor_e2))
        guesses.append([*flares, (window.box.left + float(column), window.box.top + float(row), brought)])
    worst = int(np.argmax([_misfit(window, current, u, v) for u, v, _ in flares]))
    halves = _halves(window, current, flares[worst])
    if halves is not None:
        guesses.append([*flares[:worst], *halves, *flares[worst + 1 :]])
    return guesses


def _misfit(window: Window, current: Flares, u_px: float, v_px: float) -> float:
    """Return χ² over the 3 × 3 pixels around a place."""
    row, column = (
        int(np.clip(round(at - first), 0, length - 1))
        for at, first, length in (
            (v_px, window.box.top, window.box.height),
            (u_px, window.box.left, window.box.width),
        )
    )
    near = np.s_[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]
    variance = _variance(window, current.expected_e, current.background_e)[near]
    residual = np.where(window.usable, window.image_e - current.expected_e, 0.0)[near]
    return float(np.sum(residual**2 / variance))


def _halves(window: Window, current: Flares, flare: Start) -> tuple[Start, Start] | None:
    """Return two flares in place of one, along the axis in which the image is longer than the model's."""
    u, v, flux = flare
    box = window.box
    rows, columns = np.ogrid[: box.height, : box.width]
    x, y = columns + box.left - u, rows + box.top - v
    image = _image(window, u, v, flux)
    if image is None:
        return None
    # Second moments, weighted by the model's own image: far from it there is nothing but noise.
    weight = np.where(window.usable, image.fraction / image.fraction.max(), 0.0)
    residual = (window.image_e - current.expected_e) * weight
    longer = np.array([[(residual * a * b).sum() for b in (x, y)] for a in (x, y)])
    values, axes = np.linalg.eigh(longer)
    if not values[1] > 0.0:
        return None
    half_px = 0.5 * math.hypot(window.calibration.psf_sigma_px, 0.3)
    du, dv = (half_px * axes[:, 1]).tolist()
    return (u + du, v + dv, 0.5 * flux), (u - du, v - dv, 0.5 * flux)
