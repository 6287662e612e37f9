"""What a stack says of the surroundings of a rig, set by set, against truth."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from nir_render.evaluate.match import GATE_PX, by_frame, countable, image_radius_px, on_a_lamp
from nir_render.truth.lamps import LampTruth
from nir_render.truth.sources import SourceTruth
from perception.types import Calibration, Detection, FrameKey, Measurement, MirrorPlane, RobotPose

Values = NDArray[np.float64]

SAME_PLACE_M = 0.05


@dataclass(frozen=True, eq=False)
class SetScore:
    """One source, or one mirror image, around a rig in one set, and what each estimator measured of it.

    `rows` are its truth in each frame that shows it, `position_body_m` its place, shape (3,); `countable`: it
    counts for recall in one frame at least.
    """

    number: int
    rows: tuple[SourceTruth, ...]
    position_body_m: Values
    countable: bool
    measurements: Mapping[str, Measurement]

    @property
    def truth(self) -> SourceTruth:
        """Its truth in the first frame that shows it."""
        return self.rows[0]

    @property
    def is_ghost(self) -> bool:
        """Whether it is a mirror image."""
        return self.truth.ghost_of is not None


@dataclass(frozen=True, eq=False)
class Stand:
    """How a robot of several sources is said to stand in a set, and how it does.

    `true` is the origin's place, shape (3,), and the heading (rad) in the observer's body axes, None where
    they are not known; `mixed`: its flares are of several robots; `robot` is who it is, "" where unknown.
    """

    number: int
    told: RobotPose
    true: tuple[Values, float] | None
    mixed: bool
    robot: str = ""


@dataclass(frozen=True, eq=False)
class SetEvaluation:
    """All scores; by estimator what it measured where nothing is, its numbers in `summary.json`, its mirrors.

    False alarms and mirrors stand with the number of their set; `stands` has the robots of several sources.
    """

    sets: Sequence[Sequence[FrameKey]]
    scores: tuple[SetScore, ...]
    false_alarms: Mapping[str, tuple[tuple[int, Measurement], ...]]
    summary: Mapping[str, Mapping[str, Any]]
    mirrors: Mapping[str, Sequence[tuple[int, MirrorPlane]]]
    stands: Mapping[str, Sequence[Stand]] = field(default_factory=dict)


def evaluate_sets(
    sets: Sequence[Sequence[FrameKey]],
    truth: Iterable[SourceTruth],
    calibrations: Mapping[str, Calibration],
    measurements: Mapping[str, Sequence[Measurement]],
    detections: Mapping[str, Sequence[Detection]],
    lamps: Iterable[LampTruth] = (),
    mirrors: Mapping[str, Sequence[tuple[int, MirrorPlane]]] | None = None,
) -> SetEvaluation:
    """Score the measurements of each estimator.

    A source that several cameras see counts once. A measurement belongs to the source, or mirror image, that
    one of its detections belongs to: within 3 px or the radius of the image, one to one, the nearest first.

    Parameters
    ----------
    sets
        Camera and index of the frames of each set.
    truth, calibrations, lamps
        As for `evaluate`.
    measurements, detections
        By estimator.
    mirrors
        By estimator: in which set it found which; they are shown, not judged.
    """
    of_frame = {key: number for number, keys in enumerate(sets) for key in keys}
    rows: list[list[SourceTruth]] = [[] for _ in sets]
    for row in truth:
        rows[of_frame[row.camera, row.index]].append(row)
    outlines = {key: [lamp.outline_px for lamp in own] for key, own in by_frame(lamps).items()}
    said: dict[str, list[list[Measurement]]] = {name: [[] for _ in sets] for name in measurements}
    for name, found in measurements.items():
        for each in found:
            said[name][of_frame[each.detections[0][:2]]].append(each)
    places = {name: by_frame(found) for name, found in detections.items()}
    scores: list[SetScore] = []
    false_alarms: dict[str, list[tuple[int, Measurement]]] = {name: [] for name in measurements}
    splits = dict.fromkeys(measurements, 0)
    for number, own in enumerate(rows):
        sources = _sources(number, own, calibrations)
        hits: list[dict[str, Measurement]] = [{} for _ in sources]
        for name, by_set in said.items():
            apart = _apart(sources, by_set[number], places[name], calibrations)
            paired = _pairs(apart)
            for i, j in paired:
                hits[i][name] = by_set[number][j]
            for j in set(range(len(by_set[number]))) - {j for _, j in paired}:
                one = by_set[number][j]
                if bool((apart[:, j] <= 1.0).any()):
                    splits[name] += 1
                elif not _on_lamps(one, places[name], outlines):
                    false_alarms[name].append((number, one))
        scores += [replace(source, measurements=hit) for source, hit in zip(sources, hits, strict=True)]
    return SetEvaluation(
        sets,
        tuple(scores),
        {name: tuple(alarms) for name, alarms in false_alarms.items()},
        {name: _numbers(scores, name, splits[name], len(false_alarms[name]), len(sets)) for name in said},
        mirrors or {},
    )


def _sources(
    number: int, rows: Sequence[SourceTruth], calibrations: Mapping[str, Calibration]
) -> list[SetScore]:
    """Join the rows of one source, or of one of its mirror images, in several frames."""
    joined: list[SetScore] = []
    for row in rows:
        position_m = position_body_m(row, calibrations[row.camera])
        # Of a mirror image it is whether a source there would count.
        counts = countable(replace(row, ghost_of=None), calibrations[row.camera])
        for k, other in enumerate(joined):
            same = (row.robot, row.source, row.ghost_of) == (
                other.truth.robot,
                other.truth.source,
                other.truth.ghost_of,
            )
            if same and float(np.linalg.norm(position_m - other.position_body_m)) < SAME_PLACE_M:
                joined[k] = replace(other, rows=(*other.rows, row), countable=counts or other.countable)
                break
        else:
            joined.append(SetScore(number, (row,), position_m, counts, {}))
    return joined


def position_body_m(row: SourceTruth, calibration: Calibration) -> Values:
    """Return where a row's source, or image, is in body axes, shape (3,)."""
    return np.asarray(calibration.position_body_m + row.range_m * np.array(row.bearing_body))


def _apart(
    sources: Sequence[SetScore],
    found: Sequence[Measurement],
    detections: Mapping[FrameKey, Sequence[Detection]],
    calibrations: Mapping[str, Calibration],
) -> Values:
    """Return how far measurements lie from sources, in units of the gate, in the frame where it is least."""
    apart = np.full((len(sources), len(found)), np.inf)
    for i, source in enumerate(sources):
        for row in source.rows:
            gate_px = max(GATE_PX, image_radius_px(row, calibrations[row.camera]))
            for j, measurement in enumerate(found):
                for camera, index, number in measurement.detections:
                    if (camera, index) == (row.camera, row.index):
                        hit = detections[camera, index][number]
                        off_px = math.hypot(hit.u_px - row.u_px, hit.v_px - row.v_px)
                        apart[i, j] = min(apart[i, j], off_px / gate_px)
    return apart


def _pairs(apart: Values) -> list[tuple[int, int]]:
    within = apart <= 1.0
    rows, columns = linear_sum_assignment(np.where(within, apart, 1.0 + len(apart)))
    return [(int(i), int(j)) for i, j in zip(rows, columns, strict=True) if within[i, j]]


def _on_lamps(
    measurement: Measurement,
    detections: Mapping[FrameKey, Sequence[Detection]],
    outlines: Mapping[FrameKey, Sequence[Any]],
) -> bool:
    for camera, index, number in measurement.detections:
        if on_a_lamp(detections[camera, index][number], outlines.get((camera, index), [])):
            return True
    return False


def set_error(score: SetScore, measurement: Measurement) -> Values:
    """Return by how much a measurement is off: left and up in rad, range in m, shape (3,)."""
    towards = score.position_body_m - np.array(measurement.origin_body_m)
    range_m = float(np.linalg.norm(towards))
    left, up, _ = measurement.axes_body @ (towards / range_m)
    return np.array([-left, -up, measurement.range_m - range_m])


def _numbers(scores: Sequence[SetScore], name: str, splits: int, alarms: int, sets: int) -> dict[str, Any]:
    robots = [score for score in scores if score.countable and not score.is_ghost]
    found = [(score, score.measurements[name]) for score in robots if name in score.measurements]
    kept = [(score, said) for score, said in found if said.ghost != "yes"]
    images = [
        score.measurements[name].ghost for score in scores if score.is_ghost and name in score.measurements
    ]
    errors = np.array([set_error(score, said) for score, said in kept]).reshape(-1, 3)
    range_m = np.array([np.linalg.norm(score.position_body_m) for score, _ in kept])
    off_m = np.sqrt((errors[:, :2] ** 2).sum(axis=1) * range_m**2 + errors[:, 2] ** 2)
    pulls = [
        float(error @ np.linalg.solve(said.covariance, error)) / 3.0
        for error, (_, said) in zip(errors, kept, strict=True)
        if np.isfinite(said.covariance).all() and np.isfinite(error).all()
    ]
    return {
        "sets": sets,
        "set_sources": len(robots),
        "set_recall": len(kept) / len(robots) if robots else None,
        "set_robots_called_ghosts": len(found) - len(kept),
        "set_split": splits,
        "set_false_alarms_per_set": alarms / sets if sets else None,
        "set_ghosts_visible": sum(score.countable for score in scores if score.is_ghost),
        "set_ghosts_found": len(images),
        "set_ghosts_told": images.count("yes"),
        "set_position_rmse_m": _rms(off_m),
        "set_range_rmse_m": _rms(errors[:, 2]),
        "set_nees": float(np.mean(pulls)) if pulls else None,
    }


def _rms(values: Values) -> float | None:
    finite = values[np.isfinite(values)]
    return math.sqrt(float(np.mean(finite**2))) if finite.size else None
