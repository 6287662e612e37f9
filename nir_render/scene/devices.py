"""Models of what a robot carries: sources and cameras with lens, filter and sensor."""

import math
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, ValidationInfo, field_serializer, field_validator, model_validator

from nir_render.scene.base import Document, PresetDocument, resolve_file
from nir_render.scene.pattern import PatternDocument
from nir_render.scene.points import Points, parse_points, read_csv, write_points
from nir_render.scene.units import (
    LENGTH,
    Angle,
    Bits,
    Counts,
    Electrons,
    Fraction,
    Length,
    Pixels,
    Position,
    Power,
    SystemGain,
    Time,
)

_CURVE_FORMS = ("constant", "gaussian", "points", "file")
Positive = Field(gt=0)
NotNegative = Field(ge=0)
# Names become parts of dotted paths and of file names.
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_-]*$")]


class Orientation(Document):
    """A rotation by yaw about z (to the left), then pitch about the new y (nose down), then roll about x."""

    example: ClassVar[str] = "{yaw: 90 deg}"

    yaw_rad: Angle = 0.0
    pitch_rad: Angle = 0.0
    roll_rad: Angle = 0.0


class Gaussian(Document):
    """A bell curve over wavelength."""

    centroid_m: Annotated[Length, Positive]
    fwhm_m: Annotated[Length, Positive]


class CurveDocument(Document):
    """A value against wavelength: a number (the same at every wavelength), points, or a CSV file.

    The CSV file has the header `wavelength_nm,value`; it becomes points when the scene is loaded.
    """

    read_keys: ClassVar[tuple[str, ...]] = ("file",)

    constant: Annotated[Fraction, NotNegative] | None = None
    gaussian: Gaussian | None = None
    points: Points | None = None

    @model_validator(mode="before")
    @classmethod
    def _read(cls, data: Any, info: ValidationInfo) -> Any:
        if isinstance(data, int | float | str) and not isinstance(data, bool):
            return {"constant": data}
        if not isinstance(data, Mapping):
            raise ValueError("wanted a number, or 'points', 'file' or 'gaussian'")
        forms = sorted(form for form in _CURVE_FORMS if data.get(form) is not None)
        if len(forms) > 1:
            raise ValueError(f"wanted one of 'constant', 'gaussian', 'points' and 'file', not {forms}")
        if "file" in data:
            points = read_csv(resolve_file(str(data["file"]), info), "wavelength_nm,value")
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
        if self.constant is None and self.gaussian is None and self.points is None:
            raise ValueError("wanted a number, or 'points', 'file' or 'gaussian'")
        return self


class Source(PresetDocument):
    """A 940 nm light source: a sphere, evenly bright over its disc.

    `flux` is the radiant flux over the whole spectrum and all directions, `spectrum` its shape (any scale),
    `position` the sphere's centre on the robot. Without `pattern` it shines the same in all directions;
    `orientation` turns the pattern's axes on the robot.
    """

    preset_folder: ClassVar[str] = "sources"

    flux_w: Annotated[Power, Positive]
    radius_m: Annotated[Length, Positive]
    spectrum: CurveDocument
    position_m: Position = (0.0, 0.0, 0.0)
    orientation: Orientation = Orientation()
    pattern: PatternDocument | None = None

    @field_validator("spectrum")
    @classmethod
    def _spectrum_has_an_end(cls, spectrum: CurveDocument) -> CurveDocument:
        if spectrum.constant is not None:
            raise ValueError("a spectrum needs a shape; write 'gaussian', 'points' or 'file'")
        return spectrum


class Lens(PresetDocument):
    """A rectilinear lens, focused, without vignetting other than the tilt of its aperture."""

    preset_folder: ClassVar[str] = "lenses"

    model: Literal["rectilinear"] = "rectilinear"
    focal_length_m: Annotated[Length, Positive]
    f_number: Annotated[float, Positive]
    transmission: Annotated[Fraction, Field(gt=0, le=1)]


class Bandpass(PresetDocument):
    """An interference filter, in front of the lens or behind it.

    `centre` and `fwhm` hold at normal incidence, `effective_index` sets the blue shift with the angle
    (PHYSICS: λ_c(θ) = λ_0 √(1 − (sin θ / n_eff)²)), `cavities` how steep its flanks are (1: Lorentzian),
    `blocking_od` the optical density out of band. Behind the lens the angle is that of the chief ray, linear
    in image height up to `chief_ray_angle_at_corner`, averaged over the lens's cone; in front of it, the
    field angle.
    """

    preset_folder: ClassVar[str] = "filters"

    placement: Literal["behind_lens", "in_front_of_lens"]
    centre_m: Annotated[Length, Positive]
    fwhm_m: Annotated[Length, Positive]
    peak_transmission: Annotated[Fraction, Field(gt=0, le=1)]
    effective_index: Annotated[float, Field(ge=1)]
    cavities: Annotated[int, Field(ge=1, le=10)] = 3
    blocking_od: Annotated[float, Positive]
    chief_ray_angle_at_corner_rad: Annotated[Angle, Field(ge=0, lt=math.pi / 2)] = 0.0


class Sensor(PresetDocument):
    """An image sensor: the linear model of EMVA 1288 release 4.0, as far as it is built."""

    preset_folder: ClassVar[str] = "sensors"

    columns: Annotated[int, Field(ge=1, le=65536)]
    rows: Annotated[int, Field(ge=1, le=65536)]
    pixel_pitch_m: Annotated[Length, Positive]
    quantum_efficiency: CurveDocument
    full_well_e: Annotated[Electrons, Positive]
    read_noise_e: Annotated[Electrons, NotNegative]
    system_gain_dn_per_e: Annotated[SystemGain, Positive]
    black_level_dn: Annotated[Counts, NotNegative]
    bit_depth_bit: Annotated[Bits, Field(ge=8, le=16)]

    @field_validator("quantum_efficiency")
    @classmethod
    def _at_most_one(cls, curve: CurveDocument) -> CurveDocument:
        values = [value for _, value in curve.points or ()]
        if max([curve.constant or 0.0, *values]) > 1:
            raise ValueError("a quantum efficiency is at most 1")
        if curve.gaussian is not None:
            raise ValueError("wanted a number, 'points' or 'file'")
        return curve

    @field_validator("bit_depth_bit")
    @classmethod
    def _whole_bits(cls, bits: float) -> float:
        if bits != int(bits):
            raise ValueError(f"{bits} is not a whole number of bits")
        return bits

    @model_validator(mode="after")
    def _reaches_full_scale(self) -> Self:
        if self.black_level_dn >= self.full_scale_dn:
            raise ValueError(
                f"black_level {self.black_level_dn:g} DN is not below full scale, {self.full_scale_dn} DN"
            )
        if self.full_well_e < 10.0 * self.read_noise_e:
            raise ValueError(
                f"read_noise {self.read_noise_e:g} e leaves less than ten steps of noise below the "
                f"full well of {self.full_well_e:g} e"
            )
        reached_dn = self.black_level_dn + self.system_gain_dn_per_e * self.full_well_e
        if reached_dn < 0.5 * self.full_scale_dn:
            raise ValueError(
                f"system_gain {self.system_gain_dn_per_e:g} DN/e takes a full well of "
                f"{self.full_well_e:g} e only to {reached_dn:.0f} of {self.full_scale_dn} DN; "
                "check system_gain, full_well and bit_depth"
            )
        return self

    @property
    def full_scale_dn(self) -> int:
        """The largest count of the ADC."""
        return int(2**self.bit_depth_bit) - 1


class PointSpread(Document):
    """A Gaussian point spread function in the image, without the pixel's own aperture."""

    sigma_px: Annotated[Pixels, Field(ge=0.3, le=20)]


class AutoExposure(Document):
    """Exposure that brings the brightest pixel of the last frame to `target` of the range up to clipping."""

    target: Annotated[Fraction, Field(gt=0, lt=1)] = 0.7
    shortest_s: Annotated[Time, Positive]
    longest_s: Annotated[Time, Positive]

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.shortest_s > self.longest_s:
            raise ValueError(f"shortest, {self.shortest_s:g} s, is longer than longest, {self.longest_s:g} s")
        return self


class Camera(PresetDocument):
    """A camera on a robot. Without orientation it looks along the robot's x axis, upright.

    With `auto_exposure`, `exposure` is only where it starts from before the first frame is taken.
    """

    preset_folder: ClassVar[str] = "cameras"

    lens: Lens
    filter: Bandpass | None = None
    sensor: Sensor
    point_spread: PointSpread
    exposure_s: Annotated[Time, Positive]
    auto_exposure: AutoExposure | None = None
    position_m: Position = (0.0, 0.0, 0.0)
    orientation: Orientation = Orientation()


class Rig(PresetDocument):
    """What a robot carries: sources and cameras, by name."""

    preset_folder: ClassVar[str] = "rigs"

    sources: dict[Name, Source] = {}
    cameras: dict[Name, Camera] = {}
