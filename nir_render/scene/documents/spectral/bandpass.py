"""The model of an interference filter: a few figures, or a measured table."""

import math
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, field_validator, model_validator

from nir_render.scene.documents.base import Angle, Fraction, Length, Positive, Temperature, WavelengthShift
from nir_render.scene.documents.curves import CurveDocument, check_ends
from nir_render.scene.documents.files import PresetDocument
from nir_render.spectra.bandpass import blue_shift, cavities_of_edge, transmission, width_at_half_m
from nir_render.spectra.curve import Curve

_LEAST_OF_PEAK = 0.01  # what counts as in band
_FINEST_M = 0.02e-9  # steps of integrals over tables


class Bandpass(PresetDocument):
    """An interference filter, in front of the lens or behind it.

    At normal incidence and `reference_temperature` its transmission is a `table`, or a passband of
    `peak_transmission` about `centre`, `fwhm` wide, with flanks of so many `cavities` (1: Lorentzian) or of
    an `edge`, from 90 to 10 % of the peak. `blocking_od` is the optical density out of band; data sheets
    state the least. `effective_index` sets the blue shift with the angle (λ_c = λ_0 √(1 − (sin θ / n_eff)²)),
    `wavelength_shift` how far all moves per kelvin. Behind the lens the angle is that of the chief ray,
    linear in image height up to `chief_ray_angle_at_corner`, averaged over the lens's cone; in front of it,
    the field angle. Where a table ends `blocking_od` stands, if it is given; else nothing is known.
    """

    preset_folder: ClassVar[str] = "filters"

    placement: Literal["behind_lens", "in_front_of_lens"]
    table: CurveDocument | None = None
    centre_m: Annotated[Length, Positive] | None = None
    fwhm_m: Annotated[Length, Positive] | None = None
    peak_transmission: Annotated[Fraction, Field(gt=0, le=1)] | None = None
    effective_index: Annotated[float, Field(ge=1, le=1e9)]
    cavities: Annotated[int, Field(ge=1, le=10)] = 3
    edge_m: Annotated[Length, Positive] | None = None
    blocking_od: Annotated[float, Field(gt=0, le=100)] | None = None
    chief_ray_angle_at_corner_rad: Annotated[Angle, Field(ge=0, lt=math.pi / 2)] = 0.0
    wavelength_shift_m_per_k: WavelengthShift = 0.0
    reference_temperature_k: Annotated[Temperature, Positive] = 298.15
    temperature_k: Annotated[Temperature, Field(ge=150, le=420)] = 298.15

    @field_validator("table")
    @classmethod
    def _transmits(cls, table: CurveDocument | None) -> CurveDocument | None:
        if table is not None:
            values = [value for _, value in table.points or ()]
            if not values or max(values) > 1.0 or max(values) == 0.0:
                raise ValueError(
                    "wanted 'points' or 'file': transmissions up to 1, not 0 everywhere; write 92 % as 0.92"
                )
            check_ends(table.points, "the table")
        return table

    @model_validator(mode="after")
    def _table_or_figures(self) -> Self:
        figures = {"centre": self.centre_m, "fwhm": self.fwhm_m, "peak_transmission": self.peak_transmission}
        if self.table is None:
            missing = [
                key for key, value in {**figures, "blocking_od": self.blocking_od}.items() if value is None
            ]
            if missing:
                raise ValueError(
                    f"{missing[0]}: this key is missing; write it, or a 'table' of the transmission"
                )
            return self
        too_much = [key for key, value in {**figures, "edge": self.edge_m}.items() if value is not None]
        if too_much:
            raise ValueError(
                f"{too_much[0]}: a 'table' tells it; leave it out, or set it to null where a preset has it"
            )
        return self

    @property
    def shift_m(self) -> float:
        """How far the passband has moved with the temperature, at normal incidence."""
        return self.wavelength_shift_m_per_k * (self.temperature_k - self.reference_temperature_k)

    @property
    def step_m(self) -> float:
        """A step of wavelengths that resolves the passband and its flanks."""
        if self.table is None:
            assert self.fwhm_m is not None
            width_m = self.fwhm_m if self.edge_m is None else min(self.fwhm_m, 10.0 * self.edge_m)
            return width_m / 100.0
        known = self._table()
        finest_m = float(np.diff(known.wavelength_m).min())
        width_m = width_at_half_m(known.wavelength_m, known.value)
        return max(min(width_m / 100.0, finest_m), _FINEST_M)

    def band_m(self, cos_angle: float) -> tuple[float, float]:
        """Return between which wavelengths more than 1 % of the peak pass, at angles up to one."""
        if self.table is not None:
            known = self._table()
            above = np.flatnonzero(known.value > _LEAST_OF_PEAK * known.value.max())
            first, last = max(above[0] - 1, 0), min(above[-1] + 1, len(known.value) - 1)
            low_m, high_m = known.wavelength_m[first] + self.shift_m, known.wavelength_m[last] + self.shift_m
            return float(low_m * blue_shift(cos_angle, self.effective_index)), float(high_m)
        assert self.centre_m is not None
        assert self.fwhm_m is not None
        reach = (1.0 / _LEAST_OF_PEAK - 1.0) ** (0.5 / self._cavities)
        centre_m, half_m = self.centre_m + self.shift_m, 0.5 * self.fwhm_m * reach
        return float(centre_m * blue_shift(cos_angle, self.effective_index) - half_m), centre_m + half_m

    def transmission(self, wavelength_m: ArrayLike, cos_angle: ArrayLike) -> NDArray[np.float64]:
        """Return the transmission at wavelengths in vacuum and cosines in air; they broadcast.

        Beyond a table it is the floor of `blocking_od`, 0 where that is not given.
        """
        if self.table is not None:
            floor = 0.0 if self.blocking_od is None else 10.0**-self.blocking_od
            return self._of_table(wavelength_m, cos_angle, floor)
        return self._of_figures(wavelength_m, cos_angle, self.blocking_od)

    def unblocked_m(self) -> tuple[float, float] | None:
        """Return the ends of a table beyond which nothing is known; None where nothing is left unknown."""
        if self.table is None or self.blocking_od is not None:
            return None
        known = self._table()
        return known.low_m + self.shift_m, known.high_m + self.shift_m

    def bounds(
        self, wavelength_m: ArrayLike, cos_angle: ArrayLike
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return between what the transmission is known to lie.

        Out of band from nothing to the floor of `blocking_od`, which data sheets state as the least; beyond a
        table from nothing to that floor, and to 1 where it is not given.
        """
        if self.table is None:
            return self._of_figures(wavelength_m, cos_angle, None), self.transmission(wavelength_m, cos_angle)
        most = 1.0 if self.blocking_od is None else 10.0**-self.blocking_od
        return self._of_table(wavelength_m, cos_angle, 0.0), self._of_table(wavelength_m, cos_angle, most)

    def _of_figures(
        self, wavelength_m: ArrayLike, cos_angle: ArrayLike, blocking_od: float | None
    ) -> NDArray[np.float64]:
        assert self.centre_m is not None
        assert self.fwhm_m is not None
        assert self.peak_transmission is not None
        return transmission(
            wavelength_m,
            cos_angle,
            centre_m=self.centre_m + self.shift_m,
            fwhm_m=self.fwhm_m,
            peak=self.peak_transmission,
            effective_index=self.effective_index,
            cavities=self._cavities,
            blocking_od=math.inf if blocking_od is None else blocking_od,
        )

    @property
    def _cavities(self) -> float:
        assert self.fwhm_m is not None
        return self.cavities if self.edge_m is None else cavities_of_edge(self.edge_m, self.fwhm_m)

    def _of_table(self, wavelength_m: ArrayLike, cos_angle: ArrayLike, beyond: float) -> NDArray[np.float64]:
        """Return the table, read at the wavelength that moves to the one asked for at this angle."""
        known = self._table()
        at_normal_m = np.asarray(wavelength_m, float) / blue_shift(cos_angle, self.effective_index)
        return np.interp(at_normal_m - self.shift_m, known.wavelength_m, known.value, beyond, beyond)

    def _table(self) -> Curve:
        assert self.table is not None
        return self.table.curve("the filter's table")
