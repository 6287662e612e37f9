"""One job: a scene rendered and perceived in memory, and what each estimator said of it, as rows."""

import hashlib
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import groupby

from nir_render.camera.render_noise import share_of_target
from nir_render.evaluate.metrics import Evaluation, Score, angle_deg, evaluate
from nir_render.scene.scene import Scene
from nir_render.simulation.calibration import calibration
from nir_render.simulation.clock import Shot, simulate
from nir_render.simulation.odometry import odometry_by_robot
from nir_render.stress.job.sequences import Row, Sequences
from nir_render.transport.cache import LightCache
from perception import Calibration, Detection, Estimator, OwnSetEstimator, detect, frame_sets
from perception.rig.frame_sets import robot_of
from perception.types import FrameKey

_TRUTH_FIELDS = (
    *(
        "robot",
        "source",
        "ghost_of",
        "visible_fraction",
        "on_fraction",
        "direct_e",
        "mirrored_e",
        "scattered_e",
    ),
    *("background_e", "peak_snr", "saturated_px"),
)
_DETECTION_FIELDS = (
    *("u_px", "v_px", "u_sigma_px", "v_sigma_px", "flux_dn", "mean_dn", "background_dn", "area_px"),
    *("saturated", "merged", "range_m", "range_sigma_m"),
)


def execute(
    scene: Scene, estimators: Mapping[str, Estimator | OwnSetEstimator], cache: LightCache | None = None
) -> tuple[list[Row], str]:
    """Render and perceive a scene; return the rows of the table, and the SHA-256 of all frames' counts.

    The rows are those of `table.SCHEMA` but for the job's own columns.

    Raises
    ------
    InputError, EstimatorError
        The scene cannot be rendered; one's own estimator fails.
    """
    rows: list[Row] = []
    hashed = hashlib.sha256()
    calibrations: dict[str, Calibration] = {camera: calibration(scene, camera) for camera in scene.cameras()}
    sequences = Sequences(scene, list(estimators), calibrations)
    finder = _Finder(scene, estimators, calibrations)
    for _, shots in groupby(simulate(scene, cache=cache), key=lambda shot: shot.frame.index):
        for shot, found in finder.found(shots):
            camera = shot.frame.camera
            hashed.update(f"{camera} {shot.frame.index}\0".encode() + shot.frame.data_dn.tobytes())
            rows += _rows(scene, shot, calibrations[camera], found)
            sequences.take(shot.frame, shot.truth, found)
    rows += sequences.rows()
    return rows, hashed.hexdigest()


class _Finder:
    """The estimators at work on the frames of one index; only those of sets make frames wait for others."""

    def __init__(
        self,
        scene: Scene,
        estimators: Mapping[str, Estimator | OwnSetEstimator],
        calibrations: Mapping[str, Calibration],
    ) -> None:
        self._estimators, self._calibrations = estimators, calibrations
        self._of_sets = {name: one for name, one in estimators.items() if isinstance(one, OwnSetEstimator)}
        self._odometry = odometry_by_robot(scene) if self._of_sets else {}

    def found(self, shots: Iterable[Shot]) -> Iterator[tuple[Shot, dict[str, Sequence[Detection]]]]:
        """Yield each shot with what every estimator finds in it."""
        if self._of_sets:
            shots = list(shots)
        in_sets = {name: self._in_sets(one, shots) for name, one in self._of_sets.items()}
        for shot in shots:
            key = (shot.frame.camera, shot.frame.index)
            yield (
                shot,
                {
                    name: in_sets[name].get(key, [])
                    if isinstance(one, OwnSetEstimator)
                    else detect(shot.frame, self._calibrations[key[0]], one)
                    for name, one in self._estimators.items()
                },
            )

    def _in_sets(self, estimator: OwnSetEstimator, shots: Iterable[Shot]) -> dict[FrameKey, list[Detection]]:
        """Return what an estimator of sets finds, by frame."""
        hits: dict[FrameKey, list[Detection]] = {}
        for frames in frame_sets([shot.frame for shot in shots]):
            odometry = self._odometry.get(robot_of(frames[0].camera))
            for hit in estimator(frames, self._calibrations, odometry):
                hits.setdefault((hit.camera, hit.index), []).append(hit)
        return hits


def _rows(
    scene: Scene, shot: Shot, known: Calibration, found: Mapping[str, Sequence[Detection]]
) -> list[Row]:
    frame = shot.frame
    key = (frame.camera, frame.index)
    result = evaluate([key], shot.truth, {frame.camera: known}, found, shot.lamps)
    at = {"camera": frame.camera, "index": frame.index, "time_s": frame.time_s}
    noise_share = share_of_target(shot.mean)
    rows: list[Row] = []
    for name in found:
        estimator_fields = {**at, "estimator": name}
        of_frame = _frame_fields(scene, shot, result, name, noise_share)
        rows.append({**estimator_fields, "kind": "frame", **of_frame})
        for kind, scores in (("source", result.scores), ("ghost", result.ghosts)):
            rows += [{**estimator_fields, "kind": kind, **_source_fields(score, name)} for score in scores]
        rows += [
            {**estimator_fields, "kind": "false_alarm", **_detection_fields(alarm)}
            for alarm in result.false_alarms[name]
        ]
    return rows


def _frame_fields(scene: Scene, shot: Shot, result: Evaluation, name: str, noise_share: float) -> Row:
    counts = result.summary["estimators"][name]
    return {
        "exposure_s": shot.frame.exposure_s,
        "gain": shot.frame.gain,
        "frame_false_alarms": len(result.false_alarms[name]),
        "frame_ghosts_reported": counts["ghosts_reported"],
        "frame_lamps_reported": counts["lamps_reported"],
        "render_noise_share": noise_share,
        "render_noise_target": scene.document.render.noise,
    }


def _source_fields(score: Score, name: str) -> Row:
    truth, detection = score.truth, score.detections.get(name)
    row: Row = {field: getattr(truth, field) for field in _TRUTH_FIELDS}
    row |= {"true_u_px": truth.u_px, "true_v_px": truth.v_px, "true_range_m": truth.range_m}
    row |= {
        "range_limit_m": _or_none(score.range_limit_m),
        "bearing_limit_deg": _or_none(score.bearing_limit_deg),
    }
    row |= {"countable": score.countable, "found": detection is not None}
    row["ranged"] = detection is not None and math.isfinite(detection.range_m)
    if detection is not None:
        row |= _detection_fields(detection)
        row["range_error_m"] = _or_none(detection.range_m - truth.range_m)
        row["bearing_error_deg"] = angle_deg(detection.bearing_body, truth.bearing_body)
    return row


def _detection_fields(detection: Detection) -> Row:
    return {
        field: _or_none(value) if isinstance(value := getattr(detection, field), float) else value
        for field in _DETECTION_FIELDS
    }


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
