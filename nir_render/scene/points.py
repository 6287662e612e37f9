"""Curves in a scene file: [place, value] points, and CSV files that become such points."""

import csv
import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nir_render.scene.units import ANGLE, Quantity, format_quantity, parse_quantity

Points = tuple[tuple[float, float], ...]

_ANGLE_SLACK_RAD = 1e-9


def one_form(data: Mapping[str, Any], forms: Sequence[str]) -> None:
    """Raise ValueError where not exactly one of the keys `forms` has a value."""
    given = [form for form in forms if data.get(form) is not None]
    if len(given) != 1:
        known = ", ".join(repr(form) for form in forms[:-1]) + f" and {forms[-1]!r}"
        raise ValueError(f"wanted one of {known}, not {sorted(given) if given else 'none'}")


def parse_points(points: Any, quantity: Quantity, place: str, example: str) -> Points:
    """Read [["940 nm", 0.15], …] as (place, value) pairs in SI units.

    Raises
    ------
    ValueError
        Fewer than two points, places that do not increase, a value that is negative or not finite.
    """
    try:
        pairs = [(parse_quantity(where, quantity), float(value)) for where, value in map(_pair, points)]
    except (TypeError, ValueError) as error:
        raise ValueError(f"wanted a list of [{place}, value], such as {example}: {error}") from None
    if len(pairs) < 2 or any(b <= a for (a, _), (b, _) in itertools.pairwise(pairs)):
        raise ValueError(f"wanted at least two points of increasing {place}")
    not_negative([value for _, value in pairs])
    return tuple(pairs)


def _pair(point: Any) -> Sequence[Any]:
    if isinstance(point, str) or not isinstance(point, Sequence) or len(point) != 2:
        raise ValueError(f"{point!r} is no such pair")
    return point


def not_negative(values: Sequence[float]) -> None:
    """Raise ValueError where a value of a curve is negative or not finite."""
    if any(not math.isfinite(value) or value < 0 for value in values):
        raise ValueError("values must be finite and not negative")


def write_points(points: Points | None, quantity: Quantity) -> list[list[Any]] | None:
    """Write what `parse_points` reads, to the bit: a resolved document loads again."""
    if points is None:
        return None
    return [[format_quantity(where, quantity), value] for where, value in points]


def parse_half_turn(points: Any, place: str) -> Points:
    """Read points over an angle from exactly 0 to exactly 180 deg; errors as `parse_points`."""
    pairs = parse_points(points, ANGLE, place, "['0 deg', 1.0]")
    ends = half_turn([angle for angle, _ in pairs], place)
    if not any(value for _, value in pairs):
        raise ValueError("the values are 0 everywhere")
    return tuple((angle, value) for angle, (_, value) in zip(ends, pairs, strict=True))


def half_turn(angles_rad: Sequence[float], place: str) -> list[float]:
    """Return increasing angles with their ends, rounded by their unit, at exactly 0 and π."""
    first, last = angles_rad[0], angles_rad[-1]
    if abs(first) > _ANGLE_SLACK_RAD or abs(last - math.pi) > _ANGLE_SLACK_RAD:
        given = f"from {math.degrees(first):g} to {math.degrees(last):g} deg"
        raise ValueError(f"wanted {place} from 0 to 180 deg, not {given}")
    return [0.0, *angles_rad[1:-1], math.pi]


def read_csv(path: Path, header: str) -> list[tuple[float, ...]]:
    """Read numbers from CSV under a header such as `wavelength_nm,value`; lines with # are comments.

    Raises
    ------
    ValueError
        Another header, a line of another length, a cell that is no number.
    """
    columns = header.split(",")
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(line for line in file if line.strip() and not line.startswith("#")))
    if not rows or [cell.strip() for cell in rows[0]] != columns:
        raise ValueError(f"{path}: the first line must be the header {header!r}")
    try:
        numbers = [tuple(float(cell) for cell in row) for row in rows[1:]]
    except ValueError as error:
        raise ValueError(f"{path}: each line must hold {len(columns)} numbers ({error})") from None
    if any(len(row) != len(columns) for row in numbers):
        raise ValueError(f"{path}: each line must hold {len(columns)} numbers")
    return numbers
