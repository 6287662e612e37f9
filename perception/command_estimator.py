"""Estimators that are a command: a program of one's own, in any language, that reads and writes JSON lines.

The program gets the calibrations on the first line, then a line per frame, and answers each frame with a line
of detections. What it says on standard error is kept, to be shown where it fails.
"""

import json
import math
import os
import queue
import re
import shlex
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, BinaryIO, NoReturn

from perception.estimators import ESTIMATORS, EstimatorError
from perception.files.calibration import calibration_document
from perception.files.detections import parse_detection
from perception.files.recording import frame_record
from perception.model.bearing import bearing_body
from perception.types import Calibration, Detection, RawFrame

LIMIT_S = 60.0
"""How long a program may take over one frame, its start included."""

_ENDS_WITHIN_S = 5.0
_LAST_LINES, _LAST_BYTES = 8, 4096
_MOST_BYTES = 2**26  # of one answer
_REFERENCE = re.compile(r"(?:(?P<name>[^=:/\\]*)=)?cmd:(?P<command>.*)", re.DOTALL)
_INTERPRETERS = re.compile(r"(python|pypy|bash|sh|node|ruby|perl|julia|java|uv|env)[\d.]*")
_FARTHEST_PX = 1e6
_UNIT_SLACK = 1e-3  # of the length of a bearing


def is_command(reference: str) -> bool:
    """Tell whether an estimator's reference is a command: `cmd: …` or `NAME=cmd: …`."""
    return _REFERENCE.fullmatch(reference) is not None


@dataclass(frozen=True)
class CommandEstimator:
    """An estimator that is a program: `name` is the detections', `command` its words, `limit_s` per frame."""

    name: str
    reference: str
    command: tuple[str, ...]
    limit_s: float = LIMIT_S

    @contextmanager
    def started(self, calibrations: Mapping[str, Calibration]) -> Iterator["CommandProcess"]:
        """Start the program for a block, and end it with the block.

        Parameters
        ----------
        calibrations
            Of all cameras whose frames will come, by name.

        Raises
        ------
        EstimatorError
            If it cannot be started.
        """
        with tempfile.TemporaryDirectory(prefix="nir_frames_") as folder:
            process = CommandProcess(self, calibrations, Path(folder))
            try:
                yield process
            finally:
                process.kill()


def load_command(reference: str, limit_s: float = LIMIT_S) -> CommandEstimator:
    """Read `cmd: ./my_detector --fast`, or `NAME=cmd: …`, and see that there is such a program.

    Words are split as a shell does it, but no shell runs. Without a name, the program's own is taken; of an
    interpreter such as `python3`, that of its file.

    Raises
    ------
    EstimatorError
        If the command is empty or there is no such program, the name cannot name a file of detections or is
        that of a built-in estimator, or the limit is not positive.
    """
    match = _REFERENCE.fullmatch(reference)
    if match is None:
        raise EstimatorError(f"{reference}: wanted cmd: PROGRAM, such as cmd: ./my_detector --fast")
    if not limit_s > 0.0:
        raise EstimatorError(f"{reference}: a limit of {limit_s:g} s per frame; wanted a time above 0")
    try:
        words = shlex.split(match["command"], posix=os.name == "posix")
    except ValueError as error:
        raise EstimatorError(f"{reference}: {error}; close the quotes") from None
    if not words:
        raise EstimatorError(f"{reference}: no program behind 'cmd:'; write cmd: ./my_detector --fast")
    _check_program(reference, words[0])
    name = match["name"]
    if name is None:
        name = re.sub(r"[^A-Za-z0-9_-]", "_", _program_name(words))
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        raise EstimatorError(f"{reference}: the name {name!r} may hold letters a to z, digits, - and _")
    if name.lower() in ESTIMATORS:
        raise EstimatorError(
            f"{reference}: {name.lower()!r} is an estimator that is built in; write another NAME=cmd: …"
        )
    return CommandEstimator(name, reference, tuple(words), limit_s)


class CommandProcess:
    """A program that runs, and is asked frame by frame; `CommandEstimator.started` makes one."""

    def __init__(
        self, estimator: CommandEstimator, calibrations: Mapping[str, Calibration], folder: Path
    ) -> None:
        self.estimator = estimator
        self._calibrations = calibrations
        self._folder = folder
        self._asked = 0
        known = calibration_document(calibrations.values())
        try:
            # A session of its own: whatever it starts can be ended with it, and Ctrl-C reaches us first.
            self._process = subprocess.Popen(  # noqa: S603 (what the user asked for, without a shell)
                estimator.command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                start_new_session=os.name == "posix",
            )
        except OSError as error:
            raise EstimatorError(
                f"{estimator.reference}: cannot be started ({error.strerror or error}); a script needs a "
                "first line such as #!/usr/bin/env python3, or its interpreter before it"
            ) from None
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        self._questions: queue.Queue[bytes | None] = queue.Queue()
        self._answers: queue.Queue[bytes | None] = queue.Queue(maxsize=64)
        self._complaints = bytearray()
        work = (
            (_write, self._process.stdin, self._questions),
            (_read_lines, self._process.stdout, self._answers),
            (_read_last, self._process.stderr, self._complaints),
        )
        self._threads = [threading.Thread(target=one, args=rest, daemon=True) for one, *rest in work]
        for thread in self._threads:
            thread.start()
        self._send(known)

    def detect(self, frame: RawFrame, file: Path) -> list[Detection]:
        """Ask for the flares of one frame.

        Parameters
        ----------
        frame
            The frame; its counts are put beside as a PGM, which is trivial to read.
        file
            Its PNG.

        Raises
        ------
        EstimatorError
            If the program hangs, dies, or answers anything but detections of this frame. It is ended then.
        """
        where = f"frame {frame.index} of {frame.camera}"
        with suppress(queue.Empty):
            early = self._answers.get_nowait()
            if early is None:
                self._fail_ended(where)
            self._fail(where, f"answered before it was asked: {_shown(early)}")
        counts = self._folder / f"{self._asked}.pgm"
        counts.write_bytes(pgm16(frame))
        rows, columns = frame.data_dn.shape
        record = frame_record(frame, str(file.resolve()))
        self._asked += 1
        self._send({**record, "pgm": str(counts), "width_px": columns, "height_px": rows})
        try:
            line = self._answers.get(timeout=self.estimator.limit_s)
        except queue.Empty:
            self._fail(
                where,
                f"no answer within {self.estimator.limit_s:g} s; end each answer with a newline, flush it, "
                "or give more time by --time-limit",
            )
        finally:
            counts.unlink(missing_ok=True)
        if line is None:
            self._fail_ended(where)
        try:
            return parse_answer(line, frame, self._calibrations[frame.camera])
        except EstimatorError as error:
            self._fail(where, str(error))

    def finish(self) -> None:
        """Tell the program that no frame follows, and give it a while to end by itself.

        Raises
        ------
        EstimatorError
            If it has answered more often than it was asked: then no answer can be trusted to be its frame's.
        """
        self._questions.put(None)
        with suppress(queue.Empty):
            more = self._answers.get(timeout=_ENDS_WITHIN_S)
            if more is not None:
                self._fail("after the last frame", f"answered once more: {_shown(more)}")
        # How it ends is its own affair: all answers are here.
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_ENDS_WITHIN_S)

    def kill(self) -> None:
        """End the program, and what it has started, if it still runs."""
        if self._process.poll() is None:
            if os.name == "posix":
                with suppress(ProcessLookupError):
                    os.killpg(self._process.pid, signal.SIGKILL)
            else:
                self._process.kill()
            self._process.wait()
        self._questions.put(None)
        for thread in self._threads:
            deadline_s = time.monotonic() + 1.0
            while thread.is_alive() and time.monotonic() < deadline_s:
                with suppress(queue.Empty):  # one may wait for room
                    self._answers.get_nowait()
                thread.join(0.01)

    def _send(self, record: Mapping[str, Any]) -> None:
        self._questions.put(json.dumps(record, allow_nan=False).encode() + b"\n")

    def _fail_ended(self, where: str) -> NoReturn:
        """Fail because its output has ended: say how it did."""
        try:
            status = self._process.wait(_ENDS_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._fail(where, "closed its standard output")
        self._fail(where, _how_it_ended(status))

    def _fail(self, where: str, what: str) -> NoReturn:
        """End the program, and raise what is to be said of it, with the last lines of its standard error."""
        self.kill()
        lines = bytes(self._complaints).decode(errors="replace").splitlines()[-_LAST_LINES:]
        said = "".join(f"\n    {line}" for line in lines if line.strip())
        said = f"; its standard error ended with{said}" if said else "; it said nothing on standard error"
        raise EstimatorError(f"{self.estimator.reference}: {where}: {what}{said}")


def pgm16(frame: RawFrame) -> bytes:
    """Encode a frame's counts as a PGM (P5, maxval 65535): a header, then big-endian uint16 by rows."""
    rows, columns = frame.data_dn.shape
    return f"P5\n{columns} {rows}\n65535\n".encode() + frame.data_dn.astype(">u2").tobytes()


def parse_answer(line: bytes | str, frame: RawFrame, calibration: Calibration) -> list[Detection]:
    """Read the line that a program answers a frame with: `{"detections": [{"u_px": …, "v_px": …}, …]}`.

    What a detection leaves out is not claimed: NaN, 0 or false; its bearing is that of its pixel.

    Raises
    ------
    EstimatorError
        If it is no such line, or speaks of another frame.
    """
    try:
        answer = json.loads(line)
    except (ValueError, RecursionError):
        raise EstimatorError(
            f"answered {_shown(line)}, which is no JSON; print nothing but a line per frame on standard "
            "output, the rest on standard error"
        ) from None
    found = answer.get("detections") if isinstance(answer, dict) else None
    if not isinstance(found, list):
        raise EstimatorError(f'answered {_shown(line)}; wanted {{"detections": [{{"u_px": …, "v_px": …}}]}}')
    _check_frame(answer, frame, "answered")
    return [
        _detection(record, frame, calibration, f"detection {number}") for number, record in enumerate(found)
    ]


def _detection(record: Any, frame: RawFrame, calibration: Calibration, where: str) -> Detection:
    if not isinstance(record, dict):
        raise EstimatorError(f"{where} is {_shown(json.dumps(record))}; wanted an object with u_px and v_px")
    unknown = [name for name in record if name not in _EMPTY]
    if unknown:
        known = ", ".join(name for name in _EMPTY if name != "format")
        raise EstimatorError(f"{where}: there is no field {unknown[0]!r}; known: {known}")
    _check_frame(record, frame, f"{where} is")
    given = {name: _null_for_nan(value) for name, value in record.items()}
    own = {"format": 1, "camera": frame.camera, "index": frame.index, "time_s": frame.time_s}
    for name in ("u_px", "v_px"):
        place = given.get(name)
        if not isinstance(place, int | float) or isinstance(place, bool) or not abs(place) < _FARTHEST_PX:
            raise EstimatorError(f"{where}: {name} is {_cut(repr(place))}; wanted a number of pixels")
    try:
        if given.get("bearing_body") is None:
            place_px = [[float(given["u_px"]), float(given["v_px"])]]
            bearing = [_null_for_nan(float(part)) for part in bearing_body(place_px, calibration)[0]]
            given["bearing_body"] = bearing
        detection = parse_detection({**_EMPTY, **own, **given}, where)
    except (ValueError, OverflowError) as error:
        raise EstimatorError(str(error)) from None
    if abs(math.hypot(*detection.bearing_body) - 1.0) > _UNIT_SLACK:
        raise EstimatorError(
            f"{where}: bearing_body is {list(detection.bearing_body)}; wanted a vector of length 1"
        )
    if detection.range_m <= 0.0:
        raise EstimatorError(f"{where}: range_m is {detection.range_m:g}; wanted metres above 0, or null")
    return detection


_NOTHING: dict[Any, Any] = {float: None, int: 0, bool: False}
_EMPTY: dict[str, Any] = {"format": 1} | {
    field.name: _NOTHING.get(field.type, None if field.default is MISSING else field.default)
    for field in fields(Detection)
}
"""A detection that claims nothing."""


def _check_frame(record: Mapping[str, Any], frame: RawFrame, what: str) -> None:
    camera, index = record.get("camera", frame.camera), record.get("index", frame.index)
    if (camera, index) != (frame.camera, frame.index):
        raise EstimatorError(
            f"{what} of frame {index} of {camera}, asked for this one; answer each frame with one line"
        )


def _null_for_nan(value: Any) -> Any:
    return None if isinstance(value, float) and math.isnan(value) else value


def _shown(line: bytes | str) -> str:
    text = (line.decode(errors="replace") if isinstance(line, bytes) else line).strip()
    return repr(_cut(text))


def _cut(text: str) -> str:
    return text if len(text) <= 80 else text[:79] + "…"


def _how_it_ended(status: int) -> str:
    if status >= 0:
        return f"ended with exit status {status}"
    try:
        return f"was ended by {signal.Signals(-status).name}"
    except ValueError:
        return f"was ended by signal {-status}"


def _check_program(reference: str, program: str) -> None:
    if shutil.which(program) is not None:
        return
    if Path(program).is_dir():
        raise EstimatorError(f"{reference}: {program!r} is a folder; name the program in it")
    if Path(program).is_file():
        said = f"write ./{program}" if Path(program).name == program else f"chmod +x {shlex.quote(program)}"
        raise EstimatorError(f"{reference}: {program!r} is here, but not to be run so; {said}")
    raise EstimatorError(f"{reference}: there is no program {program!r}; build it, or name it by its path")


def _program_name(words: list[str]) -> str:
    name = Path(words[0]).stem
    if _INTERPRETERS.fullmatch(Path(words[0]).name):
        files = [word for word in words[1:] if not word.startswith("-") and Path(word).is_file()]
        name = Path(files[0]).stem if files else name
    return name


def _write(stream: BinaryIO, lines: "queue.Queue[bytes | None]") -> None:
    # Closing flushes, and a program that has ended reads no more: what became of it its output tells.
    with suppress(OSError), stream:
        while (line := lines.get()) is not None:
            stream.write(line)
            stream.flush()


def _read_lines(stream: BinaryIO, lines: "queue.Queue[bytes | None]") -> None:
    with stream:
        while line := stream.readline(_MOST_BYTES):
            lines.put(line)
    lines.put(None)


def _read_last(stream: BinaryIO, last: bytearray) -> None:
    with stream:
        while part := os.read(stream.fileno(), _LAST_BYTES):
            last += part
            del last[:-_LAST_BYTES]
