"""`report.html`: a run on one page that opens from disk, with no network and no scripts."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
from markupsafe import Markup

from nir_render.evaluate.estimator_errors import EstimatorErrors, errors_of
from nir_render.evaluate.metrics import Evaluation, Score
from nir_render.report.around import around_section
from nir_render.report.drawing import Drawing
from nir_render.report.parts import Table, facts_table, render_page
from nir_render.report.pictures import (
    MOST_CAMERAS,
    cameras_of,
    close_ups,
    whole_pictures,
)
from nir_render.report.plots import bearing_plot, causes_plot, pull_plot, range_error_plot
from nir_render.report.time.section import Said, time_section
from nir_render.report.verdicts import RULES, verdicts_of
from nir_render.report.wording import counted, degrees, metres, share
from perception.causes import DetectionCauses
from perception.types import Calibration, FrameKey, RawFrame

_WORST = 8
_WORST_HEADINGS = ("frame", "source", "true", "said", "error", "limit σ", "error / limit", "bearing off")


def report_html(
    *,
    keys: Sequence[FrameKey],
    result: Evaluation,
    load: Callable[[FrameKey], RawFrame],
    calibrations: Mapping[str, Calibration],
    manifest: Mapping[str, Any],
    folder_name: str,
    files: Sequence[str],
    said: Said | None = None,
    film: str = "",
    look: str = "",
    causes: Mapping[str, Sequence[DetectionCauses]] = MappingProxyType({}),
) -> str:
    """Write the page.

    Parameters
    ----------
    keys
        Camera and index of all frames, in the order they were taken.
    result
        The evaluation of the run.
    load
        Reads one frame; only the frames that are shown are read.
    calibrations
        By camera.
    manifest
        `manifest.json`, or nothing where the run has none.
    folder_name
        The run folder's name: the title where the manifest names no scene.
    files
        Names of files that lie beside the page, to link to.
    said
        Signals and messages, where there are any.
    film
        Name of the film beside the page, if there is one.
    look
        Name of the picture of the scene from outside beside the page, likewise.
    causes
        What the σ of ranges is made of, by estimator, where that was asked for.

    Returns
    -------
    An HTML document. Whatever comes from the folder is escaped in it.
    """
    by_estimator = {name: errors_of(result.scores, name) for name in result.summary["estimators"]}
    cameras = cameras_of(keys)
    return render_page(
        "report/page.html",
        title=str(manifest.get("scene") or folder_name),
        subtitle=[
            f"{counted(len(keys), 'frame')} of {counted(len(cameras), 'camera')}",
            f"{counted(result.summary['sources_visible'], 'source')} to be found",
            f"estimators: {', '.join(by_estimator) or 'none'}",
            *([f"nir_render {manifest['versions']['nir-render']}"] if _version_known(manifest) else []),
        ],
        names=list(by_estimator),
        verdicts={
            name: verdicts_of(result.summary["estimators"][name], errors)
            for name, errors in by_estimator.items()
        },
        rules=RULES,
        numbers=_numbers(result),
        frames=_frames(keys, result, load, calibrations) if keys else None,
        around=around_section(result.around),
        over_time=time_section(result, said or Said()),
        film=film,
        look=look,
        plots=_plots(by_estimator),
        causes=Drawing(causes_plot(causes), "σ of ranges by cause, against range")
        if any(causes.values())
        else None,
        cameras=_cameras(keys, result),
        more_cameras=counted(len(cameras) - MOST_CAMERAS, "more camera")
        if len(cameras) > MOST_CAMERAS
        else "",
        worst={
            name: listed for name, errors in by_estimator.items() if (listed := _worst(result, errors, name))
        },
        facts=facts_table(manifest, but=("format", "sha256")) if manifest else None,
        files=list(files),
    )


def _numbers(result: Evaluation) -> Table:
    """Return the table of what each estimator reached, and the limit below it."""
    headings = [
        "estimator", "recall", "false alarms per frame", "ghosts reported", "range MAE", "range RMSE",
        "range bias", "without range", "bearing RMS",
    ]  # fmt: skip
    rows: list[list[str]] = []
    for name, numbers in result.summary["estimators"].items():
        alarms = numbers["false_alarms_per_frame"]
        rows.append([
            name, share(numbers["recall"]), "–" if alarms is None else f"{alarms:.3f}",
            str(numbers["ghosts_reported"]), metres(numbers["range_mae_m"]), metres(numbers["range_rmse_m"]),
            metres(numbers["range_bias_m"], signed=True), str(numbers["ranges_missing"]),
            degrees(numbers["bearing_rms_deg"]),
        ])  # fmt: skip
    limits_m = [score.range_limit_m for score in result.scores if score.countable]
    known_m = [limit_m for limit_m in limits_m if math.isfinite(limit_m)]
    # The mean absolute value of a Gaussian is √(2/π) of its σ.
    mean_m = math.sqrt(2.0 / math.pi) * sum(known_m) / len(known_m) if known_m else None
    limits = [
        "limit, all that count", "", "", "",
        metres(mean_m), metres(result.summary["range_limit_rmse_m"]), "", "",
        degrees(result.summary["bearing_limit_rms_deg"]),
    ]  # fmt: skip
    rows.append([Markup("<i>{}</i>").format(limit) for limit in limits])
    return Table(headings, rows)


def _frames(
    keys: Sequence[FrameKey],
    result: Evaluation,
    load: Callable[[FrameKey], RawFrame],
    calibrations: Mapping[str, Calibration],
) -> dict[str, Any]:
    return {
        "false_alarms": any(result.false_alarms.values()),
        "wholes": whole_pictures(keys, result, load, calibrations),
        "closes": close_ups(result, load, calibrations),
    }


def _plots(by_estimator: Mapping[str, EstimatorErrors]) -> dict[str, Drawing | None] | None:
    """Return the plots that there is something for; None without a source to be ranged."""
    if not any(errors.found.size for errors in by_estimator.values()):
        return None
    ranged = any(bool((~np.isnan(errors.error_m) & errors.found).any()) for errors in by_estimator.values())
    found = any(bool(errors.found.any()) for errors in by_estimator.values())
    return {
        "range": Drawing(
            range_error_plot(by_estimator), "signed range error against true range, with the limit as a band"
        ),
        "pull": Drawing(pull_plot(by_estimator), "range error over limit, against range and as a histogram")
        if ranged
        else None,
        "bearing": Drawing(bearing_plot(by_estimator), "bearing error against true range, with its limit")
        if found
        else None,
    }


def _cameras(keys: Sequence[FrameKey], result: Evaluation) -> Table:
    names = list(result.summary["estimators"])
    frames = Counter(camera for camera, _ in keys)
    seen = Counter(score.truth.camera for score in result.scores)
    counting = Counter(score.truth.camera for score in result.scores if score.countable)
    found = {
        name: Counter(
            score.truth.camera for score in result.scores if score.countable and name in score.detections
        )
        for name in names
    }
    alarms = {name: Counter(alarm.camera for alarm in result.false_alarms[name]) for name in names}
    headings = ["camera", "frames", "sources in view", "that count"]
    headings += [f"{name}: {what}" for name in names for what in ("found", "false alarms")]
    rows = []
    for camera in cameras_of(keys)[:MOST_CAMERAS]:
        counts = [frames[camera], seen[camera], counting[camera]]
        counts += [count[camera] for name in names for count in (found[name], alarms[name])]
        rows.append([camera, *map(str, counts)])
    return Table(headings, rows)


def _worst(result: Evaluation, errors: EstimatorErrors, name: str) -> Table | None:
    """List what to look into first: the nearest that were missed, then the largest errors for their limit."""
    counting = [score for score in result.scores if score.countable]
    missed = [index for index in range(len(counting)) if not errors.found[index]]
    missed.sort(key=lambda index: counting[index].truth.range_m)
    ranged = [index for index in range(len(counting)) if math.isfinite(errors.pull[index])]
    ranged.sort(key=lambda index: -abs(float(errors.pull[index])))
    chosen = missed[: _WORST // 2]
    chosen += ranged[: _WORST - len(chosen)]
    rows = [_worst_row(counting[index], errors, index, name) for index in chosen]
    return Table(_WORST_HEADINGS, rows) if rows else None


def _worst_row(score: Score, errors: EstimatorErrors, index: int, name: str) -> list[str]:
    truth, detection = score.truth, score.detections.get(name)
    frame, source = f"{truth.camera} {truth.index}", f"{truth.robot}.{truth.source}"
    if detection is None:
        return [frame, source, metres(truth.range_m), "missed", "", metres(score.range_limit_m), "", ""]
    flags = "".join(f" ({flag})" for flag in ("saturated", "merged") if getattr(detection, flag))
    return [
        frame,
        source + flags,
        metres(truth.range_m),
        metres(detection.range_m),
        metres(float(errors.error_m[index]), signed=True),
        metres(score.range_limit_m),
        f"{errors.pull[index]:+.1f}".replace("-", "−"),
        degrees(float(errors.bearing_deg[index])),
    ]


def _version_known(manifest: Mapping[str, Any]) -> bool:
    versions = manifest.get("versions")
    return isinstance(versions, Mapping) and "nir-render" in versions
