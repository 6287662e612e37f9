"""Calibration on a rail: the range constants from frames of one source at known ranges, judged on others.

Every other range is fitted; the ranges between them are held out and judge what was fitted.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from perception.calibrate import (
    PaperRegression,
    RangeConstantFit,
    regress_paper_range_constant,
    regress_range_constant,
)
from perception.json_fields import RecordingError
from perception.limits import flare_limit
from perception.pipeline import detect
from perception.ranging import effective_exposure_s
from perception.types import Calibration, Detection, RawFrame

LEAST_PLACES = 6
"""Three ranges to fit (a line, and one to contradict it), three to judge."""

IDEAL_MAE = math.sqrt(2.0 / math.pi)
"""Mean absolute error of a Gaussian in units of its σ."""

IMPROBABLE = 1e-4
"""A χ² this improbable, or less probable, is a fault."""

MAX_MAE = 3.0
"""A mean absolute error beyond this multiple of an ideal estimator's is a fault."""

MAX_MISFITS = 0.05
"""A larger share of frames whose flare does not look like one source is a fault."""

SETTLED = 3e-4
"""The range constant has settled when a look at the frames moves it by less than this, relatively."""

MAX_PASSES = 8

_SAME_PLACE_M = 1e-6

Progress = Callable[[int, int], None]
"""Called with the number of frames done, and of all; begins anew with each pass."""


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
    range_limit_m
        Mean Cramér–Rao σ of the range over the frames held out. `IDEAL_MAE` times that is the mean absolute
        error of an ideal estimator.
    robust, paper_held_out
        Errors of both estimators with the new constants.
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
    range_limit_m: float
    robust: HeldOut
    paper_held_out: HeldOut


@dataclass(frozen=True, eq=False)
class _Sighting:
    """A frame of the rail without its pixels, and what an estimator took for the source."""

    range_m: float
    exposure_s: float
    gain: float
    black_level_dn: float
    detection: Detection | None


@dataclass(frozen=True, eq=False)
class _Settled:
    """The last fit, how far it moved K, the number of passes, and what the last one saw."""

    fit: RangeConstantFit
    change: float
    passes: int
    seen: tuple[_Sighting, ...]


Look = Callable[[Sequence[int], Calibration, str], list[_Sighting]]
"""Lets an estimator look, with a calibration, at the frames of some indices."""


def calibrate_rail(
    ranges_m: Mapping[int, float],
    load: Callable[[int], RawFrame],
    calibration: Calibration,
    progress: Progress = lambda _done, _total: None,
) -> RailCalibration:
    """Fit the range constants of one camera, and judge them on ranges held out.

    Places are the different ranges. In order of range, the first, third, … are fitted, the others held out.
    The brightest detection of a frame is the source.

    The detector needs a K to know how large a source looks: K too large by 1 % makes the flux 0.1 % too
    small. So the frames are looked at again with the K just found, until that changes by less than 0.03 %;
    what is left in K is a tenth of that. A claimed σ holds for a given K, so that of the fitted K comes out
    up to a tenth too large.

    Parameters
    ----------
    ranges_m
        Known range of each frame, by its index.
    load
        Gives the frame of an index.
    calibration
        Of the camera. Its range constant is only a first guess.
    progress
        Told how far each pass is.

    Returns
    -------
    RailCalibration

    Raises
    ------
    RecordingError
        If there are fewer than 6 different ranges, or the source is found at fewer than two of them.
    """

    def look(indices: Sequence[int], known: Calibration, estimator: str) -> list[_Sighting]:
        seen = []
        for done, index in enumerate(indices):
            seen.append(_sight(load(index), ranges_m[index], known, estimator))
            progress(done + 1, len(indices))
        return seen

    fitted, held_out = _split(ranges_m, calibration.camera)
    to_fit = [index for place in fitted for index in place]
    to_judge = [index for place in held_out for index in place]
    settled = _settle(look, to_fit, calibration)
    paper = _fit_paper(look(to_fit, calibration, "paper"))
    known = _with_constants(calibration, settled.fit, paper)
    robust = look(to_judge, known, "robust")
    return RailCalibration(
        calibration=known,
        fit=settled.fit,
        paper=paper,
        places_fitted=len(fitted),
        places_held_out=len(held_out),
        frames_fitted=len(to_fit),
        frames_held_out=len(to_judge),
        misfits=sum(s.detection.merged for s in (*settled.seen, *robust) if s.detection),
        passes=settled.passes,
        last_change=settled.change,
        range_limit_m=_mean([_limit_m(s, s.detection, known) for s in robust if s.detection]),
        # Without a claim (a clipped flare that cannot be recovered) the range is an upper bound, no estimate.
        robust=_judge([s for s in robust if s.detection and math.isfinite(s.detection.range_sigma_m)]),
        paper_held_out=_judge(look(to_judge, known, "paper")),
    )


def faults(result: RailCalibration) -> list[str]:
    """Say what speaks against a calibration, one sentence each; nothing where it holds."""
    fit, robust, frames = result.fit, result.robust, result.frames_held_out
    ideal_mae_m = IDEAL_MAE * result.range_limit_m
    said = []
    if not abs(result.last_change) < SETTLED:
        said.append(
            f"the range constant still moves by {result.last_change:+.2%} in pass {result.passes}: "
            "what is seen at different ranges does not agree on one"
        )
    if not fit.intercept_is_zero:
        said.append(
            f"the intercept, {fit.intercept_dn_per_s:.4g} ± {fit.intercept_sigma_dn_per_s:.2g} DN/s, is not "
            "zero: the flux does not follow 1/d² (stray light? ranges that do not count from lens to source?)"
        )
    if not fit.chi2_probability > IMPROBABLE:
        said.append(
            f"the fit's reduced χ², {fit.reduced_chi2:.2f}, has the probability {fit.chi2_probability:.1e}: "
            "the line, or the claimed sigmas, are wrong"
        )
    if result.misfits > MAX_MISFITS * (result.frames_fitted + frames):
        said.append(
            f"in {result.misfits} of {result.frames_fitted + frames} frames the flare does not look like one "
            "source: check psf_sigma_px and source_radius_m, and that no other light is near it"
        )
    if robust.found < frames:
        said.append(f"the source was ranged in only {robust.found} of {frames} frames held out")
    if not chi2.sf(robust.reduced_chi2 * robust.found, robust.found) > IMPROBABLE:
        said.append(
            f"the errors held out have a reduced χ² of {robust.reduced_chi2:.2f}: larger than claimed"
        )
    if not robust.range_mae_m <= MAX_MAE * ideal_mae_m:
        said.append(
            f"the mean absolute error held out, {robust.range_mae_m:.4f} m, is more than {MAX_MAE:g} times "
            f"that of an ideal estimator, {ideal_mae_m:.4f} m"
        )
    return said


def _split(ranges_m: Mapping[int, float], camera: str) -> tuple[list[list[int]], list[list[int]]]:
    """Return the frames of the places to fit, and those of the places to judge on."""
    places: list[list[int]] = []
    for index in sorted(ranges_m, key=lambda index: ranges_m[index]):
        if places and ranges_m[index] - ranges_m[places[-1][0]] < _SAME_PLACE_M:
            places[-1].append(index)
        else:
            places.append([index])
    if len(places) < LEAST_PLACES:
        raise RecordingError(
            f"{camera}: {len(places)} different ranges are known. Record at least {LEAST_PLACES}: "
            "one half is fitted, the other judges it."
        )
    return places[0::2], places[1::2]


def _sight(frame: RawFrame, range_m: float, calibration: Calibration, estimator: str) -> _Sighting:
    found = detect(frame, calibration, estimator)
    brightest = max(found, key=lambda detection: detection.flux_dn, default=None)
    return _Sighting(range_m, frame.exposure_s, frame.gain, frame.black_level_dn, brightest)


def _settle(look: Look, indices: Sequence[int], calibration: Calibration) -> _Settled:
    """Look and fit until the range constant does not change any more, or all passes are used up."""
    # The constant that is sought has no sigma yet, so a detection claims that of its flux alone.
    known = replace(calibration, sigma=_without_constants(calibration.sigma))
    for passes in range(1, MAX_PASSES + 1):
        seen = look(indices, known, "robust")
        fit = _fit(seen, known)
        change = fit.range_constant_dn_m2_per_s / known.range_constant_dn_m2_per_s - 1.0
        if abs(change) < SETTLED:
            break
        known = replace(known, range_constant_dn_m2_per_s=fit.range_constant_dn_m2_per_s)
    return _Settled(fit, change, passes, tuple(seen))


def _fit(seen: Sequence[_Sighting], calibration: Calibration) -> RangeConstantFit:
    """Regress the flux over its effective exposure.

    Flares that do not look like one source count too, with the wider sigmas that they claim: until K is near,
    that holds for all of them.
    """
    m, sigma, ranges_m = [], [], []
    for sighting in seen:
        found = sighting.detection
        if found is None or not math.isfinite(found.range_sigma_m):
            continue
        effective_s = effective_exposure_s(
            found.u_px, found.v_px, sighting.exposure_s, sighting.gain, calibration
        )
        m.append(found.flux_dn / effective_s)
        sigma.append(m[-1] * 2.0 * found.range_sigma_m / found.range_m)  # σ_d / d = ½ σ_F / F
        ranges_m.append(sighting.range_m)
    try:
        return regress_range_constant(m, sigma, ranges_m)
    except ValueError as error:
        raise RecordingError(
            f"{calibration.camera}: the source was measured in {len(m)} of {len(seen)} frames to fit, and "
            f"{error}. Look at the frames: is one source in view, alone, not clipped? Is the first guess of "
            "range_constant_dn_m2_per_s within a factor of 2?"
        ) from error


def _fit_paper(seen: Sequence[_Sighting]) -> PaperRegression | None:
    found = [
        (s.detection.mean_dn, s.detection.background_dn, s.exposure_s, s.range_m)
        for s in seen
        if s.detection is not None and math.isfinite(s.detection.background_dn)
    ]
    if len({range_m for *_, range_m in found}) < 2:
        return None
    return regress_paper_range_constant(*zip(*found, strict=True))


def _without_constants(sigma: Mapping[str, float]) -> dict[str, float]:
    return {name: value for name, value in sigma.items() if not name.startswith("range_constant")}


def _with_constants(
    calibration: Calibration, fit: RangeConstantFit, paper: PaperRegression | None
) -> Calibration:
    sigma = _without_constants(calibration.sigma)
    sigma["range_constant_dn_m2_per_s"] = fit.range_constant_sigma_dn_m2_per_s
    fitted = replace(calibration, range_constant_dn_m2_per_s=fit.range_constant_dn_m2_per_s, sigma=sigma)
    if paper is None:
        return fitted
    if math.isfinite(paper.slope_sigma_dn_m2_per_s):
        sigma["range_constant_paper_dn_m2_per_s"] = paper.slope_sigma_dn_m2_per_s
    return replace(fitted, range_constant_paper_dn_m2_per_s=paper.slope_dn_m2_per_s)


def _judge(seen: Sequence[_Sighting]) -> HeldOut:
    said = [(s.detection.range_m, s.detection.range_sigma_m, s.range_m) for s in seen if s.detection]
    range_m, sigma_m, true_m = np.array([row for row in said if math.isfinite(row[0])]).reshape(-1, 3).T
    errors_m = range_m - true_m
    return HeldOut(
        found=errors_m.size,
        range_mae_m=_mean(np.abs(errors_m)),
        range_rmse_m=math.sqrt(_mean(errors_m**2)),
        range_bias_m=_mean(errors_m),
        reduced_chi2=_mean((errors_m / sigma_m) ** 2),
    )


def _limit_m(sighting: _Sighting, found: Detection, calibration: Calibration) -> float:
    """Return the Cramér–Rao σ of the range, from the known range and the background found."""
    # `flare_limit` knows no gain: a frame at another gain is one of a camera with that system gain.
    system_gain_dn_per_e = calibration.system_gain_dn_per_e * sighting.gain
    effective_s = effective_exposure_s(
        found.u_px, found.v_px, sighting.exposure_s, sighting.gain, calibration
    )
    flux_dn = calibration.range_constant_dn_m2_per_s * effective_s / sighting.range_m**2
    background_dn = max(found.background_dn - sighting.black_level_dn, 0.0)
    limit = flare_limit(
        replace(calibration, system_gain_dn_per_e=system_gain_dn_per_e),
        found.u_px,
        found.v_px,
        sighting.range_m,
        flux_dn / system_gain_dn_per_e,
        background_dn / system_gain_dn_per_e,
    )
    return limit.range_sigma_m


def _mean(values: Sequence[float] | NDArray[np.float64]) -> float:
    return float(np.mean(values)) if np.size(values) else math.nan
