"""Flux and apparent size of a source together: the fit needs the size, the size needs the range."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.model.flare import PixelBox, image_radius_px
from perception.model.ranging import angular_radius_rad, flux_at_one_metre_dn
from perception.robust.fit import FlareFit, fit_flare
from perception.types import Calibration

_MAX_ROUNDS = 16
_MAX_LOG_STEP = 0.4
_SLOPE_STEP = 0.02
# Where flux grows almost as fast as the size assumed (a disc cut by the frame's edge), steps stay finite.
_MAX_SLOPE = 0.95


Start = tuple[float, float, float, float]
"""First guess of (u_px, v_px, flux_e, background_e)."""


@dataclass(frozen=True, eq=False)
class SourceFit:
    """A fit whose flux agrees with the size it assumed.

    The sigmas count how flux, place and size pull on each other; `fit` holds the estimate.
    """

    fit: FlareFit
    u_sigma_px: float
    v_sigma_px: float
    flux_sigma_e: float


@dataclass(frozen=True, eq=False)
class _Trial:
    """A fit at the size that the flux e^x implies."""

    x: float
    fit: FlareFit

    @property
    def miss(self) -> float:
        """f(x) - x: how far the flux found lies above the flux assumed, in logarithms."""
        return math.log(self.fit.flux_e) - self.x


FitAt = Callable[[float, Start], FlareFit | None]
"""Fits at the size that the flux e^x implies, from a first guess."""


def fit_source(
    image_e: NDArray[np.floating],
    usable: NDArray[np.bool_],
    window: PixelBox,
    calibration: Calibration,
    *,
    place: tuple[float, float, float],
    first_fluxes_e: Sequence[float],
    exposure_s: float,
    gain: float,
    max_image_radius_px: float,
) -> SourceFit | None:
    """Fit a source of known radius and strength: flux → range → angular radius → flux, until they agree.

    With x = ln F and f(x) = ln F_fit(ρ(x)), ρ the angular radius at the range that flux x implies, the
    sought x solves f(x) = x. An unclipped flare needs two rounds, for its flux hardly depends on the size
    assumed. A clipped one is determined by its rim: too small a disc asks for a far greater flux, so plain
    iteration diverges; a secant on f(x) - x, kept within a bracket, does not.

    Noise moves the solution by δx = δf / (1 - f'), and the place with it by u' δx; both slopes come from one
    more fit at a slightly larger size.

    Parameters
    ----------
    image_e, usable, window, calibration, gain
        As of `fit.fit_flare`.
    place
        First guess of (u_px, v_px, background_e).
    first_fluxes_e
        First guesses of the flux; the one whose size fits best is followed.
    exposure_s
        Exposure time.
    max_image_radius_px
        Give up on a source that looks larger.

    Returns
    -------
    The fit, or None if a fit fails, the size grows beyond its limit, or no agreement is reached.
    """
    at_one_metre_e = flux_at_one_metre_dn(place[0], place[1], exposure_s, gain, calibration) / (
        calibration.system_gain_dn_per_e * gain
    )
    if not at_one_metre_e > 0.0:
        return None

    def fit_at(x: float, start: Start) -> FlareFit | None:
        """Fit at the size that flux e^x implies."""
        radius_rad = angular_radius_rad(math.sqrt(at_one_metre_e * math.exp(-x)), calibration.source_radius_m)
        if image_radius_px(start[0], start[1], radius_rad, calibration) > max_image_radius_px:
            return None
        fit = fit_flare(
            image_e, usable, window, calibration, start=start, angular_radius_rad=radius_rad, gain=gain
        )
        return fit if fit.converged else None

    u_px, v_px, background_e = place
    tried = [
        _Trial(math.log(flux_e), fit)
        for flux_e in first_fluxes_e
        if (fit := fit_at(math.log(flux_e), (u_px, v_px, flux_e, background_e))) is not None
    ]
    if not tried:
        return None
    agreed = _agreeing_trial(min(tried, key=lambda trial: trial.fit.reduced_chi2), fit_at)
    if agreed is None:
        return None
    return _with_sigmas(agreed.fit, fit_at(agreed.x + _SLOPE_STEP, _as_start(agreed.fit)))


def _agreeing_trial(trial: _Trial, fit_at: FitAt) -> _Trial | None:
    """Follow f(x) - x to its zero by a secant within a bracket; None where it cannot be followed."""
    low, high = -math.inf, math.inf
    slope = 0.0
    for _ in range(_MAX_ROUNDS):
        if abs(trial.miss) < 0.02 * trial.fit.flux_sigma_e / trial.fit.flux_e:
            return trial
        # `miss` falls with x: the more flux assumed, the larger the disc, the less flux the rim asks for.
        low, high = (max(low, trial.x), high) if trial.miss > 0.0 else (low, min(high, trial.x))
        found = _bracket_step(trial, low, high, slope, fit_at)
        if found is None:
            return None
        slope = min(
            (math.log(found.fit.flux_e) - math.log(trial.fit.flux_e)) / (found.x - trial.x), _MAX_SLOPE
        )
        trial = found
    return None


def _bracket_step(trial: _Trial, low: float, high: float, slope: float, fit_at: FitAt) -> _Trial | None:
    """Try where a line of the given slope of f meets x, or the bracket's middle where that lies outside."""
    step = float(np.clip(trial.miss / (1.0 - slope), -_MAX_LOG_STEP, _MAX_LOG_STEP))
    x = trial.x + step if low < trial.x + step < high else 0.5 * (low + high)
    fit = fit_at(x, _as_start(trial.fit)) if math.isfinite(x) else None
    if fit is None and math.isfinite(low):
        # Beyond the true size a disc may leave no rim to fit: as good as "too large".
        x = 0.5 * (low + min(high, x))
        fit = fit_at(x, _as_start(trial.fit))
    return None if fit is None else _Trial(x, fit)


def _as_start(fit: FlareFit) -> Start:
    return fit.u_px, fit.v_px, fit.flux_e, fit.background_e


def _with_sigmas(fit: FlareFit, larger: FlareFit | None) -> SourceFit:
    """Add what the dependence on size does to the errors."""
    slope = u_slope = v_slope = 0.0
    if larger is not None:
        slope = min(math.log(larger.flux_e / fit.flux_e) / _SLOPE_STEP, _MAX_SLOPE)
        u_slope = (larger.u_px - fit.u_px) / _SLOPE_STEP
        v_slope = (larger.v_px - fit.v_px) / _SLOPE_STEP
    # Rows: how u, v and ln F of the solution follow (u, v, ln F) of a fit at fixed size.
    follow = np.array([[1.0, 0.0, u_slope], [0.0, 1.0, v_slope], [0.0, 0.0, 1.0]])
    follow[:, 2] /= 1.0 - slope
    scale = np.array([1.0, 1.0, 1.0 / fit.flux_e])
    at_fixed_size = fit.covariance[:3, :3] * np.outer(scale, scale)
    u_sigma, v_sigma, log_sigma = np.sqrt(np.diagonal(follow @ at_fixed_size @ follow.T)).tolist()
    return SourceFit(fit, u_sigma, v_sigma, log_sigma * fit.flux_e)
