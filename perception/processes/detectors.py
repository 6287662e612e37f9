"""A detector of several processes, as a script or a pipeline holds it."""

import contextlib
import math
import os
import threading
import time
import weakref
from collections import deque
from collections.abc import Generator, Iterable, Mapping, Sequence
from functools import partial
from types import TracebackType

from perception.estimators import ESTIMATORS, cores, require_calibrations
from perception.processes.line import Line, Reading
from perception.processes.memory import Memory
from perception.processes.worker import Worker, detected_in
from perception.types import Calibration, Detections, RawFrame

_ENDS_WITHIN_S = 2.0


class DetectorProcesses:
    """Processes that find the flares of frames; they start when it is made, and wait for frames.

        with perception.DetectorProcesses(calibrations) as detectors:
            pipeline = perception.Pipeline(calibrations, detector=detectors.detect_frames)

    They load the package anew: where a script makes it, that must stand below ``if __name__ == "__main__":``.
    It is made once they are ready: a second or two, minutes where the package's loops were never compiled.
    Ctrl-C while they are at work ends them: make others.
    Shared memory (`/dev/shm`) must have room for two frames for each process, and for two whole sets where
    sets are read ahead.

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
            count = max(1, min(cores(), len(calibrations)))
        if count < 1:
            raise ValueError(f"{count} processes detect nothing: give 1 or more")
        self._calibrations = dict(calibrations)
        self._one_at_a_time = threading.RLock()
        self._workers: list[Worker] = []
        self._memory = Memory()
        self._last: Reading | None = None  # of several sets, the one that was begun last
        detected = partial(detected_in, calibrations=self._calibrations, estimator=estimator, limit_s=limit_s)
        self._end = partial(_end, self._workers, self._memory, os.getpid())
        weakref.finalize(self, self._end)  # where nobody closes it
        try:
            self._workers += [Worker() for _ in range(count)]
            for worker in self._workers:
                worker.send(detected)
            for worker in self._workers:
                worker.answer(
                    'does not start; in a script it must be made below `if __name__ == "__main__":`'
                )
        except BaseException:
            self._end()
            raise
        self._line = Line(self._workers, self._memory, detected)

    def detect_frames(self, frames: Sequence[RawFrame]) -> list[Detections]:
        """Find the flares of several frames, as `perception.detect_frames` does: to the bit the same.

        Raises
        ------
        ValueError
            As for `detect`, or if a frame's camera has no calibration.
        RuntimeError
            A process has ended, which ends the others too, or they were ended before; or they are at work
            with the next of several sets.
        """
        with self._one_at_a_time:
            reading = self._admitted(frames, after=None)
            with self._closed_by_faults():
                self._line.append(reading, most_each=1)
            return self._ended(reading)

    def detect_sets(
        self, sets: Iterable[Sequence[RawFrame]]
    ) -> Generator[tuple[Sequence[RawFrame], list[Detections]], None, None]:
        """Yield sets of frames and the flares of each, as `detect_frames` finds them.

        The processes are at work with the next set while the caller is with this one, which is told once the
        next is at hand: for what was recorded, and for cameras that are faster than both together. What is
        wrong with one, or ends the sets, ends the iteration once all sets before it are told.

        Flares are found in copies. The frames told are those that were given, by then not the latest: where
        their pixels are looked at, as `Pipeline.follow` does, no camera may have written there again.

            for frames, found in detectors.detect_sets(sets):
                heard = pipeline.follow(frames, found)

        Raises
        ------
        ValueError, RuntimeError
            As `detect_frames`; also if other frames are asked for before the last set was told.
        """
        under_way: deque[Reading] = deque()
        remaining, wrong, goes_on = iter(sets), None, True
        try:
            while goes_on:
                try:
                    self._begin_ahead(next(remaining), under_way)
                except StopIteration:
                    goes_on = False
                except Exception as error:  # told once the set before is, if that can be told
                    if not self._workers:
                        raise
                    goes_on, wrong = False, error
                if len(under_way) > 1 or (under_way and not goes_on):
                    with self._one_at_a_time:
                        found = self._ended(under_way[0])
                    yield under_way.popleft().frames, found
            if wrong is not None:
                raise wrong
        finally:  # nobody asks for the rest
            for reading in under_way:
                with self._one_at_a_time, contextlib.suppress(Exception):
                    self._ended(reading)

    def close(self) -> None:
        """End the processes, and give their memory back."""
        with self._one_at_a_time:
            self._last = None
            self._line.clear()
            self._end()

    def __enter__(self) -> "DetectorProcesses":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _admitted(self, frames: Sequence[RawFrame], after: Reading | None) -> Reading:
        """Return a set that may be begun; of one iteration two are under way, else one at a time."""
        reading = Reading(frames)
        require_calibrations(reading.frames, self._calibrations)
        if not self._workers:
            raise RuntimeError("the detector's processes were ended: make others")
        if self._last is not after:
            raise RuntimeError("the detector's processes are at work with the next of several sets")
        return reading

    def _begin_ahead(self, frames: Sequence[RawFrame], under_way: deque[Reading]) -> None:
        """Put a set into memory, and the processes to work with it once they are done with the one before."""
        with self._one_at_a_time:
            reading = self._admitted(frames, after=under_way[-1] if under_way else None)
            with self._closed_by_faults():
                under_way.append(reading)
                self._last = reading
                self._line.append(reading, most_each=2)
                self._line.place_all()

    def _ended(self, reading: Reading) -> list[Detections]:
        """Return what they find in it; raise what one of them raised."""
        if not self._workers:
            raise RuntimeError("the detector's processes were ended: make others")
        with self._closed_by_faults():  # an answer that nobody waits for would be taken for the next frame's
            self._line.finish(reading)
            if self._last is reading:
                self._last = None
        found = []
        for index in range(len(reading.frames)):
            answer = reading.answers[index]
            if isinstance(answer, Exception):
                raise answer
            found.append(answer)
        return found

    @contextlib.contextmanager
    def _closed_by_faults(self) -> Generator[None, None, None]:
        try:
            yield
        except BaseException:
            self.close()
            raise


def _end(workers: list[Worker], memory: Memory, process_id: int) -> None:
    """End processes, and give memory back, unless another process has made them."""
    if os.getpid() != process_id:
        return
    for worker in workers:
        worker.pipe.close()  # it goes, once it is done with what it is at
    until_s = time.monotonic() + _ENDS_WITHIN_S
    while workers:
        workers.pop().end(until_s)
    memory.close()
