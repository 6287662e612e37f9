"""What comes of a calibration on a rail, and what may speak against it."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception.calibration.range_constant import RangeConstantFit
from perception.causes import DetectionCauses
from perception.paper import PaperRegression
from perception.types import Calibration

IDEAL_MAE = math.sqrt(2.0 / math.pi)
"""Mean absolute error of a Gaussian in units of its σ."""

IMPROBABLE = 1e-4
"""A χ² this improbable, or less probable, is a fault."""

MAX_MAE = 3.0
"""A mean absolute error beyond this multiple of an ideal estimator's is a fault."""

MAX_MISFITS = 0.05
"""A larger share of frames whose flare does not look like one source is a fault."""

CONVERGED_CHANGE = 3e-4
"""The range constant has settled when a look at the frames moves it by less than this, relatively."""


@dataclass(frozen=True)
class HeldOut:
    """An estimator's range errors in the frames held out; NaN where it found none.

    `reduced_chi2` is the mean square of the errors in units of their claimed σ, 1 where the claims are true;
    NaN for an estimator that claims nothing.
    """

    found: int
    range_mae_m: float
    range_rmse_m: float
    range_bias_m: float
    reduced_chi2: float


@dataclass(frozen=True, eq=False)
class RailCalibration:
    """What came of a rail: the calibration with the fitted constants, and how good it is.

    Attributes
    ----------
    calibration
        As it was, but for the range constants and their sigmas.
    fit
        Its line through the origin gave the constant of the flux.
    paper
        Its slope gave the paper's constant. None where the paper's detector found the source at fewer than
        two ranges: the constant then stayed as it was.
    places_fitted, places_held_out, frames_fitted, frames_held_out
        Counts.
    misfits
        In how many frames, fitted or held out, the flare did not look like one source.
    passes, last_change
        How often the frames to fit were looked at, and by how much, relatively, the last look moved K.
    share_spread
        Relative σ by which the share of a flare's light that the detector finds differs from place to place,
        where the lens has glare; it is part of the constant's σ.
    range_limit_m
        Mean Cramér–Rao σ of the range over the frames held out. `IDEAL_MAE` times that is the mean absolute
        error of an ideal estimator.
    robust, paper_held_out
        Errors of both estimators with the new constants.
    judged_m
        True range, error and claimed σ of each frame held out, shape (n, 3).
    causes
        What each of these σ is made of.
    """

    calibration: Calibration
    fit: RangeConstantFit
    paper: PaperRegression | None
    places_fitted: int
    places_held_out: int
    frames_fitted: int
    frames_held_out: int
    misfits: int
    passes: int
    last_change: float
    share_spread: float
    range_limit_m: float
    robust: HeldOut
    paper_held_out: HeldOut
    judged_m: NDArray[np.float64]
    causes: tuple[DetectionCauses, ...]


def faults(result: RailCalibration) -> list[str]:
    """Say what speaks against a calibration, one sentence each; nothing where it holds."""
    from scipy.special import chdtrc

    fit, robust, frames = result.fit, result.robust, result.frames_held_out
    ideal_mae_m = IDEAL_MAE * result.range_limit_m
    sentences = []
    if not abs(result.last_change) < CONVERGED_CHANGE:
        sentences.append(
            f"the range constant still moves by {result.last_change:+.2%} in pass {result.passes}: "
            "what is seen at different ranges does not agree on one"
        )
    if not fit.intercept_is_zero:
        sentences.append(
            f"the intercept, {fit.intercept_dn_per_s:.4g} ± {fit.intercept_sigma_dn_per_s:.2g} DN/s, is not "
            "zero: the flux does not follow 1/d² (stray light? ranges that do not count from lens to source?)"
        )
    if not fit.chi2_probability > IMPROBABLE:
        sentences.append(
            f"the fit's reduced χ², {fit.reduced_chi2:.2f}, has the probability {fit.chi2_probability:.1e}: "
            "the line, or the claimed sigmas, are wrong"
        )
    if result.misfits > MAX_MISFITS * (result.frames_fitted + frames):
        sentences.append(
            f"in {result.misfits} of {result.frames_fitted + frames} frames the flare does not look like one "
            "source: check psf_sigma_px and source_radius_m, and that no other light is near it"
        )
    if robust.found < frames:
        sentences.append(f"the source was ranged in only {robust.found} of {frames} frames held out")
    if not chdtrc(robust.found, robust.reduced_chi2 * robust.found) > IMPROBABLE:
        sentences.append(
            f"the errors held out have a reduced χ² of {robust.reduced_chi2:.2f}: larger than claimed"
        )
    if not robust.range_mae_m <= MAX_MAE * ideal_mae_m:
        sentences.append(
            f"the mean absolute error held out, {robust.range_mae_m:.4f} m, is more than {MAX_MAE:g} times "
            f"that of an ideal estimator, {ideal_mae_m:.4f} m"
        )
    return sentences
