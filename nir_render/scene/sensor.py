"""The model of an image sensor: EMVA 1288 release 4.0, linear camera model, and what lies beyond it."""

import math
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from nir_render.saturation import Compression, full_well_e
from nir_render.scene.base import Document, PresetDocument
from nir_render.scene.curves import CurveDocument
from nir_render.scene.fields import NotNegative, Positive
from nir_render.scene.units import (
    Bits,
    Counts,
    DarkCurrent,
    Electrons,
    Fraction,
    Length,
    Quantity,
    SystemGain,
    Temperature,
    Unit,
)

_LEAST_OF_FULL_SCALE = 0.9  # what the full well must reach: an ADC whose upper counts stay empty is a mistake
_CLIP_SLACK = 1.002
SENSOR_TEMPERATURE = Quantity("temperature", "K", "308 K")


SensorTemperature = Annotated[float, Unit(SENSOR_TEMPERATURE), Field(ge=150, le=420)]


class DarkPattern(Document):
    """DSNU: fixed offsets of rows, columns and pixels, standard deviations; one number is the pixels'."""

    example: ClassVar[str] = "{pixel: 3 e, row: 0.5 e, column: 1 e}"

    pixel_e: Annotated[Electrons, NotNegative] = 0.0
    row_e: Annotated[Electrons, NotNegative] = 0.0
    column_e: Annotated[Electrons, NotNegative] = 0.0

    @model_validator(mode="before")
    @classmethod
    def _one_number(cls, data: Any) -> Any:
        return {"pixel": data} if isinstance(data, int | float | str) else data

    @property
    def total_e(self) -> float:
        """The DSNU of a data sheet: the standard deviation over all pixels."""
        return math.hypot(self.pixel_e, self.row_e, self.column_e)


class ResponsePattern(Document):
    """PRNU: relative responses of rows, columns, pixels, standard deviations; one number is the pixels'."""

    example: ClassVar[str] = "{pixel: 0.8 %, row: 0.1 %, column: 0.2 %}"

    pixel: Annotated[Fraction, Field(ge=0, le=0.2)] = 0.0
    row: Annotated[Fraction, Field(ge=0, le=0.2)] = 0.0
    column: Annotated[Fraction, Field(ge=0, le=0.2)] = 0.0

    @model_validator(mode="before")
    @classmethod
    def _one_number(cls, data: Any) -> Any:
        return {"pixel": data} if isinstance(data, int | float | str) else data

    @property
    def total(self) -> float:
        """The PRNU of a data sheet: the standard deviation over all pixels."""
        return math.hypot(self.pixel, self.row, self.column)


class Nonlinearity(Document):
    """A soft non-linearity: q electrons are read as q (1 − `loss` · (q / full well)^`exponent`)."""

    example: ClassVar[str] = "{loss: 2 %, exponent: 4}"

    loss: Annotated[Fraction, Field(ge=0, le=0.2)]
    exponent: Annotated[float, Field(ge=1, le=16)] = 4.0

    @model_validator(mode="after")
    def _increases(self) -> Self:
        if self.loss * (self.exponent + 1.0) >= 1.0:
            raise ValueError(
                f"a loss of {self.loss:g} with exponent {self.exponent:g} makes brighter pixels read darker "
                f"near the full well; the loss must be below {1.0 / (self.exponent + 1.0):.3g}"
            )
        return self


class Defects(Document):
    """Bad pixels, as shares of all; which ones they are belongs to the serial number.

    `dead` pixels do not respond to light, `hot` ones have the dark current `hot_dark_current` besides,
    `stuck` ones always read full scale.
    """

    example: ClassVar[str] = "{dead: 0.001 %, hot: 0.01 %, stuck: 0.0002 %}"

    dead: Annotated[Fraction, Field(ge=0, le=0.5)] = 0.0
    hot: Annotated[Fraction, Field(ge=0, le=0.5)] = 0.0
    hot_dark_current_e_per_s: Annotated[DarkCurrent, Positive] = 5000.0
    stuck: Annotated[Fraction, Field(ge=0, le=0.5)] = 0.0


class Sensor(PresetDocument):
    """An image sensor after EMVA 1288 release 4.0.

    How much it holds is written as data sheets do: `saturation_capacity`, the mean photoelectrons at which
    the temporal variance is largest, or as `full_well`, the charge at which a pixel clips; the other follows.
    `dark_current` holds at `reference_temperature` and doubles every `dark_current_doubling`. `blooming` is
    the share of the charge beyond the full well that spills to the neighbours in the column; the rest drains.
    """

    preset_folder: ClassVar[str] = "sensors"

    columns: Annotated[int, Field(ge=1, le=65536)]
    rows: Annotated[int, Field(ge=1, le=65536)]
    pixel_pitch_m: Annotated[Length, Positive]
    quantum_efficiency: CurveDocument
    saturation_capacity_e: Annotated[Electrons, Positive] | None = None
    full_well_e: Annotated[Electrons, Positive] | None = None
    read_noise_e: Annotated[Electrons, NotNegative]
    dark_current_e_per_s: Annotated[DarkCurrent, NotNegative] = 0.0
    dark_current_doubling_k: Annotated[Temperature, Field(ge=1, le=50)] = 7.0
    reference_temperature_k: SensorTemperature = 298.15
    temperature_k: SensorTemperature = 298.15
    dsnu: DarkPattern = DarkPattern()
    prnu: ResponsePattern = ResponsePattern()
    system_gain_dn_per_e: Annotated[SystemGain, Positive]
    black_level_dn: Annotated[Counts, NotNegative]
    bit_depth_bit: Annotated[Bits, Field(ge=8, le=16)]
    nonlinearity: Nonlinearity | None = None
    blooming: Annotated[Fraction, Field(ge=0, le=1)] = 0.0
    defects: Defects = Defects()

    @field_validator("quantum_efficiency")
    @classmethod
    def _at_most_one(cls, curve: CurveDocument) -> CurveDocument:
        values = [value for _, value in curve.points or ()]
        if max([curve.constant or 0.0, *values]) > 1:
            raise ValueError("a quantum efficiency is at most 1")
        if curve.gaussian is None and max([curve.constant or 0.0, *values]) == 0:
            raise ValueError("a quantum efficiency of 0 everywhere sees nothing")
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
    def _one_capacity(self) -> Self:
        if (self.saturation_capacity_e is None) == (self.full_well_e is None):
            raise ValueError(
                "wanted one of 'saturation_capacity' (EMVA 1288, as data sheets have it) and 'full_well' "
                "(the charge at which a pixel clips)"
            )
        return self

    @model_validator(mode="after")
    def _reaches_full_scale(self) -> Self:
        if self.black_level_dn >= self.full_scale_dn:
            raise ValueError(
                f"black_level {self.black_level_dn:g} DN is not below full scale, {self.full_scale_dn} DN"
            )
        well_e = self.well_e
        noise_e = math.hypot(self.read_noise_e, self.dsnu.total_e)
        if well_e < 10.0 * noise_e:
            raise ValueError(
                f"read_noise {self.read_noise_e:g} e and dsnu {self.dsnu.total_e:g} e leave less than ten "
                f"steps of noise below the full well of {well_e:.5g} e"
            )
        gain, black_dn = self.system_gain_dn_per_e, self.black_level_dn
        reached_dn = black_dn + gain * self.read_e(well_e)
        if reached_dn < _LEAST_OF_FULL_SCALE * self.full_scale_dn:
            wanted = (self.full_scale_dn - black_dn) / self.read_e(well_e)
            raise ValueError(
                f"system_gain {gain:g} DN/e takes a full well of {well_e:.5g} e only to {reached_dn:.0f} of "
                f"{self.full_scale_dn} DN, so full scale is never reached; it takes {wanted:.3g} DN/e; "
                "check system_gain, the full well and bit_depth"
            )
        full_scale_e = self.full_scale_e
        if self.saturation_capacity_e is not None and full_scale_e * _CLIP_SLACK < self.read_e(well_e):
            raise ValueError(
                f"system_gain {gain:g} DN/e takes the ADC to full scale at {full_scale_e:.5g} e, before the "
                f"{self.read_e(well_e):.5g} e at which pixels of a saturation_capacity of "
                f"{self.saturation_capacity_e:g} e clip (as prnu and nonlinearity have it), so that capacity "
                "could not have been measured; take at most "
                f"{(self.full_scale_dn - black_dn) / self.read_e(well_e):.3g} DN/e, or write 'full_well' in "
                "its place"
            )
        return self

    @property
    def full_scale_dn(self) -> int:
        """The largest count of the ADC."""
        return int(2**self.bit_depth_bit) - 1

    @property
    def full_scale_e(self) -> float:
        """The electrons at which the ADC reaches its largest count, at gain 1."""
        return (self.full_scale_dn - self.black_level_dn) / self.system_gain_dn_per_e

    @property
    def compression(self) -> Compression | None:
        """The soft non-linearity; None for a linear sensor."""
        if self.nonlinearity is None or self.nonlinearity.loss == 0.0:
            return None
        return Compression(self.nonlinearity.loss, self.nonlinearity.exponent)

    @property
    def well_e(self) -> float:
        """The charge at which a pixel clips, in electrons."""
        if self.full_well_e is not None:
            return self.full_well_e
        assert self.saturation_capacity_e is not None  # noqa: S101 (one of both is there)
        return full_well_e(self.saturation_capacity_e, self.prnu.total, self.compression)

    def read_e(self, charge_e: float) -> float:
        """Return the electrons that are read of a charge: the soft non-linearity's own curve."""
        compression = self.compression
        return charge_e if compression is None else float(compression(np.array(charge_e), self.well_e))

    @property
    def dark_rate_e_per_s(self) -> float:
        """The dark current at the sensor's temperature, in electrons per second."""
        return self.at_temperature_e_per_s(self.dark_current_e_per_s)

    def at_temperature_e_per_s(self, current_e_per_s: float) -> float:
        """Return what a dark current at the reference temperature is at the sensor's temperature."""
        warmer_k = self.temperature_k - self.reference_temperature_k
        return float(current_e_per_s * 2.0 ** (warmer_k / self.dark_current_doubling_k))
