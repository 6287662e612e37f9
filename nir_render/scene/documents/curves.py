"""Values against wavelength or angle: [place, value] points, CSV files that become such, and curves."""

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import ValidationInfo, field_serializer, field_validator, model_validator

from nir_render.errors import shown
from nir_render.scene.documents.base import Document, Fraction, Length, NotNegative, Positive
from nir_render.scene.documents.files import resolve_file
from nir_render.scene.text.units import ANGLE, FRACTION, LENGTH, Quantity, format_quantity, parse_quantity
from nir_render.spectra.curve import Curve, constant_curve, curve_from_points
from nir_render.spectra.illuminants import SILICON_M, gaussian_spectrum

Points = tuple[tuple[float, float], ...]

_ANGLE_SLACK_RAD = 1e-9
_END_SHARE = 0.02  # of a table's largest value, at its ends


class Gaussian(Document):
    """A bell curve over wavelength."""

    centroid_m: Annotated[Length, Positive]
    fwhm_m: Annotated[Length, Positive]


class CurveDocument(Document):
    """A value against wavelength: a number (the same at every wavelength), points, or a CSV file.

    The CSV file has the header `wavelength_nm,value`; it becomes points when the scene is loaded.
    """

    read_keys: ClassVar[tuple[str, ...]] = ("file",)
    forms: ClassVar[tuple[str, ...]] = ("constant", "gaussian", "points", "file")

    constant: Annotated[Fraction, NotNegative] | None = None
    gaussian: Gaussian | None = None
    points: Points | None = None

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any, info: ValidationInfo) -> Any:
        if isinstance(data, int | float | str) and not isinstance(data, bool):
            return {"constant": data}
        if not isinstance(data, Mapping):
            raise ValueError(cls._wanted())
        forms = sorted(form for form in cls.forms if data.get(form) is not None)
        if len(forms) > 1:
            known = ", ".join(map(repr, cls.forms[:-1]))
            raise ValueError(f"wanted one of {known} and {cls.forms[-1]!r}, not {forms}")
        if "file" in data:
            path = resolve_file(str(data["file"]), info)
            points = read_curve(path, "wavelength_nm,value")
            if len(points) < 2:
                raise ValueError(f"{path}: holds {len(points)} lines of values; wanted at least two")
            others = {key: value for key, value in data.items() if key != "file"}
            return {**others, "points": [(f"{nm!r} nm", value) for nm, value in points]}
        return data

    @field_validator("points", mode="before")
    @classmethod
    def _parse_points(cls, points: Any) -> Any:
        return None if points is None else parse_points(points, LENGTH, "wavelength", "['940 nm', 0.15]")

    @field_serializer("points")
    def _write_points(self, points: Points | None) -> list[list[Any]] | None:
        return write_points(points, LENGTH)

    @model_validator(mode="after")
    def _one_form(self) -> Self:
        if all(getattr(self, form) is None for form in self.forms if form not in self.read_keys):
            raise ValueError(self._wanted())
        return self

    @classmethod
    def _wanted(cls) -> str:
        others = ", ".join(map(repr, cls.forms[4:]))
        return f"wanted a number, or 'points', 'file'{', ' + others if others else ''} or 'gaussian'"

    def curve(self, name: str) -> Curve:
        """Return the curve, which errors call by `name`; a constant holds over what silicon sees."""
        if self.gaussian is not None:
            return gaussian_spectrum(self.gaussian.centroid_m, self.gaussian.fwhm_m, name)
        if self.points is not None:
            return curve_from_points(self.points, name)
        assert self.constant is not None  # the model admits no fourth form
        return constant_curve(self.constant, *SILICON_M, name)


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
    if isinstance(points, str) or not isinstance(points, Sequence):
        raise ValueError(f"{shown(points)} is no list; wanted a list of [{place}, value], such as {example}")
    try:
        pairs = [(parse_quantity(where, quantity), _value(value)) for where, value in map(_pair, points)]
    except ValueError as error:
        raise ValueError(f"wanted a list of [{place}, value], such as {example}: {error}") from None
    if len(pairs) < 2 or any(b <= a for (a, _), (b, _) in itertools.pairwise(pairs)):
        raise ValueError(f"wanted at least two points of increasing {place}")
    not_negative([value for _, value in pairs])
    return tuple(pairs)


def _value(written: Any) -> float:
    try:
        return float(written)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{shown(written)} is no number") from None


def _pair(point: Any) -> Sequence[Any]:
    if isinstance(point, str) or not isinstance(point, Sequence) or len(point) != 2:
        raise ValueError(f"{shown(point)} is no such pair")
    return point


def not_negative(values: Sequence[float]) -> None:
    """Raise ValueError where a value of a curve is negative, not finite, or beyond 1e12."""
    if any(not 0 <= value <= FRACTION.most for value in values):
        raise ValueError(f"values must be finite and not negative, and at most {FRACTION.most:g}")


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


def check_ends(points: Points | None, what: str) -> None:
    """Raise ValueError where a table over wavelength stops before its values do, within what silicon sees."""
    if points is None:
        return
    most = max(value for _, value in points)
    if most == 0.0:
        raise ValueError(f"{what} is 0 everywhere")
    for place_m, value in (points[0], points[-1]):
        if SILICON_M[0] < place_m < SILICON_M[1] and value > _END_SHARE * most:
            raise ValueError(
                f"{what} ends at {place_m * 1e9:.4g} nm with {100.0 * value / most:.2g} % of its largest "
                "value: what is beyond is not known; give data down to where they are below 2 %, or a point "
                "of 0 where it truly ends"
            )


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
        Another header, a line of another length, a cell that is no number; the line is named.
    """
    return [row for _, row in _numbered_rows(path, header)]


def read_curve(path: Path, header: str) -> list[tuple[float, float]]:
    """Read pairs likewise, of increasing places and of values that are finite and not negative.

    Raises
    ------
    ValueError
        As `read_csv`, or pairs that are no such; the line is named.
    """
    pairs: list[tuple[float, float]] = []
    for number, (place, value) in _numbered_rows(path, header):
        try:
            not_negative([value])
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {value:g}: {error}") from None
        if pairs and not place > pairs[-1][0]:
            raise ValueError(
                f"{path}, line {number}: {place:g} does not lie beyond {pairs[-1][0]:g}, the one before it; "
                "sort the lines, and have each once"
            )
        pairs.append((place, value))
    return pairs


def _numbered_rows(path: Path, header: str) -> list[tuple[int, tuple[float, ...]]]:
    columns = header.split(",")
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ValueError(f"{path}: this is no text; wanted CSV with the header {header!r}") from None
    written = [(number, line) for number, line in enumerate(lines, 1) if line.strip() and line[0] != "#"]
    if not written or [cell.strip() for cell in written[0][1].split(",")] != columns:
        raise ValueError(f"{path}: the first line must be the header {header!r}")
    rows = []
    for number, line in written[1:]:
        try:
            row = tuple(float(cell) for cell in line.split(","))
        except ValueError:
            row = ()
        if len(row) != len(columns):
            raise ValueError(
                f"{path}, line {number}: {shown(line)}: each line must hold {len(columns)} numbers"
            )
        rows.append((number, row))
    return rows
