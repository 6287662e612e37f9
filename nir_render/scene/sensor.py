"""The model of an image sensor."""

from typing import Annotated, ClassVar, Self

from pydantic import Field, field_validator, model_validator

from nir_render.scene.base import PresetDocument
from nir_render.scene.curves import CurveDocument
from nir_render.scene.fields import NotNegative, Positive
from nir_render.scene.units import Bits, Counts, Electrons, Length, SystemGain


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
