"""The model of an LED as its data sheet has it, and of a source's spectrum, which may be one."""

from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field, field_serializer, field_validator, model_validator

from nir_render.errors import shown
from nir_render.scene.documents.base import (
    Current,
    Document,
    Fraction,
    Length,
    Positive,
    Temperature,
    TemperatureCoefficient,
    ThermalResistance,
    Voltage,
    WavelengthShift,
)
from nir_render.scene.documents.curves import CurveDocument, Points, check_ends, parse_points, write_points
from nir_render.scene.documents.files import PresetDocument
from nir_render.scene.text.units import CURRENT
from nir_render.spectra.curve import Curve
from nir_render.spectra.led import led_spectrum, power_at_current


class Led(PresetDocument):
    """An LED: its spectrum as its data sheet measures it, and how heat and current change it.

    The spectrum is a `centroid`, an `fwhm` and a `skew` (0: a Gaussian; a peak at longer wavelengths than the
    centroid is a negative one), or a `table`. It holds at `reference_temperature` of the junction and at
    `reference_current`, and so does the source's flux. With the junction's temperature the spectrum moves as
    a whole by `wavelength_shift`, the flux changes by `power_shift`, in proportion; with the current the flux
    follows `power_at_current`: points of [current, relative flux], straight on logarithmic axes. The junction
    has `junction_temperature`, or what `ambient_temperature` + `thermal_resistance` × voltage × `current` ×
    `duty` makes of it: so current moves the spectrum too. The voltage is `forward_voltage`, that at the
    reference current, or follows `voltage_at_current`, points of [current, volts], straight between them.
    Outside `coolest` … `hottest` and the points over current nothing is known: refused.
    """

    preset_folder: ClassVar[str] = "leds"

    centroid_m: Annotated[Length, Positive] | None = None
    fwhm_m: Annotated[Length, Positive] | None = None
    skew: Annotated[Fraction, Field(gt=-1, lt=1)] = 0.0
    table: CurveDocument | None = None
    reference_temperature_k: Annotated[Temperature, Positive] = 298.15
    junction_temperature_k: Annotated[Temperature, Positive] | None = None
    ambient_temperature_k: Annotated[Temperature, Positive] | None = None
    coolest_k: Annotated[Temperature, Positive] = 233.15
    hottest_k: Annotated[Temperature, Positive] = 373.15
    wavelength_shift_m_per_k: WavelengthShift = 0.0
    power_shift_per_k: TemperatureCoefficient = 0.0
    reference_current_a: Annotated[Current, Positive] | None = None
    current_a: Annotated[Current, Positive] | None = None
    power_at_current_a: Points | None = None
    thermal_resistance_k_per_w: Annotated[ThermalResistance, Positive] | None = None
    forward_voltage_v: Annotated[Voltage, Positive] | None = None
    voltage_at_current_a: Points | None = None
    duty: Annotated[Fraction, Field(gt=0, le=1)] = 1.0

    @field_validator("power_at_current_a", "voltage_at_current_a", mode="before")
    @classmethod
    def _parse_currents(cls, points: Any) -> Any:
        return None if points is None else parse_points(points, CURRENT, "current", "['100 mA', 1]")

    @field_serializer("power_at_current_a", "voltage_at_current_a")
    def _write_currents(self, points: Points | None) -> list[list[Any]] | None:
        return write_points(points, CURRENT)

    @model_validator(mode="after")
    def _one_spectrum(self) -> Self:
        figures = (self.centroid_m, self.fwhm_m)
        if (self.table is None) == (None in figures):
            raise ValueError(
                "wanted 'centroid' and 'fwhm' (with 'skew'), or a 'table', such as "
                "{centroid: 940 nm, fwhm: 42 nm}; set the others to null"
            )
        if self.table is not None and self.table.points is None:
            raise ValueError("table: wanted 'points' or 'file', the spectrum over wavelength")
        if self.table is not None:
            check_ends(self.table.points, "table: it")
        return self

    @model_validator(mode="after")
    def _current_is_known(self) -> Self:
        if self.current_a is None:
            return self
        if self.power_at_current_a is None or self.reference_current_a is None:
            raise ValueError(
                "current: what it does to the flux is not known; give 'reference_current' and "
                "'power_at_current', such as [['10 mA', 0.1], ['100 mA', 1]]"
            )
        powers = [power for _, power in self.power_at_current_a]
        if min(powers) <= 0.0 or self.power_at_current_a[0][0] <= 0.0:
            raise ValueError("power_at_current: wanted currents and relative fluxes above 0")
        for key, current_a in (("current", self.current_a), ("reference_current", self.reference_current_a)):
            _within(key, current_a, "power_at_current", self.power_at_current_a)
        return self

    @model_validator(mode="after")
    def _junction_is_known(self) -> Self:
        if self.ambient_temperature_k is not None:
            if self.junction_temperature_k is not None:
                raise ValueError(
                    "write either 'junction_temperature' or 'ambient_temperature', from which it follows; "
                    "set the other to null"
                )
            voltage = self.forward_voltage_v or self.voltage_at_current_a
            if None in (self.thermal_resistance_k_per_w, voltage, self._current_in_use_a):
                raise ValueError(
                    "ambient_temperature: the junction's follows by 'thermal_resistance', "
                    "'forward_voltage' or 'voltage_at_current', and 'current'; give them, or "
                    "'junction_temperature' in its place"
                )
            self._check_voltage()
        if not self.coolest_k <= self.temperature_k <= self.hottest_k:
            raise ValueError(
                f"the junction is at {self.temperature_k:.5g} K, outside the {self.coolest_k:g} to "
                f"{self.hottest_k:g} K where this LED's figures hold ('coolest', 'hottest'); drive it less, "
                "or give its ambient or junction temperature"
            )
        if self.relative_power <= 0.0:
            raise ValueError(
                f"power_shift leaves no light at {self.temperature_k:.5g} K; check it: -0.3 %/K is usual"
            )
        return self

    def _check_voltage(self) -> None:
        """Raise ValueError where the voltage at the current in use is not known."""
        current_a = self._current_in_use_a
        assert current_a is not None
        if self.voltage_at_current_a is not None:
            if self.forward_voltage_v is not None:
                raise ValueError(
                    "write either 'forward_voltage' or 'voltage_at_current'; set the other to null"
                )
            _within("current", current_a, "voltage_at_current", self.voltage_at_current_a)
        elif self.current_a is not None and self.current_a != self.reference_current_a:
            raise ValueError(
                f"forward_voltage is that at the reference current; what it is at {current_a:g} A is not "
                "known, and so neither is the heat: give 'voltage_at_current', such as "
                "[['100 mA', 1.5], ['1 A', 2.3]], in its place, or 'junction_temperature'"
            )

    @property
    def _current_in_use_a(self) -> float | None:
        return self.reference_current_a if self.current_a is None else self.current_a

    @property
    def temperature_k(self) -> float:
        """The temperature of the junction."""
        if self.junction_temperature_k is not None:
            return self.junction_temperature_k
        if self.ambient_temperature_k is None:
            return self.reference_temperature_k
        current_a = self._current_in_use_a
        assert current_a is not None
        assert self.thermal_resistance_k_per_w is not None
        volts = self.forward_voltage_v
        if self.voltage_at_current_a is not None:
            currents_a, voltages_v = np.array(self.voltage_at_current_a).T
            volts = float(np.interp(current_a, currents_a, voltages_v))
        assert volts is not None
        heat_w = volts * current_a * self.duty
        return self.ambient_temperature_k + self.thermal_resistance_k_per_w * heat_w

    @property
    def shift_m(self) -> float:
        """How far the spectrum has moved to longer wavelengths from where its figures stand."""
        return self.wavelength_shift_m_per_k * (self.temperature_k - self.reference_temperature_k)

    @property
    def relative_power(self) -> float:
        """The flux over that at the reference temperature and current."""
        heated = 1.0 + self.power_shift_per_k * (self.temperature_k - self.reference_temperature_k)
        if self.current_a is None or self.power_at_current_a is None or self.reference_current_a is None:
            return heated
        driven, measured = power_at_current(
            [self.current_a, self.reference_current_a], self.power_at_current_a
        )
        return float(heated * driven / measured)

    def curve(self, name: str) -> Curve:
        """Return the spectrum at the junction's temperature, of any scale."""
        if self.table is not None:
            known = self.table.curve(name)
            return Curve(known.wavelength_m + self.shift_m, known.value, name)
        assert self.centroid_m is not None
        assert self.fwhm_m is not None
        return led_spectrum(self.centroid_m + self.shift_m, self.fwhm_m, self.skew, name)


def _within(key: str, current_a: float, table: str, points: Points) -> None:
    least_a, most_a = points[0][0], points[-1][0]
    if not least_a <= current_a <= most_a:
        raise ValueError(
            f"{key}: {current_a:g} A lies outside the {least_a:g} to {most_a:g} A of {table!r}; data are "
            "not extrapolated: take one within, or give more points"
        )


class UnitOffset(Document):
    """By what one source differs from its type: its `flux` by a factor, its spectrum by so much `wavelength`.

    A calibration is of the type and knows nothing of it.
    """

    example: ClassVar[str] = "{flux: 1.1, wavelength: 3 nm}"

    flux: Annotated[Fraction, Field(gt=0, le=100)] = 1.0
    wavelength_m: Annotated[Length, Field(ge=-100e-9, le=100e-9)] = 0.0


class SpectrumDocument(CurveDocument):
    """The spectrum of a source: that of an `led`, or a curve of any scale."""

    forms: ClassVar[tuple[str, ...]] = (*CurveDocument.forms, "led")

    led: Led | None = None

    @property
    def relative_power(self) -> float:
        """What the LED's temperature and current leave of the source's flux, 1 of any other spectrum."""
        return 1.0 if self.led is None else self.led.relative_power

    @model_validator(mode="after")
    def _has_an_end(self) -> Self:
        if self.constant is not None:
            raise ValueError(
                f"{shown(self.constant)}: a spectrum needs a shape; "
                "write 'led', 'gaussian', 'points' or 'file'"
            )
        check_ends(self.points, "the table")
        return self

    def curve(self, name: str) -> Curve:
        """Return the curve, which errors call by `name`."""
        return super().curve(name) if self.led is None else self.led.curve(name)
