"""A stack's detections against truth and against the physical limit, as numbers."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nir_render.evaluate.match import by_frame, countable, image_radius_px, match, on_a_lamp
from nir_render.evaluate.messages import MessageEvaluation
from nir_render.evaluate.sets import SetEvaluation
from nir_render.evaluate.tracks import TrackEvaluation
from nir_render.truth.lamps import LampTruth, Outline
from nir_render.truth.sources import SourceTruth
from perception.model.bearing import pixel_turn
from perception.model.fisher import flare_limits, limit_box
from perception.model.flare import PixelBox, flare_image, has_image
from perception.model.ranging import angular_radius_rad
from perception.model.sensor import at_gain
from perception.types import Calibration, Detection, FrameKey

_OVERLAP_SIGMAS = 6.0


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

    `ghosts` are the scores of the sources' mirror images, none of which counts; `around` those of the rigs'
    measurements, `over_time` those of tracks and `heard` those of messages, where there are any.
    """

    scores: tuple[Score, ...]
    false_alarms: Mapping[str, tuple[Detection, ...]]
    summary: Mapping[str, Any]
    ghosts: tuple[Score, ...] = ()
    around: SetEvaluation | None = None
    over_time: TrackEvaluation | None = None
    heard: MessageEvaluation | None = None


def evaluate(
    frames: Sequence[FrameKey],
    truth: Iterable[SourceTruth],
    calibrations: Mapping[str, Calibration],
    detections: Mapping[str, Iterable[Detection]],
    lamps: Iterable[LampTruth] = (),
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
        Where lamps and the sun stand: what is found there is counted apart.
    """
    truth_in, lamps_in = by_frame(truth), by_frame(lamps)
    found_in = {name: by_frame(found) for name, found in detections.items()}
    frame_scores = [
        _score_frame(
            truth_in.get(key, []),
            {name: found.get(key, []) for name, found in found_in.items()},
            [lamp.outline_px for lamp in lamps_in.get(key, [])],
            calibrations[key[0]],
        )
        for key in frames
    ]
    scores = [score for frame in frame_scores for score in frame.scores]
    sources = [score for score in scores if score.truth.ghost_of is None]
    return Evaluation(
        scores=tuple(sources),
        false_alarms={
            name: tuple(alarm for frame in frame_scores for alarm in frame.false_alarms[name])
            for name in detections
        },
        summary=_summary(sources, frame_scores, list(detections)),
        ghosts=tuple(score for score in scores if score.truth.ghost_of is not None),
    )


@dataclass(frozen=True)
class _FrameScores:
    """One frame: the score of each truth row, and by estimator what belongs to no source."""

    scores: tuple[Score, ...]
    false_alarms: Mapping[str, list[Detection]]
    ghosts_reported: Mapping[str, int]
    lamps_reported: Mapping[str, int]


def _score_frame(
    rows: Sequence[SourceTruth],
    detections: Mapping[str, Sequence[Detection]],
    outlines_px: Sequence[Outline],
    calibration: Calibration,
) -> _FrameScores:
    hits: list[dict[str, Detection]] = [{} for _ in rows]
    alarms: dict[str, list[Detection]] = {}
    ghosts, lamps = dict.fromkeys(detections, 0), dict.fromkeys(detections, 0)
    for name, found in detections.items():
        sources = [detection for detection in found if not detection.ghost]
        pairing = match(rows, sources, calibration)
        # What calls itself a ghost counts apart only where there is a mirror image.
        called = [detection for detection in found if detection.ghost]
        mirrored = match([row for row in rows if row.ghost_of is not None], called, calibration)
        unmatched = [sources[j] for j in pairing.unmatched] + [called[j] for j in mirrored.unmatched]
        alarms[name] = [detection for detection in unmatched if not on_a_lamp(detection, outlines_px)]
        lamps[name] = len(unmatched) - len(alarms[name])
        ghosts[name] = len(mirrored.pairs)
        for i, j in pairing.pairs:
            hits[i][name] = sources[j]
            ghosts[name] += rows[i].ghost_of is not None
    scores = tuple(
        Score(row, countable(row, calibration), *source_limits(row, calibration, rows), hit)
        for row, hit in zip(rows, hits, strict=True)
    )
    return _FrameScores(scores, alarms, ghosts, lamps)


def _summary(
    sources: Sequence[Score], frames: Sequence[_FrameScores], estimators: Sequence[str]
) -> dict[str, Any]:
    """Return the numbers of `summary.json`."""
    counted = [score for score in sources if score.countable]
    return {
        "format": 1,
        "frames": len(frames),
        "sources_visible": len(counted),
        "range_limit_rmse_m": _rms([score.range_limit_m for score in counted]),
        "bearing_limit_rms_deg": _rms([score.bearing_limit_deg for score in counted]),
        "estimators": {
            name: {
                **_estimator_numbers(counted, name),
                "false_alarms_per_frame": (
                    sum(len(frame.false_alarms[name]) for frame in frames) / len(frames) if frames else None
                ),
                "ghosts_reported": sum(frame.ghosts_reported[name] for frame in frames),
                "lamps_reported": sum(frame.lamps_reported[name] for frame in frames),
            }
            for name in estimators
        },
    }


def source_limits(
    truth: SourceTruth, calibration: Calibration, rows: Sequence[SourceTruth] = ()
) -> tuple[float, float]:
    """Return the Cramér–Rao bounds (1 σ) of a source's range, in metres, and of its bearing.

    They are those of a camera that has the frame's gain for good, of the light that is in the flare, with the
    light of elsewhere and the dark signal as background. Flares of the same frame, `rows`, whose images
    overlap have to be told from it: their places and ranges are not known either. Flares that move while they
    are exposed are drawn out, by how much is not known either. The bearing's, in degrees,
    is the root of the mean squared angle, both directions together. NaN without light.
    """
    if not truth.direct_e > 0.0:
        return math.nan, math.nan
    camera = at_gain(calibration, truth.gain)
    together = (truth, *_overlapping(truth, calibration, rows))
    flares = [_as_flare(row) for row in together]
    motions_px = [(row.moved_u_px, row.moved_v_px) for row in together]
    background_e = truth.background_e + truth.dark_e
    box = limit_box(camera, flares[:1])
    if len(flares) > 1 and box.height * box.width > 0:
        # What the others shine into its pixels is theirs.
        own, *others = (_share(flare, box, camera) * flare[3] for flare in flares)
        shone_e = sum(other[own > 0.01 * own.max()].mean() for other in others)
        background_e = max(background_e - float(shone_e), truth.dark_e)
    moves = any(map(any, motions_px))
    limit = flare_limits(camera, flares, background_e, motions_px=motions_px if moves else None)[0]
    ((turn_u, turn_v),) = pixel_turn([[truth.u_px, truth.v_px]], calibration)
    along_u_rad = float(np.linalg.norm(turn_u)) * limit.u_sigma_px
    along_v_rad = float(np.linalg.norm(turn_v)) * limit.v_sigma_px
    return limit.range_sigma_m, math.degrees(math.hypot(along_u_rad, along_v_rad))


_Flare = tuple[float, float, float, float]  # u_px, v_px, range_m, flux_e


def _as_flare(row: SourceTruth) -> _Flare:
    return row.u_px, row.v_px, row.range_m, row.flare_share * (row.direct_e + row.mirrored_e)


def _share(flare: _Flare, box: PixelBox, camera: Calibration) -> NDArray[np.float64]:
    u_px, v_px, range_m, _ = flare
    radius_rad = float(angular_radius_rad(range_m, camera.source_radius_m))
    return flare_image(u_px, v_px, radius_rad, box, camera).fraction


def _overlapping(
    truth: SourceTruth, calibration: Calibration, rows: Sequence[SourceTruth]
) -> list[SourceTruth]:
    """Return the rows whose images reach into a source's, as far as the limit knows images of their size."""
    near = []
    for row in rows:
        reach_px = sum(image_radius_px(each, calibration) for each in (truth, row))
        reach_px += _OVERLAP_SIGMAS * calibration.psf_sigma_px
        apart_px = math.hypot(row.u_px - truth.u_px, row.v_px - truth.v_px)
        light_e = row.direct_e + row.mirrored_e
        in_front = row.range_m > 2.0 * calibration.source_radius_m and bool(
            has_image(
                row.u_px, row.v_px, angular_radius_rad(row.range_m, calibration.source_radius_m), calibration
            )
        )
        if row is not truth and light_e > 0.0 and in_front and apart_px < reach_px:
            near.append(row)
    return near if truth.range_m > 2.0 * calibration.source_radius_m else []


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
