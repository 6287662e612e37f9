"""`report.html`: a run on one page that opens from disk, with no network and no scripts."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any
from urllib.parse import quote

from nir_render.evaluate.metrics import Evaluation, FrameKey, Score
from nir_render.report import style
from nir_render.report.frames import cameras_of
from nir_render.report.parts import facts_table, mark, page, plot, table
from nir_render.report.pictures import MOST_CAMERAS, close_up_figures, whole_figures
from nir_render.report.plots import bearing_plot, pull_plot, range_error_plot
from nir_render.report.samples import Samples, samples_of
from nir_render.report.verdicts import RULES, Verdict, verdicts_of
from nir_render.report.wording import counted, degrees, metres, share
from perception.types import Calibration, RawFrame

_WORST = 8


def report_html(
    *,
    keys: Sequence[FrameKey],
    result: Evaluation,
    load: Callable[[FrameKey], RawFrame],
    calibrations: Mapping[str, Calibration],
    manifest: Mapping[str, Any],
    folder_name: str,
    files: Sequence[str],
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

    Returns
    -------
    An HTML document. Whatever comes from the folder is escaped in it.
    """
    samples = {name: samples_of(result.scores, name) for name in result.summary["estimators"]}
    title = str(manifest.get("scene") or folder_name)
    cameras = cameras_of(keys)
    subtitle = [
        f"{counted(len(keys), 'frame')} of {counted(len(cameras), 'camera')}",
        f"{counted(result.summary['sources_visible'], 'source')} to be found",
        f"estimators: {', '.join(samples) or 'none'}",
        *([f"nir_render {manifest['versions']['nir-render']}"] if _version_known(manifest) else []),
    ]
    body = [
        _verdicts(result, samples),
        _table(result),
        _pictures(keys, result, load, calibrations, list(samples)),
        _plots(samples),
        _cameras(keys, result),
        _worst(result, samples),
        _facts(manifest),
        _files(files),
    ]
    return page(title, subtitle, body)


def _verdicts(result: Evaluation, samples: Mapping[str, Samples]) -> str:
    parts = ["<h2>Verdicts</h2>"]
    for name, own in samples.items():
        cards = "".join(map(_card, verdicts_of(result.summary["estimators"][name], own)))
        parts.append(f'<h3>{mark(name, list(samples))} {escape(name)}</h3><div class="cards">{cards}</div>')
    rules = "".join(f"<dt>{escape(about)}</dt><dd>{escape(rule)}</dd>" for about, rule in RULES.items())
    parts.append(f'<dl class="rules">{rules}</dl>')
    return "\n".join(parts)


def _card(verdict: Verdict) -> str:
    level = "" if verdict.level == "none" else f'<span class="level">{verdict.level}</span>'
    return (
        f'<div class="card {verdict.level}">'
        f'<div class="about"><span>{escape(verdict.about)}</span>{level}</div>'
        f'<div class="value">{escape(verdict.value)}</div>'
        f'<div class="sentence">{escape(verdict.sentence)}</div></div>'
    )


def _table(result: Evaluation) -> str:
    headings = [
        "estimator", "recall", "false alarms per frame", "ghosts reported", "range MAE", "range RMSE",
        "range bias", "without range", "bearing RMS",
    ]  # fmt: skip
    rows = []
    for name, numbers in result.summary["estimators"].items():
        alarms = numbers["false_alarms_per_frame"]
        rows.append([
            escape(name), share(numbers["recall"]), "–" if alarms is None else f"{alarms:.3f}",
            str(numbers["ghosts_reported"]), metres(numbers["range_mae_m"]), metres(numbers["range_rmse_m"]),
            metres(numbers["range_bias_m"], signed=True), str(numbers["ranges_missing"]),
            degrees(numbers["bearing_rms_deg"]),
        ])  # fmt: skip
    range_limit, bearing_limit = result.summary["range_limit_rmse_m"], result.summary["bearing_limit_rms_deg"]
    limits_m = [score.range_limit_m for score in result.scores if score.countable]
    known_m = [limit_m for limit_m in limits_m if math.isfinite(limit_m)]
    # The mean absolute value of a Gaussian is √(2/π) of its σ.
    mean_m = math.sqrt(2.0 / math.pi) * sum(known_m) / len(known_m) if known_m else None
    limits = [
        "limit, all that count",
        "",
        "",
        "",
        metres(mean_m),
        metres(range_limit),
        "",
        "",
        degrees(bearing_limit),
    ]
    rows.append([f"<i>{limit}</i>" for limit in limits])
    return "<h2>Numbers</h2>" + table(headings, rows)


def _pictures(
    keys: Sequence[FrameKey],
    result: Evaluation,
    load: Callable[[FrameKey], RawFrame],
    calibrations: Mapping[str, Calibration],
    names: list[str],
) -> str:
    if not keys:
        return "<h2>Frames</h2><p>There are none.</p>"
    more = len(cameras_of(keys)) - MOST_CAMERAS
    said = f"<p>{counted(more, 'more camera')} not shown.</p>" if more > 0 else ""
    truth = f'<circle cx="8" cy="8" r="6" class="mark" stroke="{style.TRUTH}"/>'
    key = [
        f'<span><svg viewBox="0 0 16 16">{truth}</svg> truth (dashed: too faint or hidden to count)</span>'
    ]
    key += [f"<span>{mark(name, names)} {escape(name)}</span>" for name in names]
    if any(result.false_alarms.values()):
        key.append(
            f'<span><svg viewBox="0 0 16 16"><circle cx="8" cy="8" r="6" class="mark" stroke="{style.BAD}" '
            'stroke-dasharray="2 2"/></svg> false alarm</span>'
        )
    wholes = whole_figures(keys, result, load, calibrations)
    closes = close_up_figures(result, load, calibrations)
    near_to_far = (
        "<h3>From near to far</h3><p class='faint'>Pixels as they are; the circle is the true outline of the "
        f"source.</p><div class='closes'>{closes}</div>"
        if closes
        else ""
    )
    return (
        "<h2>Frames</h2><p class='faint'>Grey follows the counts by an asinh curve, so that noise, walls and "
        "flares all show; marks tell more under the pointer.</p>"
        f'<div class="key">{"".join(key)}</div><div class="wholes">{wholes}</div>{said}{near_to_far}'
    )


def _plots(samples: Mapping[str, Samples]) -> str:
    ranged = any(bool(((own.error_m == own.error_m) & own.found).any()) for own in samples.values())
    found = any(bool(own.found.any()) for own in samples.values())
    parts = ["<h2>Range error against true range</h2>"]
    if not any(own.found.size for own in samples.values()):
        return "\n".join([*parts, "<p>No source was there to be ranged.</p>"])
    band = (
        "Each mark is one flare. The band is what physics allows (±1 σ): two of three marks of a perfect "
        "estimator lie within. The scale is linear about zero and goes by decades beyond."
    )
    parts += [
        f"<p>{band}</p>",
        plot(range_error_plot(samples), "signed range error against true range, with the limit as a band"),
    ]
    if ranged:
        pulls = (
            "The same errors, each divided by its own flare's limit. An estimator at the limit scatters like "
            "the white curve; one beside it is biased, one wider loses light or models it wrongly."
        )
        parts += [
            "<h2>Range error in units of the limit</h2>",
            f"<p>{pulls}</p>",
            plot(pull_plot(samples), "range error over limit, against range and as a histogram"),
        ]
    if found:
        parts += [
            "<h2>Bearing error</h2>",
            "<p>The angle between estimated and true direction in body axes.</p>",
            plot(bearing_plot(samples), "bearing error against true range, with its limit"),
        ]
    return "\n".join(parts)


def _cameras(keys: Sequence[FrameKey], result: Evaluation) -> str:
    names = list(result.summary["estimators"])
    frames = Counter(camera for camera, _ in keys)
    seen = Counter(score.truth.camera for score in result.scores)
    counting = Counter(score.truth.camera for score in result.scores if score.countable)
    found = {
        name: Counter(s.truth.camera for s in result.scores if s.countable and name in s.detections)
        for name in names
    }
    alarms = {name: Counter(said.camera for said in result.false_alarms[name]) for name in names}
    headings = ["camera", "frames", "sources in view", "that count"]
    headings += [f"{name}: {what}" for name in names for what in ("found", "false alarms")]
    rows = []
    for camera in cameras_of(keys)[:MOST_CAMERAS]:
        counts = [frames[camera], seen[camera], counting[camera]]
        counts += [count[camera] for name in names for count in (found[name], alarms[name])]
        rows.append([escape(camera), *map(str, counts)])
    more = len(frames) - MOST_CAMERAS
    said = f"<p>{counted(more, 'more camera')} not shown.</p>" if more > 0 else ""
    return "<h2>Cameras</h2>" + table(headings, rows) + said


def _worst(result: Evaluation, samples: Mapping[str, Samples]) -> str:
    """List what to look into first: what was missed, then the largest errors for their limit."""
    counting = [score for score in result.scores if score.countable]
    parts = []
    for name, own in samples.items():
        missed = [index for index in range(len(counting)) if not own.found[index]]
        missed.sort(key=lambda index: counting[index].truth.range_m)
        ranged = [index for index in range(len(counting)) if math.isfinite(own.pull[index])]
        ranged.sort(key=lambda index: -abs(float(own.pull[index])))
        rows = [_look_into(counting[index], own, index, name) for index in missed[: _WORST // 2]]
        rows += [_look_into(counting[index], own, index, name) for index in ranged[: _WORST - len(rows)]]
        headings = ["frame", "source", "true", "said", "error", "limit σ", "error / limit", "bearing off"]
        if rows:
            listed = table(headings, rows, text=(1,))
            parts.append(f"<details><summary>{escape(name)}</summary>{listed}</details>")
    if not parts:
        return ""
    intro = "Of each estimator the nearest sources it missed, and the largest errors for their limit."
    return f"<h2>Look into these first</h2><p class='faint'>{intro}</p>{''.join(parts)}"


def _look_into(score: Score, own: Samples, index: int, name: str) -> list[str]:
    truth, said = score.truth, score.detections.get(name)
    frame = f"{escape(truth.camera)} {truth.index}"
    source = escape(f"{truth.robot}.{truth.source}")
    if said is None:
        return [frame, source, metres(truth.range_m), "missed", "", metres(score.range_limit_m), "", ""]
    marks = "".join(f" ({what})" for what in ("saturated", "merged") if getattr(said, what))
    return [
        frame,
        source + marks,
        metres(truth.range_m),
        metres(said.range_m),
        metres(float(own.error_m[index]), signed=True),
        metres(score.range_limit_m),
        f"{own.pull[index]:+.1f}".replace("-", "−"),
        degrees(float(own.bearing_deg[index])),
    ]


def _facts(manifest: Mapping[str, Any]) -> str:
    if not manifest:
        return "<h2>How it was made</h2><p>The folder has no manifest.json.</p>"
    shown = {key: value for key, value in manifest.items() if key not in ("format", "sha256")}
    return "<h2>How it was made</h2>" + facts_table(shown)


def _files(files: Sequence[str]) -> str:
    links = " · ".join(f'<a href="{quote(name)}">{escape(name)}</a>' for name in files)
    return f"<h2>Files</h2><p>{links}</p>" if links else ""


def _version_known(manifest: Mapping[str, Any]) -> bool:
    versions = manifest.get("versions")
    return isinstance(versions, Mapping) and "nir-render" in versions
