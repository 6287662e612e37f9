"""The point spread averaged over what the shape of its glare may be.

How far glare reaches is known badly, and how much of it there is depends on that: the share's σ at one shape
says nothing of it at another. So the mean and the covariance are those over all shapes, by Gauss–Hermite
quadrature about the best one, nodes weighted by their likelihood (Naylor, Smith, Appl. Stat. 31, 214, 1982).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from perception.calibration.point_spread import (
    PointSpreadFit,
    StackedFlare,
    fit_point_spread,
    to_shape,
    to_vector,
)
from perception.types import Calibration

_NODES = 5
_SHAPE = slice(2, 4)


def averaged_over_glare(
    flares: Sequence[StackedFlare], calibration: Calibration, best: PointSpreadFit
) -> PointSpreadFit:
    """Return the mean over shapes of glare of a fit to which ln r₀ and ln (γ − 1) were free.

    Parameters
    ----------
    flares, calibration
        What was fitted.
    best
        The likeliest fit.
    """
    centre = to_vector(best.shape)
    axes = np.linalg.cholesky(best.covariance[_SHAPE, _SHAPE])
    has_growth = best.covariance[4, 4] > 0.0
    free = (True, True, False, False, has_growth)
    places, weights = np.polynomial.hermite_e.hermegauss(_NODES)
    means, covariances, log_weights = [], [], []
    for first, of_first in zip(places, weights, strict=True):
        for second, of_second in zip(places, weights, strict=True):
            away = np.array([first, second])
            start = centre.copy()
            start[_SHAPE] += axes @ away
            fit = fit_point_spread(flares, calibration, to_shape(start), free, like=best)
            inner = fit.covariance[np.ix_(*[[0, 1, *([4] if has_growth else [])]] * 2)]
            log_weights.append(
                np.log(of_first * of_second)
                + 0.5 * (away @ away)
                - 0.5 * (fit.chi2 - best.chi2)
                + 0.5 * float(np.linalg.slogdet(inner)[1])
            )
            means.append(to_vector(fit.shape))
            covariances.append(fit.covariance)
    share = np.exp(np.array(log_weights) - max(log_weights))
    share /= share.sum()
    mean = np.einsum("n,ni->i", share, means)
    off = np.array(means) - mean
    covariance = np.einsum("n,nij->ij", share, covariances) + np.einsum("n,ni,nj->ij", share, off, off)
    return replace(best, shape=to_shape(mean), covariance=covariance)
