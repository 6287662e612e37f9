"""What of two runs belongs together: frames by camera and index, and in them sources by robot and name.

Runs are compared where they show the same world; in what else their truth differs is said.
"""

import filecmp
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from nir_render.errors import InputError
from nir_render.evaluate.metrics import Evaluation, Score, angle_deg, evaluate
from nir_render.evaluate.sets import SetEvaluation
from nir_render.report.wording import counted
from nir_render.run import folder as run_folder
from nir_render.run.evaluate import check_frames_known, rows_of, sets_of
from nir_render.run.folder import parse_lines
from nir_render.run.perceive import frame_keys
from nir_render.truth.lamps import LampTruth, parse_lamp
from nir_render.truth.sources import SourceTruth, parse_truth
from perception import (
    Calibration,
    Detection,
    FrameRecord,
    RecordingError,
    parse_detection,
    read_calibrations,
    read_frame_records,
    read_recording,
)
from perception.types import FrameKey

_SAME_PLACE = 1e-6
"""Two places are one within this share of the range, two directions within this angle in radians."""

_SAME_LIGHT = 1e-3
_MOST_NAMED = 3


@dataclass(frozen=True, eq=False)
class ScoredRun:
    """A run as it was read: its frames' records, calibrations, and each frame's evaluation by itself.

    `around` has what its rigs measured, set by set; None where it has no measurements.
    """

    folder: Path
    records: Mapping[FrameKey, FrameRecord]
    calibrations: Mapping[str, Calibration]
    evaluations: Mapping[FrameKey, Evaluation]
    estimators: tuple[str, ...]
    around: SetEvaluation | None = None


@dataclass(frozen=True)
class Said:
    """What one side said of a source: NaN where it said nothing."""

    detection: Detection | None
    range_error_m: float
    bearing_error_deg: float

    @property
    def found(self) -> bool:
        """Whether it found the source."""
        return self.detection is not None


@dataclass(frozen=True)
class SourcePair:
    """One source in one frame, as both sides scored it; it counts where it counts on both."""

    name: str
    countable: bool
    range_limit_m: float
    first: Said
    second: Said


@dataclass(frozen=True)
class FrameSide:
    """One side of a frame: what belongs to no source, to ghosts, to lamps."""

    false_alarms: tuple[Detection, ...]
    ghosts: int
    lamps: int


@dataclass(frozen=True)
class FramePair:
    """One frame, as both sides scored it."""

    key: FrameKey
    sources: tuple[SourcePair, ...]
    first: FrameSide
    second: FrameSide


@dataclass(frozen=True)
class Pairing:
    """Frames that both runs have, by camera and index; whether their counts are the same; what differs."""

    keys: tuple[FrameKey, ...]
    same_frames: bool
    notes: tuple[str, ...]


def read_scored(folder: Path, estimators: Iterable[str] = ()) -> ScoredRun:
    """Read a run, and score its detections frame by frame; nothing is written.

    Parameters
    ----------
    folder
        A run folder with truth and detections.
    estimators
        Those that must be there.

    Raises
    ------
    InputError
        The folder has no truth, no detections or not these, or a file is broken.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder; give a run folder")
    if not (folder / run_folder.TRUTH).is_file():
        raise InputError(
            f"{folder / run_folder.TRUTH}: there is no such file; without truth nothing is scored"
        )
    paths = run_folder.detection_files(folder)
    known = ", ".join(paths) or "none"
    for name in estimators:
        if name not in paths:
            raise InputError(
                f"{folder}: has no detections of {name!r}; there are some of: {known}; "
                f"run 'nir-render perceive {folder} --estimator {name}' first"
            )
    if not paths:
        raise InputError(f"{folder}: there are no detections; run 'nir-render perceive {folder}' first")
    try:
        calibrations = read_calibrations(folder)
        keys = frame_keys(folder)
        truth = parse_lines(folder / run_folder.TRUTH, parse_truth)
        detections = {name: parse_lines(path, parse_detection) for name, path in paths.items()}
        lamps_path = folder / run_folder.LAMPS
        lamps = parse_lines(lamps_path, parse_lamp) if lamps_path.is_file() else []
        check_frames_known(keys, truth, lamps, detections, calibrations, folder)
        records = {(record.camera, record.index): record for record in read_frame_records(folder)}
        around = _around(folder, truth, detections, lamps)
    except InputError:
        raise
    except RecordingError as error:
        raise InputError(str(error)) from None
    return ScoredRun(
        folder,
        records,
        calibrations,
        _by_frame(keys, truth, lamps, detections, calibrations),
        tuple(paths),
        around,
    )


def _around(
    folder: Path,
    truth: Sequence[SourceTruth],
    detections: Mapping[str, Sequence[Detection]],
    lamps: Sequence[LampTruth],
) -> SetEvaluation | None:
    """Return what rigs measured, as it was scored; dark and flat frames show nothing to measure."""
    if not any(folder.glob("measurements.*.jsonl")):
        return None
    recording = read_recording(folder).of_sources
    return sets_of(recording, rows_of(recording, truth), detections, rows_of(recording, lamps))


def pair_runs(first: ScoredRun, second: ScoredRun) -> Pairing:
    """Pair the frames of two runs.

    Raises
    ------
    InputError
        No frame is in both, or a source stands elsewhere: they do not show the same world.
    """
    keys = tuple(sorted(first.records.keys() & second.records.keys()))
    if not keys:
        raise InputError(
            f"{first.folder} and {second.folder} have no frame in common (camera and index): "
            f"{_named(first.records)} in the first, {_named(second.records)} in the second"
        )
    notes = []
    for run, other, which in ((first, second, "first"), (second, first, "second")):
        alone = sorted(run.records.keys() - other.records.keys())
        if alone:
            frames = counted(len(alone), "frame")
            notes.append(f"{frames} in the {which} run only, left out: {_named(alone)}")
    if first.folder.resolve() == second.folder.resolve():
        return Pairing(keys, same_frames=True, notes=tuple(notes))
    notes += _truth_notes(first, second, keys)
    differing = [key for key in keys if not _same_counts(first, second, key)]
    if differing:
        notes.append(
            f"the counts of {len(differing)} of {len(keys)} frames differ, such as {_named(differing)}: what "
            "differs is not the estimator alone"
        )
    if not _same_file(first.folder, second.folder, run_folder.CALIBRATION):
        notes.append("calibration.json differs")
    return Pairing(keys, not differing, tuple(notes))


def frame_pair(
    key: FrameKey, first: ScoredRun, second: ScoredRun, first_name: str, second_name: str
) -> FramePair:
    """Return one frame as an estimator of the first run and one of the second scored it."""
    ours, theirs = _scores(first, key), _scores(second, key)
    sources = tuple(
        SourcePair(
            name=name,
            countable=ours[name].countable and theirs[name].countable,
            range_limit_m=ours[name].range_limit_m,
            first=_said(ours[name], first_name),
            second=_said(theirs[name], second_name),
        )
        for name in ours
        if name in theirs
    )
    return FramePair(key, sources, _side(first, key, first_name), _side(second, key, second_name))


def _by_frame(
    keys: Sequence[FrameKey],
    truth: Iterable[SourceTruth],
    lamps: Iterable[LampTruth],
    detections: Mapping[str, Iterable[Detection]],
    calibrations: Mapping[str, Calibration],
) -> dict[FrameKey, Evaluation]:
    rows: dict[FrameKey, list[SourceTruth]] = {key: [] for key in keys}
    outlines: dict[FrameKey, list[LampTruth]] = {key: [] for key in keys}
    found: dict[FrameKey, dict[str, list[Detection]]] = {key: {n: [] for n in detections} for key in keys}
    for row in truth:
        rows[row.camera, row.index].append(row)
    for lamp in lamps:
        outlines[lamp.camera, lamp.index].append(lamp)
    for name, listed in detections.items():
        for detection in listed:
            found[detection.camera, detection.index][name].append(detection)
    return {key: evaluate([key], rows[key], calibrations, found[key], outlines[key]) for key in rows}


def _scores(run: ScoredRun, key: FrameKey) -> dict[str, Score]:
    scores = run.evaluations[key].scores
    return {f"{score.truth.robot}.{score.truth.source}": score for score in scores}


def _said(score: Score, name: str) -> Said:
    detection = score.detections.get(name)
    if detection is None:
        return Said(None, math.nan, math.nan)
    return Said(
        detection,
        detection.range_m - score.truth.range_m,
        angle_deg(detection.bearing_body, score.truth.bearing_body),
    )


def _side(run: ScoredRun, key: FrameKey, name: str) -> FrameSide:
    evaluation = run.evaluations[key]
    counts = evaluation.summary["estimators"][name]
    return FrameSide(
        tuple(evaluation.false_alarms[name]), counts["ghosts_reported"], counts["lamps_reported"]
    )


def _truth_notes(first: ScoredRun, second: ScoredRun, keys: Sequence[FrameKey]) -> list[str]:
    """Say in what the truth of two runs differs; raise InputError where it is not of one world."""
    alone: dict[str, list[str]] = {"first": [], "second": []}
    moved, counting, light, taken = [], [], [], []
    for key in keys:
        ours, theirs = _scores(first, key), _scores(second, key)
        for which, names in (("first", ours.keys() - theirs), ("second", theirs.keys() - ours)):
            alone[which] += [f"{name} in {_frame(key)}" for name in sorted(names)]
        for name in ours.keys() & theirs.keys():
            one, other = ours[name], theirs[name]
            where = f"{name} in {_frame(key)}"
            if not _same_place(one.truth, other.truth):
                moved.append(
                    f"{where} is {_where(one.truth)} in the first run, {_where(other.truth)} in the second"
                )
            if one.countable != other.countable:
                counting.append(where)
            light_e = max(one.truth.direct_e, other.truth.direct_e)
            if abs(one.truth.direct_e - other.truth.direct_e) > _SAME_LIGHT * light_e:
                light.append(where)
        fields = ("time_s", "exposure_s", "gain", "black_level_dn", "line_time_s")
        if any(getattr(first.records[key], f) != getattr(second.records[key], f) for f in fields):
            taken.append(_frame(key))
    if moved:
        raise InputError(
            f"{first.folder} and {second.folder} are not of the same truth: in {len(moved)} places a source "
            f"stands elsewhere; {moved[0]}. Compare runs of one scene, with one seed of its motion"
        )
    notes = [
        f"{counted(len(names), 'source')} in view in the {which} run only, left out: {_few(names)}"
        for which, names in alone.items()
        if names
    ]
    for places, what, said in (
        (taken, "frame", "taken at another time, exposure or gain"),
        (light, "source", "of another light"),
        (counting, "source", "that counts for recall in one run only, left out"),
    ):
        if places:
            notes.append(f"{counted(len(places), what)} {said}: {_few(sorted(places))}")
    return notes


def _same_place(one: SourceTruth, other: SourceTruth) -> bool:
    turned_rad = math.radians(angle_deg(one.bearing_body, other.bearing_body))
    return abs(one.range_m - other.range_m) <= _SAME_PLACE * one.range_m and turned_rad <= _SAME_PLACE


def _where(truth: SourceTruth) -> str:
    ahead, left, up = truth.bearing_body
    return f"{truth.range_m:.4f} m away towards ({ahead:.4f}, {left:.4f}, {up:.4f})"


def _same_counts(first: ScoredRun, second: ScoredRun, key: FrameKey) -> bool:
    one, other = (run.folder / run.records[key].file for run in (first, second))
    return one.is_file() and other.is_file() and filecmp.cmp(one, other, shallow=False)


def _same_file(first: Path, second: Path, name: str) -> bool:
    return filecmp.cmp(first / name, second / name, shallow=False)


def _frame(key: FrameKey) -> str:
    return f"frame {key[1]} of {key[0]}"


def _named(keys: Iterable[FrameKey]) -> str:
    return _few([_frame(key) for key in sorted(keys)])


def _few(names: Sequence[str]) -> str:
    more = len(names) - _MOST_NAMED
    return ", ".join(names[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
