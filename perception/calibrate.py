"""The paper's calibration (Exp1): the range constant as the slope of a regression."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class PaperRegression:
    """Line m = slope / d² + intercept with the standard errors of both.

    `slope_dn_m2_per_s` is the paper's K (`Calibration.range_constant_paper_dn_m2_per_s`). An intercept that
    differs from zero by more than its sigma says that the law does not hold over these ranges.
    """

    slope_dn_m2_per_s: float
    intercept_dn_per_s: float
    slope_sigma_dn_m2_per_s: float
    intercept_sigma_dn_per_s: float


def regress_paper_range_constant(
    mean_dn: ArrayLike, background_dn: ArrayLike, exposure_s: ArrayLike, range_m: ArrayLike
) -> PaperRegression:
    """Fit the paper's range constant: m = (N_d - N̄)/t against 1/d², ordinary least squares.

    Unweighted, with an intercept, as the paper's Exp1 states it ("the slope is K").

    Parameters
    ----------
    mean_dn, background_dn
        N_d and N̄ of each image, shape (n,).
    exposure_s
        Exposure of each image, shape (n,), or one for all.
    range_m
        Known distances, shape (n,).

    Returns
    -------
    PaperRegression
        The sigmas are the usual standard errors (residual variance over n - 2); NaN for n = 2.

    Raises
    ------
    ValueError
        If there are fewer than two different ranges, or a value is not finite, or a range or exposure is
        not positive.
    """
    mean, background, exposure, distance = np.broadcast_arrays(
        *(
            np.atleast_1d(np.asarray(a, dtype=np.float64))
            for a in (mean_dn, background_dn, exposure_s, range_m)
        )
    )
    if not all(np.all(np.isfinite(a)) for a in (mean, background, exposure, distance)):
        raise ValueError("the regression takes finite values only; leave out frames without a detection")
    if np.any(exposure <= 0.0) or np.any(distance <= 0.0):
        raise ValueError("exposures and ranges must be positive")
    m = (mean - background) / exposure
    x = 1.0 / distance**2
    spread = float(np.sum((x - x.mean()) ** 2))
    if np.unique(distance).size < 2 or spread == 0.0:
        raise ValueError("a slope needs at least two different ranges")
    slope = float(np.sum((x - x.mean()) * (m - m.mean()))) / spread
    intercept = float(m.mean()) - slope * float(x.mean())
    slope_sigma = intercept_sigma = math.nan
    if m.size > 2:
        residual_variance = float(np.sum((m - slope * x - intercept) ** 2)) / (m.size - 2)
        slope_sigma = math.sqrt(residual_variance / spread)
        intercept_sigma = math.sqrt(residual_variance * (1.0 / m.size + float(x.mean()) ** 2 / spread))
    return PaperRegression(slope, intercept, slope_sigma, intercept_sigma)
