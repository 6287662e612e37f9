"""A stack's detections against truth and against the physical limit, as numbers."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from nir_render.evaluate.match import countable, match
from nir_render.evaluate.truth import SourceTruth
from perception.limits import flare_limit
from perception.types import Calibration, Detection

FrameKey = tuple[str, int]
Item = TypeVar("Item", SourceTruth, Detection)


@dataclass(frozen=True)
class Score:
    """One source in one frame: its truth, the radiometric limit, and what each estimator said of it."""

    truth: SourceTruth
    countable: bool
    range_limit_m: float
    detections: Mapping[str, Detection]


@dataclass(frozen=True)
class Evaluation:
    """All scores, and the numbers of `summary.json`."""

    scores: tuple[Score, ...]
    summary: Mapping[str, Any]


def evaluate(
    frames: Sequence[FrameKey],
    truth: Iterable[SourceTruth],
    calibrations: Mapping[str, Calibration],
    detections: Mapping[str, Iterable[Detection]],
) -> Evaluation:
    """Score the detections of each estimator.

    Parameters
    ----------
    frames
        Camera and index of all frames, those without sources included.
    truth
        All truth rows.
    calibrations
        By camera.
    detections
        By estimator: all its detections.
    """
    truth_in = _by_frame(truth)
    found_in = {name: _by_frame(found) for name, found in detections.items()}
    scores: list[Score] = []
    false_alarms = dict.fromkeys(detections, 0)
    ghosts = dict.fromkeys(detections, 0)
    for key in frames:
        calibration = calibrations[key[0]]
        rows = truth_in.get(key, [])
        matched: list[dict[str, Detection]] = [{} for _ in rows]
        for name in detections:
            real = [detection for detection in found_in[name].get(key, []) if not detection.ghost]
            ghosts[name] += len(found_in[name].get(key, [])) - len(real)
            pairing = match(rows, real, calibration)
            false_alarms[name] += len(pairing.unmatched)
            for i, j in pairing.pairs:
                matched[i][name] = real[j]
        scores += [
            Score(row, countable(row, calibration), range_limit_m(row, calibration), said)
            for row, said in zip(rows, matched, strict=True)
        ]
    counted = [score for score in scores if score.countable]
    summary = {
        "format": 1,
        "frames": len(frames),
        "sources_visible": len(counted),
        "range_limit_rmse_m": _rms([score.range_limit_m for score in counted]),
        "estimators": {
            name: {
                **_estimator_numbers(counted, name),
                "false_alarms_per_frame": false_alarms[name] / len(frames) if frames else None,
                "ghosts_reported": ghosts[name],
            }
            for name in detections
        },
    }
    return Evaluation(tuple(scores), summary)


def range_limit_m(truth: SourceTruth, calibration: Calibration) -> float:
    """Return the Cramér–Rao bound (1 σ) of a source's range from its flux; NaN without light."""
    if not truth.direct_e > 0.0:
        return math.nan
    limit = flare_limit(calibration, truth.u_px, truth.v_px, truth.range_m, truth.direct_e, 0.0)
    return limit.range_sigma_m


def _estimator_numbers(counted: Sequence[Score], name: str) -> dict[str, Any]:
    found = [(score, score.detections[name]) for score in counted if name in score.detections]
    errors_m = [said.range_m - score.truth.range_m for score, said in found if math.isfinite(said.range_m)]
    angles_deg = [_angle_deg(said.bearing_body, score.truth.bearing_body) for score, said in found]
    return {
        "recall": len(found) / len(counted) if counted else None,
        "range_mae_m": float(np.mean(np.abs(errors_m))) if errors_m else None,
        "range_rmse_m": _rms(errors_m),
        "range_bias_m": float(np.mean(errors_m)) if errors_m else None,
        "ranges_missing": len(found) - len(errors_m),
        "bearing_rms_deg": _rms(angles_deg),
    }


def _angle_deg(one: Sequence[float], other: Sequence[float]) -> float:
    """Return the angle between unit vectors, exact also where it is tiny."""
    cross = float(np.linalg.norm(np.cross(one, other)))
    return math.degrees(math.atan2(cross, float(np.dot(one, other))))


def _rms(values: Sequence[float]) -> float | None:
    finite = [value for value in values if math.isfinite(value)]
    return float(np.sqrt(np.mean(np.square(finite)))) if finite else None


def _by_frame(items: Iterable[Item]) -> dict[FrameKey, list[Item]]:
    frames: dict[FrameKey, list[Item]] = defaultdict(list)
    for item in items:
        frames[item.camera, item.index].append(item)
    return frames
