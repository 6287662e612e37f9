"""Trajectories from files: CSV with a header, and TUM's text (time x y z qx qy qz qw)."""

import csv
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from nir_render.scene.text.units import LENGTH, TIME

CSV_HEADER = "time_s,x_m,y_m,z_m,qx,qy,qz,qw"
_MOST_BYTES = 64 * 2**20
_UNIT_LENGTH = 1e-2  # how far a quaternion may be from length 1: files are rounded


def trajectory_of(file: str) -> NDArray[np.float64]:
    """Return the rows of a trajectory: time in seconds, position in metres, unit quaternion, shape (n, 8).

    Raises
    ------
    ValueError
        The file cannot be read as one: which line, what is wrong.
    """
    state = Path(file).stat()
    return _read(file, state.st_mtime_ns, state.st_size)


def scene_times_s(times_s: NDArray[np.float64], delay_s: float, start_s: float | None) -> NDArray[np.float64]:
    """Return a trajectory's times in the scene: `delay_s` later, or the first of them at `start_s`."""
    return times_s + delay_s if start_s is None else times_s - times_s[0] + start_s


@lru_cache(maxsize=64)
def _read(file: str, _changed_ns: int, size: int) -> NDArray[np.float64]:
    path = Path(file)
    if size > _MOST_BYTES:
        raise ValueError(f"{path.name} is larger than {_MOST_BYTES >> 20} MiB; leave rows out")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path.name} cannot be read ({error}); give a CSV or TUM file") from None
    is_csv = path.suffix.lower() == ".csv"
    rows = _csv_rows(text, path.name) if is_csv else _tum_rows(text)
    return _sound([(line, _numbers(row, line, path.name)) for line, row in rows], path.name)


def _csv_rows(text: str, name: str) -> list[tuple[int, list[str]]]:
    lines = list(csv.reader(text.splitlines()))
    if not lines or ",".join(cell.strip() for cell in lines[0]) != CSV_HEADER:
        raise ValueError(f"{name}, line 1: wanted the header {CSV_HEADER}")
    return [(number, row) for number, row in enumerate(lines[1:], 2) if any(cell.strip() for cell in row)]


def _tum_rows(text: str) -> list[tuple[int, list[str]]]:
    lines = ((number, line.split("#")[0].split()) for number, line in enumerate(text.splitlines(), 1))
    return [(number, row) for number, row in lines if row]


def _numbers(row: list[str], line: int, name: str) -> list[float]:
    try:
        values = [float(cell) for cell in row]
    except ValueError:
        values = []
    if len(values) != 8 or not np.isfinite(values).all():
        raise ValueError(f"{name}, line {line}: wanted eight finite numbers, {CSV_HEADER}")
    return values


def _sound(numbered: list[tuple[int, list[float]]], name: str) -> NDArray[np.float64]:
    """Return the rows with quaternions of length 1, or say which line is none that one can be at."""
    if not numbered:
        raise ValueError(f"{name} holds no rows; wanted at least one, {CSV_HEADER}")
    rows = np.array([values for _, values in numbered])
    lengths = np.linalg.norm(rows[:, 4:], axis=1)
    wrong = {
        "its time is not after that of the row before": np.diff(rows[:, 0], prepend=-np.inf) <= 0.0,
        "its quaternion is not of length 1": np.abs(lengths - 1.0) > _UNIT_LENGTH,
        f"it lies beyond {LENGTH.most:g} m": (np.abs(rows[:, 1:4]) > LENGTH.most).any(axis=1),
        f"its time is more than {TIME.most:g} s after the first row's": rows[:, 0] - rows[0, 0] > TIME.most,
    }
    for problem, where in wrong.items():
        if where.any():
            raise ValueError(f"{name}, line {numbered[int(np.argmax(where))][0]}: {problem}; mend the row")
    rows[:, 4:] /= lengths[:, None]
    return rows
