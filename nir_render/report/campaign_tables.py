"""The tables of a campaign's page: all numbers, the worst jobs, false alarms, render noise, the axes."""

import math
from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from nir_render.report.campaign_words import figure_text
from nir_render.report.parts import mark, table
from nir_render.report.wording import counted, share
from nir_render.stress.axes import Axis
from nir_render.stress.figures import FIGURES, Figure
from nir_render.stress.sums import ASKED, COUNT, LIMIT, LIMITED, TOTAL, JobSums

_WORST = 5
_MOST_LABELS = 12


def overall_table(sums: JobSums) -> str:
    """Return every figure of each estimator, over all jobs, and the limit of the same sources."""
    headings = ["", *(word for name in sums.estimators for word in (name, "its limit"))]
    rows = []
    for figure in FIGURES.values():
        cells = [escape(figure.title)]
        for name in sums.estimators:
            own = sums.of[name, figure.name].sum(axis=1)
            limit = figure_text(figure.name, float(figure.value(own[LIMIT], own[LIMITED])))
            cells.append(figure_text(figure.name, float(figure.value(own[TOTAL], own[COUNT]))))
            cells.append("" if figure.limit is None else f"<i>{limit}</i>")
        rows.append(cells)
    return table(headings, rows)


def worst_table(
    axes: Sequence[Axis], sums: JobSums, figure: Figure, commands: Mapping[str, str], bound: float | None
) -> str:
    """Return the jobs with the worst figures of each estimator; empty where none is less than perfect."""
    rows = []
    for name in sums.estimators:
        own = sums.of[name, figure.name]
        value = figure.value(own[TOTAL], own[COUNT])
        limit = figure.value(own[LIMIT], own[LIMITED])
        bad = np.where(np.isfinite(value), value if figure.higher_is_better else -np.abs(value), np.inf)
        for job in np.argsort(bad, kind="stable")[:_WORST]:
            if not math.isfinite(bad[job]) or value[job] == (1.0 if figure.higher_is_better else 0.0):
                break  # no figure, or none better
            command = commands.get(sums.jobs[job], "")
            row = [f"{mark(name, sums.estimators)} {escape(name)}"]
            row += [escape(axis.labels[sums.place[job, i]]) for i, axis in enumerate(axes)]
            row += [str(sums.seeds[job]), figure_text(figure.name, value[job], bound)]
            row += [figure_text(figure.name, limit[job])] if figure.limit else []
            row += [_of(figure, int(own[COUNT, job]), int(own[ASKED, job]))]
            rows.append([*row, f"<code>{escape(command)}</code>" if command else ""])
    if not rows:
        return ""
    headings = ["estimator", *(axis.title for axis in axes), "seed", figure.title]
    headings += ["limit"] if figure.limit else []
    headings += ["of sources" if figure.kind == "source" else "frames", "look at it"]
    return table(headings, rows, text=(len(headings) - 1,))


def false_alarms_table(rows: pa.Table, sums: JobSums) -> str:
    """Return how often each estimator reported what is no source."""
    lines = []
    for name in sums.estimators:
        own = rows.filter(pc.and_(pc.equal(rows["kind"], "frame"), pc.equal(rows["estimator"], name)))
        alarms = pc.fill_null(own["frame_false_alarms"], 0)
        total, frames = pc.sum(alarms).as_py() or 0, own.num_rows
        with_any = pc.sum(pc.greater(alarms, 0)).as_py() or 0
        lines.append(
            [
                f"{mark(name, sums.estimators)} {escape(name)}",
                str(total),
                f"{total / frames:.3f}" if frames else "–",
                f"{with_any} of {frames}",
                str(pc.max(alarms).as_py() or 0),
                str(pc.sum(own["frame_ghosts_reported"]).as_py() or 0),
                str(pc.sum(own["frame_lamps_reported"]).as_py() or 0),
            ]
        )
    headings = [
        "estimator", "false alarms", "per frame", "frames with any", "most in one", "ghosts reported",
        "lamps reported",
    ]  # fmt: skip
    return table(headings, lines)


def render_noise_sentence(rows: pa.Table) -> str:
    """Say how large the renderer's own noise is beside the sensor's, over all frames."""
    frames = rows.filter(pc.equal(rows["kind"], "frame"))
    frames = (
        frames.filter(pc.equal(frames["estimator"], frames["estimator"][0])) if frames.num_rows else frames
    )
    known = frames.filter(pc.is_valid(frames["render_noise_share"]))
    if not known.num_rows:
        return "<p>It is not known: the table has no figure of it.</p>"
    shares = known["render_noise_share"].to_numpy()
    said = (
        "Monte Carlo noise adds to the sensor's. Of the sensor's variance it is, in the median pixel or the "
        f"worst flare's place, whichever is more: {_percent(float(np.median(shares)))} in the median frame "
        f"and {_percent(float(shares.max()))} in the worst of {counted(known.num_rows, 'frame')}."
    )
    targets = pc.drop_null(known["render_noise_target"])
    if not len(targets):
        return f"<p>{said} The scene sets no target.</p>"
    over = pc.sum(pc.greater(known["render_noise_share"], known["render_noise_target"])).as_py() or 0
    least = _percent(float(pc.min(targets).as_py()))
    if not over:
        return f"<p>{said} The target is {least}: no frame is above it.</p>"
    return (
        f'<p>{said}</p><p class="warning">{counted(over, "frame is", "frames are")} above the target of '
        f"{least}: there part of the error may be the renderer's. Render them with more samples.</p>"
    )


def axes_table(axes: Sequence[Axis]) -> str:
    """Return what was varied, and through which values."""
    rows = []
    for axis in axes:
        shown = ", ".join(axis.labels[:_MOST_LABELS])
        more = len(axis.labels) - _MOST_LABELS
        last = f", … {axis.labels[-1]} ({len(axis.labels)} values)" if more > 0 else ""
        rows.append([escape(axis.title), escape(", ".join(axis.paths)), escape(shown + last)])
    return table(["axis", "sets", "values"], rows, text=(1, 2))


def _of(figure: Figure, count: int, asked: int) -> str:
    return str(asked) if figure.kind == "frame" or count == asked else f"{count}/{asked}"


def _percent(value: float) -> str:
    return share(value) if 0.001 <= value <= 1.0 else f"{100.0 * value:.2g} %"
