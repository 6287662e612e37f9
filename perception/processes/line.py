"""Frames in line for processes: which frame goes to which process, and when."""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from multiprocessing import connection

from perception.processes.memory import Handed, Memory
from perception.processes.worker import Answer, Worker
from perception.types import RawFrame


class Reading:
    """A set of frames under way, and what was found in each that is done."""

    def __init__(self, frames: Iterable[RawFrame]) -> None:
        self.frames = tuple(frames)
        self.answers: dict[int, Answer] = {}


@dataclass(frozen=True)
class Task:
    """A frame of a set, as it is handed to a process."""

    reading: Reading
    index: int
    handed: Handed


class Line:
    """Frames on their way through the processes.

    `detected_here` looks at frames that cannot be put into memory: they are soon refused.
    """

    def __init__(
        self, workers: list[Worker], memory: Memory, detected_here: Callable[[RawFrame], Answer]
    ) -> None:
        self._memory, self._detected_here = memory, detected_here
        self._at_work: list[tuple[Worker, deque[Task]]] = [(worker, deque()) for worker in workers]
        self._waiting: deque[tuple[Reading, int]] = deque()
        self._placed: deque[Task] = deque()
        self._most_each = 1
        self._flares: dict[str, int] = {}

    def append(self, reading: Reading, most_each: int) -> None:
        """Let a set wait behind others; from now on no process has more than so many frames at once.

        One where the caller waits and gives it the next, so that no frame waits for a process that is slow;
        two where it goes away, so that a process that is done goes on. Frames of cameras in which most flares
        were found last come first: what takes long should not be what all others wait for.
        """
        cameras = [frame.camera for frame in reading.frames]
        first = sorted(range(len(cameras)), key=lambda index: -self._flares.get(cameras[index], 0))
        self._waiting.extend((reading, index) for index in first)
        self._most_each = most_each

    def place_all(self) -> None:
        """Put all that wait into memory, and into the hands of processes as many as these may have."""
        self._hand_over()
        while self._place_next():
            self._hand_over()

    def finish(self, reading: Reading) -> None:
        """Give processes the next frame when they answer, until all of a set is done."""
        while len(reading.answers) < len(reading.frames):
            self._hand_over()
            if len(reading.answers) == len(reading.frames):
                break
            # One at a time, as long as nobody waits.
            goes_on = len(self._placed) < len(self._at_work) and self._place_next()
            busy = [worker.pipe for worker, tasks in self._at_work if tasks]
            answered = connection.wait(busy, timeout=0.0 if goes_on else None)
            for worker, tasks in self._at_work:
                if worker.pipe in answered:
                    answer = worker.answer("has ended, and the others with it: make others")
                    self._done(tasks.popleft(), answer)

    def _done(self, task: Task, answer: Answer) -> None:
        task.reading.answers[task.index] = answer
        if not isinstance(answer, Exception):
            self._flares[task.handed[0].camera] = len(answer)
        self._memory.reuse(task.handed)

    def _hand_over(self) -> None:
        """Give frames to whichever process has the fewest."""
        while self._placed or self._place_next():
            worker, tasks = min(self._at_work, key=lambda each: len(each[1]))
            if len(tasks) >= self._most_each:
                return
            tasks.append(self._placed.popleft())
            worker.send(tasks[-1].handed)

    def _place_next(self) -> bool:
        """Put the next frame where processes find it; tell whether there was one."""
        while self._waiting:
            reading, index = self._waiting.popleft()
            try:
                handed = self._memory.place(reading.frames[index])
            except OSError as error:  # no room: told where the frame's answer is waited for
                reading.answers[index] = error
                continue
            if handed is not None:
                self._placed.append(Task(reading, index, handed))
                return True
            reading.answers[index] = self._detected_here(reading.frames[index])
        return False

    def clear(self) -> None:
        """Forget all that is under way."""
        self._waiting.clear()
        self._placed.clear()
        for _, tasks in self._at_work:
            tasks.clear()
