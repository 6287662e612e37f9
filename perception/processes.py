"""The frames of a set side by side in processes of their own.

Threads of one interpreter hand it to and fro between the many short steps of a fit, and gain little by that;
processes do not. Frames reach them by memory that they share, detections come back by pipes.
"""

import contextlib
import math
import os
import signal
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

    Parameters
    ----------
    calibrations
        Of each camera, by its name.
    estimator
        "robust" or "paper".
    limit_s
        As for `detect`, of each frame.
    count
        How many; by default as many as there are cores, and cameras.

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
        self._memory: dict[int, SharedMemory] = {}
        self._estimator, self._limit_s = estimator, limit_s
        self._workers: list[tuple[Any, connection.Connection]] = []
        context = get_context("spawn")
        for _ in range(count):
            mine, its = context.Pipe()
            process = context.Process(
                target=_serve, args=(its, self._calibrations, estimator, limit_s), daemon=True
            )
            process.start()
            its.close()
            self._workers.append((process, mine))
        for process, mine in self._workers:
            self._receive(process, mine)

    def detect_frames(self, frames: Sequence[RawFrame]) -> list[Detections]:
        """Find the flares of several frames, as `perception.detect_frames` does: to the bit the same.

        Raises
        ------
        ValueError
            As for `detect`, or if a frame's camera has no calibration.
        RuntimeError
            A process has ended, or all were ended before.
        """
        require_calibrations(frames, self._calibrations)
        if not self._workers:
            raise RuntimeError("the detector's processes were ended: make others")
        results: dict[int, Detections | Exception] = {}
        waiting = list(range(len(frames)))[::-1]
        busy: dict[connection.Connection, tuple[Any, int]] = {}
        for process, mine in self._workers:
            self._hand_over(frames, waiting, results, busy, process, mine)
        while busy:
            for ready in connection.wait(list(busy)):
                assert isinstance(ready, connection.Connection)
                process, index = busy.pop(ready)
                results[index] = self._receive(process, ready)
                self._hand_over(frames, waiting, results, busy, process, ready)
        found = []
        for index in range(len(frames)):
            result = results[index]
            if isinstance(result, Exception):
                raise result
            found.append(result)
        return found

    def close(self) -> None:
        """End the processes, and give their memory back."""
        for _, mine in self._workers:
            with contextlib.suppress(OSError):
                mine.send(None)
        for process, mine in self._workers:
            process.join(_ENDS_WITHIN_S)
            if process.is_alive():
                process.kill()
                process.join()
            mine.close()
        self._workers = []
        for memory in self._memory.values():
            memory.close()
            memory.unlink()
        self._memory = {}

    def __enter__(self) -> "DetectorProcesses":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _hand_over(
        self,
        frames: Sequence[RawFrame],
        waiting: list[int],
        results: dict[int, Detections | Exception],
        busy: dict[connection.Connection, tuple[Any, int]],
        process: Any,
        mine: connection.Connection,
    ) -> None:
        """Give a process the next frame that waits, if one does. What is no picture is told at once."""
        while waiting:
            index = waiting.pop()
            frame = frames[index]
            pixels = frame.data_dn
            if not isinstance(pixels, np.ndarray) or pixels.dtype.kind not in "iuf" or pixels.size == 0:
                try:
                    results[index] = detect(
                        frame, self._calibrations[frame.camera], self._estimator, limit_s=self._limit_s
                    )
                except ValueError as error:
                    results[index] = error
                continue
            memory = self._memory_of(index, pixels.nbytes)
            np.copyto(np.ndarray(pixels.shape, pixels.dtype, memory.buf), pixels)
            empty = replace(frame, data_dn=np.empty((0, 0), dtype=np.uint16))
            try:
                mine.send(_Handed(index, memory.name, pixels.shape, pixels.dtype.str, empty))
            except OSError:
                self._fail(process)
            busy[mine] = (process, index)
            return

    def _memory_of(self, index: int, least_bytes: int) -> SharedMemory:
        held = self._memory.get(index)
        if held is None or held.size < least_bytes:
            if held is not None:
                held.close()
                held.unlink()
            self._memory[index] = held = SharedMemory(create=True, size=least_bytes)
        return held

    def _receive(self, process: Any, mine: connection.Connection) -> Any:
        try:
            return mine.recv()
        except (EOFError, OSError):
            self._fail(process)

    def _fail(self, process: Any) -> None:
        process.join(_ENDS_WITHIN_S)
        status = process.exitcode
        self.close()
        raise RuntimeError(
            f"a process of the detector has ended (status {status}), the others with it: make others, in a "
            'script below `if __name__ == "__main__":`'
        )


@dataclass(frozen=True, eq=False)
class _Handed:
    """A frame on its way: which of the set, where its pixels lie, and the rest of it."""

    index: int
    memory: str
    shape: tuple[int, ...]
    dtype: str
    frame: RawFrame


def _serve(
    mine: connection.Connection, calibrations: Mapping[str, Calibration], estimator: str, limit_s: float
) -> None:
    """Find flares in frames until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's Ctrl-C is for who started it
    warm_up_frames()
    mine.send("ready")
    held: dict[int, SharedMemory] = {}
    with contextlib.suppress(EOFError, OSError):
        while isinstance(handed := mine.recv(), _Handed):
            memory = held.get(handed.index)
            if memory is None or memory.name != handed.memory:
                if memory is not None:
                    memory.close()
                held[handed.index] = memory = SharedMemory(handed.memory)
            pixels: Any = np.ndarray(handed.shape, handed.dtype, memory.buf)
            frame = replace(handed.frame, data_dn=pixels)
            answer: Detections | Exception
            try:
                answer = detect(frame, calibrations[frame.camera], estimator, limit_s=limit_s)
            except ValueError as error:
                answer = error
            del frame, pixels  # a memory that something looks at cannot be given back
            mine.send(answer)
    for memory in held.values():
        with contextlib.suppress(BufferError):
            memory.close()
