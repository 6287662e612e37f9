"""`compare.html`: two sides on a page that opens from disk, the frames that differ most side by side."""

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from nir_render.compare.compare import Comparison, EstimatorComparison
from nir_render.compare.pairs import FramePair, Said, ScoredRun, SourcePair
from nir_render.compare.plots import error_plots
from nir_render.compare.words import (
    HEADINGS,
    LEVELS,
    RULES,
    counts_sentence,
    has_content,
    row_of,
    sentence_of,
)
from nir_render.errors import InputError
from nir_render.evaluate.metrics import Score
from nir_render.report.drawing import Drawing
from nir_render.report.parts import Table, render_page
from nir_render.report.pictures import CloseUp, WholePicture, close_up, shown_frame
from nir_render.report.wording import counted, degrees, metres
from nir_render.run.folder import note_seconds, write_file
from perception import RecordingError, read_frame

PAGE = "compare.html"

_MOST_FRAMES = 6
_MOST_OF_ALL = 18  # these bound the size of the page
_MOST_ROWS = 6
_ROW_HEADINGS = ("source", "first", "second", "limit σ")


@dataclass(frozen=True)
class ShownFrame:
    """One frame on both sides, the source that differs most close up, and what differs."""

    title: str
    first: WholePicture
    second: WholePicture
    closes: tuple[CloseUp, ...]
    rows: Table
    more: str


@dataclass(frozen=True)
class Section:
    """What the page says of an estimator and another."""

    title: str
    names: tuple[str, str]
    sentence: str
    counts: str
    table: Table
    plot: Drawing | None
    frames: tuple[ShownFrame, ...]
    differing: str


def compare_html(comparison: Comparison) -> str:
    """Write the page.

    Raises
    ------
    RecordingError
        A frame that is to be shown cannot be read.
    """
    first, second = comparison.labels
    one_run = comparison.first is comparison.second
    most = max(1, min(_MOST_FRAMES, _MOST_OF_ALL // len(comparison.estimators)))
    estimators = [
        pair.first if pair.first == pair.second else f"{pair.first} and {pair.second}"
        for pair in comparison.estimators
    ]
    return render_page(
        "compare/page.html",
        title=f"{first}: {estimators[0]}" if one_run else f"{first} and {second}",
        subtitle=[
            counted(len(comparison.pairing.keys), "frame"),
            f"estimators: {', '.join(estimators)}",
            "the same frames" if comparison.pairing.same_frames else "frames of their own",
        ],
        names=_names(comparison),
        notes=[f"{note[:1].upper()}{note[1:]}." for note in comparison.pairing.notes],
        sections=[_section(comparison, pair, most) for pair in comparison.estimators],
        rules=RULES,
    )


def write_page(comparison: Comparison, path: Path) -> None:
    """Write the page; in a run folder with a manifest, note it there.

    Raises
    ------
    InputError
        The file cannot be written, or a frame that is to be shown not be read.
    """
    started = time.perf_counter()
    try:
        html = compare_html(comparison)
    except RecordingError as error:
        raise InputError(str(error)) from None
    write_file(path, html.encode())
    note_seconds(path.parent, "compare", started)


def differing_frames(frames: Sequence[FramePair]) -> list[FramePair]:
    """Return the frames that differ: first where the sides found different things, then by range error."""
    ranked = [(_difference(frame), frame) for frame in frames]
    return [frame for rank, frame in sorted(ranked, key=lambda each: each[0], reverse=True) if any(rank)]


def _difference(frame: FramePair) -> tuple[int, float]:
    """Return how many findings differ, and the largest change of a range error in units of its limit."""
    found = sum(pair.first.found != pair.second.found for pair in frame.sources if pair.countable)
    alarms = abs(len(frame.first.false_alarms) - len(frame.second.false_alarms))
    return found + alarms, max((_change(pair) for pair in frame.sources), default=0.0)


def _change(pair: SourcePair) -> float:
    """Return by how many limits the size of the range error differs; in metres where there is no limit."""
    change_m = abs(abs(pair.second.range_error_m) - abs(pair.first.range_error_m))
    known = math.isfinite(pair.range_limit_m) and pair.range_limit_m > 0.0
    change = change_m / pair.range_limit_m if known else change_m
    return change if math.isfinite(change) else 0.0


def _names(comparison: Comparison) -> list[str]:
    """Return the names of all estimators of the page, each once."""
    return list(dict.fromkeys(name for pair in comparison.estimators for name in (pair.first, pair.second)))


def _section(comparison: Comparison, pair: EstimatorComparison, most: int) -> Section:
    labels = comparison.sides(pair)
    differing = differing_frames(pair.frames)
    shown = differing[:most]
    rows = [_marked(row_of(compared)) for compared in pair.all_figures if has_content(compared)]
    recall = next(compared for compared in pair.figures if compared.figure.name == "recall")
    return Section(
        title=pair.first if pair.first == pair.second else f"{pair.first} against {pair.second}",
        names=labels,
        sentence=sentence_of(pair.all_figures, pair.identical),
        counts=counts_sentence(recall),
        table=Table((HEADINGS[0], *labels, *HEADINGS[3:]), rows),
        plot=error_plots(pair.frames, *labels),
        frames=tuple(_shown(comparison, pair, frame) for frame in shown),
        differing=f"{counted(len(differing), 'frame')} of {len(pair.frames)} "
        f"differ{'s' if len(differing) == 1 else ''}"
        + (f"; the {len(shown)} that differ most are shown." if len(shown) < len(differing) else "."),
    )


def _marked(row: tuple[str, ...]) -> list[str]:
    """Return a row with its verdict coloured."""
    place = HEADINGS.index("verdict")
    word = Markup('<span class="word {}">{}</span>').format(LEVELS.get(row[place], "none"), row[place])
    return [*row[:place], word, *row[place + 1 :]]


def _shown(comparison: Comparison, pair: EstimatorComparison, frame: FramePair) -> ShownFrame:
    differing = sorted(
        (source for source in frame.sources if source.first != source.second),
        key=lambda source: (source.first.found != source.second.found, _change(source)),
        reverse=True,
    )
    rows: list[tuple[str, ...]] = [
        (
            source.name + ("" if source.countable else " (does not count)"),
            _said(source.first),
            _said(source.second),
            metres(source.range_limit_m),
        )
        for source in differing[:_MOST_ROWS]
    ]
    alarms = (len(frame.first.false_alarms), len(frame.second.false_alarms))
    if any(alarms):
        rows.append(("false alarms", *map(str, alarms), ""))
    more = len(differing) - _MOST_ROWS
    return ShownFrame(
        title=f"{frame.key[0]}, frame {frame.key[1]}",
        first=_picture(comparison.first, frame, pair.first),
        second=_picture(comparison.second, frame, pair.second),
        closes=tuple(
            _close(run, frame, name, _names(comparison), differing[0].name)
            for run, name in ((comparison.first, pair.first), (comparison.second, pair.second))
            if differing
        ),
        rows=Table(_ROW_HEADINGS, rows),
        more=f"{counted(more, 'more source')} not listed." if more > 0 else "",
    )


def _said(said: Said) -> str:
    if not said.found:
        return "not found"
    error = metres(said.range_error_m, signed=True) if math.isfinite(said.range_error_m) else "no range"
    return f"{error}, {degrees(said.bearing_error_deg)}"


def _picture(run: ScoredRun, frame: FramePair, name: str) -> WholePicture:
    raw = read_frame(run.folder, run.records[frame.key])
    alarms = {name: list(run.evaluations[frame.key].false_alarms[name])}
    return shown_frame(raw, run.calibrations[frame.key[0]], _scores(run, frame, name), alarms)


def _close(run: ScoredRun, frame: FramePair, name: str, names: Sequence[str], source: str) -> CloseUp:
    score = next(
        score
        for score in _scores(run, frame, name)
        if score.truth.ghost_of is None and f"{score.truth.robot}.{score.truth.source}" == source
    )
    raw = read_frame(run.folder, run.records[frame.key])
    return close_up(raw, run.calibrations[frame.key[0]], score, [name], names)


def _scores(run: ScoredRun, frame: FramePair, name: str) -> list[Score]:
    """Return the scores of a frame with what one estimator said."""
    evaluation = run.evaluations[frame.key]
    return [
        dataclasses.replace(score, detections={n: said for n, said in score.detections.items() if n == name})
        for score in (*evaluation.scores, *evaluation.ghosts)
    ]
