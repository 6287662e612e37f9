"""The run folder: everything that a run leaves on disk, written so that nothing is ever half there.

A new folder is written aside, beside its place, and renamed into it when it is whole; there a render that was
killed goes on. A file that is added later is written aside, synced and renamed.
"""

import contextlib
import errno
import hashlib
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from nir_render.errors import DiskFullError, InputError
from perception.files.fields import Place, RecordingError, first_of, parse_json
from perception.files.readers import number as number_of

MANIFEST = "manifest.json"
CALIBRATION = "calibration.json"
SCENE = "scene.yaml"
FRAMES = "frames.jsonl"
TRUTH = "truth.jsonl"
LAMPS = "lamps.jsonl"
SENT = "sent.jsonl"
FILM = "preview.gif"
LOOK = "look.png"
POSES = "poses.jsonl"
SETS = "sets.json"
_DIGEST = ".digest"
_NO_ROOM = {errno.ENOSPC, getattr(errno, "EDQUOT", errno.ENOSPC)}  # a quota is a POSIX matter

Item = TypeVar("Item")


@contextlib.contextmanager
def new_run_folder(folder: Path, overwrite: bool, sign: str = MANIFEST, of: str = "run") -> Iterator[Path]:
    """Give an empty folder to write a run into; it takes its place when the block ends without an error.

    `sign` is the file that tells a run, or what else is written so, `of`, from what is another's.

    Raises
    ------
    InputError
        The place holds another run and `overwrite` is not given, or holds something that is no run, or
        cannot be written.
    """
    check_free(folder, overwrite, sign, of)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        aside = Path(tempfile.mkdtemp(prefix=f".{folder.name}.partial-", dir=folder.parent))
    except OSError as error:
        raise disk_error(folder, error) from None
    try:
        yield aside
        _sync_folder(aside)
        aside.chmod(0o777 & ~_umask())
        _replace(folder, aside)
    except OSError as error:
        raise disk_error(folder, error) from None
    finally:
        shutil.rmtree(aside, ignore_errors=True)


@contextlib.contextmanager
def resumed_run_folder(folder: Path, overwrite: bool, digest: str) -> Iterator[tuple[Path, str]]:
    """Give a folder to write a run into, as `new_run_folder`; a killed run's is given again, to go on with.

    That is where `digest`, the hash of all that decides the run's files, is the same; what else lies there is
    removed. It is kept where the process is killed or interrupted, not after an error. The second value says
    what was found: "goes on", "anew" where it was of another digest, "" where nothing was there.

    Raises
    ------
    InputError
        As `new_run_folder`, or another process is writing this run.
    """
    check_free(folder, overwrite)
    aside = folder.parent / f".{folder.name}.unfinished"
    lock = aside.with_name(f"{aside.name}.lock")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(folder, error) from None
    taken = f"{folder}: another process is rendering this run; wait for it, or give another folder"
    try:
        with locked(lock, taken):
            found = _prepared(aside, digest)
            try:
                yield aside, found
                (aside / _DIGEST).unlink()
                _sync_folder(aside)
                _replace(folder, aside)
            except Exception:
                shutil.rmtree(aside, ignore_errors=True)
                lock.unlink(missing_ok=True)
                raise
    except OSError as error:
        raise disk_error(folder, error) from None
    lock.unlink(missing_ok=True)


def _prepared(aside: Path, digest: str) -> str:
    """Make a folder ready for a run of a digest; what was found there: see `resumed_run_folder`."""
    there = aside.is_dir()
    known = aside / _DIGEST
    if there and known.is_file() and known.read_text(encoding="utf-8") == digest:
        for half_written in aside.rglob(".*.partial-*"):
            half_written.unlink()
        return "goes on"
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir()
    write_file(known, digest.encode())
    return "anew" if there else ""


def check_free(folder: Path, overwrite: bool, sign: str = MANIFEST, of: str = "run") -> None:
    """Raise InputError where a run may not be written: see `new_run_folder`."""
    if not folder.exists():
        return
    if not folder.is_dir():
        raise InputError(f"{folder}: is a file; give a folder for the {of}")
    if not any(folder.iterdir()):
        return
    if not (folder / sign).is_file():
        raise InputError(
            f"{folder}: holds files that are no {of}; give a new folder (they are never overwritten)"
        )
    if not overwrite:
        raise InputError(f"{folder}: holds another {of}; give a new folder, or --overwrite to replace it")


@contextlib.contextmanager
def locked(file: Path, taken: str) -> Iterator[None]:
    """Hold a lock on a file for the block; the system gives it back whatever becomes of the process.

    Raises
    ------
    InputError
        Another process holds it, with the text `taken`; the file cannot be written.
    """
    try:
        held = file.open("a")
    except OSError as error:
        raise disk_error(file, error) from None
    with held:
        try:
            _lock(held.fileno())
        except OSError:
            raise InputError(taken) from None
        yield


def detection_files(folder: Path) -> dict[str, Path]:
    """Return the files of detections in a folder, by the name of their estimator."""
    paths = sorted(folder.glob("detections.*.jsonl"))
    return {path.name.removeprefix("detections.").removesuffix(".jsonl"): path for path in paths}


def files_beside(page: Path) -> list[str]:
    """Return the names of the files that lie beside a page, to be linked to."""
    return sorted(
        path.name
        for path in page.parent.iterdir()
        if path.is_file() and not path.name.startswith(".") and path.name != page.name
    )


def write_file(path: Path, data: bytes) -> None:
    """Write a file aside, sync it and rename it into its place.

    Raises
    ------
    InputError
        The disk is full, the folder cannot be written, ….
    """
    with write_stream(path) as file:
        file.write(data)


@contextlib.contextmanager
def write_stream(path: Path) -> Iterator[BinaryIO]:
    """Give a file to write aside; it is synced and renamed into its place when the block ends without error.

    Raises
    ------
    InputError
        As `write_file`.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, aside = tempfile.mkstemp(prefix=f".{path.name}.partial-", dir=path.parent)
        try:
            with os.fdopen(handle, "wb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            Path(aside).chmod(0o666 & ~_umask())
            Path(aside).replace(path)
        finally:
            Path(aside).unlink(missing_ok=True)
    except OSError as error:
        raise disk_error(path, error) from None


def write_json(path: Path, document: Mapping[str, Any]) -> None:
    """Write a JSON document; not-a-number is no JSON and must be None."""
    write_file(path, (json.dumps(document, indent=2, allow_nan=False) + "\n").encode())


def write_lines(path: Path, records: Iterable[Mapping[str, Any]]) -> None:
    """Write one JSON object per line."""
    with write_stream(path) as file:
        for record in records:
            file.write((json.dumps(record, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any:
    """Read a JSON document; raise InputError where it is missing or broken."""
    return _parse(_read(path), str(path))


def read_lines(path: Path) -> list[Any]:
    """Read one JSON object per line; raise InputError where the file is missing or a line broken."""
    return parse_lines(path, lambda record: record)


def parse_lines(path: Path, parse: Callable[[Any], Item]) -> list[Item]:
    """Parse a file of JSON lines; raise InputError with all that is wrong, by file and line."""
    items: list[Item] = []
    problems: list[str] = []
    for number, line in enumerate(_read(path).split("\n"), 1):
        if not line.strip():
            continue
        try:
            items.append(parse(parse_json(line, Place(""))))
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            told = getattr(error, "problems", (str(error),))
            problems += [f"{path}, line {number}: {problem}" for problem in told]
    if problems:
        raise InputError("\n".join(first_of(problems)))
    return items


def lines_of(
    folder: Path, kind: str, names: Iterable[str], parse: Callable[[Any], Item]
) -> dict[str, list[Item]]:
    """Return the lines of `KIND.NAME.jsonl`, by estimator, of those that have such a file.

    Raises
    ------
    InputError
        As `parse_lines`.
    """
    paths = {name: folder / f"{kind}.{name}.jsonl" for name in names}
    return {name: parse_lines(path, parse) for name, path in paths.items() if path.is_file()}


def write_period(folder: Path, period_s: float | None) -> None:
    """Note of which period sets of frames were, where it was given; what an earlier call noted goes."""
    if period_s is None:
        (folder / SETS).unlink(missing_ok=True)
    else:
        write_json(folder / SETS, {"format": 1, "period_s": period_s})


def read_period_s(folder: Path) -> float | None:
    """Return that period, None where none was given; raise InputError where the file is broken."""
    path = folder / SETS
    if not path.is_file():
        return None
    try:
        period_s = number_of(read_json(path), "period_s", Place(str(path)))
    except RecordingError as error:
        raise InputError(str(error)) from None
    if not period_s > 0.0:
        raise InputError(f"{path}: period_s is {period_s:g}; write a time above 0, or remove the file")
    return period_s


def write_manifest(folder: Path, facts: Mapping[str, Any]) -> None:
    """Write `manifest.json` with the given facts and the SHA-256 of every file of the folder."""
    write_json(folder / MANIFEST, {"format": 1, **facts, "sha256": _hashes(folder)})


def refresh_manifest(folder: Path, facts: Mapping[str, Any]) -> None:
    """Add facts to the manifest, where the folder has one, and the hashes of files that came or changed."""
    if (folder / MANIFEST).is_file():
        old = {
            key: value
            for key, value in read_json(folder / MANIFEST).items()
            if key not in ("format", "sha256")
        }
        write_manifest(folder, {**old, **facts})


def note_seconds(folder: Path, stage: str, started: float) -> None:
    """Add to the manifest, where there is one, how long a stage took, and the hashes of what it wrote."""
    if not (folder / MANIFEST).is_file():
        return
    seconds = read_json(folder / MANIFEST).get("seconds", {})
    refresh_manifest(folder, {"seconds": {**seconds, stage: round(time.perf_counter() - started, 3)}})


def disk_error(path: Path, error: OSError) -> InputError:
    """Return the error to show where the disk refuses; a DiskFullError where it has no room."""
    kind = DiskFullError if error.errno in _NO_ROOM else InputError
    return kind(f"{path}: cannot be written ({error.strerror or error}); nothing half-written was left there")


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from None


def _parse(text: str, name: str) -> Any:
    try:
        return parse_json(text, Place(name))
    except RecordingError as error:
        raise InputError(str(error)) from None


def _hashes(folder: Path) -> dict[str, str]:
    files = sorted(
        path for path in folder.rglob("*") if path.is_file() and path.name not in (MANIFEST, _DIGEST)
    )
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files
    }


def _replace(folder: Path, aside: Path) -> None:
    """Put `aside` in the place of `folder`; what was there goes only after the new stands."""
    if not folder.exists():
        aside.rename(folder)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{folder.name}.partial-", dir=folder.parent))
    folder.rename(old / folder.name)
    try:
        aside.rename(folder)
    except OSError:
        (old / folder.name).rename(folder)  # if this fails too, the old run stays where it was put
        old.rmdir()
        raise
    shutil.rmtree(old, ignore_errors=True)


def _sync_folder(folder: Path) -> None:
    """Make sure that the files' names are on the disk too, where the system lets folders be synced."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _lock(descriptor: int) -> None:
    if sys.platform == "win32":
        import msvcrt

        msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
