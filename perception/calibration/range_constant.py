"""The range constant of the flux as the slope of a weighted regression (the paper's is in `paper`)."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

_SPREADS = np.concatenate([[0.0], np.geomspace(1e-4, 0.01, 41)])

INTERCEPT_SIGMAS = 3.0
"""An intercept further from zero than this many of its sigmas says that the flux does not follow 1/d²."""


@dataclass(frozen=True)
class RangeConstantFit:
    """Weighted line m = slope / d² + intercept, and beside it the line through the origin, m = K / d².

    The law has no intercept. One that differs from zero is signal that does not fade with the range: stray
    light, a background that was not removed, a detector that is not linear, ranges counted from the wrong
    zero. So the line with intercept is the test of the law, and where it passes, the line through the origin
    gives the constant: it knows one thing more, and is the better for it.

    Attributes
    ----------
    slope_dn_m2_per_s, intercept_dn_per_s, slope_sigma_dn_m2_per_s, intercept_sigma_dn_per_s
        The line with intercept, and its standard deviations, each with the other free.
    correlation
        Of slope and intercept.
    range_constant_dn_m2_per_s, range_constant_sigma_dn_m2_per_s
        K of the line through the origin (`Calibration.range_constant_dn_m2_per_s`).
    reduced_chi2, chi2_probability
        χ² of the line with intercept over n - 2, and the probability of one as large or larger.
    measurements
        n.
    """

    slope_dn_m2_per_s: float
    intercept_dn_per_s: float
    slope_sigma_dn_m2_per_s: float
    intercept_sigma_dn_per_s: float
    correlation: float
    range_constant_dn_m2_per_s: float
    range_constant_sigma_dn_m2_per_s: float
    reduced_chi2: float
    chi2_probability: float
    measurements: int

    @property
    def intercept_is_zero(self) -> bool:
        """Whether the intercept is compatible with zero, within 3 sigma."""
        return abs(self.intercept_dn_per_s) <= INTERCEPT_SIGMAS * self.intercept_sigma_dn_per_s


def regress_range_constant(
    m_dn_per_s: ArrayLike, sigma_dn_per_s: ArrayLike, range_m: ArrayLike
) -> RangeConstantFit:
    """Fit the range constant of the flux: m = F / (t g cos θ · response(θ)) against 1/d², weighted by 1/σ².

    An error of m far away makes a range wrong by d³ / 2K times as much, for d = √(K / m) (docs/physics.md,
    Ranging), and unweighted the near measurements, of large m and large σ, would drown it. The sigmas
    returned follow from those claimed; they are not stretched by χ².

    The variances of measurements at the same range are averaged. Each was estimated from its own photons, so
    one that came out low by chance claims less noise; alone it would weigh more, and pull K down.

    Parameters
    ----------
    m_dn_per_s
        Flux over effective exposure (`ranging.effective_exposure_s`), shape (n,).
    sigma_dn_per_s
        Its claimed standard deviations, shape (n,).
    range_m
        Known distances, shape (n,).

    Returns
    -------
    RangeConstantFit

    Raises
    ------
    ValueError
        If there are fewer than three measurements or two different ranges, a value is not finite, or a range
        or sigma is not positive.
    """
    from scipy.special import chdtrc

    m, sigma, distance = np.broadcast_arrays(
        *(np.atleast_1d(np.asarray(a, dtype=np.float64)) for a in (m_dn_per_s, sigma_dn_per_s, range_m))
    )
    if not all(np.all(np.isfinite(a)) for a in (m, sigma, distance)):
        raise ValueError("the regression takes finite values only; leave out frames without a detection")
    if np.any(sigma <= 0.0) or np.any(distance <= 0.0):
        raise ValueError("sigmas and ranges must be positive")
    ranges_m, place = np.unique(distance, return_inverse=True)
    if ranges_m.size < 2 or m.size < 3:
        raise ValueError("a line and its χ² need at least three measurements at two different ranges")
    weight = (np.bincount(place) / np.bincount(place, weights=sigma**2))[place]
    x = 1.0 / distance**2
    total = float(weight.sum())
    x_mean, m_mean = float(weight @ x) / total, float(weight @ m) / total
    spread = float(weight @ (x - x_mean) ** 2)
    slope = float(weight @ ((x - x_mean) * (m - m_mean))) / spread
    intercept = m_mean - slope * x_mean
    # Inverse of the normal matrix [[Σ w x², Σ w x], [Σ w x, Σ w]].
    slope_variance = 1.0 / spread
    intercept_variance = 1.0 / total + x_mean**2 / spread
    through_origin = float(weight @ x**2)
    freedom = m.size - 2
    misfit = float(weight @ (m - slope * x - intercept) ** 2)
    return RangeConstantFit(
        slope_dn_m2_per_s=slope,
        intercept_dn_per_s=intercept,
        slope_sigma_dn_m2_per_s=math.sqrt(slope_variance),
        intercept_sigma_dn_per_s=math.sqrt(intercept_variance),
        correlation=-x_mean * slope_variance / math.sqrt(slope_variance * intercept_variance),
        range_constant_dn_m2_per_s=float(weight @ (x * m)) / through_origin,
        range_constant_sigma_dn_m2_per_s=1.0 / math.sqrt(through_origin),
        reduced_chi2=misfit / freedom,
        chi2_probability=float(chdtrc(freedom, misfit)),
        measurements=m.size,
    )


def regress_with_spread(
    m_dn_per_s: ArrayLike, sigma_dn_per_s: ArrayLike, range_m: ArrayLike
) -> tuple[RangeConstantFit, float]:
    """Fit the range constant where m spreads from place to place by more than its σ; return the spread too.

    Measurements at one range become their weighted mean. Each mean has, beside its own σ, a relative spread
    τ: that of the largest likelihood, −½ Σ (ln v + r²/v), v = σ² + (τ m)², r about a line through the origin.
    Measurements of a place count alike, but for those of which the σ is twice the median: these by their own.
    Parameters and errors as `regress_range_constant`.
    """
    m, sigma, distance = np.broadcast_arrays(
        *(np.atleast_1d(np.asarray(a, dtype=np.float64)) for a in (m_dn_per_s, sigma_dn_per_s, range_m))
    )
    regress_range_constant(m, sigma, distance)  # says what is wrong with them
    ranges_m, place = np.unique(distance, return_inverse=True)
    usual = np.array(
        [np.quantile(sigma[place == number], 0.5, method="lower") for number in range(ranges_m.size)]
    )[place]
    weight = 1.0 / np.where(sigma < 2.0 * usual, usual, sigma) ** 2
    total = np.bincount(place, weights=weight)
    mean, own = np.bincount(place, weights=weight * m) / total, 1.0 / np.sqrt(total)

    def at(spread: float) -> tuple[float, RangeConstantFit]:
        fit = regress_range_constant(mean, np.hypot(own, spread * mean), ranges_m)
        expected = fit.range_constant_dn_m2_per_s / ranges_m**2
        variance = own**2 + (spread * expected) ** 2
        return float(np.sum(np.log(variance) + (mean - expected) ** 2 / variance)), fit

    trials = [(*at(float(spread)), float(spread)) for spread in _SPREADS]
    _, fit, spread = min(trials, key=lambda trial: trial[0])
    return fit, spread
