"""A process that finds the flares of one frame after another."""

import contextlib
import gc
import signal
import time
from collections.abc import Callable, Mapping
from multiprocessing import connection, get_context
from multiprocessing.shared_memory import SharedMemory
from typing import Any

from perception.estimators import detect
from perception.processes.memory import Handed, taken
from perception.types import Calibration, Detections, RawFrame
from perception.warm_up import warm_up_frames

_STATUS_WITHIN_S = 2.0

Answer = Detections | Exception
"""The flares of a frame, or what is wrong with it."""


class Worker:
    """A process, and the pipe to it: it is sent what detects, and then frames."""

    def __init__(self) -> None:
        context = get_context("spawn")
        self.pipe, its = context.Pipe()
        self.process = context.Process(target=_serve, args=(its,), daemon=True)
        self.process.start()
        its.close()

    def send(self, message: Callable[[RawFrame], Answer] | Handed) -> None:
        """Give it a frame, which waits for those before it; or, first of all, what detects."""
        with contextlib.suppress(OSError):  # one that has ended is told where its answer is waited for
            self.pipe.send(message)

    def answer(self, otherwise: str) -> Any:
        """Wait for its answer; raise RuntimeError where it ends without one."""
        try:
            return self.pipe.recv()
        except (EOFError, OSError):
            self.process.join(_STATUS_WITHIN_S)
            status = self.process.exitcode
            raise RuntimeError(f"a process of the detector (status {status}) {otherwise}") from None

    def end(self, until_s: float) -> None:
        """Wait until that time of the monotonic clock for its end, after its pipe was closed; then end it."""
        self.process.join(max(until_s - time.monotonic(), 0.0))
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def detected_in(
    frame: RawFrame, calibrations: Mapping[str, Calibration], estimator: str, limit_s: float
) -> Answer:
    """Return a frame's flares, or what was wrong, to be raised where it is waited for."""
    try:
        return detect(frame, calibrations[frame.camera], estimator, limit_s=limit_s)
    except ValueError as error:
        return error.with_traceback(None)  # which refers to the frame
    except Exception as error:
        return RuntimeError(f"{type(error).__name__}: {error}")


def _serve(pipe: connection.Connection) -> None:
    """Find flares in frames until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's Ctrl-C is for who started it
    held: dict[str, SharedMemory] = {}
    with contextlib.suppress(EOFError, OSError):  # nobody is there any more
        detected: Callable[[RawFrame], Answer] = pipe.recv()
        warm_up_frames()
        gc.collect()
        gc.freeze()  # what is there by now stays, and need not be looked through again and again
        pipe.send("ready")
        while True:
            handed: Handed = pipe.recv()
            pipe.send(_answer(handed, held, detected))


def _answer(handed: Handed, held: dict[str, SharedMemory], detected: Callable[[RawFrame], Answer]) -> Answer:
    try:
        frame = taken(handed, held)
    except Exception as error:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return detected(frame)
