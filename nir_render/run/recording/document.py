"""The document `recording.yaml`: what a person says of frames that a real camera took.

A value may stand with its standard deviation, "4 mm ± 2 %". What may be left out has a default and its σ; the
template states them beside each key.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

from pydantic import Field, GetCoreSchemaHandler, GetJsonSchemaHandler, model_validator
from pydantic_core import CoreSchema, core_schema

from nir_render.errors import shown
from nir_render.scene.documents.base import (
    Bits,
    Counts,
    Document,
    Fraction,
    Frequency,
    Length,
    NotNegative,
    Orientation,
    Pixels,
    Pixels2,
    Position,
    Positive,
    Time,
)
from nir_render.scene.text.units import (
    COUNTS,
    ELECTRONS,
    FRACTION,
    LENGTH,
    PIXELS,
    POWER,
    SYSTEM_GAIN,
    Quantity,
    parse_quantity,
    read_quantity,
    wanted,
)

INTENSITY = Quantity("radiant intensity", "W/sr", "16 mW/sr", 1e6)
_PLUS_MINUS = re.compile(r"±|\+/-|\+-")


@dataclass(frozen=True)
class Measured:
    """A value and its standard deviation, both in the unit of the quantity."""

    value: float
    sigma: float
    quantity: Quantity

    @property
    def relative(self) -> float:
        """The standard deviation over the value."""
        return self.sigma / abs(self.value) if self.value else 0.0


def parse_measured(text: object, quantities: tuple[Quantity, ...], unsaid: float) -> Measured:
    """Read "4 mm ± 2 %" or "0.7 ± 0.2 px".

    Parameters
    ----------
    text
        A value with its unit; behind ± its σ, with a unit or in per cent of the value.
    quantities
        What it may be.
    unsaid
        The σ over the value where none is written.

    Raises
    ------
    ValueError
        It is none of the quantities, or its σ is none of the same, or below 0.
    """
    parts = _PLUS_MINUS.split(text) if isinstance(text, str) else [text]
    if len(parts) > 2:
        raise ValueError(f"{shown(text)} has two ±; write such as '{quantities[0].example} ± 5 %'")
    value_text, sigma_text = parts[0], str(parts[1]).strip() if len(parts) == 2 else None
    reading = read_quantity(value_text)
    if sigma_text and reading is not None and not reading.unit and not sigma_text.endswith("%"):
        unit = getattr(read_quantity(sigma_text), "unit", "")
        value_text = f"{value_text} {unit}".strip()  # "0.7 ± 0.2 px": one unit for both
    value, quantity = _first_that_fits(value_text, quantities)
    if sigma_text is None:
        return Measured(value, unsaid * abs(value), quantity)
    if sigma_text.endswith("%"):
        sigma = parse_quantity(sigma_text, FRACTION) * abs(value)
    else:
        sigma = parse_quantity(sigma_text, quantity)
    if sigma < 0.0:
        raise ValueError(f"{shown(text)} has a σ below 0; write it as a positive number")
    return Measured(value, sigma, quantity)


def _first_that_fits(text: object, quantities: tuple[Quantity, ...]) -> tuple[float, Quantity]:
    for quantity in quantities:
        try:
            return parse_quantity(text, quantity), quantity
        except ValueError as error:
            refused = error
            if len(quantities) == 1:
                raise
    names = " or ".join(wanted(quantity) for quantity in quantities)
    raise ValueError(f"{shown(text)} is not {names}") from refused


class WithSigma:
    """Annotation of a model's field: text with a unit and a σ in the document, `Measured` in the model."""

    def __init__(self, *quantities: Quantity, unsaid: float, least: float = 0.0, above: bool = True) -> None:
        self.quantities = quantities
        self.unsaid = unsaid
        self.least = least
        self.above = above

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Parse what stands in the document."""
        return core_schema.no_info_plain_validator_function(self._parse)

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the text."""
        kind = ["number", "string"] if FRACTION in self.quantities else "string"
        described = " or ".join(wanted(quantity) for quantity in self.quantities)
        said = f"{described}; its σ behind ±, else {100.0 * self.unsaid:g} %"
        return {"type": kind, "description": said, "examples": [f"{self.quantities[0].example} ± 5 %"]}

    def _parse(self, text: object) -> Measured:
        if isinstance(text, Measured):
            return text
        measured = parse_measured(text, self.quantities, self.unsaid)
        if measured.value < self.least or (self.above and measured.value == self.least):
            bound = f"{'above' if self.above else 'at least'} {self.least:g}"
            raise ValueError(f"{shown(text)} is too small; write a value {bound}")
        return measured


class SourceGiven(Document):
    """What the flares come from; all sources are alike."""

    radius_m: Annotated[Measured, WithSigma(LENGTH, unsaid=0.05)]
    wavelength_m: Annotated[Length, Field(ge=1e-7, le=1e-4)] = 940e-9
    intensity: Annotated[Measured, WithSigma(INTENSITY, unsaid=0.2)] | None = None
    power_w: Annotated[Measured, WithSigma(POWER, unsaid=0.2)] | None = None

    @model_validator(mode="after")
    def _one_of_both(self) -> Self:
        if self.intensity is not None and self.power_w is not None:
            raise ValueError("intensity and power are both given; take one of them out")
        return self


class CameraGiven(Document):
    """A camera, and the frames it took; counts and electrons are those of the frames as recorded.

    `times` is a file with the time of each frame in seconds, one a line, in place of a frame rate.
    """

    frames: Annotated[str, Field(min_length=1, max_length=1000)]
    exposure_s: Annotated[Time, Field(gt=0, le=1e4)]
    frame_rate_hz: Annotated[Frequency, Field(gt=1e-6, le=1e9)] | None
    times: Annotated[str, Field(min_length=1, max_length=1000)] | None = None
    focal_length: Annotated[Measured, WithSigma(LENGTH, PIXELS, unsaid=0.02)]
    pixel_pitch_m: Annotated[Length, Field(gt=1e-9, le=1e-2)] | None = None
    bit_depth_bit: Annotated[Bits, Field(ge=1, le=16)]
    line_time_s: Annotated[Time, Field(ge=0, le=10)] = 0.0
    binning: Annotated[int, Field(ge=1, le=64)] = 1
    roi_left_px: Annotated[Pixels, NotNegative] = 0.0
    roi_top_px: Annotated[Pixels, NotNegative] = 0.0
    sensor_size_px: Pixels2 | None = None
    principal_point_px: Pixels2 | None = None
    lens_model: Literal["rectilinear", "brown_conrady", "fisheye"] = "rectilinear"
    distortion: Annotated[list[float], Field(max_length=8)] = []
    position_m: Position = (0.0, 0.0, 0.0)
    orientation: Orientation = Orientation()
    black_level_dn: Annotated[Measured, WithSigma(COUNTS, unsaid=0.1, above=False)] | None = None
    saturation_dn: Annotated[Counts, Positive] | None = None
    saturation_capacity_e: Annotated[Measured, WithSigma(ELECTRONS, unsaid=0.1)] = Measured(
        10_000.0, 5_000.0, ELECTRONS
    )
    gain_dn_per_e: Annotated[Measured, WithSigma(SYSTEM_GAIN, unsaid=0.1)] | None = None
    read_noise_e: Annotated[Measured, WithSigma(ELECTRONS, unsaid=0.2, above=False)] | None = None
    fixed_pattern: Annotated[Fraction, Field(ge=0, le=1)] = 0.01
    psf_px: Annotated[Measured, WithSigma(PIXELS, unsaid=0.1)] = Measured(0.7, 0.2, PIXELS)
    response_at_corner: Annotated[Measured, WithSigma(FRACTION, unsaid=0.1)] = Measured(1.0, 0.1, FRACTION)
    f_number: Annotated[Measured, WithSigma(FRACTION, unsaid=0.05)] | None = None
    transmission: Annotated[Measured, WithSigma(FRACTION, unsaid=0.1)] = Measured(0.8, 0.1, FRACTION)
    quantum_efficiency: Annotated[Measured, WithSigma(FRACTION, unsaid=0.2)] = Measured(0.12, 0.06, FRACTION)

    @model_validator(mode="before")
    @classmethod
    def _times_need_no_frame_rate(cls, data: Any) -> Any:
        return {"frame_rate": None, **data} if isinstance(data, Mapping) and "times" in data else data

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        problems = []
        if (self.frame_rate_hz is None) == (self.times is None):
            problems.append("frame_rate and times: each says when frames were taken; write one of them")
        if self.bit_depth_bit != int(self.bit_depth_bit):
            problems.append(f"bit_depth is {self.bit_depth_bit:g} bit; write a whole number of bits")
        if self.focal_length.quantity is LENGTH and self.pixel_pitch_m is None:
            problems.append("pixel_pitch is missing; write it, such as '3.45 um', or focal_length in px")
        if (self.roi_left_px or self.roi_top_px) and not (self.sensor_size_px or self.principal_point_px):
            problems.append("sensor_size is missing; a cropped frame needs it, such as '[1280, 960] px'")
        if problems:
            raise ValueError("; ".join(problems))
        return self


class KnownRange(Document):
    """A frame of a source at a range that was measured; where it stands in the frame, if others are in it."""

    camera: str
    frame: int | str
    range_m: Annotated[Measured, WithSigma(LENGTH, unsaid=0.01)]
    place_px: Pixels2 | None = None


CameraName = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_-]{0,99}\.[A-Za-z_][A-Za-z0-9_-]{0,99}$")]


class RecordingDocument(Document):
    """What is known of a recording of real cameras."""

    format: Literal[1]
    source: SourceGiven
    cameras: Annotated[dict[CameraName, CameraGiven], Field(min_length=1)]
    known_ranges: list[KnownRange] = []


def recording_schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of `recording.yaml`."""
    schema = RecordingDocument.model_json_schema(by_alias=True)
    schema["$schema"] = "https://json-schema.org/draft/2020-12/schema"
    schema["title"] = "nir_render recording"
    schema["$defs"]["CameraGiven"]["required"].remove("frame_rate")  # a file of times stands in its place
    return schema
