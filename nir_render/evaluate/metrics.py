"""A stack's detections against truth and against the physical limit, as numbers."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from nir_render.evaluate.lamps import on_a_lamp
from nir_render.evaluate.match import countable, match
from nir_render.evaluate.truth import SourceTruth
from perception.bearing import direction_camera
from perception.limits import flare_limit
from perception.sensor import at_gain
from perception.types import Calibration, Detection

FrameKey = tuple[str, int]
Item = TypeVar("Item", SourceTruth, Detection)


@dataclass(frozen=True)
class Score:
    """One source in one frame: its truth, its limits (see `source_limits`), and what each estimator said."""

    truth: SourceTruth
    countable: bool
    range_limit_m: float
    bearing_limit_deg: float
    detections: Mapping[str, Detection]


@dataclass(frozen=True)
class Evaluation:
    """All scores, each estimator's false alarms, and the numbers of `summary.json`.

    `ghosts` are the scores of the sources' mirror images, none of which counts.
    """

    scores: tuple[Score, ...]
    false_alarms: Mapping[str, tuple[Detection, ...]]
    summary: Mapping[str, Any]
    ghosts: tuple[Score, ...] = ()


def evaluate(
    frames: Sequence[FrameKey],
    truth: Iterable[SourceTruth],
    calibrations: Mapping[str, Calibration],
    detections: Mapping[str, Iterable[Detection]],
    lamps: Mapping[FrameKey, Sequence[NDArray[np.float32]]] | None = None,
) -> Evaluation:
    """Score the detections of each estimator.

    A detection that belongs to a ghost, or that its estimator calls one, is counted apart: it is neither a
    hit nor a false alarm.

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
    lamps
        Outlines of lamps and the sun by frame, in pixels: what is found there is counted apart.
    """
    truth_in = _by_frame(truth)
    found_in = {name: _by_frame(found) for name, found in detections.items()}
    scores: list[Score] = []
    false_alarms: dict[str, list[Detection]] = {name: [] for name in detections}
    ghosts = dict.fromkeys(detections, 0)
    lamps_reported = dict.fromkeys(detections, 0)
    for key in frames:
        calibration = calibrations[key[0]]
        rows = truth_in.get(key, [])
        matched: list[dict[str, Detection]] = [{} for _ in rows]
        for name in detections:
            real = [detection for detection in found_in[name].get(key, []) if not detection.ghost]
            ghosts[name] += len(found_in[name].get(key, [])) - len(real)
            pairing = match(rows, real, calibration)
            outlines = (lamps or {}).get(key, ())
            on_lamps = [on_a_lamp(real[j], outlines) for j in pairing.unmatched]
            lamps_reported[name] += sum(on_lamps)
            false_alarms[name] += [
                real[j] for j, lamp in zip(pairing.unmatched, on_lamps, strict=True) if not lamp
            ]
            for i, j in pairing.pairs:
                matched[i][name] = real[j]
                ghosts[name] += rows[i].ghost_of is not None
        scores += [
            Score(row, countable(row, calibration), *source_limits(row, calibration), said)
            for row, said in zip(rows, matched, strict=True)
        ]
    mirrored = tuple(score for score in scores if score.truth.ghost_of is not None)
    scores = [score for score in scores if score.truth.ghost_of is None]
    counted = [score for score in scores if score.countable]
    summary = {
        "format": 1,
        "frames": len(frames),
        "sources_visible": len(counted),
        "range_limit_rmse_m": _rms([score.range_limit_m for score in counted]),
        "bearing_limit_rms_deg": _rms([score.bearing_limit_deg for score in counted]),
        "estimators": {
            name: {
                **_estimator_numbers(counted, name),
                "false_alarms_per_frame": len(false_alarms[name]) / len(frames) if frames else None,
                "ghosts_reported": ghosts[name],
                "lamps_reported": lamps_reported[name],
            }
            for name in detections
        },
    }
    alarms = {name: tuple(found) for name, found in false_alarms.items()}
    return Evaluation(tuple(scores), alarms, summary, mirrored)


def source_limits(truth: SourceTruth, calibration: Calibration) -> tuple[float, float]:
    """Return the Cramér–Rao bounds (1 σ) of a source's range from its flux, in metres, and of its bearing.

    They are those of a camera that has the frame's gain for good, of the light that is in the flare, with the
    light of elsewhere and the dark signal as background. The bearing's, in degrees, is the root of the mean
    squared angle, both directions together. NaN without light.
    """
    if not truth.direct_e > 0.0:
        return math.nan, math.nan
    limit = flare_limit(
        at_gain(calibration, truth.gain),
        truth.u_px,
        truth.v_px,
        truth.range_m,
        truth.flare_share * truth.direct_e,
        truth.background_e + truth.dark_e,
    )
    steps_px = np.array([[-0.5, 0.0], [0.5, 0.0], [0.0, -0.5], [0.0, 0.5]])
    left, right, above, below = direction_camera(steps_px + np.array([truth.u_px, truth.v_px]), calibration)
    along_u_rad = float(np.linalg.norm(right - left)) * limit.u_sigma_px
    along_v_rad = float(np.linalg.norm(below - above)) * limit.v_sigma_px
    return limit.range_sigma_m, math.degrees(math.hypot(along_u_rad, along_v_rad))


def _estimator_numbers(counted: Sequence[Score], name: str) -> dict[str, Any]:
    found = [(score, score.detections[name]) for score in counted if name in score.detections]
    errors_m = [said.range_m - score.truth.range_m for score, said in found if math.isfinite(said.range_m)]
    angles_deg = [angle_deg(said.bearing_body, score.truth.bearing_body) for score, said in found]
    return {
        "recall": len(found) / len(counted) if counted else None,
        "range_mae_m": float(np.mean(np.abs(errors_m))) if errors_m else None,
        "range_rmse_m": _rms(errors_m),
        "range_bias_m": float(np.mean(errors_m)) if errors_m else None,
        # The limit over the same sources, so that the two can be compared.
        "range_limit_rmse_m": _rms([s.range_limit_m for s, said in found if math.isfinite(said.range_m)]),
        "saturated": sum(said.saturated for _, said in found),
        "ranges_missing": len(found) - len(errors_m),
        "bearing_rms_deg": _rms(angles_deg),
    }


def angle_deg(one: Sequence[float], other: Sequence[float]) -> float:
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
