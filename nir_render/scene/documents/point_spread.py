"""The model of how a camera spreads the light of a point: its core, its veil, its ghosts."""

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationInfo, field_serializer, field_validator, model_validator

from nir_render.scene.documents.base import Document, Fraction, Length, Pixels
from nir_render.scene.documents.curves import not_negative, one_form
from nir_render.scene.documents.files import resolve_file
from nir_render.scene.text.units import FRACTION, format_vector, parse_vector

_LARGEST_KERNEL = 257
_LEFT_CONTRAST = 0.05
_LARGEST_WIDE_SHARE = 0.5
_RADIUS_PER_MAGNIFICATION_PX = 4.0


class MeasuredKernel(Document):
    """A measured point spread function, without the pixel's own aperture: samples on a square grid.

    `values` holds the rows from top to bottom, each as text, such as "[0, 0.1, 0]"; any scale. Neighbours
    are `pitch` apart. `file` is a CSV of such rows, without a header; it becomes `values` when the scene is
    loaded. Between the samples the function is their band-limited interpolation, and its centroid is put
    where the projection says.
    """

    read_keys: ClassVar[tuple[str, ...]] = ("file",)

    pitch_px: Annotated[Pixels, Field(ge=0.02, le=1)]
    values: tuple[tuple[float, ...], ...]

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any, info: ValidationInfo) -> Any:
        cls.check_keys(data)
        one_form(data, ("values", "file"))
        if data.get("file") is None:
            return data
        others = {key: value for key, value in data.items() if key not in ("values", "file")}
        return {**others, "values": _read_grid(resolve_file(str(data["file"]), info))}

    @field_validator("values", mode="before")
    @classmethod
    def _parse_values(cls, rows: Any) -> Any:
        if isinstance(rows, str) or not isinstance(rows, Sequence):
            raise ValueError("wanted a list of rows, each written as text, such as '[0, 0.1, 0]'")
        return tuple(parse_vector(row, FRACTION, None) for row in rows)

    @field_validator("values")
    @classmethod
    def _is_a_point_spread(cls, rows: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...], ...]:
        lengths = {len(row) for row in rows}
        if len(lengths) != 1 or not all(3 <= size <= _LARGEST_KERNEL for size in (len(rows), *lengths)):
            raise ValueError(
                f"wanted 3 to {_LARGEST_KERNEL} rows of one length, of 3 to {_LARGEST_KERNEL} values each"
            )
        not_negative([value for row in rows for value in row])
        grid = np.array(rows)
        if not grid.sum() > 0.0:
            raise ValueError("the values are 0 everywhere")
        left = _contrast_at_the_limit(grid)
        if left > _LEFT_CONTRAST:
            raise ValueError(
                f"the grid is too coarse, or cuts the light off: {left:.0%} of the contrast is left at the "
                f"finest waves that it can hold (at most {_LEFT_CONTRAST:.0%}); sample it finer, and out to "
                "where it has faded"
            )
        return rows

    @field_serializer("values")
    def _write_values(self, rows: tuple[tuple[float, ...], ...]) -> list[str]:
        return [format_vector(row, FRACTION) for row in rows]


def _contrast_at_the_limit(grid: NDArray[np.float64]) -> float:
    """Return the largest modulation at the grid's own Nyquist frequency, along either axis; 1 at rest."""
    signs = [np.where(np.arange(size) % 2, -1.0, 1.0) for size in grid.shape]
    waves = (np.fft.fft(signs[0] @ grid), np.fft.fft(grid @ signs[1]))
    return float(max(np.abs(wave).max() for wave in waves) / grid.sum())


def _read_grid(path: Path) -> list[str]:
    """Return the rows of a CSV file of numbers, as a document writes them; lines with # are comments."""
    rows = []
    for number, line in enumerate(path.read_bytes().splitlines(), start=1):
        try:
            text = line.decode("utf-8-sig").strip()
            if not text or text.startswith("#"):
                continue
            cells = next(csv.reader([text]))
            rows.append(format_vector(tuple(float(cell) for cell in cells), FRACTION))
        except ValueError as error:
            raise ValueError(
                f"{path}, line {number}: wanted rows of numbers, with no header, one comma between two "
                f"numbers and none at the end, such as 0, 0.5, 0; written in UTF-8 ({error})"
            ) from None
    return rows


class Glare(Document):
    """Veiling glare: a wide tail, w(r) ∝ (1 + (r / core_radius)²)^−exponent, that holds `share` of all light.

    It stands for what lens and housing scatter. The share is that over the whole plane of the image, most of
    which may lie beyond the frame where the exponent is near 1.
    """

    example: ClassVar[str] = "{share: 2 %, core_radius: 10 px, exponent: 2.5}"

    share: Annotated[Fraction, Field(gt=0, le=_LARGEST_WIDE_SHARE)]
    core_radius_px: Annotated[Pixels, Field(ge=3, le=10000)]
    exponent: Annotated[float, Field(ge=1.05, le=10)]


class LensGhost(Document):
    """A reflection between sensor and lens: the image about the principal point, magnified, out of focus.

    `magnification` is −1 where the ghost of a source lies opposite to it, as far from the principal point;
    each point becomes a disc of `radius` that holds `share` of its light.
    """

    example: ClassVar[str] = "{share: 0.1 %, radius: 40 px, magnification: -1}"

    share: Annotated[Fraction, Field(gt=0, le=_LARGEST_WIDE_SHARE)]
    radius_px: Annotated[Pixels, Field(ge=8, le=500)]
    magnification: Annotated[float, Field(ge=-50, le=50)] = -1.0

    @model_validator(mode="after")
    def _is_blurred(self) -> Self:
        size = abs(self.magnification)
        least_px = _RADIUS_PER_MAGNIFICATION_PX * size
        if size < 0.02 or self.radius_px < least_px:
            raise ValueError(
                f"magnification {self.magnification:g} with a radius of {self.radius_px:g} px: wanted at "
                f"least 0.02 either way, and a radius of {_RADIUS_PER_MAGNIFICATION_PX:g} px times it or more"
            )
        return self


class PointSpread(Document):
    """How the light of a point is spread in the image, before the pixel's own aperture.

    The core is the convolution of all that is given: `sigma`, a Gaussian aberration; `diffraction`, the Airy
    pattern of the lens's aperture at the wavelength given; `kernel`, a measured aberration; the disc of what
    is out of the lens's focus; `crosstalk`, the share of a pixel's charge that goes to its four neighbours,
    in all. `glare` and `ghosts` take their shares from it.
    """

    sigma_px: Annotated[Pixels, Field(ge=0.3, le=20)] | None = None
    diffraction_m: Annotated[Length, Field(ge=200e-9, le=2e-6)] | None = None
    kernel: MeasuredKernel | None = None
    crosstalk: Annotated[Fraction, Field(ge=0, lt=0.5)] = 0.0
    glare: Glare | None = None
    ghosts: tuple[LensGhost, ...] = ()

    @model_validator(mode="before")
    @classmethod
    def _no_ghosts(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        if data.get("ghosts", ()) is None:
            return {key: value for key, value in data.items() if key != "ghosts"}
        if isinstance(data.get("ghosts"), Mapping | str):
            raise ValueError(f"ghosts: wanted a list, even of one; write ghosts: [{LensGhost.example}]")
        return data

    @model_validator(mode="after")
    def _has_a_core(self) -> Self:
        if self.sigma_px is None and self.diffraction_m is None and self.kernel is None:
            raise ValueError(
                "wanted 'sigma', 'diffraction' or 'kernel', such as {sigma: 0.7 px}: no lens is sharp"
            )
        if 1.0 - self.core_share > _LARGEST_WIDE_SHARE:
            raise ValueError(
                f"glare and ghosts take {1.0 - self.core_share:.0%} of the light; wanted at most "
                f"{_LARGEST_WIDE_SHARE:.0%}"
            )
        return self

    @property
    def core_share(self) -> float:
        """The share of all light that neither glare nor ghosts take."""
        return 1.0 - (self.glare.share if self.glare else 0.0) - sum(ghost.share for ghost in self.ghosts)
