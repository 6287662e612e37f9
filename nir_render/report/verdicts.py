"""What the numbers of an estimator mean, in a plain sentence each, and whether that is good."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from nir_render.evaluate.estimator_errors import EstimatorErrors, Excess, excess, honesty
from nir_render.report.wording import counted, degrees, metres, share, times

Level = Literal["good", "fair", "bad", "none"]

LEAST_RECALL_FAIR = 0.95
FALSE_ALARMS_GOOD, FALSE_ALARMS_FAIR = 0.01, 0.1
EXCESS_GOOD, EXCESS_FAIR = 1.3, 3.0
NEES_SLACK = 1.21
NEES_FAIR = 4.0

RULES = {
    "Recall": f"good: every countable source found; fair: at least {100.0 * LEAST_RECALL_FAIR:.0f} %. "
    "Countable: in the image, lit, at least half visible, brightest pixel at least 5 σ above the noise.",
    "False alarms": f"good: at most {FALSE_ALARMS_GOOD} per frame; fair: at most {FALSE_ALARMS_FAIR}.",
    "Range and bearing": "root-mean-square error over the limit of the same flares. Good: at most "
    f"{EXCESS_GOOD} (or what chance allows so few, 97.5 %); fair: at most {EXCESS_FAIR:.0f}.",
    "Limit": "the Cramér–Rao bound: the light that truly arrives, point spread and calibration known; "
    "place, flux and background of each flare unknown. No unbiased estimator does better on single frames.",
    "Claimed σ": "mean of (range error / claimed σ)², 1 if the claims are right. Good: within the 95 % "
    "interval of that many flares, or σ right to 10 %; fair: σ right to a factor of 2.",
}


@dataclass(frozen=True)
class Verdict:
    """One card: what it is about, its number, how good that is, and a sentence of what it means."""

    about: str
    value: str
    level: Level
    sentence: str


def verdicts_of(numbers: Mapping[str, Any], errors: EstimatorErrors) -> tuple[Verdict, ...]:
    """Judge one estimator.

    Parameters
    ----------
    numbers
        Its part of `summary.json`.
    errors
        What it said of the countable sources.
    """
    return (
        _recall(errors),
        _false_alarms(numbers["false_alarms_per_frame"]),
        _range(errors),
        _bearing(errors),
        _claims(errors),
    )


def _recall(errors: EstimatorErrors) -> Verdict:
    total, found = errors.found.size, int(errors.found.sum())
    if total == 0:
        return Verdict("Recall", "–", "none", "No source was there to be found.")
    level: Level = "good" if found == total else "fair" if found >= LEAST_RECALL_FAIR * total else "bad"
    if found == total:
        said = f"Found {'the one source' if total == 1 else f'all {total} sources'} that could be seen."
    else:
        missed = errors.range_m[~errors.found]
        said = (
            f"Missed {total - found} of {counted(total, 'source')} that could be seen, "
            f"the nearest at {metres(float(missed.min()))}."
        )
    return Verdict("Recall", share(found / total), level, said)


def _false_alarms(per_frame: float | None) -> Verdict:
    if per_frame is None:
        return Verdict("False alarms", "–", "none", "There are no frames.")
    if per_frame == 0.0:
        return Verdict("False alarms", "0", "good", "Reported nothing that is no source.")
    level: Level = (
        "good" if per_frame <= FALSE_ALARMS_GOOD else "fair" if per_frame <= FALSE_ALARMS_FAIR else "bad"
    )
    said = (
        f"One in {1.0 / per_frame:.0f} frames." if per_frame < 0.7 else "Reports things that are no sources."
    )
    return Verdict("False alarms", f"{per_frame:.2g} per frame", level, said)


def _range(errors: EstimatorErrors) -> Verdict:
    known = np.isfinite(errors.error_m)
    if not known.any():
        return Verdict("Range", "–", "none", "No source was ranged.")
    rmse_m = float(np.sqrt(np.mean(errors.error_m[known] ** 2)))
    mae_m, bias_m = float(np.mean(np.abs(errors.error_m[known]))), float(np.mean(errors.error_m[known]))
    compared = excess(errors.error_m, errors.range_limit_m)
    if compared is None:
        return Verdict("Range", f"RMSE {metres(rmse_m)}", "none", "No flare has a finite limit.")
    said = (
        f"{_against(compared, metres(compared.limit_rms))} "
        f"Mean absolute error {metres(mae_m)}, bias {metres(bias_m, signed=True)}."
    )
    return Verdict("Range", f"RMSE {metres(rmse_m)}", _level(compared), said)


def _bearing(errors: EstimatorErrors) -> Verdict:
    compared = excess(errors.bearing_deg, errors.bearing_limit_deg, directions=2)
    if compared is None:
        return Verdict("Bearing", "–", "none", "No source was found.")
    said = _against(compared, degrees(compared.limit_rms))
    return Verdict("Bearing", f"RMS {degrees(compared.rms)}", _level(compared), said)


def _claims(errors: EstimatorErrors) -> Verdict:
    held = honesty(errors.error_m, errors.claimed_m)
    if held is None:
        return Verdict("Claimed σ", "none", "none", "Says nothing about how far its ranges may be off.")
    slight = 1.0 / NEES_SLACK <= held.mean_square <= NEES_SLACK
    level: Level = "bad"
    if held.low <= held.mean_square <= held.high or slight:
        level, said = "good", "Its ranges are off by as much as it claims."
    else:
        level = "fair" if 1.0 / NEES_FAIR <= held.mean_square <= NEES_FAIR else "bad"
        root = held.mean_square**0.5
        too = "too small" if root > 1.0 else "too large"
        factor = f"{times(max(root, 1.0 / root))} × " if root > 0.0 else ""
        said = f"The σ it claims are {factor}{too}."
    expected = "gives" if held.count == 1 else "give"
    interval = f"By chance {counted(held.count, 'flare')} {expected} {held.low:.2f} to {held.high:.2f}."
    return Verdict("Claimed σ", f"NEES {times(held.mean_square)}", level, f"{said} {interval}")


def _level(compared: Excess) -> Level:
    if compared.ratio <= max(EXCESS_GOOD, compared.by_chance):
        return "good"
    return "fair" if compared.ratio <= EXCESS_FAIR else "bad"


def _against(compared: Excess, limit: str) -> str:
    """Say how an error stands to its limit; what lies within chance of it is at the limit."""
    if compared.ratio <= compared.by_chance:
        return f"At the limit: physics allows {limit} ({times(compared.ratio)} ×)."
    return f"{times(compared.ratio)} × the limit: physics allows {limit}."
