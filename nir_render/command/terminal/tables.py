"""Tables for the terminal: ranges, the numbers of a summary, a calibration, the facts of a machine."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from nir_render.evaluate.metrics import Evaluation, Score
from nir_render.evaluate.tracks import FEW_SETS
from nir_render.run.calibrate import CameraCalibration
from perception.calibration.result import IDEAL_MAE, HeldOut, RailCalibration
from perception.extrinsics.calibrate import Extrinsics

_MOST_ROWS = 24


def print_table(table: Table) -> None:
    """Print a table on standard output."""
    Console().print(table)


def range_table(result: Evaluation) -> Table:
    """Return a table of true ranges, what each estimator gives, and the radiometric limit (1 sigma)."""
    names = list(result.summary["estimators"])
    table = Table(title="Range of each source, in metres", title_justify="left")
    for heading in ("frame", "source", "true", *names, "limit σ"):
        table.add_column(heading, justify="left" if heading == "source" else "right")
    for score in result.scores[:_MOST_ROWS]:
        truth = score.truth
        estimated = [_range_text(score, name) for name in names]
        frame, source = f"{truth.camera} {truth.index}", f"{truth.robot}.{truth.source}"
        table.add_row(frame, source, f"{truth.range_m:.3f}", *estimated, _metres(score.range_limit_m))
    if len(result.scores) > _MOST_ROWS:
        table.caption = f"the first {_MOST_ROWS} of {len(result.scores)}"
    return table


def summary_table(summary: Mapping[str, Any]) -> Table:
    """Return a table of the numbers of `summary.json`."""
    limit = _metres(summary["range_limit_rmse_m"])
    table = Table(
        title=(
            f"{summary['sources_visible']} sources visible in {summary['frames']} frames; "
            f"range limit {limit} m RMS"
        ),
        title_justify="left",
    )
    columns = {
        "recall": ("recall", "{:.1%}"),
        "false_alarms_per_frame": ("false alarms\nper frame", "{:.3f}"),
        "range_mae_m": ("range MAE\nm", "{:.4f}"),
        "range_rmse_m": ("range RMSE\nm", "{:.4f}"),
        "range_bias_m": ("range bias\nm", "{:+.4f}"),
        "bearing_rms_deg": ("bearing RMS\ndeg", "{:.4f}"),
    }
    return _filled(table, columns, summary["estimators"])


def time_tables(summary: Mapping[str, Any]) -> list[Table]:
    """Return a table of tracks where there are any, and one of messages where packets were sent.

    None of a run of a few sets, in which tracks have hardly begun.
    """
    followed = {
        name: numbers
        for name, numbers in summary["estimators"].items()
        if numbers.get("track_sets", 0) >= FEW_SETS
    }
    tracks = {
        "track_hota": ("HOTA", "{:.3f}"),
        "track_idf1": ("IDF1", "{:.3f}"),
        "track_switches": ("switches", "{}"),
        "tracks": ("tracks", "{}"),
        "track_position_rmse_m": ("place RMSE\nm", "{:.4f}"),
        "track_state_nees": ("NEES\n(honest: 1)", "{:.2f}"),
    }
    messages = {
        "message_sent": ("sent", "{}"),
        "message_received": ("received", "{}"),
        "message_wrong": ("wrong", "{}"),
        "message_missed": ("missed", "{}"),
        "message_latency_median_s": ("latency\ns", "{:.2f}"),
    }
    tables = []
    if followed:
        tables.append(_filled(Table(title="Over time: tracks", title_justify="left"), tracks, followed))
    if any(numbers.get("message_sent") for numbers in followed.values()):
        tables.append(_filled(Table(title="Messages", title_justify="left"), messages, followed))
    return tables


def _filled(
    table: Table, columns: Mapping[str, tuple[str, str]], estimators: Mapping[str, Mapping[str, Any]]
) -> Table:
    """Return a table with a row for each estimator; what it has no number for is a dash."""
    table.add_column("estimator")
    for heading, _ in columns.values():
        table.add_column(heading, justify="right")
    for name, numbers in estimators.items():
        cells = [
            form.format(numbers[key]) if numbers.get(key) is not None else "–"
            for key, (_, form) in columns.items()
        ]
        table.add_row(name, *cells)
    return table


def calibration_tables(name: str, camera: CameraCalibration) -> list[Table]:
    """Return tables of one camera's calibration: what was learned of it, and its range constants."""
    tables = []
    if learned := camera.learned():
        table = Table(title=f"{name}: learned", title_justify="left")
        for heading in ("", "value", "before"):
            table.add_column(heading, justify="right" if heading else "left")
        for what, value, sigma, before in learned:
            table.add_row(what.replace("_", " "), _plain_with_sigma(value, sigma), f"{before:.6g}")
        tables.append(table)
    if camera.result.rail is not None:
        tables.append(_rail_table(name, camera, camera.result.rail))
    return tables


def extrinsics_table(rig: Extrinsics) -> Table:
    """Return a table of how cameras stand to the reference: by how much otherwise than was said."""
    title = f"{rig.reference} fixed: {rig.flares} flares shared, reduced χ² {rig.reduced_chi2:.2f}"
    table = Table(title=title, title_justify="left")
    for heading in ("", "flares", "turned by, mrad (x, y, z of the body)", "shifted by, mm"):
        table.add_column(heading, justify="right" if heading else "left")
    for pose in rig.poses:
        sigma = 1e3 * np.sqrt(np.diagonal(pose.covariance))
        turned, shifted = (
            "  ".join(map(_plain_with_sigma, 1e3 * values, sigmas))
            for values, sigmas in ((pose.turned_rad, sigma[:3]), (pose.shifted_m, sigma[3:]))
        )
        table.add_row(
            pose.camera,
            str(pose.flares),
            turned if pose.has_rotation else "not told: as it was",
            shifted if pose.has_position else "not told: as it was",
        )
    table.caption = (
        f"{rig.refused} more do not agree with these.\n" if rig.refused else ""
    ) + "How all of them stand to the body, no flare tells."
    table.caption_justify = "left"
    return table


def _rail_table(name: str, camera: CameraCalibration, result: RailCalibration) -> Table:
    """Return a table of one camera's range constants: the flux, and the paper's mean grey beside it."""
    fit, paper = result.fit, result.paper
    table = Table(
        title=f"{name}: {result.places_fitted} ranges fitted, {result.places_held_out} held out",
        title_justify="left",
    )
    for heading in ("", "robust: flux", "paper: mean grey"):
        table.add_column(heading, justify="right" if heading else "left")

    constant = _with_sigma(fit.range_constant_dn_m2_per_s, fit.range_constant_sigma_dn_m2_per_s)
    slope = _with_sigma(fit.slope_dn_m2_per_s, fit.slope_sigma_dn_m2_per_s)
    intercept = _with_sigma(fit.intercept_dn_per_s, fit.intercept_sigma_dn_per_s)
    paper_slope = paper_intercept = "–"
    if paper is not None:
        paper_slope = _with_sigma(paper.slope_dn_m2_per_s, paper.slope_sigma_dn_m2_per_s)
        paper_intercept = _with_sigma(paper.intercept_dn_per_s, paper.intercept_sigma_dn_per_s)
    table.add_row("K through the origin, DN m²/s", constant, "")
    if camera.fitted_to_true is not None:
        table.add_row("  over the true K − 1", f"{camera.fitted_to_true:+.3%}", "")
    table.add_row("slope with intercept, DN m²/s", slope, paper_slope)
    table.add_row("intercept, DN/s", intercept, paper_intercept)
    table.add_row("reduced χ² (probability)", f"{fit.reduced_chi2:.3f} ({fit.chi2_probability:.2g})", "")
    table.add_section()
    robust, by_paper = result.robust, result.paper_held_out
    frames = result.frames_held_out
    table.add_row("held out: found", f"{robust.found} of {frames}", f"{by_paper.found} of {frames}")
    for label, field, form in (
        ("  range MAE, m", "range_mae_m", "{:.4f}"),
        ("  range RMSE, m", "range_rmse_m", "{:.4f}"),
        ("  range bias, m", "range_bias_m", "{:+.4f}"),
        ("  reduced χ² of the errors", "reduced_chi2", "{:.3f}"),
    ):
        table.add_row(label, _cell(robust, field, form), _cell(by_paper, field, form))
    table.caption = (
        "The intercept is zero within 3 σ: K is that of the line through the origin.\n"
        if fit.intercept_is_zero
        else "The intercept is not zero: the flux does not follow 1/d² here.\n"
    ) + (
        f"Limit: mean Cramér–Rao σ {result.range_limit_m:.4f} m, "
        f"so an ideal MAE of {IDEAL_MAE * result.range_limit_m:.4f} m."
    )
    table.caption_justify = "left"
    return table


def facts_table(facts: Mapping[str, Any]) -> Table:
    """Return a table of facts and their values, a row each."""
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for key, value in facts.items():
        table.add_row(key.replace("_", " "), escape(str(value)))
    return table


def _range_text(score: Score, name: str) -> str:
    if name not in score.detections:
        return "not found"
    mark = " sat" if score.detections[name].saturated else ""
    return _metres(score.detections[name].range_m, digits=3) + mark


def _metres(value: float | None, digits: int = 4) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def _cell(held_out: HeldOut, field: str, form: str) -> str:
    value = getattr(held_out, field)
    return form.format(value) if math.isfinite(value) else "–"


def _plain_with_sigma(value: float, sigma: float) -> str:
    """Write both to the sigma's second digit: 0.7002 ± 0.0011."""
    if not math.isfinite(sigma) or sigma <= 0.0:
        return f"{value:.4g}"
    digits = max(0, 1 - math.floor(math.log10(sigma)))
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def _with_sigma(value: float, sigma: float) -> str:
    """Write both to the sigma's second digit, in one power of ten: (1.2345 ± 0.0012)e+08."""
    if not math.isfinite(sigma) or sigma <= 0.0:
        return f"{value:.5g}"
    power = math.floor(math.log10(max(abs(value), sigma)))
    digits = max(0, power - math.floor(math.log10(sigma)) + 1)
    return f"({value / 10**power:.{digits}f} ± {sigma / 10**power:.{digits}f})e{power}"
