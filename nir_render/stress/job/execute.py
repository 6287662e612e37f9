"""One job: a scene rendered and perceived in memory, and what each estimator said of it, as rows."""

import hashlib
import math
from collections.abc import Mapping, Sequence

from nir_render.evaluate.metrics import Evaluation, Score, angle_deg, evaluate
from nir_render.scene.scene import Scene
from nir_render.simulation.calibration import calibration
from nir_render.simulation.clock import Shot, simulate
from nir_render.stress.job.sequences import Row, Sequences
from nir_render.transport.cache import LightCache
from perception import Calibration, Detection, Estimator, detect

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
    scene: Scene, estimators: Mapping[str, Estimator], cache: LightCache | None = None
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
    for shot in simulate(scene, cache=cache):
        camera = shot.frame.camera
        hashed.update(f"{camera} {shot.frame.index}\0".encode() + shot.frame.data_dn.tobytes())
        found = {
            name: detect(shot.frame, calibrations[camera], estimator)
            for name, estimator in estimators.items()
        }
        rows += _rows(scene, shot, calibrations[camera], found)
        sequences.take(shot.frame, shot.truth, found)
    rows += sequences.rows()
    return rows, hashed.hexdigest()


def _rows(
    scene: Scene, shot: Shot, known: Calibration, found: Mapping[str, Sequence[Detection]]
) -> list[Row]:
    frame = shot.frame
    key = (frame.camera, frame.index)
    result = evaluate([key], shot.truth, {frame.camera: known}, found, shot.lamps)
    at = {"camera": frame.camera, "index": frame.index, "time_s": frame.time_s}
    rows: list[Row] = []
    for name in found:
        estimator_fields = {**at, "estimator": name}
        rows.append({**estimator_fields, "kind": "frame", **_frame_fields(scene, shot, result, name)})
        for kind, scores in (("source", result.scores), ("ghost", result.ghosts)):
            rows += [{**estimator_fields, "kind": kind, **_source_fields(score, name)} for score in scores]
        rows += [
            {**estimator_fields, "kind": "false_alarm", **_detection_fields(alarm)}
            for alarm in result.false_alarms[name]
        ]
    return rows


def _frame_fields(scene: Scene, shot: Shot, result: Evaluation, name: str) -> Row:
    counts = result.summary["estimators"][name]
    return {
        "exposure_s": shot.frame.exposure_s,
        "gain": shot.frame.gain,
        "frame_false_alarms": len(result.false_alarms[name]),
        "frame_ghosts_reported": counts["ghosts_reported"],
        "frame_lamps_reported": counts["lamps_reported"],
        "render_noise_share": max(shot.noise.median_share, shot.noise.aperture_share),
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
