"""The tables of a campaign's page: all numbers, the worst jobs, false alarms, render noise, the axes."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from markupsafe import Markup

from nir_render.report.parts import Table, named_mark
from nir_render.report.wording import counted, share
from nir_render.stress.design.axes import Axis
from nir_render.stress.metrics import METRICS, Metric
from nir_render.stress.page.words import metric_text
from nir_render.stress.sums import ASKED, COUNT, LIMIT, LIMITED, TOTAL, JobSums

_WORST = 5
_MOST_LABELS = 12


def overall_table(sums: JobSums) -> Table:
    """Return every metric of each estimator, over all jobs, and the limit of the same sources.

    Those of what no job had, sequences or packets, are left out.
    """
    headings = ["", *(word for name in sums.estimators for word in (name, "its limit"))]
    rows = []
    for metric in METRICS.values():
        if metric.kind in ("sequence", "packet") and not any(
            sums.by_metric[name, metric.name][COUNT].any() for name in sums.estimators
        ):
            continue
        cells: list[str] = [metric.title]
        for name in sums.estimators:
            totals = sums.by_metric[name, metric.name].sum(axis=1)
            limit = metric_text(metric.name, float(metric.value(totals[LIMIT], totals[LIMITED])))
            cells.append(metric_text(metric.name, float(metric.value(totals[TOTAL], totals[COUNT]))))
            cells.append("" if metric.limit is None else Markup("<i>{}</i>").format(limit))
        rows.append(cells)
    return Table(headings, rows)


def worst_table(
    axes: Sequence[Axis], sums: JobSums, metric: Metric, commands: Mapping[str, str], bound: float | None
) -> Table | None:
    """Return the jobs with the worst metrics of each estimator; None where none is less than perfect."""
    rows = []
    for name in sums.estimators:
        totals = sums.by_metric[name, metric.name]
        value = metric.value(totals[TOTAL], totals[COUNT])
        limit = metric.value(totals[LIMIT], totals[LIMITED])
        bad = np.where(np.isfinite(value), value if metric.higher_is_better else -np.abs(value), np.inf)
        for job in np.argsort(bad, kind="stable")[:_WORST]:
            if not math.isfinite(bad[job]) or value[job] == (1.0 if metric.higher_is_better else 0.0):
                break  # no metric, or none better
            command = commands.get(sums.jobs[job], "")
            row: list[str] = [named_mark(name, sums.estimators)]
            row += [axis.label_of(value) for axis, value in zip(axes, sums.written[job], strict=True)]
            row += [str(sums.seeds[job]), metric_text(metric.name, value[job], bound)]
            row += [metric_text(metric.name, limit[job])] if metric.limit else []
            row += [_count_text(metric, int(totals[COUNT, job]), int(totals[ASKED, job]))]
            rows.append([*row, Markup("<code>{}</code>").format(command) if command else ""])
    if not rows:
        return None
    headings = ["estimator", *(axis.title for axis in axes), "seed", metric.title]
    headings += ["limit"] if metric.limit else []
    headings += ["of sources" if metric.kind == "source" else f"{metric.kind}s", "look at it"]
    return Table(headings, rows)


def false_alarms_table(rows: pa.Table, sums: JobSums) -> Table:
    """Return how often each estimator reported what is no source, in the jobs of `sums`."""
    lines = []
    rows = rows.filter(pc.is_in(rows["job"], pa.array(sums.jobs, pa.string())))
    for name in sums.estimators:
        of_frames = rows.filter(pc.and_(pc.equal(rows["kind"], "frame"), pc.equal(rows["estimator"], name)))
        alarms = pc.fill_null(of_frames["frame_false_alarms"], 0)
        total, frames = pc.sum(alarms).as_py() or 0, of_frames.num_rows
        with_any = pc.sum(pc.greater(alarms, 0)).as_py() or 0
        lines.append(
            [
                named_mark(name, sums.estimators),
                str(total),
                f"{total / frames:.3f}" if frames else "–",
                f"{with_any} of {frames}",
                str(pc.max(alarms).as_py() or 0),
                str(pc.sum(of_frames["frame_ghosts_reported"]).as_py() or 0),
                str(pc.sum(of_frames["frame_lamps_reported"]).as_py() or 0),
            ]
        )
    headings = [
        "estimator", "false alarms", "per frame", "frames with any", "most in one", "ghosts reported",
        "lamps reported",
    ]  # fmt: skip
    return Table(headings, lines)


def render_noise_sentences(rows: pa.Table) -> tuple[str, str]:
    """Say how large the renderer's own noise is beside the sensor's, over all frames; and warn, if so."""
    frames = rows.filter(pc.equal(rows["kind"], "frame"))
    frames = (
        frames.filter(pc.equal(frames["estimator"], frames["estimator"][0])) if frames.num_rows else frames
    )
    known = frames.filter(pc.is_valid(frames["render_noise_share"]))
    if not known.num_rows:
        return "It is not known: the table has no figure of it.", ""
    shares = known["render_noise_share"].to_numpy()
    sentence = (
        "Monte Carlo noise adds to the sensor's. Of the sensor's variance it is, in the median pixel of each "
        f"seventh row or the worst flare's place, whichever is more: {_percent(float(np.median(shares)))} in "
        f"the median frame and {_percent(float(shares.max()))} in the worst of "
        f"{counted(known.num_rows, 'frame')}."
    )
    targets = pc.drop_null(known["render_noise_target"])
    if not len(targets):
        return f"{sentence} The scene sets no target.", ""
    over = pc.sum(pc.greater(known["render_noise_share"], known["render_noise_target"])).as_py() or 0
    least = _percent(float(pc.min(targets).as_py()))
    if not over:
        return f"{sentence} The target is {least}: no frame is above it.", ""
    return sentence, (
        f"{counted(over, 'frame is', 'frames are')} above the target of {least}: there part of the error may "
        "be the renderer's. Render them with more samples."
    )


def axes_table(axes: Sequence[Axis]) -> Table:
    """Return what was varied, and through which values."""
    rows = []
    for axis in axes:
        shown = ", ".join(axis.labels[:_MOST_LABELS])
        more = len(axis.labels) - _MOST_LABELS
        last = f", … {axis.labels[-1]} ({len(axis.labels)} values)" if more > 0 else ""
        last += f"; {counted(sum(axis.added), 'value')} of these added at limits" if any(axis.added) else ""
        rows.append([axis.title, ", ".join(axis.paths), shown + last])
    return Table(("axis", "sets", "values"), rows)


def _count_text(metric: Metric, count: int, asked: int) -> str:
    return str(asked) if metric.kind != "source" or count == asked else f"{count}/{asked}"


def _percent(value: float) -> str:
    return share(value) if 0.001 <= value <= 1.0 else f"{100.0 * value:.2g} %"
