"""The frames of a set side by side in processes of their own.

Threads of one interpreter hand it to and fro between the many short steps of a fit, and gain little by that;
processes do not. Frames reach them by memory that they share, the next ones while they are at work, and
detections come back by pipes.
"""

import contextlib
import math
import os
import signal
import threading
import weakref
from collections import deque
from collections.abc import Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from multiprocessing import connection, get_context
from multiprocessing.shared_memory import SharedMemory
from types import TracebackType
from typing import Any

import numpy as np

from perception.estimators import ESTIMATORS, detect, require_calibrations
from perception.types import Calibration, Detections, RawFrame
from perception.warm_up import warm_up_frames

_ENDS_WITHIN_S = 2.0


class DetectorProcesses:
    """Processes that find the flares of frames; they start when it is made, and wait for frames.

        with perception.DetectorProcesses(calibrations) as detectors:
            pipeline = perception.Pipeline(calibrations, detector=detectors.detect_frames)

    They load the package anew: where a script makes it, that must stand below ``if __name__ == "__main__":``.
    It is made once they are ready: a second or two, minutes where the package's loops were never compiled.
    Shared memory (`/dev/shm`) must have room for two frames for each process, and for a whole set where sets
    are read ahead.

    Parameters
    ----------
    calibrations
        Of each camera, by its name.
    estimator
        "robust" or "paper".
    limit_s
        As for `detect`, of each frame.
    count
        How many; by default as many as there are cores, or cameras if these are fewer.

    Raises
    ------
    ValueError
        The estimator's name is not known, or `count` is no positive number.
    RuntimeError
        One of them does not start.
    """

    def __init__(
        self,
        calibrations: Mapping[str, Calibration],
        estimator: str = "robust",
        *,
        limit_s: float = math.inf,
        count: int | None = None,
    ) -> None:
        if estimator not in ESTIMATORS:
            raise ValueError(f"estimator {estimator!r} is not known here; {' and '.join(ESTIMATORS)} are")
        if count is None:
            count = max(1, min(os.cpu_count() or 1, len(calibrations)))
        if count < 1:
            raise ValueError(f"{count} processes detect nothing: give 1 or more")
        self._calibrations = dict(calibrations)
        self._one_at_a_time = threading.RLock()
        self._workers: list[_Worker] = []
        self._memory = _Memory()
        self._is_ahead = False
        weakref.finalize(self, _end, self._workers, self._memory)  # where nobody closes it
        try:
            for _ in range(count):
                self._workers.append(_Worker(self._calibrations, estimator, limit_s))
            for worker in self._workers:
                worker.answer(
                    'does not start; in a script it must be made below `if __name__ == "__main__":`'
                )
        except BaseException:
            self.close()
            raise

    def detect_frames(self, frames: Sequence[RawFrame]) -> list[Detections]:
        """Find the flares of several frames, as `perception.detect_frames` does: to the bit the same.

        Raises
        ------
        ValueError
            As for `detect`, or if a frame's camera has no calibration.
        RuntimeError
            A process has ended, which ends the others too, or they were ended before.
        """
        with self._one_at_a_time:
            return self._ended(self._begun(frames))

    def detect_sets(
        self, sets: Iterable[Sequence[RawFrame]]
    ) -> Generator[tuple[Sequence[RawFrame], list[Detections]], None, None]:
        """Yield sets of frames and the flares of each, as `detect_frames` finds them.

        The processes are at work with the next set while the caller is with this one, which is told once the
        next is at hand: for what was recorded, and for cameras that are faster than both together. The frames
        of a set are copied before the next is asked for. What is wrong with one ends the iteration, once all
        sets before it are told.

            for frames, found in detectors.detect_sets(sets):
                heard = pipeline.follow(frames, found)

        Raises
        ------
        ValueError, RuntimeError
            As `detect_frames`; also if other frames are asked for before the last set was told.
        """
        begun: _Reading | None = None
        try:
            for frames in chain(sets, [None]):
                with self._one_at_a_time:
                    read, begun = begun, None
                    found = [] if read is None else self._ended(read)
                    wrong: Exception | None = None
                    try:
                        begun = None if frames is None else self._begun(frames, ahead=True)
                    except ValueError as error:
                        wrong = error
                if read is not None:
                    yield read.frames, found
                if wrong is not None:
                    raise wrong
        finally:
            if begun is not None:  # nobody asks for the rest
                with self._one_at_a_time, contextlib.suppress(ValueError, RuntimeError):
                    self._ended(begun)

    def close(self) -> None:
        """End the processes, and give their memory back."""
        with self._one_at_a_time:
            _end(self._workers, self._memory)

    def __enter__(self) -> "DetectorProcesses":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _begun(self, frames: Sequence[RawFrame], *, ahead: bool = False) -> "_Reading":
        """Put the processes to work with a set."""
        require_calibrations(frames, self._calibrations)
        if not self._workers:
            raise RuntimeError("the detector's processes were ended: make others")
        if self._is_ahead:
            raise RuntimeError("the detector's processes are at work with the next of several sets")
        reading = _Reading(frames, self._workers, self._memory)
        self._is_ahead = ahead
        try:
            reading.begin(all_of_them=ahead)
        except BaseException:
            self.close()
            raise
        return reading

    def _ended(self, reading: "_Reading") -> list[Detections]:
        """Return what they find in it; raise what one of them raised."""
        self._is_ahead = False
        if not self._workers:
            raise RuntimeError("the detector's processes were ended: make others")
        try:
            answers = reading.answers()
        except BaseException:  # an answer that nobody waits for would be taken for the next frame's
            self.close()
            raise
        found = []
        for answer in answers:
            if isinstance(answer, Exception):
                raise answer
            found.append(answer)
        return found


class _Reading:
    """The frames of a set on their way through the processes."""

    def __init__(self, frames: Sequence[RawFrame], workers: "list[_Worker]", memory: "_Memory") -> None:
        self.frames, self._memory, self._most_placed = frames, memory, len(workers)
        self._waiting = iter(enumerate(frames))
        self._placed: deque[tuple[int, _Handed]] = deque()
        self._idle = list(workers)
        self._busy: dict[Any, tuple[_Worker, int, _Handed]] = {}
        self._answers: dict[int, Detections | Exception] = {}

    def begin(self, *, all_of_them: bool = False) -> None:
        """Give each idle process a frame; put all others into memory, if asked to."""
        while self._idle and (self._placed or self._place_next()):
            worker, (index, handed) = self._idle.pop(), self._placed.popleft()
            worker.hand_over(handed)
            self._busy[worker.pipe] = (worker, index, handed)
        while all_of_them and self._place_next():
            pass

    def answers(self) -> list[Detections | Exception]:
        """Give each process the next frame when it answers; that is in memory by then."""
        while len(self._answers) < len(self.frames):
            self.begin()
            # One at a time, as long as nobody waits.
            goes_on = len(self._placed) < self._most_placed and self._place_next()
            for ready in connection.wait(list(self._busy), timeout=0.0 if goes_on else None):
                worker, index, handed = self._busy.pop(ready)
                self._answers[index] = worker.answer("has ended, and the others with it: make others")
                self._memory.give_back(handed)
                self._idle.append(worker)
        return [self._answers[index] for index in range(len(self.frames))]

    def _place_next(self) -> bool:
        """Put the next frame where processes find it; tell whether there was one."""
        for index, frame in self._waiting:
            self._placed.append((index, self._memory.place(frame)))
            return True
        return False


class _Worker:
    """A process, and the pipe to it."""

    def __init__(self, calibrations: Mapping[str, Calibration], estimator: str, limit_s: float) -> None:
        context = get_context("spawn")
        self.pipe, its = context.Pipe()
        self.process = context.Process(
            target=_serve, args=(its, calibrations, estimator, limit_s), daemon=True
        )
        self.process.start()
        its.close()

    def hand_over(self, handed: "_Handed") -> None:
        """Give it a frame."""
        with contextlib.suppress(OSError):  # one that has ended is told where its answer is waited for
            self.pipe.send(handed)

    def answer(self, otherwise: str) -> Any:
        """Wait for its answer; raise RuntimeError where it ends without one."""
        try:
            return self.pipe.recv()
        except (EOFError, OSError):
            self.process.join(_ENDS_WITHIN_S)
            status = self.process.exitcode
            raise RuntimeError(f"a process of the detector (status {status}) {otherwise}") from None

    def end(self) -> None:
        """End it, within seconds."""
        with contextlib.suppress(OSError):
            self.pipe.send(None)
        self.process.join(_ENDS_WITHIN_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()
        self.pipe.close()


@dataclass(frozen=True)
class _Place:
    """Where the pixels of a frame lie, and in which pieces of memory others may."""

    memory: str
    shape: tuple[int, ...]
    dtype: str
    pieces: frozenset[str]


_Handed = tuple[RawFrame, _Place | None]
"""A frame, without its pixels where these lie in memory."""


class _Memory:
    """Memory that processes share, a piece for each frame that is in it."""

    def __init__(self) -> None:
        self._all: dict[str, SharedMemory] = {}
        self._free: list[str] = []

    def place(self, frame: RawFrame) -> _Handed:
        """Put a frame's pixels into memory. What is no array of numbers stays as it is."""
        pixels = frame.data_dn
        if not (isinstance(pixels, np.ndarray) and pixels.dtype.kind in "iuf" and pixels.size):
            return frame, None
        name = next((each for each in self._free if self._all[each].size >= pixels.nbytes), None)
        if name is None:
            while self._free:  # too small, all of them
                _forget(self._all.pop(self._free.pop()))
            memory = SharedMemory(create=True, size=pixels.nbytes)
            name, self._all[memory.name] = memory.name, memory
        else:
            self._free.remove(name)
        np.copyto(np.ndarray(pixels.shape, pixels.dtype, self._all[name].buf), pixels)
        without = replace(frame, data_dn=np.empty((0, 0), dtype=np.uint16))
        return without, _Place(name, pixels.shape, pixels.dtype.str, frozenset(self._all))

    def give_back(self, handed: _Handed) -> None:
        """Take a frame's memory for another."""
        if handed[1] is not None:
            self._free.append(handed[1].memory)

    def close(self) -> None:
        """Give all of it back."""
        self._free.clear()
        while self._all:
            _forget(self._all.popitem()[1])


def _forget(memory: SharedMemory) -> None:
    memory.close()
    with contextlib.suppress(FileNotFoundError):
        memory.unlink()


def _end(workers: list[_Worker], memory: _Memory) -> None:
    while workers:
        workers.pop().end()
    memory.close()


def _serve(
    pipe: connection.Connection, calibrations: Mapping[str, Calibration], estimator: str, limit_s: float
) -> None:
    """Find flares in frames until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's Ctrl-C is for who started it
    warm_up_frames()
    with contextlib.suppress(EOFError, OSError):  # nobody is there any more
        pipe.send("ready")
        held: dict[str, SharedMemory] = {}
        while (handed := pipe.recv()) is not None:
            answer: Detections | Exception
            frame: RawFrame | None = None
            try:
                frame = _taken(handed, held)
                answer = detect(frame, calibrations[frame.camera], estimator, limit_s=limit_s)
            except ValueError as error:
                answer = error
            except Exception as error:  # whatever it is, it is told where it is waited for
                answer = RuntimeError(f"{type(error).__name__}: {error}")
            frame = None  # nothing refers to its memory any more
            pipe.send(answer)


def _taken(handed: _Handed, held: dict[str, SharedMemory]) -> RawFrame:
    """Return a frame as it lies in memory; what is there no more is held no longer."""
    frame, place = handed
    if place is None:
        return frame
    for gone in held.keys() - place.pieces:
        held.pop(gone).close()
    if place.memory not in held:
        held[place.memory] = SharedMemory(place.memory)
    return replace(frame, data_dn=np.ndarray(place.shape, place.dtype, held[place.memory].buf))
