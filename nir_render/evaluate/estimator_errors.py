"""The errors of an estimator: its ranges and bearings against truth, as arrays to draw and to judge."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from nir_render.evaluate.metrics import Score, angle_deg

Values = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class EstimatorErrors:
    """One estimator on all countable sources, in the order of the scores; arrays of shape (n,).

    Where it found none, `found` is False and what it said is NaN. `claimed_m` is the σ of the range that the
    estimator claims; `range_limit_m` and `bearing_limit_deg` are the limits, 1 σ.
    """

    found: NDArray[np.bool_]
    range_m: Values
    error_m: Values
    range_limit_m: Values
    claimed_m: Values
    bearing_deg: Values
    bearing_limit_deg: Values

    @property
    def pull(self) -> Values:
        """Range error in units of the limit; NaN where either is missing or the limit is infinite."""
        return _ratio(self.error_m, self.range_limit_m)


def errors_of(scores: Sequence[Score], name: str) -> EstimatorErrors:
    """Return what one estimator said of the countable sources."""
    rows = []
    for score in scores:
        if not score.countable:
            continue
        truth, said = score.truth, score.detections.get(name)
        heard = (np.nan, np.nan, np.nan)
        if said is not None:
            heard = (
                said.range_m - truth.range_m,
                said.range_sigma_m,
                angle_deg(said.bearing_body, truth.bearing_body),
            )
        rows.append((said is not None, truth.range_m, score.range_limit_m, score.bearing_limit_deg, *heard))
    columns = np.array(rows, dtype=np.float64).reshape(-1, 7).T
    found, range_m, range_limit_m, bearing_limit_deg, error_m, claimed_m, bearing_deg = columns
    return EstimatorErrors(
        found=found.astype(bool),
        range_m=range_m,
        error_m=error_m,
        range_limit_m=range_limit_m,
        claimed_m=claimed_m,
        bearing_deg=bearing_deg,
        bearing_limit_deg=bearing_limit_deg,
    )


@dataclass(frozen=True)
class Excess:
    """How far an error exceeds its limit, as a ratio of root mean squares over the same flares.

    `by_chance` is what the ratio of a perfect estimator stays below in 97.5 of 100 runs. It counts the
    flares that matter, (Σσ²)² / Σσ⁴: a few far ones may carry all of the error.
    """

    rms: float
    limit_rms: float
    count: int
    by_chance: float

    @property
    def ratio(self) -> float:
        """RMS over RMS."""
        return self.rms / self.limit_rms


def excess(error: Values, limit: Values, directions: int = 1) -> Excess | None:
    """Compare errors with their limits; None where no flare has both.

    Parameters
    ----------
    error, limit
        Shape (n,); those that are not finite are left out.
    directions
        Of how many independent Gaussian parts each error consists: 1 for a range, 2 for a bearing.
    """
    known = np.isfinite(error) & np.isfinite(limit) & (limit > 0.0)
    if not known.any():
        return None
    error2, limit2 = error[known] ** 2, limit[known] ** 2
    effective = directions * limit2.sum() ** 2 / (limit2**2).sum()
    return Excess(
        rms=float(np.sqrt(error2.mean())),
        limit_rms=float(np.sqrt(limit2.mean())),
        count=int(known.sum()),
        by_chance=float(np.sqrt(chdtri(effective, 0.025) / effective)),
    )


@dataclass(frozen=True)
class Honesty:
    """Mean squared error in units of the claimed σ (NEES): 1 if the claims are right.

    `low` to `high` holds 95 of 100 runs of an estimator whose claims are right (χ² with `count` degrees of
    freedom).
    """

    mean_square: float
    count: int
    low: float
    high: float


def honesty(error: Values, claimed: Values) -> Honesty | None:
    """Hold errors against the σ that was claimed for them; None where no σ is claimed."""
    ratio = _ratio(error, claimed)
    known = ratio[np.isfinite(ratio)]
    if known.size == 0:
        return None
    low, high = (float(chdtri(known.size, tail)) / known.size for tail in (0.975, 0.025))
    return Honesty(float(np.mean(known**2)), int(known.size), low, high)


def limit_curve(range_m: Values, limit: Values, bins: int = 40) -> tuple[Values, Values]:
    """Return the limit against range as a line: root mean square over at most `bins` steps of range.

    The limit also depends on exposure, field angle and occlusion, so flares at one range differ.

    Returns
    -------
    Mean range and RMS limit of each step that holds a flare, by increasing range.
    """
    known = np.isfinite(range_m) & np.isfinite(limit)
    if not known.any():
        return np.empty(0), np.empty(0)
    x, y2 = range_m[known], limit[known] ** 2
    edges = np.linspace(x.min(), x.max(), bins + 1)
    step = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, bins - 1)
    count = np.bincount(step, minlength=bins)
    filled = count > 0
    mean_x = np.bincount(step, x, bins)[filled] / count[filled]
    return mean_x, np.sqrt(np.bincount(step, y2, bins)[filled] / count[filled])


def _ratio(error: Values, sigma: Values) -> Values:
    usable = np.isfinite(error) & np.isfinite(sigma) & (sigma > 0.0)
    ratio: Values = np.divide(error, sigma, out=np.full(error.shape, np.nan), where=usable)
    return ratio
