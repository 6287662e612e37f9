"""Models of sources, and of where they shine to (patterns)."""

import itertools
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

from pydantic import (
    ValidationError,
    ValidationInfo,
    field_serializer,
    field_validator,
    model_validator,
)

from nir_render.errors import shown
from nir_render.scene.documents.base import (
    Document,
    Length,
    Orientation,
    Position,
    Positive,
    Power,
)
from nir_render.scene.documents.curves import (
    Points,
    half_turn,
    not_negative,
    one_form,
    parse_half_turn,
    read_csv,
    write_points,
)
from nir_render.scene.documents.files import PresetDocument, resolve_file
from nir_render.scene.documents.spectral.led import SpectrumDocument, UnitOffset
from nir_render.scene.documents.times.drives import FULL_DRIVE, SourceDrive
from nir_render.scene.text.units import ANGLE, FRACTION, format_vector, parse_vector

_PATTERN_FORMS = ("points", "grid", "file")
_PATTERN_HEADER = "polar_deg,azimuth_deg,value"


class PatternGrid(Document):
    """Values over a grid of directions: one row of `values` for each polar angle, one value per azimuth.

    Polar angles go from 0 to 180 deg, azimuths from 0 up to less than 360 deg, and on from the last to the
    first. All are written as text: `polar: "[0, 90, 180] deg"`, `values: ["[1, 1]", "[0.5, 0.7]", "[0, 0]"]`.
    """

    polar_rad: tuple[float, ...]
    azimuth_rad: tuple[float, ...]
    values: tuple[tuple[float, ...], ...]

    @field_validator("polar_rad", "azimuth_rad", mode="before")
    @classmethod
    def _parse_angles(cls, text: Any) -> tuple[float, ...]:
        angles_rad = parse_vector(text, ANGLE, None)
        if any(b <= a for a, b in itertools.pairwise(angles_rad)):
            raise ValueError("wanted increasing angles")
        return angles_rad

    @field_validator("polar_rad")
    @classmethod
    def _all_polar_angles(cls, angles_rad: tuple[float, ...]) -> tuple[float, ...]:
        return tuple(half_turn(angles_rad, "polar angles"))

    @field_validator("azimuth_rad")
    @classmethod
    def _within_a_turn(cls, angles_rad: tuple[float, ...]) -> tuple[float, ...]:
        if angles_rad[0] < 0.0 or angles_rad[-1] >= 2.0 * math.pi - 1e-9:
            raise ValueError("wanted azimuths from 0 up to less than 360 deg: 360 is 0 again")
        return angles_rad

    @field_validator("values", mode="before")
    @classmethod
    def _parse_values(cls, rows: Any) -> Any:
        if isinstance(rows, str) or not isinstance(rows, Sequence):
            raise ValueError("wanted a list of rows, each written as text, such as '[1, 0.5, 0.2]'")
        return tuple(parse_vector(row, FRACTION, None) for row in rows)

    @model_validator(mode="after")
    def _full(self) -> Self:
        if len(self.values) != len(self.polar_rad) or {len(row) for row in self.values} != {
            len(self.azimuth_rad)
        }:
            raise ValueError(
                f"wanted {len(self.polar_rad)} rows of {len(self.azimuth_rad)} values: one row for each "
                "polar angle, one value for each azimuth"
            )
        flat = [value for row in self.values for value in row]
        not_negative(flat)
        if not any(flat):
            raise ValueError("the values are 0 everywhere")
        return self

    @field_serializer("polar_rad", "azimuth_rad")
    def _write_angles(self, angles_rad: tuple[float, ...]) -> str:
        return format_vector(angles_rad, ANGLE)

    @field_serializer("values")
    def _write_values(self, rows: tuple[tuple[float, ...], ...]) -> list[str]:
        return [format_vector(row, FRACTION) for row in rows]


class PatternDocument(Document):
    """Relative radiant intensity of a source over its own polar angle (from its z axis) and azimuth (from x).

    `points` are [polar angle, value] and the same all around the axis. `file` is a CSV with the header
    `polar_deg,azimuth_deg,value` that holds a full grid; it becomes `grid` when the scene is loaded. The
    scale does not matter: the source's flux is its own.
    """

    read_keys: ClassVar[tuple[str, ...]] = ("file",)

    points: Points | None = None
    grid: PatternGrid | None = None

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, Mapping):
            raise ValueError(
                f"{shown(data)} stands where 'points', 'grid' or 'file' is wanted, such as "
                "{points: [[0 deg, 1], [90 deg, 0.5], [180 deg, 0]]}"
            )
        cls.check_keys(data)
        one_form(data, _PATTERN_FORMS)
        if data.get("file") is None:
            return data
        others = {key: value for key, value in data.items() if key not in _PATTERN_FORMS}
        return {**others, "grid": _read_grid(resolve_file(str(data["file"]), info))}

    @field_validator("points", mode="before")
    @classmethod
    def _parse_points(cls, points: Any) -> Any:
        return None if points is None else parse_half_turn(points, "polar angles")

    @field_serializer("points")
    def _write_points(self, points: Points | None) -> list[list[Any]] | None:
        return write_points(points, ANGLE)


class Source(PresetDocument):
    """A 940 nm light source: a sphere, evenly bright over its disc.

    `flux` is the radiant flux over the whole spectrum and all directions (of an LED at its reference
    temperature and current), `spectrum` its shape (any scale),
    `position` the sphere's centre on the robot. Without `pattern` it shines the same in all directions;
    `orientation` turns the pattern's axes on the robot. `drive` is what it sends over time; a calibration
    speaks of a source that is fully lit. `unit` is by what this one differs from its type.
    """

    preset_folder: ClassVar[str] = "sources"

    flux_w: Annotated[Power, Positive]
    radius_m: Annotated[Length, Positive]
    spectrum: SpectrumDocument
    position_m: Position = (0.0, 0.0, 0.0)
    orientation: Orientation = Orientation()
    pattern: PatternDocument | None = None
    drive: SourceDrive = FULL_DRIVE
    unit: UnitOffset = UnitOffset()

    @property
    def of_its_type(self) -> "Source":
        """The source as its type is: what a calibration speaks of."""
        return self.model_copy(update={"unit": UnitOffset()})

    @property
    def sent_flux_w(self) -> float:
        """The radiant flux that it sends fully lit, at its LED's temperature and current."""
        return self.flux_w * self.spectrum.relative_power * self.unit.flux


def _read_grid(path: Path) -> dict[str, Any]:
    """Return the grid of a CSV file as a document; its lines may come in any order."""
    value_at = {}
    for polar_deg, azimuth_deg, value in read_csv(path, _PATTERN_HEADER):
        if (polar_deg, azimuth_deg) in value_at:
            raise ValueError(
                f"{path}: polar {polar_deg:g}, azimuth {azimuth_deg:g} deg stands twice; take one of them out"
            )
        value_at[polar_deg, azimuth_deg] = value
    polars_deg = sorted({polar for polar, _ in value_at})
    azimuths_deg = sorted({azimuth for _, azimuth in value_at})
    if not value_at:
        raise ValueError(f"{path}: holds no values; write a line for each direction")
    for polar, azimuth in itertools.product(polars_deg, azimuths_deg):
        if (polar, azimuth) not in value_at:
            raise ValueError(
                f"{path}: no value at polar {polar:g}, azimuth {azimuth:g} deg; wanted a full grid"
            )
    grid = {
        "polar": f"[{', '.join(map(repr, polars_deg))}] deg",
        "azimuth": f"[{', '.join(map(repr, azimuths_deg))}] deg",
        "values": [
            format_vector(tuple(value_at[polar, azimuth] for azimuth in azimuths_deg), FRACTION)
            for polar in polars_deg
        ],
    }
    try:
        PatternGrid.model_validate(grid)
    except ValidationError as error:
        told = error.errors()[0].get("ctx", {}).get("error", "holds no such grid; check it")
        raise ValueError(f"{path}: {told}") from None
    return grid
