"""The stage `perceive`: the frames of any folder become detections, tracks, messages, by some estimators."""

import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import median

from nir_render.errors import InputError
from nir_render.run import folder as run_folder
from nir_render.run.folder import note_seconds
from nir_render.run.follow import Follower, OwnParts
from nir_render.run.render import Progress
from perception import (
    ESTIMATORS,
    Calibration,
    CommandEstimator,
    Detection,
    Detections,
    Estimator,
    EstimatorError,
    OwnSetEstimator,
    RawFrame,
    Recording,
    detect,
    detection_record,
    frame_sets,
    load_command,
    load_estimator,
    read_frame_records,
    read_odometry,
    read_recording,
)
from perception.causes import DetectionCauses, detection_causes
from perception.command_estimator import LIMIT_S, is_command
from perception.messages.own import DecoderError
from perception.rig.frame_sets import robot_of
from perception.rig.overlap import finest, overlap_warnings
from perception.robust.detect import detect_robust
from perception.robust.search.reason import NO_FAULT
from perception.robust.together.free_width import log_width_of_frames
from perception.track.own import TrackerError
from perception.types import FrameKey, Odometry

RunEstimator = Estimator | OwnSetEstimator | CommandEstimator
"""What can be run over a folder: a function of a frame, a function of a set of frames, or a command."""

Found = dict[FrameKey, list[Detection]]


@dataclass(frozen=True)
class Perceived:
    """How many detections each estimator made, and what went wrong with those that failed, by name.

    `warnings` say where what was found contradicts the calibration, why nothing was found at all, and where
    more was seen than was measured.
    """

    detections: Mapping[str, int]
    failures: Mapping[str, str]
    warnings: tuple[str, ...] = ()

    @property
    def problems(self) -> tuple[str, ...]:
        """What to tell the user, a text for each estimator that failed."""
        return tuple(f"--estimator {text}" for text in self.failures.values())


def chosen_estimators(names: Sequence[str], limit_s: float | None = None) -> dict[str, RunEstimator]:
    """Return the estimators of these names, by name.

    `file.py:function` loads one of the user's own, `cmd: …` and `NAME=cmd: …` are programs, which may take
    `limit_s` for a frame, by default a minute. After so much `robust` begins with no further flare, if it is
    given.

    Raises
    ------
    InputError
        An estimator is unknown or cannot be loaded, or two of them have the same name.
    """
    chosen: dict[str, RunEstimator] = {}
    for name in dict.fromkeys(names):
        if name in ESTIMATORS:
            chosen[name] = ESTIMATORS[name]
            if limit_s is not None and ESTIMATORS[name] is detect_robust:
                chosen[name] = partial(detect_robust, limit_s=limit_s)
            continue
        if ":" not in name and not name.endswith(".py"):
            known = ", ".join(ESTIMATORS)
            raise InputError(
                f"--estimator {name}: unknown; known: {known}, or one's own as file.py:function or "
                "'cmd: PROGRAM'"
            )
        try:
            own = load_command(name, limit_s or LIMIT_S) if is_command(name) else load_estimator(name)
        except EstimatorError as error:
            raise InputError(f"--estimator {error}") from None
        if own.name in chosen:
            mend = (
                f"write OTHER=cmd: …{name.partition('cmd:')[2]}" if is_command(name) else "rename one of them"
            )
            raise InputError(f"--estimator {name}: another estimator is called {own.name!r} too; {mend}")
        chosen[own.name] = own
    return chosen


def estimators_in_process(names: Sequence[str]) -> dict[str, Estimator | OwnSetEstimator]:
    """Return the estimators of these names that are functions, of a frame or of a set of frames.

    Raises
    ------
    InputError
        As `chosen_estimators`, or one of them is a command.
    """
    chosen: dict[str, Estimator | OwnSetEstimator] = {}
    for name, estimator in chosen_estimators(names).items():
        if isinstance(estimator, CommandEstimator):
            raise InputError(
                f"--estimator {estimator.reference}: is a command, which only 'nir-render run' and "
                "'perceive' take; give a function of a frame or of a set of frames here"
            )
        chosen[name] = estimator
    return chosen


def perceive_run(
    folder: Path,
    *,
    estimators: Mapping[str, RunEstimator],
    progress: Progress,
    own: OwnParts = OwnParts(),  # noqa: B008
    calibration: Path | None = None,
    causes: bool = False,
    period_s: float | None = None,
) -> Perceived:
    """Run estimators over the frames of a folder; write the detections of each that reads them all.

    Dark and flat frames are passed over. `calibration` is a file in place of the folder's own. With `causes`
    what the σ of each range is made of is written beside the detections, else there is none of it. With
    `period_s` sets of frames are those of that period (`frame_sets`), here and where they are scored:
    `sets.json` says it.

    One's own that fails on a frame is left out from there on, and the others go on. Of it nothing is written;
    detections of an earlier call stay. `own` are a tracker and a decoder of one's own, for all of them.

    Raises
    ------
    InputError
        The folder is no recording.
    """
    started = time.perf_counter()
    try:
        recording = read_recording(folder).of_sources
        if calibration is not None:
            recording = recording.calibrated_by(calibration)
        if not recording.records:
            raise InputError(
                f"{folder / run_folder.FRAMES}: names dark and flat frames only; they are for 'nir-render "
                "calibrate', and show no source to perceive"
            )
        found, failures, notes = _read_all(recording, estimators, progress, own, period_s)
    except InputError:
        raise
    except ValueError as error:  # a broken recording, or a frame that does not match its calibration
        raise InputError(str(error)) from None
    keys = dict.fromkeys((record.camera, record.index) for record in recording.records)
    counts = {}
    for name, (of_frames, follower) in found.items():
        listed = [detection for key in keys for detection in of_frames.get(key, [])]
        run_folder.write_lines(folder / f"detections.{name}.jsonl", map(detection_record, listed))
        follower.write(folder)
        (folder / f"causes.{name}.jsonl").unlink(missing_ok=True)
        if causes:
            lines = (one.record() for one in _causes(recording, of_frames))
            run_folder.write_lines(folder / f"causes.{name}.jsonl", lines)
        counts[name] = len(listed)
    for name, text in failures.items():
        if (folder / f"detections.{name}.jsonl").is_file():
            failures[name] = f"{text}\ndetections.{name}.jsonl is of an earlier call, and stays as it was"
    if counts:
        run_folder.write_period(folder, period_s)
        note_seconds(folder, "perceive", started)
    said = [
        text
        for name, total in counts.items()
        for text in notes[name].warnings(name, total, recording.calibrations)
    ]
    return Perceived(counts, failures, (*_overlap_warnings(recording, found, period_s), *said))


def _causes(recording: Recording, found: Found) -> Iterator[DetectionCauses]:
    for record in recording.records:
        hits = found.get((record.camera, record.index), [])
        known = recording.calibrations[record.camera]
        yield from detection_causes(hits, known, record.gain, record.black_level_dn)


def _overlap_warnings(
    recording: Recording, found: Mapping[str, tuple[Found, Follower]], period_s: float | None
) -> Iterator[str]:
    """Yield, by robot, where what its cameras see contradicts how the calibration has them stand."""
    name = finest(list(found))
    if name is None:
        return
    hits, _ = found[name]
    sets = []
    for group in frame_sets(recording.records, period_s):
        of_cameras: dict[str, list[Detection]] = {}
        for frame in group:  # of a bracket all exposures
            of_cameras.setdefault(frame.camera, []).extend(hits.get((frame.camera, frame.index), []))
        sets.append(of_cameras)
    yield from overlap_warnings(sets, recording.calibrations)


def _read_all(
    recording: Recording,
    estimators: Mapping[str, RunEstimator],
    progress: Progress,
    own: OwnParts,
    period_s: float | None,
) -> tuple[dict[str, tuple[Found, Follower]], dict[str, str], dict[str, "_Notes"]]:
    """Return what each estimator found and followed to the end, what went wrong with others, and notes."""
    records, calibrations = recording.records, recording.calibrations
    odometry = read_odometry(recording.folder)
    found: dict[str, tuple[Found, Follower]] = {}
    failures: dict[str, str] = {}
    done = 0
    with ExitStack() as stack:
        readers: dict[str, _Reader] = {}

        def attempt(name: str, work: Callable[[], None]) -> None:
            try:
                work()
            except (EstimatorError, TrackerError, DecoderError) as error:
                failures[name] = str(error)
                found.pop(name, None)

        def start(name: str, estimator: RunEstimator) -> None:
            readers[name] = _Reader.of(estimator, calibrations, odometry, stack)
            found[name] = {}, Follower(name, calibrations, odometry, own)

        def read(name: str, frames: Sequence[RawFrame], files: Sequence[Path]) -> None:
            hits, follower = found[name]
            for detection in readers[name].read(frames, files):
                hits.setdefault((detection.camera, detection.index), []).append(detection)
            follower.take(frames, [hits.get((frame.camera, frame.index), []) for frame in frames])

        for name, estimator in estimators.items():
            attempt(name, partial(start, name, estimator))
        for group in frame_sets(records, period_s):
            if not found:
                break
            frames = [recording.frame(record) for record in group]
            files = [recording.folder / record.file for record in group]
            for name in list(found):
                attempt(name, partial(read, name, frames, files))
            done += len(group)
            progress(done, len(records))
        for name in list(found):
            attempt(name, readers[name].finish)
        for name, (_, follower) in list(found.items()):
            attempt(name, follower.finish)
    return found, failures, {name: reader.notes for name, reader in readers.items()}


@dataclass
class _Notes:
    """What an estimator says of frames as a whole: why they hold nothing, and how many hold too much."""

    reasons: dict[str, Counter[str]] = field(default_factory=dict)  # by camera
    found: Counter[str] = field(default_factory=Counter)  # detections of each camera
    truncated: int = 0
    doubts: list[tuple[float, float]] = field(default_factory=list)  # `range_doubt`, `psf_width_off`
    widths: dict[str, list[tuple[float, float]]] = field(default_factory=dict)  # `psf_width_seen`, by camera
    swept: list[float] = field(default_factory=list)  # `swept_px`

    def take(self, camera: str, found: Detections) -> Detections:
        """Note what is said of a camera's frame, and return its detections."""
        self.reasons.setdefault(camera, Counter()).update([found.reason] if found.reason else [])
        self.found[camera] += len(found)
        self.truncated += found.truncated
        self.doubts += [(found.range_doubt, found.psf_width_off)] if found.range_doubt else []
        self.widths.setdefault(camera, []).append(found.psf_width_seen)
        self.swept += [found.swept_px] if found.swept_px else []
        return found

    def warnings(self, name: str, total: int, calibrations: Mapping[str, Calibration]) -> Iterator[str]:
        """Yield what is to be told, of an estimator that made so many detections in all.

        Of one camera alone that found nothing: where that is its frames' own fault, not for want of flares.
        """
        if total == 0:
            yield from self._nothing(name, "", sum(self.reasons.values(), Counter()))
        else:
            for camera, reasons in self.reasons.items():
                faults = Counter({one: n for one, n in reasons.items() if not one.startswith(NO_FAULT)})
                if not self.found[camera] and faults:
                    yield from self._nothing(name, f" of {camera}", faults)
        if self.truncated:
            frames = "one frame" if self.truncated == 1 else f"{self.truncated} frames"
            yield f"{name} saw more in {frames} than it measures: the brightest are reported and told apart"
        if by_discs := [doubt for doubt, width_off in self.doubts if not width_off]:
            yield self._doubted(name, by_discs, "near sources whose size and flux, as calibrated, contradict")
        if of_width := [(doubt, width_off) for doubt, width_off in self.doubts if width_off]:
            by_width, off = zip(*of_width, strict=True)
            yield self._doubted(name, by_width, self._small_flares(median(off)))
        for camera, seen in self.widths.items():
            if not of_width and (together := log_width_of_frames(seen, calibrations[camera])):
                yield (
                    f"{name} saw {self._small_flares(together)}, in all frames of {camera} together: ranges "
                    "of clipped ones may be off as much, beyond their sigmas: state the sigma of psf_sigma_px"
                )
        if self.swept:
            by = f"{median(self.swept):.2g} px in {len(self.swept)} frame{'s'[: len(self.swept) != 1]}"
            yield f"{name} saw cameras turn while exposed, {by}: if none did, the point spread is not round"

    @staticmethod
    def _small_flares(off: float) -> str:
        how, why = ("wider", "defocus, or larger sources") if off > 0.0 else ("narrower", "smaller sources")
        return f"small flares {100.0 * abs(off):.2g} % {how} than the calibration's point spread ({why}?)"

    @staticmethod
    def _doubted(name: str, doubts: Sequence[float], what: str) -> str:
        frames = "one frame" if len(doubts) == 1 else f"{len(doubts)} frames"
        return (
            f"{name} saw {what}, in {frames}: ranges may be off by {100.0 * median(doubts):.2g} %, "
            "which their sigmas cover"
        )

    @staticmethod
    def _nothing(name: str, whose: str, reasons: Counter[str]) -> Iterator[str]:
        of = sum(reasons.values())
        if of:
            said = "; ".join(f"{reason} ({count})" for reason, count in reasons.most_common(3))
            yield f"{name} found nothing in {of} frame{'s'[: of != 1]}{whose}: {said}"


@dataclass(frozen=True)
class _Reader:
    """An estimator at work: what reads the frames of a group, whose PNGs are given too, and what ends it."""

    read: Callable[[Sequence[RawFrame], Sequence[Path]], list[Detection]]
    finish: Callable[[], None] = lambda: None
    notes: _Notes = field(default_factory=_Notes)

    @staticmethod
    def of(
        estimator: RunEstimator,
        calibrations: Mapping[str, Calibration],
        odometry: Mapping[str, Sequence[Odometry]],
        stack: ExitStack,
    ) -> "_Reader":
        """Set an estimator to work; a process that this starts ends with the stack."""
        if isinstance(estimator, CommandEstimator):
            process = stack.enter_context(estimator.started(calibrations))
            return _Reader(
                lambda frames, files: [
                    detection
                    for frame, file in zip(frames, files, strict=True)
                    for detection in process.detect(frame, file)
                ],
                process.finish,
            )
        if isinstance(estimator, OwnSetEstimator):
            return _Reader(
                lambda frames, _: estimator(frames, calibrations, odometry.get(robot_of(frames[0].camera)))
            )
        notes = _Notes()
        return _Reader(
            lambda frames, _: [
                detection
                for frame in frames
                for detection in notes.take(
                    frame.camera, detect(frame, calibrations[frame.camera], estimator)
                )
            ],
            notes=notes,
        )


def frame_keys(folder: Path) -> list[FrameKey]:
    """Return camera and index of all frames of a recording; raise InputError where it has none."""
    keys = [(record.camera, record.index) for record in read_frame_records(folder)]
    if not keys:
        raise InputError(f"{folder / run_folder.FRAMES}: names no frame")
    return keys


def unknown_camera(folder: Path, camera: str, known: Collection[str]) -> InputError:
    """Return the error of a frame whose camera has no calibration."""
    names = ", ".join(known) or "none"
    return InputError(
        f"{folder / run_folder.CALIBRATION}: knows no camera {camera!r}, which {run_folder.FRAMES} names; "
        f"known: {names}; name the camera so, or calibrate it"
    )
