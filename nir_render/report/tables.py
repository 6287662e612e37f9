"""Tables for the terminal."""

import math
from collections.abc import Mapping
from typing import Any

from rich.table import Table

from nir_render.evaluate.metrics import Evaluation, Score

_MOST_ROWS = 24


def range_table(result: Evaluation) -> Table:
    """Return a table of true ranges, what each estimator said, and the radiometric limit (1 sigma)."""
    names = list(result.summary["estimators"])
    table = Table(title="Range of each source, in metres", title_justify="left")
    for heading in ("frame", "source", "true", *names, "limit σ"):
        table.add_column(heading, justify="left" if heading == "source" else "right")
    for score in result.scores[:_MOST_ROWS]:
        truth = score.truth
        said = [_said(score, name) for name in names]
        frame, source = f"{truth.camera} {truth.index}", f"{truth.robot}.{truth.source}"
        table.add_row(frame, source, f"{truth.range_m:.3f}", *said, _metres(score.range_limit_m))
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
    table.add_column("estimator")
    for heading, _ in columns.values():
        table.add_column(heading, justify="right")
    for name, numbers in summary["estimators"].items():
        cells = [
            form.format(numbers[key]) if numbers[key] is not None else "–"
            for key, (_, form) in columns.items()
        ]
        table.add_row(name, *cells)
    return table


def _said(score: Score, name: str) -> str:
    if name not in score.detections:
        return "not found"
    mark = " sat" if score.detections[name].saturated else ""
    return _metres(score.detections[name].range_m, digits=3) + mark


def _metres(value: float | None, digits: int = 4) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"
