"""The frames of a set side by side in processes of their own.

Threads of one interpreter hand it to and fro between the many short steps of a fit, and gain little by that;
processes do not. Frames reach them by memory that they share, detections come back by pipes.
"""

import contextlib
import math
import os
import signal
import threading
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
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
        weakref.finalize(self, _end, self._workers)  # where nobody closes it
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
        require_calibrations(frames, self._calibrations)
        with self._one_at_a_time:
            if not self._workers:
                raise RuntimeError("the detector's processes were ended: make others")
            try:
                answers = self._answers(frames)
            except BaseException:  # an answer that nobody waits for would be taken for the next frame's
                self.close()
                raise
        found = []
        for answer in answers:
            if isinstance(answer, Exception):
                raise answer
            found.append(answer)
        return found

    def close(self) -> None:
        """End the processes, and give their memory back."""
        with self._one_at_a_time:
            _end(self._workers)

    def __enter__(self) -> "DetectorProcesses":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _answers(self, frames: Sequence[RawFrame]) -> list[Detections | Exception]:
        """Give each process a frame, and the next one when it answers."""
        answers: dict[int, Detections | Exception] = {}
        waiting = iter(enumerate(frames))
        busy: dict[Any, tuple[_Worker, int]] = {}
        idle = list(self._workers)
        while True:
            for worker in idle:
                handed = next(waiting, None)
                if handed is not None:
                    worker.hand_over(handed[1])
                    busy[worker.pipe] = (worker, handed[0])
            if not busy:
                return [answers[index] for index in range(len(frames))]
            idle = []
            for ready in connection.wait(list(busy)):
                worker, index = busy.pop(ready)
                answers[index] = worker.answer("has ended, and the others with it: make others")
                idle.append(worker)


class _Worker:
    """A process, the pipe to it, and the memory in which it finds its frame."""

    def __init__(self, calibrations: Mapping[str, Calibration], estimator: str, limit_s: float) -> None:
        context = get_context("spawn")
        self.pipe, its = context.Pipe()
        self._memory: SharedMemory | None = None
        self.process = context.Process(
            target=_serve, args=(its, calibrations, estimator, limit_s), daemon=True
        )
        self.process.start()
        its.close()

    def hand_over(self, frame: RawFrame) -> None:
        """Give it a frame. What is no array of numbers goes as it is."""
        pixels, place = frame.data_dn, None
        if isinstance(pixels, np.ndarray) and pixels.dtype.kind in "iuf" and pixels.size:
            if self._memory is None or self._memory.size < pixels.nbytes:
                self._forget()
                self._memory = SharedMemory(create=True, size=pixels.nbytes)
            np.copyto(np.ndarray(pixels.shape, pixels.dtype, self._memory.buf), pixels)
            place = _Place(self._memory.name, pixels.shape, pixels.dtype.str)
            frame = replace(frame, data_dn=np.empty((0, 0), dtype=np.uint16))
        with contextlib.suppress(OSError):  # one that has ended is told where its answer is waited for
            self.pipe.send((frame, place))

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
        self._forget()

    def _forget(self) -> None:
        if self._memory is not None:
            self._memory.close()
            with contextlib.suppress(FileNotFoundError):
                self._memory.unlink()
            self._memory = None


def _end(workers: "list[_Worker]") -> None:
    while workers:
        workers.pop().end()


@dataclass(frozen=True)
class _Place:
    """Where the pixels of a frame lie."""

    memory: str
    shape: tuple[int, ...]
    dtype: str


def _serve(
    pipe: connection.Connection, calibrations: Mapping[str, Calibration], estimator: str, limit_s: float
) -> None:
    """Find flares in frames until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's Ctrl-C is for who started it
    warm_up_frames()
    with contextlib.suppress(EOFError, OSError):  # nobody is there any more
        pipe.send("ready")
        held: SharedMemory | None = None
        while (handed := pipe.recv()) is not None:
            answer: Detections | Exception
            try:
                frame, place = handed
                if place is not None:
                    if held is None or held.name != place.memory:
                        held = SharedMemory(place.memory)
                    frame = replace(frame, data_dn=np.ndarray(place.shape, place.dtype, held.buf))
                answer = detect(frame, calibrations[frame.camera], estimator, limit_s=limit_s)
            except ValueError as error:
                answer = error
            except Exception as error:  # whatever it is, it is told where it is waited for
                answer = RuntimeError(f"{type(error).__name__}: {error}")
            pipe.send(answer)
